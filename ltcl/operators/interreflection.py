# SPDX-License-Identifier: BSD-3-Clause
"""From a measured T and its first bounce F to S = T F^-1 = I + R on a device (eq. 3 and 6)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Device
from ltcl.operators.base import Operator
from ltcl.operators.composed import Host, IdentityPlus, ScaledColumns, Shifted
from ltcl.operators.csr import CSR, Pattern
from ltcl.operators.dense import Dense


def interreflections(matrices: Sequence[Any], F: np.ndarray, device: Device) -> tuple[IdentityPlus, ...]:
    """S = T F^-1 = I + R of every channel, on the device.

    Parameters
    ----------
    matrices : sequence of (N, N) array, csr_array or LinearOperator
        T of each channel, checked.
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
        R = _interreflection(matrix, f, device, pattern)
        pattern = R.pattern if isinstance(R, CSR) else None
        systems.append(IdentityPlus(R, weights=1.0 / f if np.all(f > 0) else None))
    return tuple(systems)


def _interreflection(matrix: Any, F: np.ndarray, device: Device, pattern: Pattern | None) -> Operator:
    """R = T F^-1 - I, computed in float64 and rounded once."""
    lit = F > 0
    # Divided, not multiplied by 1 / F: x / x is 1 to the bit, so that F = diag(T) leaves R no diagonal.
    divisor = np.where(lit, F, np.inf)
    if isinstance(matrix, np.ndarray):
        return Dense(device, _dense_R(matrix, divisor, lit))
    if isinstance(matrix, scipy.sparse.csr_array):
        return CSR(device, _sparse_R(matrix, divisor, lit), pattern)
    return Shifted(ScaledColumns(Host(device, matrix), 1.0 / divisor), None if lit.all() else lit)


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


def _sparse_R(T: Any, divisor: np.ndarray, lit: np.ndarray) -> scipy.sparse.csr_array:
    """T F^-1 - I that keeps T's pattern, or drops its whole diagonal, so that channels stay alike."""
    row = np.repeat(np.arange(T.shape[0]), np.diff(T.indptr))
    on_diagonal = T.indices == row
    data = T.data / divisor[T.indices]
    data[on_diagonal] -= lit[row[on_diagonal]]
    if np.count_nonzero(on_diagonal) < T.shape[0]:  # some F was given where T stores nothing
        missing = lit.copy()
        missing[row[on_diagonal]] = False
        R = scipy.sparse.csr_array((data, T.indices, T.indptr), shape=T.shape)
        return scipy.sparse.csr_array(R - scipy.sparse.diags_array(missing.astype(np.float64)))
    if data[on_diagonal].any():
        return scipy.sparse.csr_array((data, T.indices, T.indptr), shape=T.shape)
    keep = ~on_diagonal
    indptr = T.indptr - np.arange(T.shape[0] + 1)  # exactly one diagonal entry a row is gone
    return scipy.sparse.csr_array((data[keep], T.indices[keep], indptr), shape=T.shape)
