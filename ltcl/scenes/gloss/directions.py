# SPDX-License-Identifier: BSD-3-Clause
"""Directions over a patch, cut into bins that all receive the same light from a uniform sky.

A direction (x, y, z), z along the normal, is known by its shadow (x, y) on the unit disk, and equal areas
of the disk are equal projected solid angles (Nusselt). The concentric map of Shirley and Chiu, "A low
distortion map between disk and square", J. Graphics Tools 2(3), 1997, turns the disk into the unit square
and keeps ratios of areas; k x k cells of the square are then M = k^2 bins of pi / M projected steradian
each. Bin number: column * k + row, columns along x. So irradiance is pi times the mean radiance of the bins,
and light that is the same in all directions is the same number in all bins, exactly.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError

LEAST = 4


def side(directions: Any) -> int:
    """k of k x k bins.

    Raises
    ------
    InputError
        If directions is no square number of at least 4.

    Examples
    --------
    >>> side(64)
    8
    """
    k = math.isqrt(checks.count("directions", directions, least=LEAST))
    if k * k != directions:
        raise InputError(f"directions is {directions}; it must be a square number: 16, 36, 64, ...")
    return k


def from_square(square: np.ndarray) -> np.ndarray:
    """Unit vectors (..., 3), z >= 0, of points (..., 2) of the unit square.

    Examples
    --------
    >>> from_square(np.array([0.5, 0.5]))  # the middle looks along the normal
    array([0., 0., 1.])
    """
    a, b = np.moveaxis(2.0 * square - 1.0, -1, 0)
    steep = np.abs(a) <= np.abs(b)
    radius = np.where(steep, b, a)  # signed
    ratio = np.divide(np.where(steep, a, b), radius, out=np.zeros_like(radius), where=radius != 0)
    angle = np.pi / 4 * ratio
    along, across = radius * np.cos(angle), radius * np.sin(angle)
    z = np.sqrt(np.maximum(0.0, 1.0 - radius**2))
    return np.stack([np.where(steep, across, along), np.where(steep, along, across), z], axis=-1)


def to_square(vectors: np.ndarray) -> np.ndarray:
    """Points (..., 2) of the unit square of unit vectors (..., 3); undoes `from_square`."""
    x, y = vectors[..., 0], vectors[..., 1]
    steep = np.abs(x) <= np.abs(y)
    radius = np.hypot(x, y) * np.sign(np.where(steep, y, x))
    slope = np.divide(np.where(steep, x, y), np.where(steep, y, x), out=np.zeros_like(x), where=radius != 0)
    other = radius * np.arctan(slope) * 4 / np.pi
    return (np.stack([np.where(steep, other, radius), np.where(steep, radius, other)], axis=-1) + 1) / 2


def bins(vectors: np.ndarray, k: int) -> np.ndarray:
    """Numbers (...) of the bins, of k x k, that unit vectors (..., 3) fall into."""
    column, row = np.moveaxis(np.clip((to_square(vectors) * k).astype(np.intp), 0, k - 1), -1, 0)
    return column * k + row


def lattice(k: int, points: int) -> np.ndarray:
    """Unit vectors (k^2, points^2, 3) spread evenly over each of k x k bins."""
    place = ((np.arange(k)[:, None] + (np.arange(points) + 0.5) / points) / k).ravel()
    square = np.stack(np.meshgrid(place, place, indexing="ij"), axis=-1)  # (k points, k points, 2)
    cells = square.reshape(k, points, k, points, 2).swapaxes(1, 2)
    return from_square(cells.reshape(k * k, points * points, 2))
