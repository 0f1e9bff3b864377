# SPDX-License-Identifier: BSD-3-Clause
"""The interreflection S = T F^-1 = I + R from a measured T and its first bounce F (eq. 3 and 6)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array, Device, open_device
from ltcl.device.arrays import rounded
from ltcl.errors import InputError
from ltcl.operators.base import Operator
from ltcl.operators.csr import CSR, Pattern
from ltcl.operators.identity_plus import IdentityPlus
from ltcl.operators.knowledge import Float64Form
from ltcl.operators.multi_device import upload_matrix
from ltcl.operators.out_of_core import Streamed, row_blocks, stays_on_disk
from ltcl.operators.scaled_columns import ScaledColumns, spread
from ltcl.operators.scipy_operator import Host

# F_j as a multiple of the largest entry of column j of T, up to which S keeps 6 digits of it.
MAX_FIRST_BOUNCE_RATIO = 16.0
# Bytes of a block of rows in float64.
BLOCK_BYTES = 1 << 24


def interreflections(
    matrices: Sequence[Any], F: np.ndarray, device: Device
) -> tuple[IdentityPlus, ...]:
    """S = T F^-1 = I + R of every channel, on the device.

    Parameters
    ----------
    matrices : sequence of (N, N) array, csr_array, Operator or LinearOperator
        T of each channel, checked. If one is S diag(F), that S is taken as it is. If they are
        mapped arrays or the rows of a store that do not fit the device or the host, each product
        reads them.
    F : (channels, N)
        First bounces; 0 for a masked projector pixel, whose column of R is then 0.
    device : Device

    Returns
    -------
    tuple of IdentityPlus
        Sparse channels share one pattern if their nonzeros are in the same places. `weights` are
        1 / F if no pixel is masked: if T is symmetric (reciprocity, patches of equal area), so is
        F^-1 T F^-1.
    """
    systems = []
    pattern = None
    on_disk = device.agreed(stays_on_disk(matrices, device))
    for matrix, first_bounce in zip(matrices, F, strict=True):
        S = underlying_system(matrix)
        if S is not None and np.array_equal(matrix.d, first_bounce):
            systems.append(S)
            continue
        T = Streamed(device, matrix) if on_disk else matrix
        R = _interreflection(T, first_bounce, device, pattern)
        pattern = R.pattern if isinstance(R, CSR) else None
        weights = 1.0 / first_bounce if np.all(first_bounce > 0) else None
        system = IdentityPlus(R, weights=weights)
        if S is not None and S.error_bound:
            # Norms change by max(d / f) / min(d / f) at most.
            lit = first_bounce > 0
            ratio = spread(matrix.d[lit] / first_bounce[lit])
            system.solution_error = ratio * S.solution_error
            system.error_bound = ratio * S.error_bound
        systems.append(system)
    return tuple(systems)


def underlying_system(matrix: Any) -> IdentityPlus | None:
    """The S of an operator that is S diag(d); None for any other matrix."""
    if isinstance(matrix, ScaledColumns) and isinstance(matrix.A, IdentityPlus):
        return None if matrix.shift.any() else matrix.A
    return None


def _has_entries(matrix: Any) -> bool:
    """True if it is an array, a sparse matrix or a store."""
    is_matrix = isinstance(matrix, (np.ndarray, scipy.sparse.csr_array))
    return is_matrix or hasattr(matrix, "row_blocks")


def can_mask_pixels(matrix: Any) -> bool:
    """True if pixels may be dropped from it, which a LinearOperator would keep in its products."""
    return _has_entries(matrix) or underlying_system(matrix) is not None


def common_device(rows: Sequence[Sequence[Any]], requested: Device | str | None) -> Device | None:
    """The device that all operators in `rows` lie on; None without operators.

    `requested` must be that device.
    """
    devices = {A.device for row in rows for A in row if isinstance(A, Operator)}
    if not devices:
        return None
    if len(devices) > 1:
        raise InputError("matrix has operators on several devices; all must be on one")
    device = devices.pop()
    if requested is not None and open_device(requested) is not device:
        raise InputError(
            f"device is {requested!r}, but operators lie on {device}; all must be on one device"
        )
    return device


def nbytes(systems: Sequence[Operator]) -> int:
    """Bytes of all operators on the device; a pattern or a basis that they share counts once."""
    arrays: set[Array] = set()
    for S in systems:
        arrays |= S.arrays()
    return sum(array.nbytes for array in arrays)


def _interreflection(
    matrix: Any, F: np.ndarray, device: Device, pattern: Pattern | None
) -> Operator:
    """R = T F^-1 - I, computed in float64 and rounded once."""
    lit = F > 0
    entries = matrix.matrix if isinstance(matrix, Streamed) else matrix
    if _has_entries(entries):
        _check_first_bounce(entries, F)
    # Divided, not multiplied by 1 / F: x / x is 1 to the bit, so that F = diag(T) leaves R no
    # diagonal.
    divisor = np.where(lit, F, np.inf)
    if isinstance(matrix, np.ndarray):

        def dense_rows(first: int, rows: np.ndarray) -> np.ndarray:
            return _dense_R(rows, divisor, lit, first)

        R = upload_matrix(device, matrix, dense_rows)
        R.exact_form = Float64Form.from_quotient(matrix, divisor, lit)
        return R
    if isinstance(matrix, scipy.sparse.csr_array):
        return upload_matrix(device, _sparse_R(matrix, divisor, lit), pattern=pattern)
    if hasattr(matrix, "row_blocks"):

        def sparse_rows(first: int, rows: Any) -> scipy.sparse.csr_array:
            return _sparse_R(rows, divisor, lit, first)

        return upload_matrix(device, matrix, sparse_rows, added_entries=len(F))
    if not isinstance(matrix, Operator):
        matrix = Host(device, matrix)
    # One number joins the epilogue of the product.
    shift = 1.0 if lit.all() else lit
    scale = 1.0 / divisor
    if isinstance(matrix, ScaledColumns) and not matrix.shift.any():
        # Columns that are scaled twice would take a pass over all pixels more.
        scale = scale * matrix.d
        matrix = matrix.A
    return ScaledColumns(matrix, scale, shift)


def _check_first_bounce(T: Any, F: np.ndarray) -> None:
    """Refuse F if -1 + T_jj / F_j has lost the digits of column j, all of it far below F_j."""
    diagonal = np.abs(np.asarray(T.diagonal(), np.float64))
    is_lost = (MAX_FIRST_BOUNCE_RATIO * diagonal < F) & (diagonal > 0)
    if not is_lost.any():
        return
    largest = diagonal
    for _, block in row_blocks(T):
        column_maxima = abs(block).max(axis=0)
        if scipy.sparse.issparse(column_maxima):
            column_maxima = column_maxima.toarray()
        largest = np.maximum(largest, column_maxima)
    is_lost &= MAX_FIRST_BOUNCE_RATIO * largest < F
    if is_lost.any():
        j = int(np.argmax(is_lost))
        raise InputError(
            f"first_bounce is {F[j]:.3g} at pixel {j}, {F[j] / largest[j]:.3g} times the largest "
            f"entry of its column of T; it must be at most {MAX_FIRST_BOUNCE_RATIO:g} times that, "
            "or S = I + R in float32 loses it"
        )


def _dense_R(T: np.ndarray, divisor: np.ndarray, lit: np.ndarray, first: int = 0) -> np.ndarray:
    """Rows from `first` on of T F^-1 - I, from the same rows of T."""
    checks.fits_host(f"R of {T.shape[0]} x {T.shape[1]}", 4 * T.size)
    R = np.empty(T.shape, np.float32)
    rows = max(1, BLOCK_BYTES // (8 * len(lit)))
    for start in range(0, len(T), rows):
        block = T[start : start + rows] / divisor
        row = np.arange(len(block))
        column = first + start + row
        block[row, column] -= lit[column]
        R[start : start + rows] = rounded(block, np.float32)
    return R


def _sparse_R(
    T: Any, divisor: np.ndarray, lit: np.ndarray, first: int = 0
) -> scipy.sparse.csr_array:
    """Rows from `first` on of T F^-1 - I, in T's pattern or without a diagonal.

    So channels keep one pattern.
    """
    rows = T.shape[0]
    row = first + np.repeat(np.arange(rows), np.diff(T.indptr))
    is_diagonal = T.indices == row
    data = T.data / divisor[T.indices]
    data[is_diagonal] -= lit[row[is_diagonal]]
    has_full_diagonal = np.count_nonzero(is_diagonal) == rows
    if has_full_diagonal and not data[is_diagonal].any():
        is_kept = ~is_diagonal
        # One entry of each row is gone.
        indptr = T.indptr - np.arange(rows + 1)
        return scipy.sparse.csr_array((data[is_kept], T.indices[is_kept], indptr), shape=T.shape)
    R = scipy.sparse.csr_array((data, T.indices, T.indptr), shape=T.shape)
    if has_full_diagonal:
        return R
    # F was given where T stores nothing.
    missing = lit[first : first + rows].astype(np.float64)
    missing[row[is_diagonal] - first] = 0.0
    diagonal = scipy.sparse.diags_array(missing, offsets=first, shape=T.shape)
    return scipy.sparse.csr_array(R - diagonal)
