# SPDX-License-Identifier: BSD-3-Clause
"""Random small scenes and cameras, which sketches are made of: shared by benches of faults."""

from __future__ import annotations

from typing import Any

import numpy as np

from acquire import corner
from ltcl import Transport, scenes

# Scenes, and the sides of their walls in projector pixels.
SIDES = {
    "corner": (10, 13),
    "square corner": (14, 18),
    "two walls and a floor": (8, 10),
    "with a block": (8, 10),
}
PAINTS = ("white", "painted smoothly", "painted by pixels")
RESPONSES = ("linear", "srgb", "film")
BITS = (8, 10, 12)
# The same seed makes the same scene.
SEED = 77


def random_scene(number: int) -> tuple[str, np.ndarray, tuple[int, int]]:
    """A scene of 192 to 648 pixels: its name, its T in float64, and its grid."""
    random = np.random.default_rng((SEED, number))
    name = list(SIDES)[number % len(SIDES)]
    side = int(random.integers(*SIDES[name]))
    albedo = float(random.uniform(0.3, 0.9))
    if name == "square corner":
        dense = corner(side, albedo)
        grid = (side, side)
    else:
        T = walls(name, side, albedo, random).transport()
        dense = dense_matrix(T)
        grid = T.grid
    paint = PAINTS[int(random.integers(len(PAINTS)))]
    reflectance = np.ones(len(dense))
    if paint == "painted smoothly":
        height, width = grid
        y, x = np.mgrid[:height, :width] / max(grid)
        frequency = random.uniform(2.0, 10.0)
        reflectance = (0.65 + 0.35 * np.sin(frequency * x + 5.0 * y)).ravel()
    if paint == "painted by pixels":
        reflectance = random.uniform(0.3, 1.0, len(dense))
    return f"{name}, {paint}", reflectance[:, None] * dense, grid


def walls(name: str, side: int, albedo: float, random: np.random.Generator) -> scenes.Scene:
    """A scene by its name."""
    if name == "corner":
        return scenes.dihedral(side, albedo=albedo)
    block = None
    if name == "with a block":
        x, y = random.uniform(0.2, 0.5, 2)
        block = scenes.Block((x, y, 0.0), tuple(random.uniform(0.2, 0.4, 3)), albedo=albedo)
    return scenes.box(side, 3, albedo=albedo, occluder=block)


def dense_matrix(T: Transport) -> np.ndarray:
    """T of a scene of one channel, (N, N) float64."""
    n = T.shape[1]
    pixels = np.eye(n).reshape(n, *T.grid)
    return np.asarray(T @ pixels, np.float64).reshape(n, n).T


def random_camera(number: int) -> dict[str, Any]:
    """Options of a virtual camera."""
    random = np.random.default_rng((SEED, number, 1))
    return {
        "response": RESPONSES[int(random.integers(len(RESPONSES)))],
        "bits": BITS[int(random.integers(len(BITS)))],
        "gain": float(random.uniform(2000.0, 20000.0)),
        "read": float(random.uniform(0.0003, 0.002)),
    }
