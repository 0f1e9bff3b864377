# SPDX-License-Identifier: BSD-3-Clause
"""Glossy reflection that keeps all light and obeys reciprocity, exactly, in bins of directions.

A direction (x, y, z), z along the normal, is known by its shadow (x, y) on the unit disk, and equal
areas of the disk are equal projected solid angles (Nusselt). The concentric map of Shirley and
Chiu, "A low distortion map between disk and square", J. Graphics Tools 2(3), 1997, turns the disk
into the unit square and keeps ratios of areas; k x k cells of the square are then M = k^2 bins of
pi / M projected steradian each. Bin number: column * k + row, columns along x. So irradiance is pi
times the mean radiance of the bins.

    pi f(u, v) = albedo ((1 - gloss) + gloss s(u) p(u, v) s(v)),    p = (h . normal)^exponent

with h halfway between the directions u and v: a matte part and the lobe of Blinn, "Models of light
reflection for computer synthesized pictures", SIGGRAPH 1977. Any lobe as it stands sends more light
to some sides than to others; the scale s sets that right: each row of s p s must have the mean 1
over the bins, the symmetric Sinkhorn scaling of a positive matrix, which always exists. Then f(u,
v) = f(v, u), and exactly the share `albedo` of light from any side comes back. Between bins s
follows from the same condition, s(u) = 1 / mean_m p(u, m) s(m), so single directions (camera,
projector) see a lobe as sharp as it is.

Known limit: light between bins is spread over a whole bin; lobes much narrower than one are
refused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError

# Points along a bin, over which its mean is taken.
BIN_POINTS = 4
# Exponent per bin: lobes down to half a bin's width, two points of a bin.
MAX_EXPONENT_PER_BIN = 8
MAX_SCALING_ROUNDS = 1000
SCALING_TOLERANCE = 1e-14
# Sums of two directions shorter than this are those of opposite grazing directions.
OPPOSITE_TOLERANCE = 1e-12


def side(directions: Any) -> int:
    """k of k x k bins, of a square number of at least 4.

    >>> side(64)
    8
    """
    k = math.isqrt(checks.count("directions", directions, least=4))
    if k * k != directions:
        raise InputError(f"directions is {directions}; it must be a square number: 16, 36, 64, ...")
    return k


def from_square(square: np.ndarray) -> np.ndarray:
    """Unit vectors (..., 3), z >= 0, of points (..., 2) of the unit square.

    >>> from_square(np.array([0.5, 0.5]))  # the middle looks along the normal
    array([0., 0., 1.])
    """
    a, b = np.moveaxis(2.0 * square - 1.0, -1, 0)
    is_steep = np.abs(a) <= np.abs(b)
    radius = np.where(is_steep, b, a)  # signed
    shorter = np.where(is_steep, a, b)
    ratio = _ratio(shorter, radius)
    angle = np.pi / 4 * ratio
    along = radius * np.cos(angle)
    across = radius * np.sin(angle)
    x = np.where(is_steep, across, along)
    y = np.where(is_steep, along, across)
    z = np.sqrt(np.maximum(0.0, 1.0 - radius**2))
    return np.stack([x, y, z], axis=-1)


def bins(vectors: np.ndarray, k: int) -> np.ndarray:
    """Numbers (...) of the k x k bins that hold unit vectors (..., 3); undoes `from_square`."""
    x = vectors[..., 0]
    y = vectors[..., 1]
    is_steep = np.abs(x) <= np.abs(y)
    longer = np.where(is_steep, y, x)
    shorter = np.where(is_steep, x, y)
    radius = np.hypot(x, y) * np.sign(longer)
    turn = radius * np.arctan(_ratio(shorter, longer)) * 4 / np.pi
    column = _cell(np.where(is_steep, turn, radius), k)
    row = _cell(np.where(is_steep, radius, turn), k)
    return column * k + row


def _ratio(shorter: np.ndarray, longer: np.ndarray) -> np.ndarray:
    """shorter / longer, or 0 at the middle of the square."""
    return np.divide(shorter, longer, out=np.zeros_like(longer), where=longer != 0)


def _cell(place: np.ndarray, k: int) -> np.ndarray:
    """Numbers of the cells, of k, in which places in [-1, 1] lie."""
    return np.clip(((place + 1) / 2 * k).astype(np.intp), 0, k - 1)


@dataclass(frozen=True, eq=False)
class Lobe:
    """Part s p s of a material, between k x k bins and other directions; mean 1 over the bins.

    `places` (M, points, 3) are the directions over which means of bins are taken, `scale` (M,) is s
    in the bins, and `between` (M, M) is symmetric, with the mean 1 in every row and column.
    """

    exponent: float
    places: np.ndarray
    scale: np.ndarray
    between: np.ndarray

    def towards(self, vectors: np.ndarray) -> np.ndarray:
        """Lobe between single directions (N, 3), z >= 0, and the bins: (N, M), rows of mean 1."""
        values = _bin_means(vectors, self.places, self.exponent) * self.scale
        return values / values.mean(axis=1, keepdims=True)

    def direct(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """The lobe between pairs of single directions, (N, 3) each: (N,)."""
        return _blinn(u, v, self.exponent) * self._scale_of(u) * self._scale_of(v)

    def _scale_of(self, vectors: np.ndarray) -> np.ndarray:
        """The scale s of single directions (N, 3), (N,)."""
        means = _bin_means(vectors, self.places, self.exponent)
        return 1.0 / (means @ self.scale / len(self.scale))


def lobe(exponent: float, k: int) -> Lobe:
    """Lobe of an exponent over k x k bins; InputError if not above 0, or too sharp for the bins.

    >>> shine = lobe(20, k=4)
    >>> (
    ...     bool(np.allclose(shine.between.mean(axis=0), 1)),
    ...     bool((shine.between == shine.between.T).all()),
    ... )
    (True, True)
    """
    exponent = checks.number("exponent", exponent, above=0.0)
    bins = k * k
    largest = MAX_EXPONENT_PER_BIN * bins
    if exponent > largest:
        raise InputError(
            f"exponent is {exponent:g}; it must be at most {largest} for {bins} directions, "
            "which cannot show a sharper lobe; raise directions"
        )
    # Points spread evenly over each bin.
    points = (np.arange(BIN_POINTS) + 0.5) / BIN_POINTS
    place = ((np.arange(k)[:, None] + points) / k).ravel()
    square = np.stack(np.meshgrid(place, place, indexing="ij"), axis=-1)
    cells = square.reshape(k, BIN_POINTS, k, BIN_POINTS, 2).swapaxes(1, 2)
    places = from_square(cells.reshape(bins, BIN_POINTS**2, 2))
    rows = []
    for bin_places in places:
        rows.append(_bin_means(bin_places, places, exponent).mean(axis=0))
    means = np.stack(rows)
    means = (means + means.T) / 2  # symmetric to the bit
    scale = np.ones(bins)
    for _ in range(MAX_SCALING_ROUNDS):
        row_means = scale * (means @ scale) / bins
        scale = scale / np.sqrt(row_means)
        if np.abs(row_means - 1).max() < SCALING_TOLERANCE:
            break
    return Lobe(exponent, places, scale, np.outer(scale, scale) * means)


def _blinn(u: np.ndarray, v: np.ndarray, exponent: float) -> np.ndarray:
    """(h . normal)^exponent of directions (..., 3) that broadcast."""
    half = u + v
    # Two grazing directions opposite to each other mirror one another: h is the normal.
    length = np.linalg.norm(half, axis=-1)
    is_proper = length > OPPOSITE_TOLERANCE
    cosine = np.divide(half[..., 2], length, out=np.ones_like(length), where=is_proper)
    return np.maximum(cosine, 0.0) ** exponent


def _bin_means(vectors: np.ndarray, places: np.ndarray, exponent: float) -> np.ndarray:
    """p of directions (N, 3) averaged over each bin, (N, M)."""
    means = [_blinn(v, places, exponent).mean(axis=1) for v in vectors]
    return np.reshape(means, (len(vectors), len(places)))
