# SPDX-License-Identifier: BSD-3-Clause
"""Pictures on one side, right-hand sides of a linear system on the other.

A picture is (h, w) or (h, w, 3), with frames in front where there are several, or flat (N,). A system of
N pixels takes (N, k), a column a frame, and for a transport of one channel a column a colour, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError


@dataclass(frozen=True)
class Layout:
    """The shape of a picture, so that results come back in the same one.

    `colour` tells whether results have a last axis of 3; `frames` is None for a single picture.
    """

    flat: bool
    frames: int | None
    colour: bool

    def pack(self, columns: Sequence[np.ndarray], grid: tuple[int, int]) -> np.ndarray:
        """The picture whose right-hand sides are `columns`, one (N, k) array per transport channel."""
        frames = self.frames or 1
        n = grid[0] * grid[1]
        if len(columns) == 1:
            values = np.reshape(columns[0], (n, frames, 3 if self.colour else 1)).transpose(1, 0, 2)
        else:
            values = np.stack([column.T for column in columns], axis=-1)
        pixels = (n,) if self.flat else grid
        shape = (() if self.frames is None else (frames,)) + pixels + ((3,) if self.colour else ())
        return np.ascontiguousarray(values).reshape(shape)


def unpack(name: str, picture: Any, grid: tuple[int, int], channels: int) -> tuple[list[np.ndarray], Layout]:
    """Cut a picture into the right-hand sides of each channel of a transport.

    Parameters
    ----------
    name : str
        What the picture is called in a refusal.
    picture : (h, w), (h, w, 3), (frames, h, w), (frames, h, w, 3) or (N,)
        A grey picture serves all three channels of a colour transport.
    grid : (h, w)
    channels : int
        1 or 3, of the transport.

    Returns
    -------
    columns : list of (N, k) arrays, one per channel
    layout : Layout

    Raises
    ------
    InputError
        Another size, NaN or infinite values.

    >>> columns, layout = unpack("image", np.zeros((4, 5, 3)), (4, 5), channels=1)
    >>> columns[0].shape, layout.pack(columns, (4, 5)).shape
    ((20, 3), (4, 5, 3))
    """
    array = checks.finite(name, checks.real(name, picture))
    layout = _layout(name, array, grid, channels)
    n = grid[0] * grid[1]
    values = array.reshape(layout.frames or 1, n, -1)  # (frames, N, 1 or 3)
    if channels == 1:
        return [np.ascontiguousarray(values.transpose(1, 0, 2)).reshape(n, -1)], layout
    values = np.broadcast_to(values, (*values.shape[:2], 3))
    return [np.ascontiguousarray(values[:, :, channel].T) for channel in range(3)], layout


def _layout(name: str, array: np.ndarray, grid: tuple[int, int], channels: int) -> Layout:
    n = grid[0] * grid[1]
    for shape, flat, colour in (((n,), True, False), (grid, False, False), ((*grid, 3), False, True)):
        if array.shape == shape:
            return Layout(flat, None, colour or channels == 3)
    for shape, colour in ((grid, False), ((*grid, 3), True)):
        if array.ndim > 2 and array.shape[1:] == shape and len(array):
            return Layout(False, len(array), colour or channels == 3)
    h, w = grid
    raise InputError(
        f"{name} has shape {array.shape}; it must be ({h}, {w}), ({h}, {w}, 3) or frames of these"
    )
