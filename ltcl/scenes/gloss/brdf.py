# SPDX-License-Identifier: BSD-3-Clause
"""Glossy reflection that keeps all light and obeys reciprocity, exactly, in bins of directions.

    pi f(u, v) = albedo ((1 - gloss) + gloss s(u) p(u, v) s(v)),    p = (h . normal)^exponent

with h halfway between the directions u and v: a matte part and the lobe of Blinn, "Models of light
reflection for computer synthesized pictures", SIGGRAPH 1977. Any lobe as it stands sends more light to some
sides than to others; the scale s sets that right. It is found in the bins (`directions`), where
each row of s p s must have the mean 1: the symmetric Sinkhorn scaling of a positive matrix, which always
exists. Then f(u, v) = f(v, u), and exactly the share `albedo` of light from any side comes back.

Between bins s follows from the same condition, s(u) = 1 / mean_m p(u, m) s(m), so single directions (camera,
projector) see a lobe as sharp as it is, and no light is made for them either.

Known limit: light between bins is spread over a whole bin; lobes much narrower than one are refused.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltcl import checks
from ltcl.errors import InputError
from ltcl.scenes.gloss.directions import lattice

POINTS = 4  # along a bin, over which its mean is taken
SHARPEST = 8  # exponent per bin: lobes down to half a bin's width, two points of a bin
_ROUNDS, _CLOSE = 1000, 1e-14  # of the scaling


@dataclass(frozen=True, eq=False)
class Lobe:
    """The part s p s of a material, between k x k bins and any other directions; mean 1 over the bins.

    Attributes
    ----------
    exponent : float
    places : ndarray, (M, points, 3)
        Directions over which means of bins are taken.
    scale : ndarray, (M,)
        s in the bins.
    between : ndarray, (M, M)
        Symmetric; every row and column has the mean 1.
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
        return self._scale_of(u) * _blinn(u, v, self.exponent) * self._scale_of(v)

    def _scale_of(self, vectors: np.ndarray) -> np.ndarray:
        return 1.0 / (_bin_means(vectors, self.places, self.exponent) @ self.scale / len(self.scale))


def lobe(exponent: float, k: int) -> Lobe:
    """The lobe of an exponent over k x k bins.

    Raises
    ------
    InputError
        If the exponent is not above 0, or so high that the bins cannot show the lobe.

    Examples
    --------
    >>> shine = lobe(20, k=4)
    >>> bool(np.allclose(shine.between.mean(axis=0), 1)), bool((shine.between == shine.between.T).all())
    (True, True)
    """
    exponent = checks.number("exponent", exponent, above=0.0)
    if exponent > SHARPEST * k * k:
        raise InputError(
            f"exponent is {exponent:g}; it must be at most {SHARPEST * k * k} for {k * k} directions, "
            "which cannot show a sharper lobe; raise directions"
        )
    places = lattice(k, POINTS)
    means = np.stack([_bin_means(own, places, exponent).mean(axis=0) for own in places])
    means = (means + means.T) / 2  # rounding
    scale = _symmetric_scale(means)
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


def _symmetric_scale(matrix: np.ndarray) -> np.ndarray:
    """s such that every row of s matrix s has the mean 1."""
    scale = np.ones(len(matrix))
    for _ in range(_ROUNDS):
        means = scale * (matrix @ scale) / len(matrix)
        scale = scale / np.sqrt(means)
        if np.abs(means - 1).max() < _CLOSE:
            break
    return scale
