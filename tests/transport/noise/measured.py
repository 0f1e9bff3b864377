# SPDX-License-Identifier: BSD-3-Clause
"""Five scenes whose transports are known, and measurements of them with noise that is known."""

from __future__ import annotations

from functools import cache

import numpy as np

import ltcl
from ltcl import scenes
from ltcl.transport.noise import Noise

SCENES = ("corner", "painted", "box", "occluded", "glossy")
N = 12


@cache
def truth(name: str, n: int = N) -> ltcl.Transport:
    """T of a scene without noise: two walls, three painted ones, three, with a block, glossy."""
    block = scenes.Block((0.3, 0.3, 0.2), (0.3, 0.3, 0.3))
    if name == "corner":
        scene = scenes.dihedral(n, albedo=0.6)
    elif name == "painted":
        scene = scenes.trihedral(n, albedo=[[0.9], [0.3], [0.6]])
    elif name == "box":
        scene = scenes.box(n, 3, albedo=0.7)
    elif name == "occluded":
        scene = scenes.box(n, 3, albedo=0.7, occluder=block)
    else:
        corner = scenes.dihedral(n)
        scene = scenes.glossy(corner, n, albedo=0.6, gloss=0.4, projector=(0.5, 0.8, 1.5))
    T = scene.transport()
    return ltcl.Transport(T.to_numpy().astype(np.float64), T.grid)


def noise_of(T: ltcl.Transport, level: float, photons: float = 0.0) -> Noise:
    """A floor of `level` times the median first bounce, and `photons` times its variance."""
    median = float(np.median(T.first_bounce))
    return Noise.uniform(T.shape, level * median, photons * level**2 * median)


def measure(T: ltcl.Transport, noise: Noise, seed: int, known: bool = True) -> ltcl.Transport:
    """T with errors of this noise; `known`: the transport is told its noise."""
    entries = T.to_numpy()
    normal = np.random.default_rng(seed).standard_normal(entries.shape)
    measured = entries + normal * np.sqrt(noise.variance(entries))
    return ltcl.Transport(measured.astype(np.float32), T.grid, noise=noise if known else None)
