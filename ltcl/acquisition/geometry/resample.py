# SPDX-License-Identifier: BSD-3-Clause
"""Photographs on the projector's grid, by least squares where camera pixels are smaller than its own.

A camera pixel m shows the mean over its footprint, so with p the radiance of projector pixels, even
on each,

    c = C p + e,  C_mn = part of footprint m that lies in pixel n,  var e_m = S^2 + K^2 sum_n C_mn
    (1 - C_mn)

where the second term is what an error of the map does to pixels that straddle. Regularised least
squares, `(C^T V^-1 C + I) p = C^T V^-1 c`, is solved for each pixel with its neighbours, 5 x 5;
pixels just outside the projector's grid are unknown, too. Entries below a thousandth of a row's
largest are dropped, and rows sum to one; a pixel that camera pixels do not separate from its
neighbours is not seen. Where most are larger than 0.85 of the projector's, a pixel is a mean of
those that see it, by the part of a tent over twice their footprint that lies in it.

A dark pixel next to a bright one, of which few camera pixels were decoded, would be a small
difference of two large numbers: where what its weights take away of white is more than 0.7 of what
they add, errors are multiplied by 6, and it counts as not seen.

Known limits, measured with maps from Gray code of a corner of 16 x 16 pixels (`bench/geometry.py`):
with 1.5 camera pixels to a projector pixel's side pictures have errors of up to 5.4 %, with 2 of 2
%, with 3 and 4 of 1 %; with 500 electrons at full scale and 3 pixels of 3.5 %. Where light varies
within a projector pixel, the value is that at a place 0.03 pixels from its centre.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.acquisition.geometry.correspondence import Correspondence
from ltcl.errors import InputError

# In brackets: the error of pictures of noise with 2 camera pixels to a side and an exact map,
# measured.
NOISE, MAP = 0.02, 0.1  # S and K, of the light (S half, twice: 0.9 %; K half: 0.8 %, twice: 1.1 %)
REACH = 2  # pixels to each side that are solved together (1: 1.0 %, 2 and 3: 0.9 %)
POINTS = 8  # of a footprint, to each side (4: 1.2 %, 8: 0.9 %, 16: 0.6 % in four times the time)
RIM = REACH + 1  # unknown pixels around the grid, and what a window reads around these
LEAST = 0.001  # of the largest weight of a row (0: 0.9 %, 0.01: 1.2 %)
AT_ONCE = 1 << 12  # pixels solved, or camera pixels cast on the grid: 20 MB of 25 x 25 systems
# times the other difference: one that crosses the border of an object (perspective: below 1.1)
BREAK = 2.5
# times the median: what no camera pixel spans on a surface that it sees at less than 80 degrees
WIDEST = 6.0
SEPARABLE = (
    0.85  # length of a camera pixel in projector pixels: above, least squares err by 10 % and more
)
RESOLVED = (
    0.9  # part of the answer of least squares that is a pixel's own light; with less it is not seen
)
NEGATIVE = 0.7  # of what is added under white: more of it taken away leaves nothing that is known
AREA, HALF = (
    0.15,
    0.5,
)  # of a pixel's area, seen where it is separated (less: an error of the map), where not


@dataclass(frozen=True)
class Resampling:
    """Resampling of photographs (H, W) = `camera_grid` to the projector's `grid` (h, w).

    Rows of `weights` (N, M), float32, sum to 1 for projector pixels that are seen; others are
    empty. They are negative only where least squares take away what camera pixels show of a
    neighbour. `coverage` (h, w): what fraction of each projector pixel camera pixels cover;
    `doubtful` (h, w): pixels that count as not seen for what white showed (`ascertained`).

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
        """The resampling by a measured map; InputError where no two neighbouring pixels of it are valid."""
        footprints = Footprints.of(mapping)
        if not footprints.known.any():
            raise InputError(
                "mapping has no two valid neighbours; the size of a camera pixel is unknown"
            )
        C, pixels = footprints.shares(), inner(mapping.grid)
        coverage = np.asarray(np.abs(np.linalg.det(footprints.J)).ravel() @ C)[pixels]
        if footprints.width < SEPARABLE:
            matrix, least = _unmix(C, footprints), AREA
        else:
            matrix, least = _normalised(footprints.shares(tent=True)[:, pixels].T), HALF
        seen = (coverage >= least) & (np.asarray(matrix.sum(axis=1)).ravel() > 0)
        matrix = scipy.sparse.csr_array(_rows(seen) @ matrix, dtype=np.float32)
        matrix.eliminate_zeros()
        matrix.sort_indices()
        coverage = (
            np.where(seen, np.minimum(coverage, 1.0), 0.0).reshape(mapping.grid).astype(np.float32)
        )
        return cls(matrix, coverage, mapping.grid, mapping.camera_grid)

    @classmethod
    def aligned(cls, grid: tuple[int, int]) -> Resampling:
        """The identity: the camera already on the projector's grid."""
        h, w = checks.grid("grid", grid)
        return cls(
            scipy.sparse.csr_array(_rows(np.ones(h * w))),
            np.ones((h, w), np.float32),
            (h, w),
            (h, w),
        )

    def ascertained(self, white: Any, valid: Any) -> Resampling:
        """The same without pixels that would be small differences of large numbers.

        `white` (H, W[, c]) is what the camera shows under white, less ambient light, where that is
        `valid`. Rows 0 and 1 of camera pixels that are half in a dark pixel and half in a bright
        one:

        >>> weights = scipy.sparse.csr_array([[2.0, -1.0], [0.0, 1.0]], dtype=np.float32)
        >>> R = Resampling(weights, np.ones((1, 2), np.float32), (1, 2), (1, 2))
        >>> R.ascertained(np.array([[0.55, 1.0]]), np.ones((1, 2), bool)).seen
        array([[False,  True]])
        """
        light = np.where(np.asarray(valid), np.maximum(np.asarray(white), 0.0), 0.0)
        total = self._product(abs(self.weights), "white", light)
        negative = (total - self._product(self.weights, "white", light)).reshape(*self.grid, -1) / 2
        positive = total.reshape(negative.shape) - negative
        doubtful = self.seen & (negative > NEGATIVE * positive).any(axis=-1)
        weights = scipy.sparse.csr_array(_rows(~doubtful.ravel()) @ self.weights, dtype=np.float32)
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
        return self._product(self.weights.power(2), "variance", variance)

    def _product(self, matrix: scipy.sparse.csr_array, name: str, image: Any) -> np.ndarray:
        array = checks.real(name, image)
        H, W = self.camera_grid
        if array.ndim not in (2, 3) or array.shape[:2] != (H, W):
            raise InputError(
                f"{name} has shape {array.shape}; it must be ({H}, {W}) or ({H}, {W}, c)"
            )
        flat = checks.finite(name, array).reshape(H * W, -1).astype(np.float32, copy=False)
        return (matrix @ flat).reshape(*self.grid, *array.shape[2:])


@dataclass(frozen=True)
class Footprints:
    """Parallelograms on the projector's grid that camera pixels see.

    They span `J` (H, W, 2, 2) float64, d(x, y) / d(u, v), where that is `known` (H, W); those
    `straddling` are next to a pixel that is not known, or not next to it on the surface: they may
    see two surfaces.
    """

    mapping: Correspondence
    J: np.ndarray
    known: np.ndarray
    straddling: np.ndarray

    @classmethod
    def of(cls, mapping: Correspondence) -> Footprints:
        """Differences to both valid neighbours, averaged; of one only, where the other leads across a border.

        Where a row or a column of pixels stands alone, and on a side of 1 of the projector's grid,
        camera pixels count as squares. Those that would span six times the median have no
        footprint.
        """
        x = np.stack([mapping.x, mapping.y], axis=-1).astype(np.float64)  # NaN where not valid
        (du, both_u), (dv, both_v) = _slope(x, 1), _slope(x, 0)
        J = np.stack([du, dv], axis=-1)
        J[:, :, np.equal(mapping.grid[::-1], 1)] = np.nan
        # What is missing, of a square: Cauchy and Riemann's equations.
        J = np.nan_to_num(np.where(np.isnan(J), J[..., ::-1, ::-1] * [[1, -1], [-1, 1]], J))
        known = np.linalg.det(J) != 0
        span = np.abs(J).max(axis=(2, 3))
        if known.any():
            known &= span <= WIDEST * np.median(span[known])
        return cls(mapping, J, known, known & ~(both_u & both_v))

    @property
    def width(self) -> float:
        """Length of the median footprint, in projector pixels."""
        return float(np.median(np.linalg.norm(self.J[self.known], 2, axis=(1, 2))))

    def shares(self, tent: bool = False) -> scipy.sparse.csr_array:
        """C (M, pixels), on the grid with its rim: `inner` are the columns of the projector's pixels.

        With `tent`, of twice the footprint, less towards its border: as bilinear interpolation
        weighs.
        """
        h, w = self.mapping.grid
        width, points = w + 2 * RIM, 2 * POINTS if tent else POINTS
        i, j = (place.ravel() for place in np.mgrid[:points, :points])
        # Sheared: no two points lie on one line along a side, which a border may be, too.
        du, dv = ((a + (b + 0.5) / points) / points - 0.5 for a, b in ((i, j), (j, i)))
        if tent:
            du, dv = (np.copysign(1.0 - np.sqrt(1.0 - 2.0 * np.abs(d)), d) for d in (du, dv))
        known = self.known.ravel()
        x, y = (np.where(self.known, c, 0.0).ravel() for c in (self.mapping.x, self.mapping.y))
        J, shares = self.J.reshape(-1, 4), []
        for start in range(0, known.size, AT_ONCE):
            some = slice(start, start + AT_ONCE)
            xu, xv, yu, yv = J[some].T[..., None]
            i = np.clip(np.rint(x[some, None] + xu * du + xv * dv), -1, w).astype(np.int32) + RIM
            j = np.clip(np.rint(y[some, None] + yu * du + yv * dv), -1, h).astype(np.int32) + RIM
            place = (j * width + i)[known[some]]
            indptr = np.append(0, np.cumsum(known[some], dtype=np.int32) * points**2)
            ones = np.full(place.size, 1.0 / points**2)
            chunk = scipy.sparse.csr_array(
                (ones, place.ravel(), indptr), (len(i), (h + 2 * RIM) * width)
            )
            chunk.sum_duplicates()
            shares.append(chunk)
        return scipy.sparse.csr_array(scipy.sparse.vstack(shares))


def inner(grid: tuple[int, int]) -> np.ndarray:
    """Numbers of the projector's pixels on the grid with its rim, (N,)."""
    h, w = grid
    return np.add.outer((np.arange(h) + RIM) * (w + 2 * RIM), np.arange(w) + RIM).ravel()


def _slope(x: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Difference to the next and the previous pixel along `axis`, (H, W, 2), and where both count.

    NaN where neither is valid; of two that differ much the smaller one counts.
    """
    step = np.diff(x, axis=axis)
    none = np.full_like(np.take(x, [0], axis=axis), np.nan)
    steps = np.stack([np.concatenate([step, none], axis), np.concatenate([none, step], axis)])
    size = np.linalg.norm(steps, axis=-1, keepdims=True)
    use = np.isfinite(size) & ~(size > BREAK * size[::-1])
    total, count = np.where(use, steps, 0.0).sum(axis=0), use.sum(axis=0)
    return np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0), count[
        ..., 0
    ] == 2


def _unmix(C: scipy.sparse.csr_array, footprints: Footprints) -> scipy.sparse.csr_array:
    """Weights of camera pixels for all projector pixels by least squares, (N, M)."""
    h, w = footprints.mapping.grid
    mixed = C.copy()
    mixed.data *= 1.0 - mixed.data
    blurred = np.asarray(mixed.sum(axis=1)).ravel() + footprints.straddling.ravel()
    back = (C * (1.0 / (NOISE**2 + MAP**2 * blurred))[:, None]).T.tocsr()  # C^T V^-1
    G, pixels, steps = (back @ C).tocsr(), inner((h, w)), np.arange(-REACH, REACH + 1)
    window = np.add.outer(steps * (w + 2 * RIM), steps).ravel()
    n, unit, weights = len(window), np.eye(len(window)), []
    G.sort_indices()  # entries are found three times as fast
    for start in range(0, h * w, AT_ONCE):
        places = pixels[start : start + AT_ONCE, None] + window
        local = G[np.repeat(places, n, axis=1), np.tile(places, n)].toarray().reshape(-1, n, n)
        Z = np.linalg.solve(local + unit, unit[:, [n // 2]])[..., 0]  # rows of (G + I)^-1
        Z *= 1.0 - Z[:, [n // 2]] >= RESOLVED  # (G + I)^-1 G has the diagonal 1 - Z_nn
        entries = Z.ravel(), places.ravel(), np.arange(0, Z.size + 1, n)
        rows = scipy.sparse.csr_array(entries, (len(Z), G.shape[0])) @ back
        least = LEAST * np.asarray(abs(rows).max(axis=1).todense()).ravel()
        rows.data[np.abs(rows.data) < np.repeat(least, np.diff(rows.indptr))] = 0.0
        weights.append(_normalised(rows))
    return scipy.sparse.csr_array(scipy.sparse.vstack(weights))


def _normalised(rows: scipy.sparse.csr_array) -> scipy.sparse.csr_array:
    """Rows with a positive sum, which then is one; others stay as they are."""
    total = np.asarray(rows.sum(axis=1)).ravel()
    return scipy.sparse.diags_array(1.0 / np.where(total > 0, total, 1.0)) @ rows


def _rows(chosen: np.ndarray) -> scipy.sparse.dia_array:
    """A diagonal of ones for the rows that are chosen."""
    return scipy.sparse.diags_array(chosen.astype(np.float32))


@dataclass(frozen=True)
class Blocks:
    """The `pixels` (h, w) of a projector in blocks of side x side, fewer at the right and lower rim.

    >>> Blocks((2, 3), 2).sum(np.array([[1.0, 2.0, 5.0], [3.0, 4.0, 7.0]])).tolist()
    [[10.0, 12.0]]
    """

    pixels: tuple[int, int]
    side: int

    def __post_init__(self) -> None:
        checks.count("block", self.side, most=max(checks.grid("pixels", self.pixels)))

    @cached_property
    def grid(self) -> tuple[int, int]:
        """(h, w) of the blocks."""
        return -(-self.pixels[0] // self.side), -(-self.pixels[1] // self.side)

    def enlarged(self, pattern: np.ndarray) -> np.ndarray:
        """The pattern on the projector's pixels, (h, w)."""
        h, w = self.pixels
        return np.repeat(np.repeat(pattern, self.side, axis=0)[:h], self.side, axis=1)[:, :w]

    def sum(self, picture: np.ndarray) -> np.ndarray:
        """Sum over every block of a picture (h, w[, c])."""
        if self.side == 1:
            return picture
        for axis in (0, 1):
            starts = np.arange(0, self.pixels[axis], self.side)
            picture = np.add.reduceat(picture, starts, axis=axis)
        return picture
