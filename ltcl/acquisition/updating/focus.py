# SPDX-License-Identifier: BSD-3-Clause
"""What a pixel that is out of focus lights around it, as the camera's pixels show it.

A camera pixel sees the mean of the pattern over its footprint, blurred by projector and lens: by a
Gaussian of the deviation s, in projector pixels. With the resampling R of pictures and what camera
pixels see of each projector pixel, S(s), a flat white wall would show

    D = R S(s)

on the projector's pixels. Its entries around the diagonal vary from pixel to pixel, as the camera's
pixels fall on the projector's; after the projector has moved they vary otherwise. s is the one
whose D is most like the old T, by absolute differences, since few pixels lie near a crease. In a
sharp picture the entries beside the diagonal are but errors of the map: if they are more like their
medians than like D, nothing is known of the focus.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy  # its subpackages optimize and special are loaded at the first use
import scipy.sparse

from ltcl.acquisition.estimation.windows import REACH
from ltcl.acquisition.geometry import Correspondence, Resampling
from ltcl.acquisition.geometry.footprints import Footprints
from ltcl.acquisition.updating.movement import MIN_FOOTPRINT, Movement

# Pixels along both sides of a window around a pixel.
WINDOW = 2 * REACH + 1
MIDDLE = WINDOW**2 // 2
# Largest deviation of the blur, in projector pixels, with which a scan is refused, and how well it
# is found.
MAX_BLUR = 0.5
BLUR_STEP = 0.002
# Pixels to which the blur is fitted, at random, and whose light is computed at once.
FITTED_PIXELS = 1 << 10
CHUNK_PIXELS = 1 << 12
SEED = 3
# Light of a pixel on a flat white wall that counts at least.
LEAST_LIGHT = 0.1
# Least deviation of a Gaussian: a hundredth of a pixel.
MIN_BLUR = 0.01


@dataclass(frozen=True, eq=False, kw_only=True)
class Focus:
    """Light of a flat white wall around the diagonal of T, (N, 25), in the scan and now."""

    before: np.ndarray
    now: np.ndarray

    def refocused(self, direct: np.ndarray, rows: Any) -> np.ndarray:
        """Direct light (N, 25) at the places of now, as `rows` (N, N) interpolate."""
        reflected = direct.sum(axis=1) / np.maximum(self.before.sum(axis=1), LEAST_LIGHT)
        rest = direct - reflected[:, None] * self.before
        return (rows @ reflected)[:, None] * self.now + rows @ rest

    def own_change(self, rows: Any) -> np.ndarray:
        """The own light of pixels (N,) relative to that which `rows` interpolate."""
        own = self.before[:, MIDDLE]
        return self.now[:, MIDDLE] / np.maximum(rows @ own, LEAST_LIGHT)


@dataclass(frozen=True, eq=False, kw_only=True)
class Optics:
    """Places of the camera's pixels on the projector's, and the resampling of pictures.

    `width` is that of a camera pixel in projector pixels.
    """

    mapping: Correspondence
    resampling: Resampling
    movement: Movement
    width: float

    def flat_wall(self, blur: float) -> np.ndarray:
        """D of a flat white wall around the diagonal, (N, 25)."""
        height, width = self.mapping.grid
        numbers = np.arange(height * width)
        chunks = np.split(numbers, range(CHUNK_PIXELS, len(numbers), CHUNK_PIXELS))
        return np.concatenate([self.flat_wall_at(chunk, blur) for chunk in chunks])

    def flat_wall_at(self, pixels: np.ndarray, blur: float) -> np.ndarray:
        """D of a flat white wall around the diagonal, for some pixels (n,), (n, 25)."""
        height, width = self.mapping.grid
        weights = scipy.sparse.csr_array(self.resampling.weights[pixels])
        camera = np.unique(weights.indices)
        row, column = self.movement.forward(
            self.mapping.y.ravel()[camera].astype(np.float64),
            self.mapping.x.ravel()[camera].astype(np.float64),
        )
        down, lit_rows = _blurred(row, height, self.width, blur)
        across, lit_columns = _blurred(column, width, self.width, blur)
        light = down[:, :, None] * across[:, None, :]
        lit = lit_rows[:, :, None] * width + lit_columns[:, None, :]
        places = np.repeat(np.arange(len(camera)), WINDOW**2), lit.ravel()
        seen = scipy.sparse.csr_array((light.ravel(), places), shape=(len(camera), height * width))
        wall = scipy.sparse.coo_array(weights[:, camera] @ seen)
        return near_diagonal(wall, self.mapping.grid, pixels)


def find_focus(
    near: np.ndarray,
    mapping: Correspondence,
    before: Resampling,
    now: Resampling,
    movement: Movement,
) -> Focus | None:
    """The focus of a transport whose entries around the diagonal are `near`, (N, 25).

    None if the camera's pixels do not explain how these vary.
    """
    width = float(np.clip(Footprints.from_map(mapping).width, MIN_FOOTPRINT, 1.0))
    still = Movement.shift(mapping.grid)
    optics = Optics(mapping=mapping, resampling=before, movement=still, width=width)
    lit = np.flatnonzero((near[:, MIDDLE] > 0) & before.seen.ravel())
    if len(lit) == 0:
        return None
    lit = np.random.default_rng(SEED).permutation(lit)[:FITTED_PIXELS]
    shares = near[lit] / near[lit, MIDDLE, None]

    def left(blur: float) -> float:
        wall = optics.flat_wall_at(lit, blur)
        expected = wall / np.maximum(wall[:, MIDDLE, None], LEAST_LIGHT)
        return float(np.abs(shares - expected).sum())

    found: Any = scipy.optimize.minimize_scalar(
        left, bounds=(0.0, MAX_BLUR), method="bounded", options={"xatol": BLUR_STEP}
    )
    constant = np.abs(shares - np.median(shares, axis=0)).sum()
    if found.fun >= constant:
        return None
    moved = replace(optics, resampling=now, movement=movement)
    return Focus(before=optics.flat_wall(found.x), now=moved.flat_wall(found.x))


def _blurred(
    place: np.ndarray, pixels: int, width: float, blur: float
) -> tuple[np.ndarray, np.ndarray]:
    """Light of the pixels around places along one side, and their numbers, (n, 5) each."""
    number = np.rint(place)[:, None] + np.arange(-REACH, REACH + 1)
    is_there = (number >= 0) & (number < pixels)
    start = number - 0.5 - place[:, None]
    s = max(blur, MIN_BLUR)
    light = _integral(start + 1.0, width, s) - _integral(start, width, s)
    return np.where(is_there, light, 0.0), np.where(is_there, number, 0).astype(np.int64)


def _integral(x: np.ndarray, width: float, s: float) -> np.ndarray:
    """Integral up to x of a box of a width and unit area, blurred by a Gaussian."""
    ends = []
    for end in ((x + width / 2) / s, (x - width / 2) / s):
        density = np.exp(-0.5 * end**2) / np.sqrt(2 * np.pi)
        ends.append(end * scipy.special.ndtr(end) + density)
    return (ends[0] - ends[1]) * s / width


def near_diagonal(
    entries: Any, grid: tuple[int, int], pixels: np.ndarray | None = None
) -> np.ndarray:
    """Entries up to `REACH` pixels from the diagonal, (n, 25), of a coo_array.

    Its rows are those of `pixels` (n,), by default of all.
    """
    width = grid[1]
    number = entries.row if pixels is None else pixels[entries.row]
    down = entries.col // width - number // width
    across = entries.col % width - number % width
    is_near = (np.abs(down) <= REACH) & (np.abs(across) <= REACH)
    offset = (down + REACH) * WINDOW + across + REACH
    near = np.zeros((entries.shape[0], WINDOW**2))
    near[entries.row[is_near], offset[is_near]] = entries.data[is_near]
    return near
