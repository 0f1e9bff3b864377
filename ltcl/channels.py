# SPDX-License-Identifier: BSD-3-Clause
"""The matrices that a `Transport` is made of, by colour channel, checked on the host."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from ltcl import checks
from ltcl.errors import InputError

_WORST = 1e6  # condition number of a mixing, at which float32 has hardly a digit left


def own(matrix: Any, name: str = "matrix") -> tuple[Any, ...]:
    """The checked matrices of 1 or 3 channels; one of a sequence is grey. `name` is for refusals."""
    if _is_matrix(matrix):
        parts = [matrix]
    elif isinstance(matrix, (list, tuple)) and any(_is_matrix(part) for part in matrix):
        parts = list(matrix)
    else:
        array = checks.real(name, matrix)
        parts = list(array) if array.ndim == 3 else [array]
    if len(parts) not in (1, 3):
        raise InputError(f"{name} has {len(parts)} channels; it must be one matrix, or three for RGB")
    names = [name] if len(parts) == 1 else [f"{name}[{channel}]" for channel in range(3)]
    checked = tuple(_checked(each, part) for each, part in zip(names, parts, strict=True))
    shapes = [part.shape for part in checked]
    if len(set(shapes)) > 1:
        raise InputError(f"{name} has channels of shapes {shapes}; all must be the same")
    return checked


def blocks(matrix: Any) -> tuple[tuple[Any, ...], ...] | None:
    """3 x 3 checked matrices of one shape, or None where `matrix` is no nested sequence or (3, 3, M, N)."""
    stacked = isinstance(matrix, np.ndarray) and matrix.ndim == 4 and matrix.shape[:2] == (3, 3)
    nested = stacked or (
        isinstance(matrix, (list, tuple))
        and any(isinstance(row, (list, tuple)) for row in matrix)
        and any(_is_matrix(part) for row in matrix if isinstance(row, (list, tuple)) for part in row)
    )
    if not nested:
        return None
    sizes = [len(row) if isinstance(row, (list, tuple, np.ndarray)) else 1 for row in matrix]
    if sizes != [3, 3, 3]:
        raise InputError(f"matrix has rows of {sizes} matrices; it must be 3 x 3 of them, or 3, or one")
    found = tuple(
        tuple(_checked(f"matrix[{c}][{d}]", part) for d, part in enumerate(row))
        for c, row in enumerate(matrix)
    )
    shapes = sorted({part.shape for row in found for part in row})
    if len(shapes) > 1:
        raise InputError(f"matrix has blocks of shapes {shapes}; all must be the same")
    return found


def mixing(given: Any, count: int, blocks: Any) -> np.ndarray:
    """M (3, 3) float64 of a T of 3 channels; one that cannot be undone is refused."""
    if count != 3 or blocks is not None:
        kind = "one channel" if count == 1 else "3 x 3 blocks, which mix colours themselves"
        raise InputError(f"mixing is given, but T has {kind}; it is for a T of 3 channels")
    M = checks.finite("mixing", checks.shape("mixing", checks.real("mixing", given), (3, 3))).astype(
        np.float64
    )
    condition = float(np.linalg.cond(M))
    if not condition < _WORST:
        raise InputError(
            f"mixing has the condition number {condition:.3g}; it must be invertible, below {_WORST:g}"
        )
    return M


def _is_matrix(part: Any) -> bool:
    return scipy.sparse.issparse(part) or hasattr(part, "matvec") or getattr(part, "ndim", 0) == 2


def _checked(name: str, part: Any) -> Any:
    if len(np.shape(part)) != 2:
        raise InputError(f"{name} has shape {np.shape(part)}; it must be (M, N)")
    if scipy.sparse.issparse(part):
        result = checks.csr(name, part)
    elif hasattr(part, "matvec"):
        result = scipy.sparse.linalg.aslinearoperator(part)
    else:
        result = checks.finite(name, checks.real(name, part))
    if 0 in (result.shape or ()):
        raise InputError(f"{name} has shape {result.shape}; it must have at least one row and one column")
    return result
