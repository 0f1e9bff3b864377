# SPDX-License-Identifier: BSD-3-Clause
"""From a measured T and its first bounce F to S = T F^-1 = I + R on a device (eq. 3 and 6)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array, Device, open_device
from ltcl.errors import InputError
from ltcl.operators.base import Operator
from ltcl.operators.composed import Host, IdentityPlus, ScaledColumns, Shifted, spread
from ltcl.operators.csr import CSR, Pattern, RowBlocks
from ltcl.operators.dense import Dense


def interreflections(matrices: Sequence[Any], F: np.ndarray, device: Device) -> tuple[IdentityPlus, ...]:
    """S = T F^-1 = I + R of every channel, on the device.

    Parameters
    ----------
    matrices : sequence of (N, N) array, csr_array, Operator or LinearOperator
        T of each channel, checked. Of S diag(F), which has an S already, that S is taken as it is.
    F : (channels, N)
        First bounces; 0 where a projector pixel is masked, whose column of R is then 0.
    device : Device

    Returns
    -------
    tuple of IdentityPlus
        Sparse channels share one pattern where their nonzeros are in the same places. Their `weights` are
        1 / F, where no pixel is masked: if T is symmetric (reciprocity, patches of equal area), so is
        F^-1 S = F^-1 T F^-1.
    """
    systems, pattern = [], None
    for matrix, f in zip(matrices, F, strict=True):
        S = made_with(matrix)
        if S is not None and np.array_equal(matrix.d, f):
            systems.append(S)
            continue
        R = _interreflection(matrix, f, device, pattern)
        pattern = R.pattern if isinstance(R, CSR) else None
        weights = 1.0 / f if np.all(f > 0) else None
        systems.append(IdentityPlus(R, weights=weights, solution_error=_carried(matrix, f)))
    return tuple(systems)


def made_with(matrix: Any) -> IdentityPlus | None:
    """The S of an operator that is S diag(d); None of any other matrix."""
    if isinstance(matrix, ScaledColumns) and isinstance(matrix.A, IdentityPlus):
        return matrix.A
    return None


def maskable(matrix: Any) -> bool:
    """Whether pixels of it may be dropped: others of somebody's own LinearOperator would stay in products."""
    own = isinstance(matrix, (np.ndarray, scipy.sparse.csr_array)) or hasattr(matrix, "row_blocks")
    return own or made_with(matrix) is not None


def device_of(rows: Sequence[Sequence[Any]], wanted: Device | str | None) -> Device | None:
    """The device that operators among the parts lie on, None where there are none; no two, and no other."""
    found = {part.device for row in rows for part in row if isinstance(part, Operator)}
    if not found:
        return None
    (first, *others) = found
    if others or (wanted is not None and open_device(wanted) is not first):
        asked = f"device is {wanted!r}" if not others else "matrix has operators on several devices"
        raise InputError(f"{asked}, but operators lie on {first}; all must be on one device")
    return first


def nbytes(systems: Sequence[IdentityPlus]) -> int:
    """Bytes of all S on the device; a pattern or a basis that they share counts once."""
    return sum(array.nbytes for array in set[Array]().union(*(S.arrays() for S in systems)))


def _carried(matrix: Any, f: np.ndarray) -> float:
    """Solution error of T diag(1 / f), T = S diag(d): norms change by max(d / f) / min(d / f) at most."""
    S = made_with(matrix)
    if S is None or S.solution_error == 0.0:
        return 0.0
    return S.solution_error * spread(matrix.d[f > 0] / f[f > 0])


def _interreflection(matrix: Any, F: np.ndarray, device: Device, pattern: Pattern | None) -> Operator:
    """R = T F^-1 - I, computed in float64 and rounded once."""
    lit = F > 0
    # Divided, not multiplied by 1 / F: x / x is 1 to the bit, so that F = diag(T) leaves R no diagonal.
    divisor = np.where(lit, F, np.inf)
    if isinstance(matrix, np.ndarray):
        return Dense(device, _dense_R(matrix, divisor, lit))
    if isinstance(matrix, scipy.sparse.csr_array):
        return CSR(device, _sparse_R(matrix, divisor, lit), pattern)
    if hasattr(matrix, "row_blocks"):
        rows = lambda: ((k, _sparse_R(block, divisor, lit, k)) for k, block in matrix.row_blocks())  # noqa: E731
        return RowBlocks(device, matrix.shape, rows, matrix.nnz + len(F))
    operator = matrix if isinstance(matrix, Operator) else Host(device, matrix)
    return Shifted(ScaledColumns(operator, 1.0 / divisor), None if lit.all() else lit)


def _dense_R(T: np.ndarray, divisor: np.ndarray, lit: np.ndarray) -> np.ndarray:
    n = len(divisor)
    checks.fits_host(f"R of {n} x {n}", 4 * n * n)
    R = np.empty((n, n), np.float32)
    rows = max(1, (1 << 24) // (8 * n))  # float64 only a block at a time
    for start in range(0, n, rows):
        block = T[start : start + rows] / divisor
        here = np.arange(len(block))
        block[here, start + here] -= lit[start : start + rows]
        R[start : start + rows] = block
    return R


def _sparse_R(T: Any, divisor: np.ndarray, lit: np.ndarray, first: int = 0) -> scipy.sparse.csr_array:
    """T F^-1 - I that keeps T's pattern, or drops its whole diagonal, so that channels stay alike.

    T may be rows `first` and on of one.
    """
    row = first + np.repeat(np.arange(T.shape[0]), np.diff(T.indptr))
    on_diagonal = T.indices == row
    data = T.data / divisor[T.indices]
    data[on_diagonal] -= lit[row[on_diagonal]]
    full = np.count_nonzero(on_diagonal) == T.shape[0]
    if full and not data[on_diagonal].any():
        keep = ~on_diagonal
        indptr = T.indptr - np.arange(T.shape[0] + 1)  # exactly one diagonal entry a row is gone
        return scipy.sparse.csr_array((data[keep], T.indices[keep], indptr), shape=T.shape)
    R = scipy.sparse.csr_array((data, T.indices, T.indptr), shape=T.shape)
    if full:
        return R
    missing = lit[first : first + T.shape[0]].astype(np.float64)  # F was given where T stores nothing
    missing[row[on_diagonal] - first] = 0.0
    return scipy.sparse.csr_array(R - scipy.sparse.diags_array(missing, offsets=first, shape=T.shape))
