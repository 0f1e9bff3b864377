# SPDX-License-Identifier: BSD-3-Clause
"""Which projector coordinates each camera pixel sees, from photographs of Gray code alone.

An edge of a stripe lies where pattern and inverse are equal; between two camera pixels linear
interpolation finds it to a few hundredths of a pixel, and there the projector coordinate is n +
1/2. Every boundary of two projector columns is an edge of exactly one bit. A least-squares plane `x
= a + b u + c v` through the edges in a window, and faintly through the coordinates of the pixels
themselves, gives x at the pixel.

Where a window crosses a border, its edges spread about the plane; at the rim of the picture they
lie nearly on one line. There the window counts, of the nine around and next to the pixel (Kuwahara
et al. 1976), whose plane has the least standard error at the pixel, and where all of them spread,
smaller ones. Where the plane leaves the pixel's cell [n - 1/2, n + 1/2] by more than a quarter, the
whole number stays. Known limit: next to the border of an object pixels deviate by some tenths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from ltcl import checks
from ltcl.acquisition.geometry.graycode import ADJACENT, Axis, GrayCode
from ltcl.acquisition.radiometry.merge import in_strips
from ltcl.errors import InputError

NEIGHBOURS = 5  # side of the neighbourhood that a coordinate must fit
FAR = np.float32(1e9)  # beyond any coordinate
# projector pixels by which a plane may leave a pixel's cell: six times the error of an edge
LEAVES = 0.25
WEIGHT = (
    0.01  # of a whole number next to an edge: (0.04 / 0.29)^2 of their deviations, and half of that
)
BEYOND = 1.0  # projector pixels from the picture: camera pixels further away see none of it
SPREAD = (
    0.2  # deviation of edges from a plane: more is no plane; whole numbers of pixels alone add 0.06
)
ERROR, CURVE = (
    0.04,
    0.03,
)  # of an edge; of a plane at a window's reach from its middle, on curved surfaces
LINE = 0.06  # of the squared reach: edges that spread less (evenly: 1/3) lie nearly on one line
EDGES = 8  # that determine a plane on one side, which has three unknowns
ACROSS = 2.5  # edges on each side of a pixel that a window should hold
SMALLEST, LARGEST = (
    2,
    15,
)  # reach of a window, in camera pixels: 5 x 5 hold 8 edges; 31 x 31 are a surface
STRIP = 1 << 16  # pixels of a strip of rows: its moments stay in the cache


@dataclass(frozen=True)
class Correspondence:
    """A map from camera pixels to projector coordinates.

    `x`, `y` (H, W) float32: column and row of the projector's `grid` (h, w), in pixels with centres
    at integers; NaN where not `valid` (H, W) bool. InputError for sizes that differ, and where a
    valid coordinate is not finite.

    >>> Correspondence.aligned((2, 3)).x
    array([[0., 1., 2.],
           [0., 1., 2.]], dtype=float32)
    """

    x: np.ndarray
    y: np.ndarray
    valid: np.ndarray
    grid: tuple[int, int]

    def __post_init__(self) -> None:
        checks.grid("grid", self.grid)
        valid = np.asarray(self.valid, bool)
        if valid.ndim != 2 or valid.size == 0:
            raise InputError(f"valid has shape {valid.shape}; it must be (H, W)")
        object.__setattr__(self, "valid", valid)
        for name in ("x", "y"):
            array = checks.shape(name, checks.real(name, getattr(self, name)), valid.shape)
            checks.finite(f"{name}[valid]", array[valid])
            object.__setattr__(self, name, np.where(valid, array, np.nan).astype(np.float32))

    @classmethod
    def aligned(cls, grid: tuple[int, int]) -> Correspondence:
        """The camera already on the projector's grid."""
        h, w = checks.grid("grid", grid)
        y, x = np.mgrid[:h, :w]
        return cls(x, y, np.ones(grid, bool), (h, w))

    @property
    def camera_grid(self) -> tuple[int, int]:
        """(H, W) of the camera."""
        return self.valid.shape[0], self.valid.shape[1]

    @property
    def decoded(self) -> float:
        """Fraction of the camera's pixels that are valid."""
        return float(self.valid.mean())


def decode(
    images: Sequence[Any],
    grid: tuple[int, int],
    *,
    subpixel: bool = True,
    levels: int | None = None,
) -> Correspondence:
    """The map from photographs (H, W) or (H, W, 3) of `GrayCode(grid).patterns()`, in that order.

    They are linear or raw, all of one exposure. `subpixel`: fractions of a pixel (error 0.03) by
    planes through the edges of stripes. Pixels that are not fully known or do not fit their
    neighbours are not valid. `levels`: codes of the camera where images are floats; a difference of
    one code may be noise.

    InputError for another number of photographs, mixed sizes, NaN; white as dark as black; no valid
    pixel.

    >>> decode(GrayCode((4, 6)).patterns(), (4, 6)).decoded
    1.0
    """
    code = GrayCode(checks.grid("grid", grid))
    x, y = code.decode(images, levels=levels, edges=checks.flag("subpixel", subpixel))
    valid = (x.width <= 2.0) & (y.width <= 2.0)
    valid &= _consistent(x.value, valid) & _consistent(y.value, valid)
    if not valid.any():
        raise InputError(
            "photographs: no pixel is decoded; patterns must be in view, sharp, above the noise"
        )
    if not subpixel:
        return Correspondence(x.value, y.value, valid, code.grid)
    return Correspondence(_refine(x, valid, grid[1]), _refine(y, valid, grid[0]), valid, code.grid)


def _consistent(value: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Which of the valid coordinates (H, W) fit their neighbours'.

    The centre of a plane is the median of its 5 x 5 neighbourhood. A pixel may deviate from that by
    one projector pixel and twice the median absolute deviation of the neighbours, which is large at
    folds and borders, and must have three valid neighbours (fewer only where the picture is that
    small).
    """

    def median(value: np.ndarray, low: np.float32) -> np.ndarray:
        """Of the valid neighbours, within one rank; invalid ones are `low` and far in turn."""
        filled = np.full(value.shape, FAR)
        filled[::2, 1::2] = filled[1::2, ::2] = low
        np.copyto(filled, value, "same_kind", where=valid)
        return cv2.medianBlur(filled, NEIGHBOURS)

    deviation = np.abs(value - median(value, -FAR))
    # Invalid pixels count as half very near and half very far: they leave the median where it is.
    spread = np.minimum(median(deviation, np.float32(0.0)), FAR / 4)
    size, border = (NEIGHBOURS, NEIGHBOURS), cv2.BORDER_CONSTANT
    count = cv2.boxFilter(valid.view(np.uint8), -1, size, normalize=False, borderType=border)
    return valid & (count > min(3, value.size - 1)) & (deviation <= 1.0 + 2.0 * spread)


def _refine(axis: Axis, valid: np.ndarray, size: int) -> np.ndarray:
    """Projector coordinate (H, W) float32 of the valid pixels, to a fraction of a pixel.

    `size`: projector pixels along the axis. Camera pixels that see a part of the outermost of these
    may lie beyond them.
    """
    half = axis.width / 2 + LEAVES
    cell = np.stack([axis.value - half, axis.value + half])
    cell[0, cell[0] < 0] -= BEYOND
    cell[1, cell[1] > size - 1] += BEYOND
    # Camera pixels on each side of a window for a few edges, by their mean distance.
    edges = sum(np.count_nonzero(np.isfinite(fractions)) for fractions in (axis.right, axis.below))
    reach = int(np.clip(ACROSS * np.count_nonzero(valid) / max(edges, 1) + 1, SMALLEST, LARGEST))
    planes = _planes(axis, valid, reach)
    value = _at(
        planes, *(place.astype(np.float32) for place in np.ogrid[tuple(map(slice, valid.shape))])
    )
    v, u = np.nonzero(valid & ((planes[6] > SPREAD) | (planes[7] < LINE * reach**2)))
    while len(v):
        value[v, u], spread = _best(cell[:, v, u], planes, reach, v, u)
        border = (spread > SPREAD) & np.isfinite(
            spread
        )  # too few edges are fewer in smaller windows
        v, u = v[border], u[border]
        if reach <= SMALLEST or len(v) == 0:
            break
        reach = max(reach // 2, SMALLEST)
        planes = _planes(axis, valid, reach)
    return np.where(valid & (cell[0] <= value) & (value <= cell[1]), value, axis.value)


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
        better = (error < least) & (cell[0] <= value) & (value <= cell[1])
        for result, here in ((best, value), (spread, plane[6]), (least, error)):
            np.copyto(result, here, where=better)
    return best, spread


def _planes(axis: Axis, valid: np.ndarray, reach: int) -> np.ndarray:
    """Least-squares planes through the window about each pixel, (8, H, W) float32.

    Number of edges; means of u, v, x; slopes b, c; deviation of edges; least variance of their
    places.
    """
    H, W = valid.shape
    planes = np.empty((8, H, W), np.float32)

    def strip(rows: slice) -> None:
        top = max(rows.start - reach, 0)
        # One row more: edges below the last one of the window.
        moments = _moments(axis, valid, slice(top, min(rows.stop + reach + 1, H)), 2 * reach + 1)
        n, *means = (moment[rows.start - top : rows.stop - top] for moment in moments)
        weight = 1.0 / np.maximum(n, 1e-6)  # no valid pixel near
        mean_u, mean_v, mean_x, uu, uv, vv, ux, vx, xx = (
            np.multiply(m, weight, out=m) for m in means
        )
        # A little more spread than there is: edges on one line determine the slope across it only.
        uu += 1e-3 - mean_u**2
        vv += 1e-3 - mean_v**2
        uv -= mean_u * mean_v
        ux -= mean_u * mean_x
        vx -= mean_v * mean_x
        xx -= mean_x**2
        det = np.maximum(uu * vv - uv**2, 1e-9)
        b, c = (ux * vv - vx * uv) / det, (vx * uu - ux * uv) / det
        deviation = np.sqrt(np.maximum(xx - b * ux - c * vx, 0.0))
        deviation[n < EDGES] = np.inf
        planes[:, rows] = (
            np.maximum(n, 1e-6),
            mean_u,
            mean_v + top,
            mean_x,
            b,
            c,
            deviation,
            det / (uu + vv),
        )

    in_strips(H, max(STRIP // W, 4 * reach), strip)
    return planes


def _moments(axis: Axis, valid: np.ndarray, rows: slice, window: int) -> list[np.ndarray]:
    """Sums over the window about each pixel of w, w u, w v, w x, w uu, w uv, w vv, w ux, w vx and w xx.

    Edges to the right are at (u + r, v), those below at (u, v + d), with r and d in [0, 1]; v
    counts from the first of the rows.
    """
    valid, value, place = valid[rows], axis.value[rows].astype(np.float64), axis.place[rows]
    v, u = np.ogrid[: float(len(valid)), : float(valid.shape[1])]
    n = np.where(valid, WEIGHT, 0.0)
    r, rx, d, dx = (np.zeros_like(n) for _ in range(4))
    x = n * value
    xx = x * value
    shifts = (axis.right[rows], r, rx), (axis.below[rows], d, dx)
    for (fractions, t, tx), (here, there) in zip(shifts, ADJACENT, strict=True):
        edge = np.isfinite(fractions[here]) & valid[here] & valid[there]
        between = edge * (0.5 * (place[here] + place[there]))
        np.copyto(t[here], fractions[here], where=edge)
        np.multiply(t[here], between, out=tx[here])
        n[here] += edge
        x[here] += between
        xx[here] += between * between
    nu, nv = n * u + r, n * v + d
    total = [n, nu, nv, x, (nu + r) * u + r * r, nu * v + d * u, (nv + d) * v + d * d]
    total += [x * u + rx, x * v + dx, xx]
    size, border = (window, window), cv2.BORDER_CONSTANT
    return [cv2.boxFilter(plane, -1, size, normalize=False, borderType=border) for plane in total]
