# SPDX-License-Identifier: BSD-3-Clause
"""Matrices made entry by entry from another: |R|, its squares, and R of an S that is stored whole."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse

from ltcl.operators.base import Operator
from ltcl.operators.csr import CSR
from ltcl.operators.dense import Dense
from ltcl.operators.relaxation import readable


def mapped(M: CSR | Dense, f: Callable[[np.ndarray], np.ndarray]) -> CSR | Dense:
    """f of every stored entry of M, float32; f(0) must be 0.

    >>> import ltcl
    >>> M = Dense(ltcl.open_device(), [[0.0, -0.5], [2.0, 0.0]])
    >>> mapped(M, np.abs).to_dense().tolist()
    [[0.0, 0.5], [2.0, 0.0]]
    """
    if isinstance(M, CSR):
        host = scipy.sparse.csr_array((f(M.data), M.pattern.indices, M.pattern.indptr), shape=M.shape)
        return CSR(M.device, host, M.pattern)
    return Dense(M.device, np.concatenate([f(slab.arguments[1].get()) for slab in M.slabs]))


def squares(M: CSR | Dense) -> CSR | Dense:
    """M_ij^2, which carry variances; made at the first call and kept with M, as much memory again."""
    if "squares" not in M.tables:
        M.tables["squares"] = mapped(M, np.square)
    return M.tables["squares"]


def rows_of_R(S: Operator, method: str) -> tuple[CSR | Dense, float]:
    """R with rows to read, and the sign in S = I + sign R.

    Of an S that is stored whole R is made at the first call, and kept with it.

    Raises
    ------
    InputError
        S does not give its rows; the message names `method`.
    """
    rows = readable(S, method)
    if rows.shift == 1.0:
        return rows.M, rows.scale
    if "R" not in rows.M.tables:
        rows.M.tables["R"] = _without_identity(rows.M)
    return rows.M.tables["R"], 1.0


def _without_identity(S: CSR | Dense) -> CSR | Dense:
    if isinstance(S, CSR):
        host = scipy.sparse.csr_array((S.data, S.pattern.indices, S.pattern.indptr), shape=S.shape)
        R = scipy.sparse.csr_array(host - scipy.sparse.eye_array(S.shape[0]))
        R.eliminate_zeros()
        return CSR(S.device, R)
    dense = np.concatenate([slab.arguments[1].get() for slab in S.slabs])
    dense[np.diag_indices_from(dense)] -= 1.0
    return Dense(S.device, dense)
