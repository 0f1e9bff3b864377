# SPDX-License-Identifier: BSD-3-Clause
"""Sub-pixel coordinates from Gray code alone: a plane through the edges of stripes near each pixel.

An edge lies where pattern and inverse are equal; between two camera pixels linear interpolation finds it to
a few hundredths of a pixel, and there the projector coordinate is n + 1/2. Every boundary of two projector
columns is an edge of exactly one bit. A weighted least-squares plane `x = a + b u + c v` through the edges in
a window, and faintly through the coordinates of the pixels themselves, gives x at the pixel.

Where a window crosses a border, its edges spread about the plane; at the rim of the picture they lie nearly
on one line. There the window counts, of the nine around and next to the pixel (Kuwahara et al. 1976), whose
plane has the least standard error at the pixel, and where all of them spread, smaller ones. Where the plane
leaves the pixel's cell [n - 1/2, n + 1/2] by more than a quarter, the whole number stays. Known limit: next
to the border of an object pixels deviate by some tenths.
"""

from __future__ import annotations

import cv2
import numpy as np

from ltcl.acquisition.geometry.graycode import Axis, in_strips

LEAVES = 0.25  # projector pixels by which a plane may leave a pixel's cell: six times the error of an edge
WEIGHT = 0.01  # of a whole number next to an edge: (0.04 / 0.29)^2 of their deviations, and half of that
BEYOND = 1.0  # projector pixels from the picture: camera pixels further away see none of it
SPREAD = 0.2  # deviation of edges from a plane: more is no plane; whole numbers of pixels alone add 0.06
ERROR, CURVE = 0.04, 0.03  # of an edge; of a plane at a window's reach from its middle, on curved surfaces
LINE = 0.06  # of the squared reach: edges that spread less (evenly: 1/3) lie nearly on one line
EDGES = 8  # that determine a plane on one side, which has three unknowns
ACROSS = 2.5  # edges on each side of a pixel that a window should hold
SMALLEST, LARGEST = 2, 15  # reach of a window, in camera pixels: 5 x 5 hold 8 edges; 31 x 31 are a surface
STRIP = 1 << 16  # pixels of a strip of rows: its moments stay in the cache


def refine(axis: Axis, valid: np.ndarray, size: int) -> np.ndarray:
    """Projector coordinate (H, W) float32 of the valid pixels, to a fraction of a pixel.

    `valid`: pixels of width 2 at most that fit their neighbours; `size`: projector pixels along the axis, of
    which camera pixels that see a part of the outermost may lie beyond these.
    """
    # What each pixel may see, from and to; cells at the border of the picture reach beyond it.
    cell = np.stack([axis.value - axis.width / 2, axis.value + axis.width / 2])
    cell[0, cell[0] < 0] -= BEYOND
    cell[1, cell[1] > size - 1] += BEYOND
    edges = sum(int(np.count_nonzero(np.isfinite(t))) for t in (axis.right, axis.below))
    if edges == 0:
        return axis.value
    # Camera pixels on each side of a window for a few edges, by their mean distance.
    reach = int(np.clip(np.ceil(ACROSS * np.count_nonzero(valid) / edges), SMALLEST, LARGEST))
    planes = _planes(axis, valid, reach)
    value = _at(planes, *(place.astype(np.float32) for place in np.ogrid[tuple(map(slice, valid.shape))]))
    v, u = np.nonzero(valid & ((planes[6] > SPREAD) | (planes[7] < LINE * reach**2)))
    while len(v):
        value[v, u], spread = _best(cell[:, v, u], planes, reach, v, u)
        border = (spread > SPREAD) & np.isfinite(spread)  # too few edges are fewer in smaller windows
        v, u = v[border], u[border]
        if reach <= SMALLEST or len(v) == 0:
            break
        reach = max(reach // 2, SMALLEST)
        planes = _planes(axis, valid, reach)
    return np.where(valid & _fit(cell, value), np.clip(value, *cell), axis.value)


def _fit(cell: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Where a plane's value is inside the cell, or nearly so."""
    return (value >= cell[0] - LEAVES) & (value <= cell[1] + LEAVES)


def _at(planes: np.ndarray, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Values of planes (8, ...) at pixels (v, u)."""
    mean_u, mean_v, mean_x, b, c = planes[1:6]
    return mean_x + b * (u - mean_u) + c * (v - mean_v)


def _best(
    cell: np.ndarray, planes: np.ndarray, reach: int, v: np.ndarray, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Values at pixels (v, u) of that window around or next to each of least standard error; its spread."""
    best, spread, least = _at(planes[:, v, u], v, u), planes[6, v, u], np.full(len(v), np.inf)
    (H, W), steps = planes.shape[1:], (0, -reach, reach)
    for j, i in ((j, i) for j in steps for i in steps):
        plane = planes[:, np.clip(v + j, 0, H - 1), np.clip(u + i, 0, W - 1)]
        value, squared = _at(plane, v, u), (u - plane[1]) ** 2 + (v - plane[2]) ** 2
        error = (plane[6] ** 2 + ERROR**2) * (1.0 + squared / plane[7]) / plane[0]
        error += (CURVE * squared / reach**2) ** 2
        better = (error < least) & _fit(cell, value)
        for result, here in ((best, value), (spread, plane[6]), (least, error)):
            np.copyto(result, here, where=better)
    return best, spread


def _planes(axis: Axis, valid: np.ndarray, reach: int) -> np.ndarray:
    """Planes through the window about each pixel, (8, H, W) float32.

    Number of edges; means of u, v, x; slopes b, c; deviation of edges; least variance of their places.
    """
    H, W = valid.shape
    planes = np.empty((8, H, W), np.float32)

    def strip(rows: slice) -> None:
        above = min(reach, rows.start)
        # One row more: edges below the last one of the window.
        more = slice(rows.start - above, min(rows.stop + reach + 1, H))
        own = slice(above, above + rows.stop - rows.start)
        moments = [moment[own] for moment in _moments(axis, valid, more, 2 * reach + 1)]
        _plane(moments, rows.start - above, planes[:, rows])

    in_strips(H, max(STRIP // W, 4 * reach), strip)
    return planes


def _moments(axis: Axis, valid: np.ndarray, rows: slice, window: int) -> list[np.ndarray]:
    """Sums over the window about each pixel of w, w u, w v, w x, w uu, w uv, w vv, w ux, w vx and w xx.

    Edges to the right are at (u + r, v), those below at (u, v + d), with r and d in [0, 1].
    """
    valid = valid[rows]
    v, u = np.ogrid[: float(len(valid)), : float(valid.shape[1])]
    n, value, place = WEIGHT * valid, axis.value[rows].astype(np.float64), axis.place[rows]
    x = n * value
    xx = x * value
    shifts = []
    for fractions, here, there in (
        (axis.right[rows], np.s_[:, :-1], np.s_[:, 1:]),
        (axis.below[rows], np.s_[:-1], np.s_[1:]),
    ):
        seen = np.isfinite(fractions[here]) & valid[here] & valid[there]
        t, tx = np.zeros_like(n), np.zeros_like(n)
        np.copyto(t[here], fractions[here], where=seen)
        between = seen * (0.5 * (place[here] + place[there]))
        np.multiply(t[here], between, out=tx[here])
        shifts += [t, tx]
        n[here] += seen
        x[here] += between
        xx[here] += between * between
    r, rx, d, dx = shifts
    nu, nv = n * u + r, n * v + d
    total = [n, nu, nv, x, (nu + r) * u + r * r, nu * v + d * u, (nv + d) * v + d * d]
    total += [x * u + rx, x * v + dx, xx]
    size, border = (window, window), cv2.BORDER_CONSTANT
    return [cv2.boxFilter(plane, -1, size, normalize=False, borderType=border) for plane in total]


def _plane(sums: list[np.ndarray], top: int, out: np.ndarray) -> None:
    """Weighted least-squares planes from ten moments, whose v counts from row `top`: as `_planes`."""
    n, *means = sums
    weight = 1.0 / np.maximum(n, 1e-6)  # no valid pixel near
    mean_u, mean_v, mean_x, uu, uv, vv, ux, vx, xx = (np.multiply(m, weight, out=m) for m in means)
    # A little more spread than there is: edges on one line determine the slope across it only.
    uu += 1e-3 - mean_u**2
    vv += 1e-3 - mean_v**2
    uv -= mean_u * mean_v
    ux -= mean_u * mean_x
    vx -= mean_v * mean_x
    xx -= mean_x**2
    det = np.maximum(uu * vv - uv**2, 1e-9)
    b, c = (ux * vv - vx * uv) / det, (vx * uu - ux * uv) / det
    out[:6] = np.maximum(n, 1e-6), mean_u, mean_v + top, mean_x, b, c
    np.sqrt(np.maximum(xx - b * ux - c * vx, 0.0), out=out[6], casting="same_kind")
    out[6][n < EDGES] = np.inf
    out[7] = det / (uu + vv)
