# SPDX-License-Identifier: BSD-3-Clause
"""Sub-pixel coordinates from Gray code alone: a plane through the edges of stripes near each pixel.

An edge lies where pattern and inverse are equal; between two camera pixels linear interpolation finds it to
a few hundredths of a pixel, and there the projector coordinate is known: n + 1/2. Every boundary of two
projector columns is an edge of exactly one bit. A weighted least-squares plane `x = a + b u + c v` through
the edges in a window, and faintly through the coordinates of the pixels themselves, gives x at the pixel.
Where edges deviate from it, the window crosses a border, and one to a side or a smaller one gives the plane;
at the rim of the picture, beyond which there are no edges, it is one further inside. Where that leaves the
pixel's own cell [n - 1/2, n + 1/2] by more than a quarter, the whole number stays if others around leave
theirs (a sharp fold); else the bits of the pixel are wrong, and it is dropped.

Known limit: next to the border of an object pixels deviate by some tenths, and so does light that only they
see.
"""

from __future__ import annotations

import cv2
import numpy as np

from ltcl.acquisition.geometry.graycode import Axis, Edges, in_strips

LEAVES = 0.25  # projector pixels by which a plane may leave a pixel's cell: six times the error of an edge
WEIGHT = 0.01  # of a whole number next to an edge: (0.04 / 0.29)^2 of their deviations, and half of that
BEYOND = 1.0  # projector pixels from the picture: camera pixels further away see none of it
COMPANY = 5  # camera pixels that leave their planes, in a window of as many to each side: a line of them
SPREAD = 0.2  # deviation of edges from a plane: more is no plane; whole numbers of pixels alone add 0.06
FULL = 0.9  # part of a window that is valid: less is a rim
ACROSS_LINE = 0.06  # of the squared reach: edges that spread less (evenly: 1/3) lie nearly on one line
EDGES = 8  # that determine a plane on one side, which has three unknowns
ACROSS = 2.5  # edges on each side of a pixel that a window should hold
SMALLEST, LARGEST = 2, 15  # reach of a window, in camera pixels: 5 x 5 hold 8 edges; 31 x 31 are a surface
STRIP = 1 << 16  # pixels of a strip of rows: its moments stay in the cache


def refine(axis: Axis, valid: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Projector coordinate (H, W) float32 of the valid pixels, to a fraction of a pixel, and which may stay.

    Parameters
    ----------
    axis : Axis
        Decoded with ``edges=True``; one without edges comes back as it is.
    valid : (H, W) bool
        Pixels of width 2 at most that fit their neighbours.
    size : int
        Projector pixels along the axis. Camera pixels that see a part of the outermost may lie beyond them.
    """
    if axis.edges is None:
        return axis.value, valid
    cell, reach = _cell(axis, size), _reach(axis.edges, valid)
    planes = _planes(axis, valid, reach)
    odd = valid & ~_fit(cell, planes[0])
    odd &= _sums([odd.astype(np.float32)], COMPANY)[0] < COMPANY - 0.5  # fewer than the line of a fold has
    if odd.any():  # their edges are none
        valid = valid & ~odd
        planes = _planes(axis, valid, reach)
    plane = _at_pixels(axis, valid, cell, planes, reach)
    place = np.where(valid & _fit(cell, plane), np.clip(plane, *cell), axis.value)
    return place.astype(np.float32, copy=False), valid


def _cell(axis: Axis, size: int) -> np.ndarray:
    """What each pixel may see, from and to; (2, H, W). Cells at the border of the picture reach beyond it."""
    low, high = axis.value - axis.width / 2, axis.value + axis.width / 2
    low[low < 0] -= BEYOND
    high[high > size - 1] += BEYOND
    return np.stack([low, high])


def _fit(cell: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """Where the plane is inside the cell, or nearly so."""
    low, high = cell
    return (plane >= low - LEAVES) & (plane <= high + LEAVES)


def _planes(axis: Axis, valid: np.ndarray, reach: int) -> np.ndarray:
    """Planes through the window about each pixel, (5, H, W).

    Value there; slopes b and c; the deviation of edges from it; the variance of their places in the direction
    in which it is least, in camera pixels.
    """
    H, W = valid.shape
    planes = np.empty((5, H, W), np.float32)

    def strip(rows: slice) -> None:
        above = min(reach, rows.start)
        # One row more: edges below the last one of the window.
        more = slice(rows.start - above, min(rows.stop + reach + 1, H))
        own = slice(above, above + rows.stop - rows.start)
        _plane([m[own] for m in _moments(axis, valid, more, 2 * reach + 1)], above, planes[:, rows])

    in_strips(H, max(STRIP // W, 4 * reach), strip)
    return planes


def _at_pixels(axis: Axis, valid: np.ndarray, cell: np.ndarray, planes: np.ndarray, reach: int) -> np.ndarray:
    """Value of the plane of each pixel, (H, W).

    Where a window crosses the border of an object, which shows as spread, windows to the sides are tried
    (Kuwahara et al. 1976), and then smaller ones.
    """
    value, spread = _inward(cell, valid, planes, reach)
    v, u = np.divmod(np.flatnonzero(valid & (spread > SPREAD)), valid.shape[1])
    while len(v):
        value[v, u], least = _best(cell[:, v, u], planes, reach, v, u)
        if reach <= SMALLEST:
            break
        v, u = v[least > SPREAD], u[least > SPREAD]
        reach = max(reach // 2, SMALLEST)
        planes = _planes(axis, valid, reach)
    return value


def _inward(
    cell: np.ndarray, valid: np.ndarray, planes: np.ndarray, reach: int
) -> tuple[np.ndarray, np.ndarray]:
    """Values and spreads (H, W) of the windows about pixels; at a rim, of one further inside.

    A window about a pixel at the rim holds few edges, maybe on one line: the whole numbers of pixels would
    decide the slope across it.
    """
    value, spread = planes[0].copy(), planes[3].copy()
    window, one = 2 * reach + 1, valid.astype(np.float32)
    rows, columns = (index.astype(np.float32) for index in np.ogrid[: valid.shape[0], : valid.shape[1]])
    count, sum_v, sum_u = _sums([one, one * rows, one * columns], window)
    v, u = np.nonzero(valid & (count < FULL * window**2) & (planes[4] < ACROSS_LINE * reach**2))
    j, i = sum_v[v, u] / count[v, u] - v, sum_u[v, u] / count[v, u] - u  # to the middle of what is valid
    least = planes[4, v, u]
    for further in (1, 2):  # a full window is twice as far inside as that middle
        at = (np.rint(further * part).astype(int) for part in (j, i))
        there, spread_there, across = _extrapolated(planes, v, u, *at)
        some = (across > least) & (least < ACROSS_LINE * reach**2) & (spread_there <= SPREAD)
        some &= _fit(cell[:, v, u], there)
        value[v[some], u[some]], spread[v[some], u[some]] = there[some], spread_there[some]
        least = np.where(some, across, least)
    return value, spread


def _sums(planes: list[np.ndarray], window: int) -> list[np.ndarray]:
    size, border = (window, window), cv2.BORDER_CONSTANT
    return [cv2.boxFilter(plane, -1, size, normalize=False, borderType=border) for plane in planes]


def _best(
    cell: np.ndarray, planes: np.ndarray, reach: int, v: np.ndarray, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Values at pixels (v, u) of that window around or next to each which spreads least, and its spread."""
    best, least = planes[0, v, u], np.full(len(v), np.inf)
    for j, i in ((j, i) for j in (0, -reach, reach) for i in (0, -reach, reach)):
        there, spread, _ = _extrapolated(planes, v, u, j, i)
        better = (spread < least) & _fit(cell, there)
        best, least = np.where(better, there, best), np.where(better, spread, least)
    return best, least


def _extrapolated(planes: np.ndarray, v: np.ndarray, u: np.ndarray, j, i) -> tuple[np.ndarray, ...]:
    """Values at pixels (v, u) of the planes `j` rows and `i` columns away; the last two parts of these."""
    H, W = planes.shape[1:]
    row, column = np.clip(v + j, 0, H - 1), np.clip(u + i, 0, W - 1)
    value, b, c, *rest = planes[:, row, column]
    return value - b * (column - u) - c * (row - v), *rest


def _reach(edges: Edges, valid: np.ndarray) -> int:
    """Camera pixels on each side of a window for a few edges, by their mean distance."""
    count = sum(int(np.count_nonzero(np.isfinite(t))) for t in (edges.right, edges.below))
    return min(max(int(np.ceil(ACROSS * np.count_nonzero(valid) / max(count, 1))), SMALLEST), LARGEST)


def _moments(axis: Axis, valid: np.ndarray, rows: slice, window: int) -> list[np.ndarray]:
    """Sums over the window about each pixel of w, w u, w v, w x, w uu, w uv, w vv, w ux, w vx and w xx.

    Edges to the right are at (u + r, v), those below at (u, v + d), with r and d in [0, 1].
    """
    edges, valid = axis.edges, valid[rows]
    assert edges is not None  # noqa: S101  (checked by `refine`)
    v, u = np.ogrid[: float(len(valid)), : float(valid.shape[1])]
    n, value, place = WEIGHT * valid, axis.value[rows].astype(np.float64), edges.place[rows]
    x = n * value
    xx = x * value
    shifts = []
    for part, here, there in (
        (edges.right[rows], np.s_[:, :-1], np.s_[:, 1:]),
        (edges.below[rows], np.s_[:-1], np.s_[1:]),
    ):
        seen = np.isfinite(part[here]) & valid[here] & valid[there]
        t, tx = np.zeros_like(n), np.zeros_like(n)
        np.copyto(t[here], part[here], where=seen)
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
    return _sums(total, window)


def _plane(sums: list[np.ndarray], top: int, out: np.ndarray) -> None:
    """Weighted least-squares planes from their ten moments: as `_planes` does."""
    h, W = sums[0].shape
    v, u = np.ogrid[float(top) : top + h, : float(W)]
    n, *means = sums
    part = 1.0 / np.maximum(n, 1e-6)  # no valid pixel near
    mean_u, mean_v, mean_x, uu, uv, vv, ux, vx, xx = (np.multiply(m, part, out=m) for m in means)
    # A little more spread than there is: edges on one line determine the slope across it only.
    uu += 1e-3 - mean_u**2
    vv += 1e-3 - mean_v**2
    uv -= mean_u * mean_v
    ux -= mean_u * mean_x
    vx -= mean_v * mean_x
    xx -= mean_x**2
    det = np.maximum(uu * vv - uv**2, 1e-9)
    b, c = (ux * vv - vx * uv) / det, (vx * uu - ux * uv) / det
    out[:3] = mean_x + b * (u - mean_u) + c * (v - mean_v), b, c
    out[4] = det / (uu + vv)
    out[3] = np.maximum(xx - b * ux - c * vx, 0.0)
    np.sqrt(out[3], out=out[3])
    out[3][n < EDGES] = np.inf
