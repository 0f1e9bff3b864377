# SPDX-License-Identifier: BSD-3-Clause
"""Closed rooms of parallelograms, and an independent estimate of form factors, for the tests of scenes."""

from __future__ import annotations

import numpy as np

from ltcl.scenes.blocks import Block
from ltcl.scenes.walls import Wall
from tests import reference


def closed_room(*edges: tuple[float, float, float]) -> list[Wall]:
    """The six faces of a parallelepiped, seen from inside."""
    walls = []
    for k in range(3):
        p, q, across = (np.array(edges[(k + i) % 3], np.float64) for i in range(3))
        if np.cross(q, p) @ across < 0:
            p, q = q, p
        walls.append(Wall(f"low {k}", (0, 0, 0), tuple(p), tuple(q)))
        walls.append(Wall(f"high {k}", tuple(across), tuple(q), tuple(p)))
    return walls


def sampled_exchange(
    first: Wall, second: Wall, samples: int, block: Block | None = None
) -> tuple[float, float]:
    """a_i F_ij between whole walls by random pairs of points, and its standard error."""
    rng = np.random.default_rng(0)
    x, y = (
        wall.corner + rng.random((samples, 1)) * wall.right + rng.random((samples, 1)) * wall.down
        for wall in (first, second)
    )
    ray = y - x
    r2 = np.einsum("ki,ki->k", ray, ray)
    kernel = np.maximum(ray @ first.normal, 0) * np.maximum(-ray @ second.normal, 0) / (np.pi * r2**2)
    kernel *= first.area * second.area
    if block is not None:
        box = np.concatenate([block.low + block.high, block.high - block.low]) / 2
        box[3:] *= 1 - 1e-9  # its faces see past their edges
        kernel[reference.blocked(x, y, box[None])] = 0
    return float(kernel.mean()), float(kernel.std() / np.sqrt(samples))
