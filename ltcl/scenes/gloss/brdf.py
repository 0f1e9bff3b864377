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

_POINTS = 4  # along a bin, over which its mean is taken
_SHARPEST = 8  # exponent per bin: lobes down to half a bin's width, two points of a bin
_ROUNDS, _CLOSE = 1000, 1e-14  # of the scaling


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
    steep = np.abs(a) <= np.abs(b)
    radius = np.where(steep, b, a)  # signed
    ratio = np.divide(np.where(steep, a, b), radius, out=np.zeros_like(radius), where=radius != 0)
    angle = np.pi / 4 * ratio
    along, across = radius * np.cos(angle), radius * np.sin(angle)
    z = np.sqrt(np.maximum(0.0, 1.0 - radius**2))
    return np.stack([np.where(steep, across, along), np.where(steep, along, across), z], axis=-1)


def bins(vectors: np.ndarray, k: int) -> np.ndarray:
    """Numbers (...) of the bins, of k x k, that unit vectors (..., 3) fall into; undoes `from_square`."""
    x, y = vectors[..., 0], vectors[..., 1]
    steep = np.abs(x) <= np.abs(y)
    radius = np.hypot(x, y) * np.sign(np.where(steep, y, x))
    slope = np.divide(
        np.where(steep, x, y), np.where(steep, y, x), out=np.zeros_like(x), where=radius != 0
    )
    other = radius * np.arctan(slope) * 4 / np.pi
    column, row = (
        np.clip(((place + 1) / 2 * k).astype(np.intp), 0, k - 1)
        for place in (np.where(steep, other, radius), np.where(steep, radius, other))
    )
    return column * k + row


@dataclass(frozen=True, eq=False)
class Lobe:
    """The part s p s of a material, between k x k bins and any other directions; mean 1 over the bins.

    `places` (M, points, 3) are the directions over which means of bins are taken, `scale` (M,) is s
    in the bins, and `between` (M, M) is symmetric, with the mean 1 in every row and column.
    """

    exponent: float
    places: np.ndarray
    scale: np.ndarray
    between: np.ndarray

    def towards(self, vectors: np.ndarray) -> np.ndarray:
        """Between single directions (N, 3), z >= 0, and the bins: (N, M), rows of mean 1."""
        values = _bin_means(vectors, self.places, self.exponent) * self.scale
        return values / values.mean(axis=1, keepdims=True)

    def direct(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Between pairs of single directions, (N, 3) each: (N,)."""
        scales = (
            1.0 / (_bin_means(vectors, self.places, self.exponent) @ self.scale / len(self.scale))
            for vectors in (u, v)
        )
        return _blinn(u, v, self.exponent) * next(scales) * next(scales)


def lobe(exponent: float, k: int) -> Lobe:
    """The lobe of an exponent over k x k bins; InputError: not above 0, or too sharp for the bins to show.

    >>> shine = lobe(20, k=4)
    >>> (
    ...     bool(np.allclose(shine.between.mean(axis=0), 1)),
    ...     bool((shine.between == shine.between.T).all()),
    ... )
    (True, True)
    """
    exponent = checks.number("exponent", exponent, above=0.0)
    if exponent > _SHARPEST * k * k:
        raise InputError(
            f"exponent is {exponent:g}; it must be at most {_SHARPEST * k * k} for {k * k} directions, "
            "which cannot show a sharper lobe; raise directions"
        )
    place = ((np.arange(k)[:, None] + (np.arange(_POINTS) + 0.5) / _POINTS) / k).ravel()
    square = np.stack(
        np.meshgrid(place, place, indexing="ij"), axis=-1
    )  # spread evenly over each bin
    cells = square.reshape(k, _POINTS, k, _POINTS, 2).swapaxes(1, 2)
    places = from_square(cells.reshape(k * k, _POINTS**2, 2))
    means = np.stack([_bin_means(own, places, exponent).mean(axis=0) for own in places])
    means = (means + means.T) / 2  # rounding
    scale = np.ones(len(means))
    for _ in range(_ROUNDS):
        rows = scale * (means @ scale) / len(means)
        scale = scale / np.sqrt(rows)
        if np.abs(rows - 1).max() < _CLOSE:
            break
    return Lobe(exponent, places, scale, np.outer(scale, scale) * means)


def _blinn(u: np.ndarray, v: np.ndarray, exponent: float) -> np.ndarray:
    """(h . normal)^exponent of directions (..., 3) that broadcast."""
    half = u + v
    # Two grazing directions opposite to each other mirror one another: h is the normal.
    length = np.linalg.norm(half, axis=-1)
    cosine = np.divide(half[..., 2], length, out=np.ones_like(length), where=length > 1e-12)
    return np.maximum(cosine, 0.0) ** exponent


def _bin_means(vectors: np.ndarray, places: np.ndarray, exponent: float) -> np.ndarray:
    """p of directions (N, 3) averaged over each bin, (N, M)."""
    means = [_blinn(v, places, exponent).mean(axis=1) for v in vectors]
    return np.reshape(means, (len(vectors), len(places)))
