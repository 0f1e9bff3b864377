# SPDX-License-Identifier: BSD-3-Clause
"""Fractal noise and blending, the brushes that `landscape` paints with.

Noise comes from random lattices of a fixed number of cells, so a picture keeps its forms whatever its
resolution. Lattices are blown up with cubic interpolation; each octave has twice the cells and half
the weight of the one before. Everything is float32.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike


def fractal(
    rng: np.random.Generator, shape: tuple[int, int], cells: tuple[float, float], octaves: int
) -> np.ndarray:
    """Fractal noise, `shape` float32, of mean 1/2 and mostly inside [0, 1].

    Parameters
    ----------
    rng : numpy.random.Generator
        Where the lattices come from.
    shape : (height, width)
        Pixels.
    cells : (down, across)
        Cells of the coarsest octave.
    octaves : int
        Number of octaves.

    Examples
    --------
    >>> fractal(np.random.default_rng(1), (4, 6), (2, 3), octaves=2).shape
    (4, 6)
    """
    total = np.zeros(shape, dtype=np.float32)
    for octave in range(octaves):
        # One cell more than asked for on each side, as interpolation needs neighbours.
        lattice = rng.random([int(np.ceil(c * 2**octave)) + 2 for c in cells], dtype=np.float32)
        total += (_blow_up(lattice, shape) - 0.5) * 0.5**octave
    return total * 0.75 + 0.5


def ridged(
    rng: np.random.Generator, shape: tuple[int, int], cells: tuple[float, float], octaves: int
) -> np.ndarray:
    """Noise with sharp crests, rough on high ground and smooth in valleys; arguments as in `fractal`.

    `shape` float32 in [0, 1]. After Musgrave's ridged multifractal (Ebert et al., "Texturing and
    Modeling: A Procedural Approach"): each octave counts as much as the ground below it is high.

    Examples
    --------
    >>> float(ridged(np.random.default_rng(1), (4, 6), (2, 3), octaves=2).max()) <= 1
    True
    """
    total, ground = np.zeros(shape, dtype=np.float32), np.ones(shape, dtype=np.float32)
    for octave in range(octaves):
        folded = np.abs(2 * fractal(rng, shape, (cells[0] * 2**octave, cells[1] * 2**octave), 1) - 1)
        ground = (1 - np.minimum(1.4 * folded, 1)) ** 1.4 * ground
        total += ground * 0.5 ** (octave + 1)
        ground = np.minimum(2 * ground, 1)
    return total / (1 - 0.5**octaves)


def look_up(texture: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Values of a texture (or picture) at column u and row v, mirrored beyond its borders.

    Examples
    --------
    >>> look_up(np.float32([[0, 1], [2, 3]]), np.float32([[0.5]]), np.float32([[1.0]]))
    array([[2.5]], dtype=float32)
    """
    u, v = (np.ascontiguousarray(c, dtype=np.float32) for c in np.broadcast_arrays(u, v))
    return cv2.remap(texture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)


def step(low: float, high: float, x: ArrayLike) -> np.ndarray:
    """Smooth step from 0 at `low` to 1 at `high`; falling if low > high.

    Examples
    --------
    >>> step(0, 1, np.array([-1.0, 0.5, 2.0]))
    array([0. , 0.5, 1. ])
    """
    t = np.clip((np.asarray(x) - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def blend(under: ArrayLike, over: ArrayLike, weight: np.ndarray) -> np.ndarray:
    """Colours laid over others, each (..., 3) or one colour, with a weight (...) in [0, 1].

    Examples
    --------
    >>> blend((0, 0, 0), (1, 0.5, 0), np.array([0.5]))
    array([[0.5 , 0.25, 0.  ]])
    """
    under, over = np.asarray(under, dtype=np.float32), np.asarray(over, dtype=np.float32)
    return under + (over - under) * weight[..., None]


def _blow_up(lattice: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Cubic interpolation of the inner cells of a lattice, (height, width)."""
    rows, columns = lattice.shape
    scale = np.array([[(columns - 2) / shape[1], 0, 0.5], [0, (rows - 2) / shape[0], 0.5]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(lattice, scale, shape[::-1], flags=flags, borderMode=cv2.BORDER_REFLECT)
