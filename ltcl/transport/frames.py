# SPDX-License-Identifier: BSD-3-Clause
"""Pictures as right-hand sides of a linear system, one array of columns for each colour channel.

picture                       right-hand sides of a system of N = h * w pixels
(h, w) or flat (N,)           (N, 1)
(k, h, w), k frames           (N, k); (3, h, w) is refused for a T in colour, as ambiguous
(h, w, 3)                     three of (N, 1); of a T with one channel, one (N, 3)
(k, h, w, 3)                  three of (N, k); of a T with one channel, one (N, 3 k)
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError

logger = logging.getLogger(__name__)
UNITS = (
    "it is taken as linear light in the units of T; divide by %d, or read sRGB by ltcl.images.read"
)
# Pixels that are transposed at once: they fit the caches.
PIXELS_PER_TRANSPOSE = 4096


@dataclass(frozen=True)
class PictureLayout:
    """The shape of a picture.

    Attributes
    ----------
    flat : bool
        Whether the pixels are on one axis (N,).
    frames : int or None
        Number of frames; None for a single picture without a frame axis.
    colour : bool
        Whether results have a last axis of 3.
    """

    flat: bool
    frames: int | None
    colour: bool

    @property
    def frame_count(self) -> int:
        """Frames of the picture, 1 for a single one."""
        return 1 if self.frames is None else self.frames

    def pack(self, columns: Sequence[np.ndarray], grid: tuple[int, int]) -> np.ndarray:
        """The picture of right-hand sides: (N, k) of each channel, or one (3 N, k) of all three."""
        n = grid[0] * grid[1]
        if len(columns[0]) != n:
            columns = np.split(columns[0], 3)
        return self._interleave(columns).reshape(self.shape(grid))

    def shape(self, grid: tuple[int, int]) -> tuple[int, ...]:
        """The shape of a result on that grid."""
        shape: tuple[int, ...] = (grid[0] * grid[1],) if self.flat else grid
        if self.frames is not None:
            shape = (self.frames, *shape)
        if self.colour:
            shape = (*shape, 3)
        return shape

    def stacked(self, count: int) -> PictureLayout:
        """The layout of `count` pictures of this one, all as frames."""
        return dataclasses.replace(self, frames=count * self.frame_count)

    def columns(self, picture: np.ndarray, pixels: int, channels: int) -> list[np.ndarray]:
        """Copies of the values of a picture as right-hand sides (N, k) of each channel."""
        # (frames, N, 1 or 3)
        values = picture.reshape(self.frame_count, pixels, -1)
        if channels == 1:
            column = np.array(values.transpose(1, 0, 2), order="C").reshape(pixels, -1)
            return [column]
        columns = []
        for channel in range(channels):
            column = np.empty((pixels, len(values)), values.dtype)
            # A grey picture has the same light in each channel.
            column[...] = values[..., min(channel, values.shape[2] - 1)].T
            columns.append(column)
        return columns

    def _interleave(self, columns: Sequence[np.ndarray]) -> np.ndarray:
        if len(columns) == 1:
            return self._from_one_channel(columns[0])
        return self._from_three_channels(columns)

    def _from_one_channel(self, column: np.ndarray) -> np.ndarray:
        """(frames, N, colours) from (N, frames * colours)."""
        colours = 3 if self.colour else 1
        values = np.reshape(column, (len(column), self.frame_count, colours))
        return values.transpose(1, 0, 2).copy()

    def _from_three_channels(self, columns: Sequence[np.ndarray]) -> np.ndarray:
        """(frames, N, 3) from three (N, frames)."""
        n = len(columns[0])
        values = np.empty((self.frame_count, n, 3), np.result_type(*columns))
        for start in range(0, n, PIXELS_PER_TRANSPOSE):
            rows = slice(start, start + PIXELS_PER_TRANSPOSE)
            for channel, column in enumerate(columns):
                values[:, rows, channel] = column[rows].T
        return values


def unpack(
    name: str, picture: Any, grid: tuple[int, int], channels: int
) -> tuple[list[np.ndarray], PictureLayout]:
    """Copies of a picture as right-hand sides (N, k) of each channel; warns of integers above 1."""
    array = checks.finite(name, checks.real(name, picture))
    _warn_of_codes(name, array)
    if array.dtype not in (np.float32, np.float64):
        array = array.astype(np.float64)
    layout = find_layout(name, array.shape, grid, channels)
    return layout.columns(array, grid[0] * grid[1], channels), layout


def _warn_of_codes(name: str, array: np.ndarray) -> None:
    """Warn of integers above 1, which are codes of a file rather than light."""
    is_integer = array.dtype.kind in "iu"
    if not is_integer or array.size == 0 or array.max() <= 1:
        return
    white = 255
    if array.dtype in (np.uint8, np.uint16):
        white = np.iinfo(array.dtype).max
    logger.warning("%s holds %s, up to %d; %s", name, array.dtype, array.max(), UNITS % white)


def find_layout(
    name: str, shape: tuple[int, ...], grid: tuple[int, int], channels: int
) -> PictureLayout:
    """The layout of the first shape that fits: flat, colour, grey; refused if there is none."""
    colour_grid = (*grid, 3)
    is_colour_result = channels == 3 or shape[-3:] == colour_grid
    if shape == (grid[0] * grid[1],):
        return PictureLayout(True, None, is_colour_result)
    for size in (colour_grid, grid):
        if shape == size:
            return PictureLayout(False, None, is_colour_result)
        if shape[1:] == size and shape[0]:
            _check_unambiguous(name, shape, grid, channels)
            return PictureLayout(False, shape[0], is_colour_result)
    allowed = f"{grid}, {(*grid, 3)} or frames of these"
    if shape[-3:] == (3, *grid):
        allowed += f"; if it is in colour, colours come last: numpy.moveaxis({name}, -3, -1)"
    raise InputError(f"{name} has shape {shape}; it must be {allowed}")


def to_light(
    columns: Sequence[np.ndarray], F: np.ndarray, mixing: np.ndarray | None
) -> list[np.ndarray]:
    """Projector light F^-1 l_d of direct components l_d (N, k) by channel; 0 where F is 0."""
    light = []
    for l_d, f in zip(columns, F, strict=True):
        divisor = f
        if np.min(f) <= 0:
            # Light divided by infinity is 0.
            divisor = np.where(f > 0, f, np.inf)
        light.append(l_d / divisor[:, None])
    if mixing is None:
        return light
    return list(np.einsum("ij,jnk->ink", np.linalg.inv(mixing), light))


def _check_unambiguous(
    name: str, shape: tuple[int, ...], grid: tuple[int, int], channels: int
) -> None:
    """Refuse (3, h, w) for a T in colour: three grey frames, or the colours of one picture."""
    if channels == 3 and shape == (3, *grid):
        raise InputError(
            f"{name} has shape {shape}: three grey frames, or the colours of one picture? "
            f"It must be {(*grid, 3)} for colours, numpy.moveaxis({name}, 0, -1), "
            f"or {(3, *grid, 3)} for frames, numpy.stack([{name}] * 3, -1)"
        )
