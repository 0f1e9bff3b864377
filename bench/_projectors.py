# SPDX-License-Identifier: BSD-3-Clause
"""Virtual projectors on one corner: direct light with blur, a response, and a shift after the scan.

Each lights a window of the camera's picture, blurred in its own pixels; S of the corner is shared.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import scipy.ndimage
import scipy.optimize
import scipy.sparse

# Weights below this part of a row are left out.
MIN_WEIGHT = 1e-4
# Share of the picture that projectors light beyond its border.
OVERSCAN = 0.05
CODES = 255
# Camera pixels beside the crease, and along the border, that do not count as seams.
CREASE = 6
EDGE = 5


@dataclass(frozen=True, kw_only=True)
class VirtualProjector:
    """A projector of `grid` pixels on a window (top, bottom, left, right) of the camera's picture.

    Attributes
    ----------
    gain : float
        Its brightness.
    blur : float
        Standard deviation in its own pixels.
    gamma : float
        Light of a code is code^gamma.
    shift : (dy, dx)
        In its own pixels, since the scan.
    """

    grid: tuple[int, int]
    window: tuple[float, float, float, float] = (0.0, 1.0, 0.0, 1.0)
    gain: float = 1.0
    blur: float = 0.6
    gamma: float = 2.2
    shift: tuple[float, float] = (0.0, 0.0)

    def direct(self, camera_grid: tuple[int, int], albedo: float = 1.0) -> scipy.sparse.csr_array:
        """F_k (M, N_k): the part of each projector pixel in the direct light of camera pixels."""
        top, bottom, left, right = self.window
        rows = _blurred(camera_grid[0], (top, bottom), self.grid[0], self.blur, self.shift[0])
        columns = _blurred(camera_grid[1], (left, right), self.grid[1], self.blur, self.shift[1])
        product = scipy.sparse.kron(scipy.sparse.csr_array(rows), scipy.sparse.csr_array(columns))
        return scipy.sparse.csr_array(albedo * self.gain * product)

    def shown(self, pattern: np.ndarray) -> np.ndarray:
        """The light of a pattern after it has become codes of 8 bits."""
        codes = np.rint(CODES * np.clip(pattern, 0.0, 1.0) ** (1.0 / self.gamma))
        return (codes / CODES) ** self.gamma

    def moved(self, dy: float, dx: float) -> VirtualProjector:
        """The same projector after a nudge."""
        return dataclasses.replace(self, shift=(dy, dx))


def _blurred(
    camera_pixels: int, span: tuple[float, float], pixels: int, blur: float, shift: float
) -> np.ndarray:
    """Weights (camera pixels, projector pixels) along one axis; what falls beside is lost."""
    start, stop = span
    place = (np.arange(camera_pixels) + 0.5) / camera_pixels
    at = (place - start) / (stop - start) * pixels - 0.5 + shift
    everywhere = np.arange(-3 * pixels, 4 * pixels)
    weights = np.exp(-0.5 * np.square((at[:, None] - everywhere) / blur))
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), np.finfo(np.float64).tiny)
    inside = weights[:, 3 * pixels : 4 * pixels]
    return np.where(inside > MIN_WEIGHT, inside, 0.0)


def tiled(
    rows: int, columns: int, grid: tuple[int, int], overlap: float, gamma_spread: float = 0.6
) -> list[VirtualProjector]:
    """rows x columns projectors that overlap by a part of their size, of several gains."""
    projectors = []
    count = rows * columns
    for number in range(count):
        row, column = divmod(number, columns)
        top, bottom = _span(row, rows, overlap)
        left, right = _span(column, columns, overlap)
        at = number / max(count - 1, 1)
        projectors.append(
            VirtualProjector(
                grid=grid,
                window=(top, bottom, left, right),
                gain=1.0 + 0.25 * ((number % 3) - 1),
                blur=0.5 + 0.2 * (number % 2),
                gamma=2.2 + gamma_spread * (at - 0.5),
            )
        )
    return projectors


def _span(number: int, count: int, overlap: float) -> tuple[float, float]:
    """Begin and end of one of `count` parts of 0 .. 1."""
    size = (1.0 + 2.0 * OVERSCAN) / (count - (count - 1) * overlap)
    start = number * size * (1.0 - overlap) - OVERSCAN
    return start, start + size


def least_seam(
    projectors: list[VirtualProjector],
    camera_grid: tuple[int, int],
    shift: float,
    reach: int,
    local: int,
) -> float:
    """The least seam that any weights can have, by a linear program along one axis.

    Where the first projector fades to the next one below it, or beside it where there is none
    below, an even picture changes by d = (A' - A) w after its shift, with its weights w and its
    blur before and after, A and A'. Weights are 1 where it is alone; all others are free. The seam
    is the largest |d - mean of d over `local` pixels| near both borders.
    """
    first = projectors[0]
    axis = 0 if first.window[1] < 1.0 else 1
    begin, end = first.window[2 * axis : 2 * axis + 2]
    next_begin = min(p.window[2 * axis] for p in projectors if p.window[2 * axis] > begin)
    pixels = first.grid[axis]
    camera = camera_grid[axis]
    A = _blurred(camera, (begin, end), pixels, first.blur, 0.0)
    moved = _blurred(camera, (begin, end), pixels, first.blur, shift)
    change = moved - A
    detail = change - scipy.ndimage.uniform_filter1d(change, local, axis=0, mode="nearest")
    y = np.arange(camera) + 0.5
    near = np.minimum(np.abs(y - end * camera), np.abs(y - next_begin * camera)) <= reach
    detail = detail[near]
    # Unknowns are w and the largest deviation.
    place = begin + (np.arange(pixels) + 0.5) / pixels * (end - begin)
    bounds = [(1.0, 1.0) if at < next_begin else (0.0, 1.0) for at in place]
    ones = np.ones((len(detail), 1))
    limits = np.block([[detail, -ones], [-detail, -ones]])
    cost = np.append(np.zeros(pixels), 1.0)
    # Its light ends with its last pixel, which has to be dark.
    bounds[-1] = (0.0, 0.0)
    solution = scipy.optimize.linprog(
        cost, limits, np.zeros(len(limits)), bounds=[*bounds, (0.0, None)]
    )
    return float(solution.fun)


def border_band(
    projectors: list[VirtualProjector], camera_grid: tuple[int, int], reach: int
) -> np.ndarray:
    """Camera pixels within `reach` of a projector's border that lies inside of the picture.

    The crease of the corner and the border of the picture, where any shift shows, do not count.
    """
    H, W = camera_grid
    y = np.arange(H)[:, None] + 0.5
    x = np.arange(W)[None, :] + 0.5
    band = np.zeros(camera_grid, bool)
    for projector in projectors:
        top, bottom, left, right = projector.window
        is_in_rows = (y > H * top - reach) & (y < H * bottom + reach)
        is_in_columns = (x > W * left - reach) & (x < W * right + reach)
        for edge, size in ((top, H), (bottom, H)):
            if 0.01 < edge < 0.99:
                band |= (np.abs(y - edge * size) <= reach) & is_in_columns
        for edge, size in ((left, W), (right, W)):
            if 0.01 < edge < 0.99:
                band |= (np.abs(x - edge * size) <= reach) & is_in_rows
    is_plain = (np.abs(x - 0.5 * W) > CREASE) & (x > EDGE) & (x < W - EDGE)
    return band & is_plain & (y > EDGE) & (y < H - EDGE)
