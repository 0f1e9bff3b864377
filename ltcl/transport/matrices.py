# SPDX-License-Identifier: BSD-3-Clause
"""Checks of the matrices of a transport: one (M, N), three for RGB, 3 x 3 blocks, and a mixing.

Checked matrices are NumPy arrays, `scipy.sparse.csr_array` or LinearOperators.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from ltcl import checks
from ltcl.errors import InputError

# Condition number of a mixing: above, float32 has hardly a digit left.
MAX_MIXING_CONDITION = 1e6


Blocks = tuple[tuple[Any, ...], ...]


def split_channels(value: Any) -> tuple[Blocks | None, tuple[Any, ...]]:
    """The 3 x 3 checked blocks or None, and the matrix of each channel: their diagonal."""
    blocks = check_blocks(value)
    if blocks is None:
        return None, check_matrices(value)
    return blocks, tuple(blocks[channel][channel] for channel in range(3))


def check_matrices(value: Any, name: str = "matrix") -> tuple[Any, ...]:
    """The checked matrices of 1 or 3 channels; a sequence of one matrix is grey."""
    if _is_matrix(value):
        channels = [value]
    elif isinstance(value, (list, tuple)) and any(map(_is_matrix, value)):
        channels = list(value)
    else:
        array = checks.real(name, value)
        channels = list(array) if array.ndim == 3 else [array]
    if len(channels) not in (1, 3):
        shape = f"{len(channels)} channels"
        if isinstance(value, np.ndarray):
            shape = f"shape {value.shape}"
        raise InputError(
            f"{name} has {shape}; it must be (M, N), or three of these for RGB, (3, M, N)"
        )
    if len(channels) == 1:
        return _check_parts(name, {name: channels[0]})
    named = {f"{name}[{channel}]": matrix for channel, matrix in enumerate(channels)}
    return _check_parts(name, named)


def check_blocks(value: Any) -> Blocks | None:
    """3 x 3 checked matrices of one shape; None if `value` is not nested, or (3, 3, M, N)."""
    rows = [_members(row, 3) for row in _members(value, 4)]
    if not any(_is_matrix(block) for row in rows for block in row):
        return None
    # A row that is one matrix, in place of a sequence, counts as one.
    sizes = [max(len(row), 1) for row in rows]
    if sizes != [3, 3, 3]:
        raise InputError(
            f"matrix has rows of {sizes} matrices; it must be 3 x 3 of them, or 3, or one"
        )
    named = {}
    for c, row in enumerate(rows):
        for d, block in enumerate(row):
            named[f"matrix[{c}][{d}]"] = block
    checked = _check_parts("matrix", named)
    return checked[:3], checked[3:6], checked[6:]


def check_mixing(value: Any, channels: int, has_blocks: bool) -> np.ndarray:
    """The (3, 3) float64 mixing of a T of 3 channels without blocks; a singular one is refused."""
    if channels != 3 or has_blocks:
        kind = "one channel"
        if has_blocks:
            kind = "3 x 3 blocks, which mix colours themselves"
        raise InputError(f"mixing is given, but T has {kind}; it is for a T of 3 channels")
    M = checks.shape("mixing", checks.real("mixing", value), (3, 3))
    M = checks.finite("mixing", M).astype(np.float64)
    condition = float(np.linalg.cond(M))
    # Written so that NaN is refused, too.
    if not condition < MAX_MIXING_CONDITION:
        raise InputError(
            f"mixing has the condition number {condition:.3g}; "
            f"it must be below {MAX_MIXING_CONDITION:g}"
        )
    return M


def _members(value: Any, ndim: int) -> Any:
    """The members of a sequence, or of an array with `ndim` dimensions; none of anything else."""
    if isinstance(value, (list, tuple)) or getattr(value, "ndim", 0) == ndim:
        return value
    return []


def _is_matrix(value: Any) -> bool:
    if scipy.sparse.issparse(value) or hasattr(value, "matvec"):
        return True
    return getattr(value, "ndim", 0) == 2


def _check_parts(name: str, named: dict[str, Any]) -> tuple[Any, ...]:
    """Checked matrices, all of one shape; `named` has their names for messages."""
    checked = []
    for part_name, matrix in named.items():
        checked.append(_check_matrix(part_name, matrix))
    shapes = sorted({matrix.shape for matrix in checked})
    if len(shapes) > 1:
        raise InputError(f"{name} has parts of shapes {shapes}; all must be the same")
    return tuple(checked)


def _check_matrix(name: str, matrix: Any) -> Any:
    shape = np.shape(matrix)
    if len(shape) != 2 or 0 in shape:
        raise InputError(f"{name} has shape {shape}; it must be (M, N), not empty")
    if scipy.sparse.issparse(matrix):
        return checks.csr(name, matrix)
    if hasattr(matrix, "matvec"):
        return scipy.sparse.linalg.aslinearoperator(matrix)
    return checks.finite(name, checks.real(name, matrix))
