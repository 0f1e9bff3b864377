# SPDX-License-Identifier: BSD-3-Clause
"""Areas on the projector's grid that camera pixels see: parallelograms from a measured map.

The parallelogram of a camera pixel is spanned by the differences of the map to its neighbours. Its
share in each projector pixel is counted with points spread evenly over it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.acquisition.geometry.correspondence import Correspondence
from ltcl.acquisition.radiometry.strips import in_strips

# A difference that is so many times the opposite one crosses the border of an object (perspective:
# below 1.1).
MAX_DIFFERENCE_RATIO = 2.5

# Times the median: no camera pixel spans more on a surface that it sees at less than 80 degrees.
MAX_SPAN_RATIO = 6.0

# Points of a footprint along each side (error of pictures of noise with 2 camera pixels to a side
# and an exact map, measured: 4: 1.2 %, 8: 0.9 %, 16: 0.6 % in four times the time).
POINTS_PER_SIDE = 8

# Corners (u, v) of a camera pixel: if all lie in one projector pixel, so does the footprint.
CORNERS = np.array([[-0.5, -0.5, 0.5, 0.5], [-0.5, 0.5, -0.5, 0.5]])

# Camera pixels of a strip of rows whose differences are taken at once.
STRIP_PIXELS = 1 << 16

# Camera pixels whose shares are in memory at once.
SHARES_PIXELS = 1 << 20

# Camera pixels whose points are placed at once.
PIXELS_AT_ONCE = 1 << 14


@dataclass(frozen=True)
class PaddedGrid:
    """A projector's `grid` (h, w) with `rim` pixels more on each side."""

    grid: tuple[int, int]
    rim: int

    @property
    def width(self) -> int:
        """Pixels of a row, with the rim."""
        return self.grid[1] + 2 * self.rim

    @property
    def size(self) -> int:
        """Pixels of the grid and its rim."""
        return (self.grid[0] + 2 * self.rim) * self.width

    @property
    def inner(self) -> np.ndarray:
        """Numbers of the projector's pixels on the padded grid, (h w,)."""
        h, w = self.grid
        rows = (np.arange(h) + self.rim) * self.width
        columns = np.arange(w) + self.rim
        return np.add.outer(rows, columns).ravel()

    def numbers(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Numbers of the pixels at (x, y); places outside count as pixels just outside the grid."""
        h, w = self.grid
        column = np.clip(np.rint(x), -1, w).astype(np.int32) + self.rim
        row = np.clip(np.rint(y), -1, h).astype(np.int32) + self.rim
        return row * self.width + column


@dataclass(frozen=True, kw_only=True)
class Footprints:
    """Parallelograms on the projector's grid that camera pixels see.

    Their derivatives J = d(x, y) / d(u, v), whose columns span the parallelogram, are computed row
    by row when they are needed: those of 45 megapixels would be 720 megabytes.

    Attributes
    ----------
    mapping : Correspondence
        Places of their middles.
    known : (H, W) bool
        Whether J is known.
    straddling : (H, W) bool
        Whether the pixel is next to one that is not known, or not next to it on the surface: it may
        see two surfaces.
    width : float
        Length of the median footprint, in projector pixels; NaN if none is known.
    """

    mapping: Correspondence
    known: np.ndarray
    straddling: np.ndarray
    width: float

    @classmethod
    def from_map(cls, mapping: Correspondence) -> Footprints:
        """Footprints from differences to both valid neighbours, averaged.

        Only one counts if the other is across a border.

        If a row or a column of pixels stands alone, and on a side of 1 of the projector's grid,
        camera pixels count as squares. Those that would span six times the median have no
        footprint.
        """
        H, W = mapping.camera_grid
        span = np.empty((H, W), np.float32)
        length = np.empty((H, W), np.float32)
        is_known = np.empty((H, W), bool)
        has_both = np.empty((H, W), bool)

        def measure_rows(rows: slice) -> None:
            J, has_both[rows] = _jacobians(mapping, rows)
            span[rows] = np.abs(J).max(axis=(2, 3))
            length[rows] = _squared_lengths(J)
            is_known[rows] = _determinants(J) != 0

        in_strips(H, STRIP_PIXELS // W, measure_rows)
        width = np.nan
        if is_known.any():
            is_known &= span <= MAX_SPAN_RATIO * np.median(span[is_known])
            del span
            width = float(np.sqrt(np.median(length[is_known])))
        return cls(mapping=mapping, known=is_known, straddling=is_known & ~has_both, width=width)

    def strips(self) -> list[slice]:
        """Rows of camera pixels whose shares are in memory at once."""
        H, W = self.mapping.camera_grid
        step = max(SHARES_PIXELS // W, 1)
        return [slice(top, min(top + step, H)) for top in range(0, H, step)]

    def shares(
        self, padded: PaddedGrid, rows: slice, *, tent: bool = False
    ) -> tuple[scipy.sparse.csr_array, np.ndarray]:
        """Part of each footprint of some rows in each pixel of the padded grid, and its area.

        They are (m, pixels), and (m,) in projector pixels.

        With `tent`, parts of twice the footprint, with less weight towards its border, as bilinear
        interpolation weighs.
        """
        _, W = self.mapping.camera_grid
        points = _footprint_points(tent)
        corners = CORNERS * (1 + tent)
        step = max(PIXELS_AT_ONCE // W, 1)
        height = rows.stop - rows.start
        chunks: dict[int, scipy.sparse.csr_array] = {}
        area = np.empty((height, W), np.float32)

        def split_rows(strip: slice) -> None:
            in_picture = _shifted(strip, rows.start)
            known = self.known[in_picture].ravel()
            x = np.where(self.known[in_picture], self.mapping.x[in_picture], 0.0).ravel()
            y = np.where(self.known[in_picture], self.mapping.y[in_picture], 0.0).ravel()
            J, _ = _jacobians(self.mapping, in_picture)
            area[strip] = np.abs(_determinants(J))
            J = J.reshape(-1, 4)
            numbers = padded.numbers(*_places(x, y, J, corners))
            is_split = known & (numbers != numbers[:, :1]).any(axis=1)
            places = _places(x[is_split], y[is_split], J[is_split], points)
            counts = _count_points(padded.numbers(*places), padded.size)
            chunks[strip.start] = _insert_whole(counts, is_split, known, numbers[:, 0])

        in_strips(height, step, split_rows)
        ordered = [chunks[top] for top in sorted(chunks)]
        return scipy.sparse.csr_array(scipy.sparse.vstack(ordered)), area.ravel()


def _shifted(rows: slice, top: int) -> slice:
    """Rows of a strip that begins at `top`, as numbered in the picture."""
    return slice(rows.start + top, rows.stop + top)


def _jacobians(mapping: Correspondence, rows: slice) -> tuple[np.ndarray, np.ndarray]:
    """J of some rows, float32, 0 where it is not known, and whether all four neighbours count."""
    # One row more on each side has the differences along columns.
    top = max(rows.start - 1, 0)
    window = slice(top, rows.stop + 1)
    inside = slice(rows.start - top, rows.stop - top)
    places = np.stack([mapping.x[window], mapping.y[window]], axis=-1)  # NaN if not valid
    du, has_both_u = _differences(places.astype(np.float64), 1)
    dv, has_both_v = _differences(places.astype(np.float64), 0)
    J = np.stack([du, dv], axis=-1)[inside]
    h, w = mapping.grid
    if w == 1:
        J[:, :, 0] = np.nan
    if h == 1:
        J[:, :, 1] = np.nan
    # Missing derivatives of a square, by Cauchy and Riemann's equations.
    of_square = J[..., ::-1, ::-1] * [[1, -1], [-1, 1]]
    known = np.nan_to_num(np.where(np.isnan(J), of_square, J))
    return known.astype(np.float32), (has_both_u & has_both_v)[inside]


def _squared_lengths(J: np.ndarray) -> np.ndarray:
    """Squares of the largest singular values of 2 x 2 matrices."""
    half = np.sum(J**2, axis=(-2, -1)) / 2
    return half + np.sqrt(np.maximum(half**2 - _determinants(J) ** 2, 0.0))


def _determinants(J: np.ndarray) -> np.ndarray:
    """Determinants of matrices (..., 2, 2)."""
    return J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]


def _places(
    x: np.ndarray, y: np.ndarray, J: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Places x and y, (camera pixels, points), of points (2, points) of each camera pixel."""
    du, dv = points
    xu, xv, yu, yv = J.T[..., None]
    return x[:, None] + xu * du + xv * dv, y[:, None] + yu * du + yv * dv


def _footprint_points(tent: bool) -> np.ndarray:
    """Points (u, v) of a camera pixel, in pixels from its middle.

    They are sheared: no two points lie on one line along a side, which a border may be, too.
    """
    points = 2 * POINTS_PER_SIDE if tent else POINTS_PER_SIDE
    number = np.arange(points)
    row = np.repeat(number, points)
    column = np.tile(number, points)
    u = (row + (column + 0.5) / points) / points - 0.5
    v = (column + (row + 0.5) / points) / points - 0.5
    even = np.stack([u, v])
    return _spread_as_tent(even) if tent else even


def _spread_as_tent(even: np.ndarray) -> np.ndarray:
    """Points of a tent over [-1, 1] from points that are even over [-1/2, 1/2]."""
    return np.copysign(1.0 - np.sqrt(1.0 - 2.0 * np.abs(even)), even)


def _count_points(numbers: np.ndarray, pixels: int) -> scipy.sparse.csr_array:
    """Part of the points (camera pixels, points) in each projector pixel."""
    count, points = numbers.shape
    indptr = np.arange(count + 1, dtype=np.int32) * points
    values = np.full(numbers.size, 1.0 / points)
    shares = scipy.sparse.csr_array((values, numbers.ravel(), indptr), (count, pixels))
    shares.sum_duplicates()
    return shares


def _insert_whole(
    split: Any, is_split: np.ndarray, known: np.ndarray, numbers: np.ndarray
) -> scipy.sparse.csr_array:
    """Rows of all camera pixels: `split` of split ones, others whole in the projector's `numbers`.

    Rows of unknown ones are empty.
    """
    lengths = known.astype(np.int32)
    lengths[is_split] = np.diff(split.indptr)
    indptr = np.append(0, np.cumsum(lengths, dtype=np.int32))
    is_part = np.repeat(is_split, lengths)
    values = np.ones(len(is_part))
    values[is_part] = split.data
    columns = np.empty(len(is_part), np.int32)
    columns[is_part] = split.indices
    columns[~is_part] = numbers[known & ~is_split]
    return scipy.sparse.csr_array((values, columns, indptr), (len(known), split.shape[1]))


def _differences(x: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean difference to the next and the previous pixel along `axis`, and whether both count.

    It is NaN if neither is valid; of two that differ much the smaller one counts.
    """
    step = np.diff(x, axis=axis)
    missing = np.full_like(np.take(x, [0], axis=axis), np.nan)
    to_next = np.concatenate([step, missing], axis)
    to_previous = np.concatenate([missing, step], axis)
    steps = np.stack([to_next, to_previous])
    size = np.linalg.norm(steps, axis=-1, keepdims=True)
    is_used = np.isfinite(size) & ~(size > MAX_DIFFERENCE_RATIO * size[::-1])
    total = np.where(is_used, steps, 0.0).sum(axis=0)
    count = is_used.sum(axis=0)
    mean = np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)
    return mean, count[..., 0] == 2
