# SPDX-License-Identifier: BSD-3-Clause
"""Photographs on the projector's grid, by least squares if camera pixels are smaller than its own.

A camera pixel m shows the mean over its footprint, so with p the radiance of projector pixels, even
on each,

    c       = C p + e,    C_mn = part of footprint m that lies in pixel n
    var e_m = S^2 + K^2 sum_n C_mn (1 - C_mn)

where the second term is the effect of an error of the map on pixels that straddle. Regularised
least squares, `(C^T V^-1 C + I) p = C^T V^-1 c`, is solved for each pixel with its neighbours, 5 x
5; pixels just outside the projector's grid are unknown, too. Entries below a thousandth of a row's
largest are dropped, and rows sum to one; a pixel that camera pixels do not separate from its
neighbours is not seen. If most camera pixels are larger than 0.85 of the projector's, a projector
pixel is a mean of those that see it, by the part of a tent over twice their footprint that lies in
it.

A dark pixel next to a bright one, of which few camera pixels were decoded, would be a small
difference of two large numbers: if the negative weights of a pixel take away more than 0.7 of what
the positive ones add under white, errors are multiplied by 6, and it counts as not seen.

Known limits, measured with maps from Gray code of a corner of 16 x 16 pixels (`bench/geometry.py`):
with 1.5 camera pixels to a projector pixel's side pictures have errors of up to 5.4 %, with 2 of 2
%, with 3 and 4 of 1 %; with 500 electrons at full scale and 3 pixels of 3.5 %. If light varies
within a projector pixel, the value is that at a place 0.03 pixels from its centre.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.acquisition.geometry.correspondence import Correspondence
from ltcl.acquisition.geometry.footprints import Footprints, PaddedGrid
from ltcl.errors import InputError

# Length of a camera pixel in projector pixels: above, least squares err by 10 % and more.
SEPARABLE_WIDTH = 0.85

# Part of a pixel's area that camera pixels must cover if they separate it (less: an error of the
# map), and if they do not.
MIN_SEPARATED_AREA = 0.15
MIN_AREA = 0.5

# More than this of the light that is added under white, taken away, leaves nothing that is known.
MAX_NEGATIVE_SHARE = 0.7

# The following constants are of the least squares. In brackets: the error of pictures of noise with
# 2 camera pixels to a side and an exact map, measured.

# S, of the light (half: 0.9 %, twice: 0.9 %).
NOISE = 0.02

# K, of the light (half: 0.8 %, twice: 1.1 %).
MAP_ERROR = 0.1

# Pixels to each side that are solved together (1: 1.0 %, 2 and 3: 0.9 %).
REACH = 2

# Unknown pixels around the grid, and those that a window reads around these.
RIM = REACH + 1

# Least weight, of the largest of a row (0: 0.9 %, 0.01: 1.2 %).
MIN_WEIGHT = 0.001

# Least entry of an inverse, of the one of the pixel itself.
MIN_ENTRY = 0.1 * MIN_WEIGHT

# Part of the answer of least squares that is a pixel's own light; with less it is not seen.
MIN_RESOLUTION = 0.9

# Pixels solved at once: 20 MB of 25 x 25 systems; and entries of their weights, at most.
PIXELS_AT_ONCE = 1 << 12
ENTRIES_AT_ONCE = 1 << 24


@dataclass(frozen=True)
class Resampling:
    """Resampling of photographs on the projector's grid.

    Parameters
    ----------
    weights : (N, M) sparse array
        float32. Rows sum to 1 for projector pixels that are seen; others are empty. Weights are
        negative only where least squares take away light that camera pixels show of a neighbour.
    coverage : (h, w) float32
        Fraction of each projector pixel that camera pixels cover.
    grid : (int, int)
        Height and width of the projector, N = h w.
    camera_grid : (int, int)
        Height and width of photographs, M = H W.
    doubtful : (h, w) bool, optional
        Pixels that `ascertained` counts as not seen.

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
        """Resampling by a measured map.

        Parameters
        ----------
        mapping : Correspondence
            Map from the camera to the projector.

        Returns
        -------
        Resampling

        Raises
        ------
        InputError
            No two neighbouring pixels of the map are valid.
        """
        footprints = Footprints.from_map(mapping)
        if not footprints.known.any():
            raise InputError(
                "mapping has no two valid neighbours; the size of a camera pixel is unknown"
            )
        padded = PaddedGrid(mapping.grid, RIM)
        if footprints.width < SEPARABLE_WIDTH:
            area, weights = _separated_pixels(footprints, padded)
            is_covered = area >= MIN_SEPARATED_AREA
        else:
            area, weights = _tent_means(footprints, padded)
            is_covered = area >= MIN_AREA
        is_seen = is_covered & (np.asarray(weights.sum(axis=1)).ravel() > 0)
        weights = _keep_rows(weights, is_seen)
        weights.sort_indices()
        coverage = np.where(is_seen, np.minimum(area, 1.0), 0.0).astype(np.float32)
        return cls(weights, coverage.reshape(mapping.grid), mapping.grid, mapping.camera_grid)

    @classmethod
    def aligned(cls, grid: tuple[int, int]) -> Resampling:
        """Identity: the camera is already on the projector's grid."""
        h, w = checks.grid("grid", grid)
        identity = scipy.sparse.diags_array(np.ones(h * w, np.float32))
        coverage = np.ones((h, w), np.float32)
        return cls(scipy.sparse.csr_array(identity), coverage, (h, w), (h, w))

    def ascertained(self, white: Any, valid: Any) -> Resampling:
        """The same without pixels that would be small differences of large numbers.

        Parameters
        ----------
        white : (H, W) or (H, W, c) array_like
            Photograph under white, less ambient light.
        valid : bool, same shape
            Whether a pixel of it is valid.

        Returns
        -------
        Resampling
            Its `doubtful` are the pixels left out.

        Examples
        --------
        Rows 0 and 1 of camera pixels that are half in a dark pixel and half in a bright one:

        >>> weights = scipy.sparse.csr_array([[2.0, -1.0], [0.0, 1.0]], dtype=np.float32)
        >>> R = Resampling(weights, np.ones((1, 2), np.float32), (1, 2), (1, 2))
        >>> R.ascertained(np.array([[0.55, 1.0]]), np.ones((1, 2), bool)).seen
        array([[False,  True]])
        """
        light = np.where(np.asarray(valid), np.asarray(white), 0.0)
        planes = light.reshape(*light.shape[:2], -1)
        return self.ascertained_by(planes[..., c] for c in range(planes.shape[2]))

    def ascertained_by(self, white: Iterable[np.ndarray]) -> Resampling:
        """The same, by the channels (H, W) of the photograph, 0 where they are not valid."""
        is_doubtful = np.zeros(self.grid, bool)
        for plane in white:
            light = np.maximum(plane, 0.0)
            total = self._product(self._with_data(np.abs(self.weights.data)), "white", light)
            difference = self._product(self.weights, "white", light)
            negative = (total - difference) / 2
            positive = total - negative
            is_doubtful |= self.seen & (negative > MAX_NEGATIVE_SHARE * positive)
        return replace(
            self,
            weights=_keep_rows(self.weights, ~is_doubtful.ravel()),
            coverage=np.where(is_doubtful, np.float32(0.0), self.coverage),
            doubtful=is_doubtful,
        )

    def camera_pixels(self, projector_pixels: np.ndarray | None = None) -> np.ndarray:
        """Numbers of the camera pixels that see the projector, or some of its pixels, ascending."""
        weights = self.weights
        if projector_pixels is not None:
            weights = weights[projector_pixels]
        is_used = np.zeros(math.prod(self.camera_grid), bool)
        is_used[weights.indices] = True
        return np.flatnonzero(is_used)

    @property
    def seen(self) -> np.ndarray:
        """Projector pixels that some camera pixel sees, (h, w) bool."""
        return self.coverage > 0

    def apply(self, image: Any) -> np.ndarray:
        """Photograph (H, W) or (H, W, c) on the projector's grid, (h, w[, c]); 0 if not seen."""
        return self._product(self.weights, "image", image)

    def variance(self, variance: Any) -> np.ndarray:
        """Variance of the result of `apply`, for independent pixels with this variance."""
        return self._product(self._with_data(self.weights.data**2), "variance", variance)

    def _with_data(self, data: np.ndarray) -> scipy.sparse.csr_array:
        """Other weights at the places of those of this resampling."""
        weights = self.weights
        return scipy.sparse.csr_array((data, weights.indices, weights.indptr), weights.shape)

    def _product(self, matrix: scipy.sparse.csr_array, name: str, image: Any) -> np.ndarray:
        array = checks.real(name, image)
        H, W = self.camera_grid
        if array.ndim not in (2, 3) or array.shape[:2] != (H, W):
            raise InputError(
                f"{name} has shape {array.shape}; it must be ({H}, {W}) or ({H}, {W}, c)"
            )
        columns = checks.finite(name, array).reshape(H * W, -1).astype(np.float32, copy=False)
        return (matrix @ columns).reshape(*self.grid, *array.shape[2:])


def _tent_means(
    footprints: Footprints, padded: PaddedGrid
) -> tuple[np.ndarray, scipy.sparse.csr_array]:
    """Covered area (N,) of the projector's pixels, and weights (N, M) of means by tents."""
    area = np.zeros(padded.size)
    strips = []
    for rows in footprints.strips():
        shares, footprint_areas = footprints.shares(padded, rows)
        area += footprint_areas @ shares
        tents, _ = footprints.shares(padded, rows, tent=True)
        strips.append(tents)
    tents = scipy.sparse.csr_array(scipy.sparse.vstack(strips))
    return area[padded.inner], _normalise_rows(tents[:, padded.inner].T)


def _separated_pixels(
    footprints: Footprints, padded: PaddedGrid
) -> tuple[np.ndarray, scipy.sparse.csr_array]:
    """Covered area (N,) of the projector's pixels, and weights (N, M) by least squares."""
    area = np.zeros(padded.size)
    normal = scipy.sparse.csr_array((padded.size, padded.size))
    strips = []
    for rows in footprints.strips():
        shares, footprint_areas = footprints.shares(padded, rows)
        area += footprint_areas @ shares
        weighted = _inverse_variance_shares(shares, footprints.straddling[rows])
        normal = normal + weighted @ shares
        strips.append(weighted)
    return area[padded.inner], _solve_pixels(scipy.sparse.csr_array(normal), strips, padded)


def _solve_pixels(
    normal: scipy.sparse.csr_array, strips: list[scipy.sparse.csr_array], padded: PaddedGrid
) -> scipy.sparse.csr_array:
    """Weights (N, M) of least squares, by C^T V^-1 C and strips of C^T V^-1, which are used up."""
    weighted = _join_columns(strips)
    normal.sort_indices()  # entries are then found three times as fast
    steps = np.arange(-REACH, REACH + 1)
    window = np.add.outer(steps * padded.width, steps).ravel().astype(np.int32)
    pixels = padded.inner.astype(np.int32)
    # A row may have the entries of all pixels of a window, most of which are then dropped.
    most = weighted.nnz // len(pixels) * len(window)
    step = int(np.clip(ENTRIES_AT_ONCE // max(most, 1), 1, PIXELS_AT_ONCE))
    chunks = []
    for start in range(0, len(pixels), step):
        windows = pixels[start : start + step, None] + window
        rows = _inverse_rows(normal, windows) @ weighted
        normalised = _normalise_rows(_drop_small_weights(rows))
        entries = (
            normalised.data.astype(np.float32),
            _short(normalised.indices),
            normalised.indptr,
        )
        chunks.append(scipy.sparse.csr_array(entries, normalised.shape))
    del weighted
    return scipy.sparse.csr_array(scipy.sparse.vstack(chunks))


def _join_columns(strips: list[Any]) -> scipy.sparse.csr_array:
    """Matrices side by side; the list is emptied meanwhile, as both do not fit into the memory."""
    if len(strips) == 1:
        return strips.pop()
    lengths: list[np.ndarray] = [np.diff(strip.indptr) for strip in strips]
    counts = np.sum(lengths, axis=0)
    ends = np.cumsum(counts)
    indptr = np.append(0, ends)
    data = np.empty(ends[-1], strips[0].dtype)
    indices = np.empty(ends[-1], np.int32)
    next_place = indptr[:-1].copy()
    width = 0
    for length in lengths:
        strip = strips.pop(0)
        first = np.repeat(next_place - np.asarray(strip.indptr)[:-1], length)
        places = first + np.arange(strip.nnz)
        data[places] = strip.data
        indices[places] = strip.indices + width
        next_place += length
        width += int(strip.shape[1])
    return scipy.sparse.csr_array((data, indices, _short(indptr)), (len(counts), width))


def _inverse_variance_shares(
    shares: scipy.sparse.csr_array, straddling: np.ndarray
) -> scipy.sparse.csr_array:
    """C^T V^-1 of some camera pixels."""
    mixed = shares.copy()
    mixed.data *= 1.0 - mixed.data
    blurred = np.asarray(mixed.sum(axis=1)).ravel() + straddling.ravel()
    precision = 1.0 / (NOISE**2 + MAP_ERROR**2 * blurred)
    return (shares * precision[:, None]).T.tocsr()


def _inverse_rows(normal: Any, windows: np.ndarray) -> scipy.sparse.csr_array:
    """Rows of (G + I)^-1 of the middles of windows (pixels, n), for pixels that are resolved."""
    n = windows.shape[1]
    middle = n // 2
    row_numbers = np.repeat(windows, n, axis=1)
    column_numbers = np.tile(windows, n)
    local = normal[row_numbers, column_numbers].toarray().reshape(-1, n, n)
    identity = np.eye(n)
    Z = np.linalg.solve(local + identity, identity[:, [middle]])[..., 0]
    # (G + I)^-1 G has the diagonal 1 - Z_nn.
    Z *= 1.0 - Z[:, [middle]] >= MIN_RESOLUTION
    # Entries that give no weight above the least one.
    Z[np.abs(Z) < MIN_ENTRY * np.abs(Z[:, [middle]])] = 0.0
    indptr = np.arange(0, Z.size + 1, n, dtype=np.int32)
    rows = scipy.sparse.csr_array((Z.ravel(), windows.ravel(), indptr), (len(Z), normal.shape[0]))
    rows.eliminate_zeros()
    return rows


def _drop_small_weights(rows: scipy.sparse.csr_array) -> scipy.sparse.csr_array:
    largest = np.asarray(abs(rows).max(axis=1).todense()).ravel()
    threshold = np.repeat(MIN_WEIGHT * largest, np.diff(rows.indptr))
    rows.data[np.abs(rows.data) < threshold] = 0.0
    rows.eliminate_zeros()
    return rows


def _normalise_rows(rows: scipy.sparse.csr_array) -> scipy.sparse.csr_array:
    """Rows with a positive sum, which then is one; others stay as they are."""
    total = np.asarray(rows.sum(axis=1)).ravel()
    return scipy.sparse.diags_array(1.0 / np.where(total > 0, total, 1.0)) @ rows


def _keep_rows(weights: Any, is_kept: np.ndarray) -> scipy.sparse.csr_array:
    """Weights in float32, with empty rows for pixels that are not kept."""
    matrix = scipy.sparse.csr_array(weights)
    lengths = np.diff(np.asarray(matrix.indptr))
    is_kept_entry = np.repeat(is_kept, lengths)
    arrays = (
        matrix.data[is_kept_entry].astype(np.float32),
        _short(matrix.indices[is_kept_entry]),
        _short(np.append(0, np.cumsum(lengths * is_kept))),
    )
    rows = scipy.sparse.csr_array(arrays, matrix.shape)
    rows.eliminate_zeros()
    return rows


def _short(indices: np.ndarray) -> np.ndarray:
    """Indices in 32 bits, if that is enough."""
    is_short = len(indices) == 0 or indices.max() <= np.iinfo(np.int32).max
    return indices.astype(np.int32 if is_short else np.int64, copy=False)
