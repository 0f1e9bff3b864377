# SPDX-License-Identifier: BSD-3-Clause
"""Pictures as right-hand sides of a linear system, matrices by colour channel.

A picture is (h, w), (h, w, 3), frames of these, or flat (N,). A system of N pixels takes (N, k), a
column a frame, and for a transport of one channel a column a colour, too.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from ltcl import checks
from ltcl.errors import InputError

logger = logging.getLogger(__name__)
UNITS = (
    "it is taken as linear light in the units of T; divide by %d, or read sRGB by ltcl.images.read"
)
_BLOCK = 4096  # pixels that are transposed at once: caches hold them
_LARGEST_CONDITION = 1e6  # of a mixing: beyond, float32 has hardly a digit left


@dataclass(frozen=True)
class Layout:
    """The shape of a picture: results have a last axis of 3 if `colour`, `frames` is None of a single one."""

    flat: bool
    frames: int | None
    colour: bool

    def pack(self, columns: Sequence[np.ndarray], grid: tuple[int, int]) -> np.ndarray:
        """The picture whose right-hand sides are `columns`, one (N, k) a channel, or (3 N, k) of three."""
        frames, n = self.frames or 1, grid[0] * grid[1]
        if len(columns[0]) != n:
            columns = np.split(columns[0], 3)
        if len(columns) == 1:
            values = (
                np.reshape(columns[0], (n, frames, 3 if self.colour else 1))
                .transpose(1, 0, 2)
                .copy()
            )
        else:
            values = np.empty((frames, n, 3), np.result_type(*columns))
            for start in range(0, n, _BLOCK):
                rows = slice(start, start + _BLOCK)
                for channel, column in enumerate(columns):
                    values[:, rows, channel] = column[rows].T
        pixels = (n,) if self.flat else grid
        shape = (() if self.frames is None else (frames,)) + pixels + ((3,) if self.colour else ())
        return values.reshape(shape)


def unpack(
    name: str, picture: Any, grid: tuple[int, int], channels: int
) -> tuple[list[np.ndarray], Layout]:
    """Copies of a picture as right-hand sides (N, k) of each channel; warns of the codes of a file."""
    array = checks.finite(name, checks.real(name, picture))
    if array.dtype.kind in "iu" and array.size and array.max() > 1:
        white = np.iinfo(array.dtype).max if array.dtype in (np.uint8, np.uint16) else 255
        logger.warning("%s holds %s, up to %d; %s", name, array.dtype, array.max(), UNITS % white)
    if array.dtype not in (np.float32, np.float64):
        array = array.astype(np.float64)
    n = grid[0] * grid[1]
    for size, flat, colour in (
        ((n,), True, False),
        ((*grid, 3), False, True),
        (grid, False, False),
    ):
        if array.shape == size or (not flat and array.shape[1:] == size and len(array)):
            frames = None if array.shape == size else len(array)
            layout = Layout(flat, frames, colour or channels == 3)
            break
    else:
        allowed = f"{grid}, {(*grid, 3)} or frames of these"
        raise InputError(f"{name} has shape {array.shape}; it must be {allowed}")
    values = array.reshape(layout.frames or 1, n, -1)  # (frames, N, 1 or 3)
    if channels == 1:
        return [np.array(values.transpose(1, 0, 2), order="C").reshape(n, -1)], layout
    columns = [np.empty((n, len(values)), values.dtype) for _ in range(3)]
    for channel, column in enumerate(columns):
        column[...] = values[..., min(channel, values.shape[2] - 1)].T
    return columns, layout


def to_light(
    columns: Sequence[np.ndarray], F: np.ndarray, mixing: np.ndarray | None
) -> list[np.ndarray]:
    """Projector light F^-1 l_d from direct components (N, k) of each channel; 0 where F is."""
    lit = (f if np.min(f) > 0 else np.where(f > 0, f, np.inf) for f in F)  # light / inf = 0
    light = [l_d / f[:, None] for l_d, f in zip(columns, lit, strict=True)]
    return light if mixing is None else list(np.einsum("ij,jnk->ink", np.linalg.inv(mixing), light))


def matrices(value: Any, name: str = "matrix") -> tuple[Any, ...]:
    """The checked matrices of 1 or 3 channels; one of a sequence is grey."""
    if _is_matrix(value):
        channels = [value]
    elif isinstance(value, (list, tuple)) and any(map(_is_matrix, value)):
        channels = list(value)
    else:
        array = checks.real(name, value)
        channels = list(array) if array.ndim == 3 else [array]
    if len(channels) not in (1, 3):
        shape = (
            f"shape {value.shape}" if isinstance(value, np.ndarray) else f"{len(channels)} channels"
        )
        raise InputError(
            f"{name} has {shape}; it must be (M, N), or three of these for RGB, (3, M, N)"
        )
    return _checked(
        name, {f"{name}[{c}]" if channels[1:] else name: T for c, T in enumerate(channels)}
    )


def blocks(value: Any) -> tuple[tuple[Any, ...], ...] | None:
    """3 x 3 checked matrices of one shape, or None where `value` is no nested sequence or (3, 3, M, N)."""
    rows = value if isinstance(value, (list, tuple)) or getattr(value, "ndim", 0) == 4 else []
    rows = [
        row if isinstance(row, (list, tuple)) or getattr(row, "ndim", 0) == 3 else []
        for row in rows
    ]
    if not any(any(map(_is_matrix, row)) for row in rows):
        return None
    if (sizes := [len(row) or 1 for row in rows]) != [3, 3, 3]:
        raise InputError(
            f"matrix has rows of {sizes} matrices; it must be 3 x 3 of them, or 3, or one"
        )
    named = {
        f"matrix[{c}][{d}]": block for c, row in enumerate(rows) for d, block in enumerate(row)
    }
    checked = _checked("matrix", named)
    return checked[:3], checked[3:6], checked[6:]


def mixing(value: Any, channels: int, coupled: Any) -> np.ndarray:
    """M (3, 3) float64 of a T of 3 channels without `coupled` blocks; a singular one is refused."""
    if channels != 3 or coupled is not None:
        kind = "one channel" if channels == 1 else "3 x 3 blocks, which mix colours themselves"
        raise InputError(f"mixing is given, but T has {kind}; it is for a T of 3 channels")
    M = checks.finite("mixing", checks.shape("mixing", checks.real("mixing", value), (3, 3)))
    M = M.astype(np.float64)
    if not (condition := float(np.linalg.cond(M))) < (most := _LARGEST_CONDITION):
        raise InputError(
            f"mixing has the condition number {condition:.3g}; it must be below {most:g}"
        )
    return M


def _is_matrix(value: Any) -> bool:
    return (
        scipy.sparse.issparse(value) or hasattr(value, "matvec") or getattr(value, "ndim", 0) == 2
    )


def _checked(name: str, named: dict[str, Any]) -> tuple[Any, ...]:
    """Matrices by their names as arrays, csr_array or LinearOperator, all of one shape."""
    checked = []
    for each, matrix in named.items():
        if len(np.shape(matrix)) != 2 or 0 in np.shape(matrix):
            raise InputError(f"{each} has shape {np.shape(matrix)}; it must be (M, N), not empty")
        if scipy.sparse.issparse(matrix):
            checked.append(checks.csr(each, matrix))
        elif hasattr(matrix, "matvec"):
            checked.append(scipy.sparse.linalg.aslinearoperator(matrix))
        else:
            checked.append(checks.finite(each, checks.real(each, matrix)))
    shapes = sorted({matrix.shape for matrix in checked})
    if len(shapes) > 1:
        raise InputError(f"{name} has parts of shapes {shapes}; all must be the same")
    return tuple(checked)
