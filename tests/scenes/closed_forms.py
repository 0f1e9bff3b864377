# SPDX-License-Identifier: BSD-3-Clause
"""Form factors known otherwise: closed forms at right angles, random points, closed rooms.

Sources: Ehlert and Smith, "View factors for perpendicular and parallel rectangular plates", J.
Thermophysics and Heat Transfer 7(1), 1993; C-13 and C-15 in Howell, "A catalog of radiation heat
transfer configuration factors".
"""

from __future__ import annotations

import numpy as np
import scipy.special

from ltcl.scenes import Block
from ltcl.scenes.walls import Vector, Wall, vector
from tests import reference


def parallel(n: int, gap: int) -> np.ndarray:
    """F of unit squares x, y apart in planes `gap` apart, (n, n): differences by C-13."""
    x = np.arange(-1.0, n + 1)[:, None]
    y = np.arange(-1.0, n + 1)
    across_x = np.hypot(x, gap)
    across_y = np.hypot(y, gap)
    arcs = y * across_x * np.arctan2(y, across_x) + x * across_y * np.arctan2(x, across_y)
    primitive = (arcs - gap**2 / 2 * np.log(x**2 + y**2 + gap**2)) / (2 * np.pi)
    return np.diff(np.diff(primitive, 2, axis=0), 2, axis=1)


def perpendicular(n: int) -> np.ndarray:
    """F of unit squares d apart along a seam, p and q away, (n, n, n): C-15, exact below 8."""
    d = np.arange(-1.0, n + 1)[:, None, None]
    p = np.arange(n + 1.0)[:, None]
    q = np.arange(n + 1.0)
    across = np.hypot(p, q)
    log = scipy.special.xlogy(across**2 - d**2, across**2 + d**2) / 4
    primitive = (d * across * np.arctan2(d, across) - log) / (2 * np.pi)
    return -np.diff(np.diff(np.diff(primitive, 2, axis=0), axis=1), axis=2)


def slope(angle: float, length: float = 1.0, width: float = 1.0) -> Wall:
    """A wall that rises from the edge of the floor along y, `angle` degrees from the floor."""
    x = length * float(np.cos(np.radians(angle)))
    z = length * float(np.sin(np.radians(angle)))
    return Wall("slope", corner=(x, 0.0, z), right=(0, width, 0), down=(-x, 0.0, -z))


def closed_room(*edges: Vector) -> list[Wall]:
    """The six faces of a parallelepiped, seen from inside."""
    walls = []
    for k in range(3):
        p, q, across = (np.array(edges[(k + i) % 3], np.float64) for i in range(3))
        if np.cross(q, p) @ across < 0:
            p, q = q, p
        walls.append(Wall(f"low {k}", (0, 0, 0), vector(p), vector(q)))
        walls.append(Wall(f"high {k}", vector(across), vector(q), vector(p)))
    return walls


def sampled(
    first: Wall, second: Wall, samples: int, block: Block | None = None
) -> tuple[float, float]:
    """a_i F_ij between whole walls by random pairs of points, and its standard error."""
    rng = np.random.default_rng(0)
    x, y = (wall.points(*rng.random((2, samples))) for wall in (first, second))
    ray = y - x
    r2 = np.einsum("ki,ki->k", ray, ray)
    kernel = (
        np.maximum(ray @ first.normal, 0) * np.maximum(-ray @ second.normal, 0) / (np.pi * r2**2)
    )
    kernel *= first.area * second.area
    if block is not None:
        box = np.concatenate([block.low + block.high, block.high - block.low]) / 2
        box[3:] *= 1 - 1e-9  # its faces see past their edges
        kernel[reference.blocked(x, y, box[None])] = 0
    return float(kernel.mean()), float(kernel.std() / np.sqrt(samples))
