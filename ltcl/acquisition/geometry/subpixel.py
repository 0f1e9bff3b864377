# SPDX-License-Identifier: BSD-3-Clause
"""Projector coordinates of camera pixels to a fraction of a pixel, by planes through stripe edges.

An edge of a stripe lies where pattern and inverse are equal; between two camera pixels linear
interpolation finds it to a few hundredths of a pixel, and there the projector coordinate is n +
1/2. Every boundary of two projector columns is an edge of exactly one bit. A least-squares plane

    x = a + b u + c v

through the edges in a window, and faintly through the coordinates of the pixels themselves, gives x
at the pixel.

If a window crosses a border, its edges spread about the plane; at the rim of the picture they lie
nearly on one line. There, of the nine windows around and next to the pixel (Kuwahara et al. 1976),
the one whose plane has the least standard error at the pixel counts, and if all of them spread,
smaller ones. If the plane leaves the pixel's cell [n - 1/2, n + 1/2] by more than a quarter, the
whole number stays. Known limit: next to the border of an object pixels deviate by some tenths.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import cv2
import numpy as np

from ltcl.acquisition.geometry.axis import NO_EDGE, Axis
from ltcl.acquisition.geometry.bits import BELOW_PAIR, RIGHT_PAIR
from ltcl.acquisition.radiometry.strips import in_strips

# Projector pixels by which a plane may leave a pixel's cell: six times the error of an edge.
MAX_CELL_EXCESS = 0.25

# Projector pixels from the picture: camera pixels further away see none of it.
MAX_RIM_EXCESS = 1.0

# Weight of a whole number next to that of an edge: (0.04 / 0.29)^2 of their deviations, and half of
# that.
WHOLE_NUMBER_WEIGHT = 0.01

# Deviation of edges from a plane: more is no plane; whole numbers of pixels alone add 0.06.
MAX_SPREAD = 0.2

# Standard error of an edge.
EDGE_ERROR = 0.04

# Deviation of a plane at a window's reach from its middle, on curved surfaces.
CURVATURE_ERROR = 0.03

# Edges that spread less, of the squared reach (evenly: 1/3), lie nearly on one line.
MIN_LINE_SPREAD = 0.06

# Edges that determine a plane on one side, which has three unknowns.
MIN_EDGES = 8

# Edges on each side of a pixel that a window should hold.
EDGES_PER_SIDE = 2.5

# Reach of a window, in camera pixels: 5 x 5 hold 8 edges; 31 x 31 are a surface.
MIN_REACH = 2
MAX_REACH = 15

# Pixels of a strip of rows: its moments stay in the cache.
STRIP_PIXELS = 1 << 16

# Bytes of a pixel of a strip while it is refined, and those of all strips at once, at most.
BYTES_PER_PIXEL = 200
MAX_BYTES = 1 << 28

# Instead of a division by zero, where no valid pixel is near.
MIN_COUNT = 1e-6
MIN_DETERMINANT = 1e-9

# Spread that is added: edges on one line then determine the slope across it only.
ADDED_SPREAD = 1e-3


@dataclass(frozen=True, kw_only=True)
class Planes:
    """Least-squares planes through the windows about the pixels of some rows, (rows, W) float32.

    Attributes
    ----------
    top : int
        First of the rows.
    count : ndarray
        Weighted number of edges.
    u, v, x : ndarray
        Means of the edges' places in the camera and of their projector coordinate.
    slope_u, slope_v : ndarray
        Slopes b and c.
    spread : ndarray
        Deviation of the edges from the plane; infinite for too few edges.
    extent : ndarray
        Least variance of the edges' places.
    """

    top: int
    count: np.ndarray
    u: np.ndarray
    v: np.ndarray
    x: np.ndarray
    slope_u: np.ndarray
    slope_v: np.ndarray
    spread: np.ndarray
    extent: np.ndarray

    @classmethod
    def fit(cls, axis: Axis, valid: np.ndarray, rows: slice, reach: int) -> Planes:
        """Planes through the windows of `reach` pixels about each pixel of some rows."""
        # One row more has the edges below the last one of the window.
        top = max(rows.start - reach, 0)
        bottom = min(rows.stop + reach + 1, len(valid))
        moments = _moments(axis, valid, slice(top, bottom), 2 * reach + 1)
        inside = slice(rows.start - top, rows.stop - top)
        return cls.from_moments([moment[inside] for moment in moments], top, rows.start)

    @classmethod
    def from_moments(cls, moments: list[np.ndarray], origin: int, top: int) -> Planes:
        """Planes of rows from `top` on; the moments count v from the row `origin`."""
        n, *sums = moments
        weight = 1.0 / np.maximum(n, MIN_COUNT)
        means = [np.multiply(total, weight, out=total) for total in sums]
        mean_u, mean_v, mean_x, uu, uv, vv, ux, vx, xx = means
        uu += ADDED_SPREAD - mean_u**2
        vv += ADDED_SPREAD - mean_v**2
        uv -= mean_u * mean_v
        ux -= mean_u * mean_x
        vx -= mean_v * mean_x
        xx -= mean_x**2

        # Cramer's rule.
        det = np.maximum(uu * vv - uv**2, MIN_DETERMINANT)
        b = (ux * vv - vx * uv) / det
        c = (vx * uu - ux * uv) / det
        spread = np.sqrt(np.maximum(xx - b * ux - c * vx, 0.0))
        spread[n < MIN_EDGES] = np.inf
        return cls(
            top=top,
            count=np.maximum(n, MIN_COUNT).astype(np.float32),
            u=mean_u.astype(np.float32),
            v=(mean_v + origin).astype(np.float32),
            x=mean_x.astype(np.float32),
            slope_u=b.astype(np.float32),
            slope_v=c.astype(np.float32),
            spread=spread.astype(np.float32),
            extent=(det / (uu + vv)).astype(np.float32),
        )

    def rows(self, rows: slice) -> Planes:
        """Planes of some of the rows, as numbered in the picture."""
        return self._select(np.s_[rows.start - self.top : rows.stop - self.top], rows.start)

    def take(self, v: np.ndarray, u: np.ndarray) -> Planes:
        """Planes of pixels (v, u)."""
        return self._select((v - self.top, u), self.top)

    def _select(self, index: Any, top: int) -> Planes:
        return Planes(
            top=top,
            count=self.count[index],
            u=self.u[index],
            v=self.v[index],
            x=self.x[index],
            slope_u=self.slope_u[index],
            slope_v=self.slope_v[index],
            spread=self.spread[index],
            extent=self.extent[index],
        )

    def at(self, v: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Values of the planes at pixels (v, u)."""
        return self.x + self.slope_u * (u - self.u) + self.slope_v * (v - self.v)


def refine(axis: Axis, valid: np.ndarray, size: int) -> np.ndarray:
    """Projector coordinate (H, W) float32 of the valid pixels, to a fraction of a pixel.

    `size` is the number of projector pixels along the axis. Camera pixels that see a part of the
    outermost of these may lie beyond them. Faint pixels that lie on no plane are NaN.
    """
    H, W = valid.shape
    reach = _window_reach(axis, valid)
    value = np.empty((H, W), np.float32)

    def refine_rows(rows: slice) -> None:
        value[rows] = _refine_strip(axis, valid, size, rows, reach)

    rows = max(STRIP_PIXELS // W, 4 * reach)
    strip_bytes = (rows + 2 * reach) * W * BYTES_PER_PIXEL
    in_strips(H, rows, refine_rows, workers=max(MAX_BYTES // strip_bytes, 1))
    return value


def _refine_strip(axis: Axis, valid: np.ndarray, size: int, rows: slice, reach: int) -> np.ndarray:
    """Coordinates of some rows, by windows of `reach` pixels, and smaller ones at borders."""
    H, W = valid.shape
    strip = axis.rows(rows)
    cell = _cells(strip, size)
    around = slice(max(rows.start - reach, 0), min(rows.stop + reach, H))
    planes = Planes.fit(axis, valid, around, reach)
    inside = planes.rows(rows)
    lines = np.arange(rows.start, rows.stop, dtype=np.float32)[:, None]
    value = inside.at(lines, np.arange(W, dtype=np.float32)[None, :])

    is_poor = (inside.spread > MAX_SPREAD) | (inside.extent < MIN_LINE_SPREAD * reach**2)
    v, u = np.nonzero(valid[rows] & is_poor)
    while len(v):
        place = v + rows.start, u
        value[v, u], spread = _best_window(cell[:, v, u], planes, reach, place, H)
        # Windows with too few edges, of infinite spread, have fewer when they are smaller.
        is_border = (spread > MAX_SPREAD) & np.isfinite(spread)
        v = v[is_border]
        u = u[is_border]
        if reach <= MIN_REACH or len(v) == 0:
            break
        reach = max(reach // 2, MIN_REACH)
        planes = Planes.fit(axis, valid, around, reach)
    is_in_cell = (cell[0] <= value) & (value <= cell[1])
    whole = np.where(strip.known, strip.value, np.float32(np.nan))
    return np.where(valid[rows] & is_in_cell, value, whole)


def _cells(axis: Axis, size: int) -> np.ndarray:
    """Least and largest coordinate that a plane may give each pixel, (2, rows, W)."""
    value = axis.value
    # Faint places are those of two neighbouring pixels.
    half = np.minimum(axis.width, 2.0) / 2 + MAX_CELL_EXCESS
    cell = np.stack([value - half, value + half])
    low, high = cell
    low[low < 0] -= MAX_RIM_EXCESS
    high[high > size - 1] += MAX_RIM_EXCESS
    return cell


def _window_reach(axis: Axis, valid: np.ndarray) -> int:
    """Camera pixels on each side of a window for a few edges, by their mean distance."""
    edges = 0
    for steps in (axis.right_steps, axis.below_steps):
        edges += np.count_nonzero(steps != NO_EDGE)
    reach = EDGES_PER_SIDE * np.count_nonzero(valid) / max(edges, 1) + 1
    return int(np.clip(reach, MIN_REACH, MAX_REACH))


def _best_window(
    cell: np.ndarray, planes: Planes, reach: int, place: tuple[np.ndarray, np.ndarray], height: int
) -> tuple[np.ndarray, np.ndarray]:
    """Values at a place (v, u) of the window of least standard error there, and its spread.

    `planes` are those of all rows within `reach` of the pixels, in a picture of this height.
    """
    v, u = place
    width = planes.spread.shape[1]
    middle = planes.take(v, u)
    best_value = middle.at(v, u)
    best_spread = middle.spread
    least_error = np.full(len(v), np.inf)
    steps = (0, -reach, reach)
    for down, right in product(steps, steps):
        plane = planes.take(np.clip(v + down, 0, height - 1), np.clip(u + right, 0, width - 1))
        value = plane.at(v, u)
        squared_distance = (u - plane.u) ** 2 + (v - plane.v) ** 2
        error = (
            (plane.spread**2 + EDGE_ERROR**2)
            * (1.0 + squared_distance / plane.extent)
            / plane.count
        )
        error += (CURVATURE_ERROR * squared_distance / reach**2) ** 2
        is_better = (error < least_error) & (cell[0] <= value) & (value <= cell[1])
        np.copyto(best_value, value, where=is_better)
        np.copyto(best_spread, plane.spread, where=is_better)
        np.copyto(least_error, error, where=is_better)
    return best_value, best_spread


def _moments(axis: Axis, valid: np.ndarray, rows: slice, window: int) -> list[np.ndarray]:
    """Sums of w, w u, w v, w x, w uu, w uv, w vv, w ux, w vx and w xx over windows.

    Edges to the right are at (u + r, v), those below at (u, v + d), with r and d in [0, 1]; v
    counts from the first of the rows.
    """
    valid = valid[rows]
    axis = axis.rows(rows)
    value = axis.value.astype(np.float64)
    place = axis.place.astype(np.float64)
    height, width = valid.shape
    u = np.arange(width, dtype=np.float64)[None, :]
    v = np.arange(height, dtype=np.float64)[:, None]
    n = np.where(valid, WHOLE_NUMBER_WEIGHT, 0.0)
    x = n * value
    xx = x * value
    r = np.zeros_like(n)
    rx = np.zeros_like(n)
    d = np.zeros_like(n)
    dx = np.zeros_like(n)
    for fractions, shift, shift_x, (pixels, neighbours) in (
        (axis.right, r, rx, RIGHT_PAIR),
        (axis.below, d, dx, BELOW_PAIR),
    ):
        is_edge = np.isfinite(fractions[pixels]) & valid[pixels] & valid[neighbours]
        between = is_edge * (0.5 * (place[pixels] + place[neighbours]))
        np.copyto(shift[pixels], fractions[pixels], where=is_edge)
        np.multiply(shift[pixels], between, out=shift_x[pixels])
        n[pixels] += is_edge
        x[pixels] += between
        xx[pixels] += between * between

    nu = n * u + r
    nv = n * v + d
    uu = (nu + r) * u + r * r
    uv = nu * v + d * u
    vv = (nv + d) * v + d * d
    ux = x * u + rx
    vx = x * v + dx
    planes = [n, nu, nv, x, uu, uv, vv, ux, vx, xx]
    return [_window_sum(plane, window) for plane in planes]


def _window_sum(plane: np.ndarray, window: int) -> np.ndarray:
    return cv2.boxFilter(
        plane, -1, (window, window), normalize=False, borderType=cv2.BORDER_CONSTANT
    )
