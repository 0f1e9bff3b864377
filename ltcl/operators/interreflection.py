# SPDX-License-Identifier: BSD-3-Clause
"""From a measured T and its first bounce F to S = T F^-1 = I + R on a device (eq. 3 and 6)."""

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
from ltcl.operators.multi_device import upload_matrix
from ltcl.operators.out_of_core import Streamed, row_blocks, stays_on_disk
from ltcl.operators.scaled_columns import ScaledColumns, spread
from ltcl.operators.scipy_operator import Host

# times the largest entry of a column of T: up to such an F, S keeps 6 digits of the column
_DIGITS = 16.0


def interreflections(
    matrices: Sequence[Any], F: np.ndarray, device: Device
) -> tuple[IdentityPlus, ...]:
    """S = T F^-1 = I + R of every channel, on the device.

    Parameters
    ----------
    matrices : sequence of (N, N) array, csr_array, Operator or LinearOperator
        T of each channel, checked. Of S diag(F) that S is taken as it is. Where they are mapped
        arrays or the rows of a store that do not fit the device or the host, each product reads
        them.
    F : (channels, N)
        First bounces; 0 where a projector pixel is masked, whose column of R is then 0.

    Returns
    -------
    tuple of IdentityPlus
        Sparse channels share one pattern where their nonzeros are in the same places. `weights` are
        1 / F, where no pixel is masked: if T is symmetric (reciprocity, patches of equal area), so
        is F^-1 T F^-1.
    """
    systems, pattern = [], None
    on_disk = device.agreed(stays_on_disk(matrices, device))
    for matrix, f in zip(matrices, F, strict=True):
        S = underlying_system(matrix)
        if S is not None and np.array_equal(matrix.d, f):
            systems.append(S)
            continue
        R = _interreflection(Streamed(device, matrix) if on_disk else matrix, f, device, pattern)
        pattern = R.pattern if isinstance(R, CSR) else None
        system = IdentityPlus(R, weights=1.0 / f if np.all(f > 0) else None)
        if S is not None and S.error_bound:  # norms change by max(d / f) / min(d / f) at most
            ratio = spread(matrix.d[f > 0] / f[f > 0])
            system.solution_error, system.error_bound = (
                ratio * S.solution_error,
                ratio * S.error_bound,
            )
        systems.append(system)
    return tuple(systems)


def underlying_system(matrix: Any) -> IdentityPlus | None:
    """The S of an operator that is S diag(d); None of any other matrix."""
    unshifted = isinstance(matrix, ScaledColumns) and not matrix.shift.any()
    return matrix.A if unshifted and isinstance(matrix.A, IdentityPlus) else None


def can_mask_pixels(matrix: Any) -> bool:
    """Whether pixels may be dropped from it, which a LinearOperator would keep in its products."""
    entries = isinstance(matrix, (np.ndarray, scipy.sparse.csr_array)) or hasattr(
        matrix, "row_blocks"
    )
    return entries or underlying_system(matrix) is not None


def common_device(rows: Sequence[Sequence[Any]], requested: Device | str | None) -> Device | None:
    """The device that all operators in `rows` lie on, None where there are none; `requested` must be that."""
    devices = {A.device for row in rows for A in row if isinstance(A, Operator)}
    if len(devices) > 1:
        raise InputError("matrix has operators on several devices; all must be on one")
    device = devices.pop() if devices else None
    if device is not None and requested is not None and open_device(requested) is not device:
        raise InputError(
            f"device is {requested!r}, but operators lie on {device}; all must be on one device"
        )
    return device


def nbytes(systems: Sequence[IdentityPlus]) -> int:
    """Bytes of all S on the device; a pattern or a basis that they share counts once."""
    return sum(array.nbytes for array in set[Array]().union(*(S.arrays() for S in systems)))


def _interreflection(
    matrix: Any, F: np.ndarray, device: Device, pattern: Pattern | None
) -> Operator:
    """R = T F^-1 - I, computed in float64 and rounded once."""
    lit = F > 0
    entries = matrix.matrix if isinstance(matrix, Streamed) else matrix
    if isinstance(entries, (np.ndarray, scipy.sparse.csr_array)) or hasattr(entries, "row_blocks"):
        _check_first_bounce(entries, F)
    # Divided, not multiplied by 1 / F: x / x is 1 to the bit, so that F = diag(T) leaves R no
    # diagonal.
    divisor = np.where(lit, F, np.inf)
    if isinstance(matrix, np.ndarray):
        R = upload_matrix(device, matrix, lambda first, rows: _dense_R(rows, divisor, lit, first))
        R.exact = matrix, divisor, lit
        return R
    if isinstance(matrix, scipy.sparse.csr_array):
        return upload_matrix(device, _sparse_R(matrix, divisor, lit), pattern=pattern)
    if hasattr(matrix, "row_blocks"):
        return upload_matrix(
            device, matrix, lambda k, rows: _sparse_R(rows, divisor, lit, k), more=len(F)
        )
    operator = matrix if isinstance(matrix, Operator) else Host(device, matrix)
    return ScaledColumns(operator, 1.0 / divisor, 1.0 if lit.all() else lit)


def _check_first_bounce(T: Any, F: np.ndarray) -> None:
    """Refuse F where -1 + T_jj / F_j has lost the digits of column j, which is far below F_j all over."""
    diagonal = np.abs(np.asarray(T.diagonal(), np.float64))
    lost = (_DIGITS * diagonal < F) & (diagonal > 0)
    if not lost.any():
        return
    largest = diagonal
    for _, block in row_blocks(T):
        columns = abs(block).max(axis=0)
        largest = np.maximum(
            largest, columns.toarray() if scipy.sparse.issparse(columns) else columns
        )
    lost &= _DIGITS * largest < F
    if lost.any():
        j = int(np.argmax(lost))
        raise InputError(
            f"first_bounce is {F[j]:.3g} at pixel {j}, {F[j] / largest[j]:.3g} times the largest entry of "
            f"its column of T; it must be at most {_DIGITS:g} times that, or S = I + R in float32 loses it"
        )


def _dense_R(T: np.ndarray, divisor: np.ndarray, lit: np.ndarray, first: int = 0) -> np.ndarray:
    """Rows from `first` on, of the same of T."""
    checks.fits_host(f"R of {T.shape[0]} x {T.shape[1]}", 4 * T.size)
    R, rows = (
        np.empty(T.shape, np.float32),
        max(1, (1 << 24) // (8 * len(lit))),
    )  # float64 a block at a time
    for start in range(0, len(T), rows):
        block = T[start : start + rows] / divisor
        here = np.arange(len(block))
        block[here, first + start + here] -= lit[first + start + here]
        R[start : start + rows] = rounded(block, np.float32)
    return R


def _sparse_R(
    T: Any, divisor: np.ndarray, lit: np.ndarray, first: int = 0
) -> scipy.sparse.csr_array:
    """Rows from `first` on of T F^-1 - I in T's pattern, or without a diagonal: channels stay alike."""
    row = first + np.repeat(np.arange(T.shape[0]), np.diff(T.indptr))
    on_diagonal = T.indices == row
    data = T.data / divisor[T.indices]
    data[on_diagonal] -= lit[row[on_diagonal]]
    full = np.count_nonzero(on_diagonal) == T.shape[0]
    if full and not data[on_diagonal].any():
        keep, indptr = ~on_diagonal, T.indptr - np.arange(T.shape[0] + 1)  # one entry a row is gone
        return scipy.sparse.csr_array((data[keep], T.indices[keep], indptr), shape=T.shape)
    R = scipy.sparse.csr_array((data, T.indices, T.indptr), shape=T.shape)
    if full:
        return R
    missing = lit[first : first + T.shape[0]].astype(
        np.float64
    )  # F was given where T stores nothing
    missing[row[on_diagonal] - first] = 0.0
    return scipy.sparse.csr_array(
        R - scipy.sparse.diags_array(missing, offsets=first, shape=T.shape)
    )
