# SPDX-License-Identifier: BSD-3-Clause
"""What users hold as arrays of a linear system: pictures as right-hand sides, matrices by colour channel.

A picture is (h, w) or (h, w, 3), with frames in front where there are several, or flat (N,). A system of
N pixels takes (N, k), a column a frame, and for a transport of one channel a column a colour, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from ltcl import checks
from ltcl.errors import InputError

_BLOCK = 2048  # pixels that are transposed at once: caches hold them
_LARGEST_CONDITION = 1e6  # of a mixing: beyond, float32 has hardly a digit left


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
        frames, n = self.frames or 1, grid[0] * grid[1]
        if len(columns) == 1:
            values = np.reshape(columns[0], (n, frames, 3 if self.colour else 1)).transpose(1, 0, 2)
        else:
            values = np.empty((frames, n, 3), np.result_type(*columns))
            step = _BLOCK if frames > 1 else n
            for start in range(0, n, step):
                for channel, column in enumerate(columns):
                    values[:, start : start + step, channel] = column[start : start + step].T
        pixels = (n,) if self.flat else grid
        shape = (() if self.frames is None else (frames,)) + pixels + ((3,) if self.colour else ())
        return np.ascontiguousarray(values).reshape(shape)


def unpack(name: str, picture: Any, grid: tuple[int, int], channels: int) -> tuple[list[np.ndarray], Layout]:
    """Cut a picture into the right-hand sides of each channel of a transport.

    Parameters
    ----------
    name : str
        Of the argument, for messages.
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
    columns = [np.empty(values.shape[1::-1], values.dtype) for _ in range(3)]
    for start in range(0, n, _BLOCK):
        for channel, column in enumerate(columns):
            column[start : start + _BLOCK] = values[
                :, start : start + _BLOCK, min(channel, values.shape[2] - 1)
            ].T
    return columns, layout


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


def to_light(columns: Sequence[np.ndarray], F: np.ndarray, mixing: np.ndarray | None) -> list[np.ndarray]:
    """Projector light F^-1 l_d from direct components (N, k) of each channel; 0 where F is.

    >>> to_light([np.array([[0.2], [0.3]])], np.array([[0.5, 0.0]]), None)[0].tolist()
    [[0.4], [0.0]]
    """
    lit = (f if np.min(f) > 0 else np.where(f > 0, f, np.inf) for f in F)  # light / inf = 0
    light = [l_d / f[:, None] for l_d, f in zip(columns, lit, strict=True)]
    return light if mixing is None else list(np.einsum("ij,jnk->ink", np.linalg.inv(mixing), light))


def matrices(value: Any, name: str = "matrix") -> tuple[Any, ...]:
    """The checked matrices of 1 or 3 channels; one of a sequence is grey."""
    if _is_matrix(value):
        parts = [value]
    elif isinstance(value, (list, tuple)) and any(_is_matrix(part) for part in value):
        parts = list(value)
    else:
        array = checks.real(name, value)
        parts = list(array) if array.ndim == 3 else [array]
    if len(parts) not in (1, 3):
        raise InputError(f"{name} has {len(parts)} channels; it must be one matrix, or three for RGB")
    names = [name] if len(parts) == 1 else [f"{name}[{channel}]" for channel in range(3)]
    checked = tuple(_checked(each, part) for each, part in zip(names, parts, strict=True))
    shapes = [part.shape for part in checked]
    if len(set(shapes)) > 1:
        raise InputError(f"{name} has channels of shapes {shapes}; all must be the same")
    return checked


def blocks(value: Any) -> tuple[tuple[Any, ...], ...] | None:
    """3 x 3 checked matrices of one shape, or None where `value` is no nested sequence or (3, 3, M, N)."""
    stacked = isinstance(value, np.ndarray) and value.ndim == 4 and value.shape[:2] == (3, 3)
    rows = (
        [row for row in value if isinstance(row, (list, tuple))] if isinstance(value, (list, tuple)) else []
    )
    if not stacked and not any(_is_matrix(part) for row in rows for part in row):
        return None
    sizes = [len(row) if isinstance(row, (list, tuple, np.ndarray)) else 1 for row in value]
    if sizes != [3, 3, 3]:
        raise InputError(f"matrix has rows of {sizes} matrices; it must be 3 x 3 of them, or 3, or one")
    checked = tuple(
        tuple(_checked(f"matrix[{c}][{d}]", part) for d, part in enumerate(row))
        for c, row in enumerate(value)
    )
    shapes = sorted({part.shape for row in checked for part in row})
    if len(shapes) > 1:
        raise InputError(f"matrix has blocks of shapes {shapes}; all must be the same")
    return checked


def mixing(value: Any, channels: int, coupled: Any) -> np.ndarray:
    """M (3, 3) float64 of a T of 3 channels without `coupled` blocks; a singular one is refused."""
    if channels != 3 or coupled is not None:
        kind = "one channel" if channels == 1 else "3 x 3 blocks, which mix colours themselves"
        raise InputError(f"mixing is given, but T has {kind}; it is for a T of 3 channels")
    M = checks.finite("mixing", checks.shape("mixing", checks.real("mixing", value), (3, 3)))
    condition = float(np.linalg.cond(M.astype(np.float64)))
    if not condition < _LARGEST_CONDITION:
        raise InputError(
            f"mixing has the condition number {condition:.3g}; it must be invertible, "
            f"below {_LARGEST_CONDITION:g}"
        )
    return M.astype(np.float64)


def _is_matrix(part: Any) -> bool:
    return scipy.sparse.issparse(part) or hasattr(part, "matvec") or getattr(part, "ndim", 0) == 2


def _checked(name: str, part: Any) -> Any:
    if len(np.shape(part)) != 2:
        raise InputError(f"{name} has shape {np.shape(part)}; it must be (M, N)")
    if 0 in np.shape(part):
        raise InputError(f"{name} has shape {np.shape(part)}; it must have at least one row and one column")
    if scipy.sparse.issparse(part):
        return checks.csr(name, part)
    if hasattr(part, "matvec"):
        return scipy.sparse.linalg.aslinearoperator(part)
    return checks.finite(name, checks.real(name, part))
