# SPDX-License-Identifier: BSD-3-Clause
"""Photographs on the projector's grid: every projector pixel is a weighted mean of the camera pixels near it.

Camera pixels that are smaller than the projector's separate these, by least squares (`unmixing`). Where
they are not, camera pixel m at x_m, with footprint J_m, reaches projector pixel n with the weight

    w_nm = |det J_m| k(d^T Q_m^-1 d),  d = n - x_m,  Q_m = C J_m J_m^T + P I,  k(s) = (1 - s)^2 for s < 1

which is an elliptical filter as wide as the two pixels together: it interpolates, and what is finer than two
projector pixels blurs. All rows sum to one and are corrected to first order (`unmixing.centred`).

A dark pixel beside a bright one, of which few camera pixels were decoded, would be a small difference of two
large numbers. Where what its weights take away of white is more than 0.7 of what they add, errors of the
photographs and of the map are multiplied by 6, and it counts as not seen. Known limit: a pixel of which
0.7 or less is taken away may deviate, too, by more than the noise.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.acquisition.geometry.correspondence import Correspondence
from ltcl.acquisition.geometry.unmixing import centred, jacobian, unmix
from ltcl.errors import InputError

CAMERA = 1.54  # C: wide enough that samples of a square grid surround every place, however large they are
PROJECTOR = 1.1  # P: a kernel as wide as a tent over the projector's pixels
SEEN = 0.05  # of a projector pixel: less is not seen
RESOLVED = 0.9  # part of the answer of least squares that is a pixel's own light
TAKEN = 0.7  # of what is added under white: more of it taken away leaves nothing that is known
PART, HALF = 0.15, 0.5  # of its area, where that is so (less may be an error of the map), and where it is not


@dataclass(frozen=True)
class Resampling:
    """Area-filtered resampling of photographs to the projector's grid.

    Attributes
    ----------
    weights : (N, M) csr_array, float32
        Rows of projector pixels that are seen sum to 1, others are empty. Weights are negative only where
        least squares take away what camera pixels show of a neighbour.
    coverage : (h, w) float32
        What part of each projector pixel camera pixels cover, 0 to 1; with large ones, of its surroundings.
    grid, camera_grid : (h, w), (H, W)
    doubtful : (h, w) bool, optional
        Pixels that count as not seen for what white showed (`ascertained`).

    Examples
    --------
    >>> R = Resampling.of(Correspondence.aligned((4, 5)))
    >>> bool(np.allclose(R.apply(np.full((4, 5), 3.0)), 3.0)), bool(R.seen.all())
    (True, True)
    """

    weights: scipy.sparse.csr_array
    coverage: np.ndarray
    grid: tuple[int, int]
    camera_grid: tuple[int, int]
    doubtful: np.ndarray | None = None

    @classmethod
    def of(cls, mapping: Correspondence) -> Resampling:
        """The resampling by a measured map.

        Raises
        ------
        InputError
            No two neighbouring pixels of the map are valid.
        """
        if not isinstance(mapping, Correspondence):
            raise InputError(f"mapping is a {type(mapping).__name__}; it must be a Correspondence")
        J, known = jacobian(mapping)
        if not known.any():
            raise InputError("mapping has no two valid neighbours; the size of a camera pixel is unknown")
        wide, fine = _kernels(mapping, J, known), unmix(mapping, J, known)
        if fine is None:
            coverage = np.asarray(wide.sum(axis=1))
            keep = coverage >= SEEN
            matrix = centred(_normalised(wide, keep), mapping)
        else:
            coverage, resolved = fine.area, fine.resolved >= RESOLVED
            keep = (coverage >= PART) & resolved | (coverage >= HALF)
            blurred = centred(_normalised(wide, keep & ~resolved), mapping)
            matrix = scipy.sparse.diags_array((keep & resolved).astype(float)) @ fine.weights + blurred
        matrix = scipy.sparse.csr_array(matrix, dtype=np.float32)
        matrix.eliminate_zeros()
        matrix.sort_indices()
        part = np.minimum(np.where(keep, coverage, 0.0), 1.0).astype(np.float32)
        return cls(matrix, part.reshape(mapping.grid), mapping.grid, mapping.camera_grid)

    @classmethod
    def aligned(cls, grid: tuple[int, int]) -> Resampling:
        """The identity: the camera already on the projector's grid."""
        h, w = checks.grid("grid", grid)
        n = np.arange(h * w + 1)
        one = scipy.sparse.csr_array((np.ones(h * w, np.float32), n[:-1], n))
        return cls(one, np.ones((h, w), np.float32), (h, w), (h, w))

    def ascertained(self, white: Any, valid: Any) -> Resampling:
        """The same without pixels that would be small differences of large numbers.

        Parameters
        ----------
        white : (H, W) or (H, W, c)
            What the camera shows under white, less ambient light.
        valid : bool, the same shape
            Where that is known.

        Examples
        --------
        Rows 0 and 1 of camera pixels that are half in a dark pixel and half in a bright one:

        >>> one = scipy.sparse.csr_array([[2.0, -1.0], [0.0, 1.0]], dtype=np.float32)
        >>> R = Resampling(one, np.ones((1, 2), np.float32), (1, 2), (1, 2))
        >>> R.ascertained(np.array([[0.55, 1.0]]), np.ones((1, 2), bool)).seen
        array([[False,  True]])
        """
        light = np.where(np.asarray(valid), np.maximum(np.asarray(white), 0.0), 0.0)
        both = [self.weights.copy() for _ in range(2)]
        for part, sign in zip(both, (1, -1), strict=True):
            part.data = np.maximum(sign * part.data, 0.0)
        added, taken = (self._product(part, "white", light).reshape(*self.grid, -1) for part in both)
        doubtful = self.seen & (taken > TAKEN * added).any(axis=-1)
        sure = scipy.sparse.diags_array((~doubtful).ravel().astype(np.float32))
        weights = scipy.sparse.csr_array(sure @ self.weights, dtype=np.float32)
        weights.eliminate_zeros()
        coverage = np.where(doubtful, np.float32(0.0), self.coverage)
        return replace(self, weights=weights, coverage=coverage, doubtful=doubtful)

    @property
    def seen(self) -> np.ndarray:
        """(h, w) bool: projector pixels that some camera pixel sees."""
        return self.coverage > 0

    def apply(self, image: Any) -> np.ndarray:
        """The photograph (H, W) or (H, W, c) on the projector's grid, (h, w[, c]); 0 where not seen."""
        return self._product(self.weights, "image", image)

    def variance(self, variance: Any) -> np.ndarray:
        """The variance of `apply`'s result, of independent pixels with this variance: sum w^2 var."""
        squared = self.weights.copy()
        squared.data = squared.data**2
        return self._product(squared, "variance", variance)

    def _product(self, matrix: scipy.sparse.csr_array, name: str, image: Any) -> np.ndarray:
        array = checks.real(name, image)
        H, W = self.camera_grid
        if array.ndim not in (2, 3) or array.shape[:2] != (H, W):
            raise InputError(f"{name} has shape {array.shape}; it must be ({H}, {W}) or ({H}, {W}, c)")
        flat = checks.finite(name, array).reshape(H * W, -1).astype(np.float32, copy=False)
        return (matrix @ flat).reshape(*self.grid, *array.shape[2:])


def _kernels(mapping: Correspondence, J: np.ndarray, known: np.ndarray) -> scipy.sparse.csr_array:
    """w_nm of all pairs of a camera pixel and the projector pixels inside its ellipse, (N, M)."""
    h, w = mapping.grid
    (xu, xv), (yu, yv) = np.moveaxis(J[known], 0, -1)
    xx, yy = (CAMERA * (a**2 + b**2) + PROJECTOR for a, b in ((xu, xv), (yu, yv)))
    xy = CAMERA * (xu * yu + xv * yv)
    det = xx * yy - xy**2
    # The kernel over its ellipse integrates to pi sqrt(det Q) / 3.
    area = np.abs(xu * yv - xv * yu) * 3 / (np.pi * np.sqrt(det))
    x, y = mapping.x[known].astype(np.float64), mapping.y[known].astype(np.float64)
    size = np.ceil(np.sqrt(np.maximum(xx, yy)) - 0.5).astype(int)  # pixels from the nearest one
    rows, columns, values = [], [], []
    for far in np.unique(size):
        m = np.flatnonzero(size == far)
        for j, i in itertools.product(range(-far, far + 1), repeat=2):
            column, row = np.rint(x[m]) + i, np.rint(y[m]) + j
            dx, dy = column - x[m], row - y[m]
            s = (yy[m] * dx * dx - 2 * xy[m] * dx * dy + xx[m] * dy * dy) / det[m]  # d^T Q^-1 d
            good = (s < 1) & (column >= 0) & (column < w) & (row >= 0) & (row < h)
            rows.append((row[good] * w + column[good]).astype(np.int64))
            columns.append(np.flatnonzero(known)[m[good]])
            values.append(area[m[good]] * (1 - s[good]) ** 2)
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return scipy.sparse.csr_array(entries, shape=(h * w, known.size))


def _normalised(weights: scipy.sparse.csr_array, keep: np.ndarray) -> scipy.sparse.csr_array:
    """Rows to keep, which sum to one."""
    total = np.asarray(weights.sum(axis=1))
    scale = np.divide(1.0, total, out=np.zeros_like(total), where=keep)
    return scipy.sparse.csr_array(scipy.sparse.diags_array(scale) @ weights)
