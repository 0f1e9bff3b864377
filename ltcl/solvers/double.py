# SPDX-License-Identifier: BSD-3-Clause
"""S x in float64 on the host, where the numbers of S are at hand: for residuals that float32 cannot tell.

S is the operator as it stands, whose numbers are in float32; its products are not rounded to that.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ltcl import checks
from ltcl.operators import CSR, Dense, Host, IdentityPlus, Operator, RowBlocks, ScaledColumns, Shifted, Tiles

Product = Callable[[np.ndarray], np.ndarray]  # (N, k) float64 -> (M, k) float64


def product(S: Operator) -> Product | None:
    """x -> S x; None where the numbers are on the device alone, or the host has no room for them.

    >>> import ltcl
    >>> from ltcl.operators import as_operator
    >>> times = product(IdentityPlus(as_operator([[0.0, 0.5], [0.5, 0.0]])))
    >>> times(np.array([[1.0], [1e-9]])).ravel().tolist()
    [1.0000000005, 0.500000001]
    """
    if isinstance(S, Host):
        return lambda x: np.asarray(S.operator @ x, np.float64)
    if isinstance(S, IdentityPlus):
        return _after(product(S.R), lambda Rx, x: x + S.sign * Rx)
    if isinstance(S, Shifted):
        return _after(product(S.A), lambda Ax, x: Ax - S.d[:, None] * x)
    if isinstance(S, ScaledColumns):
        A = product(S.A)
        return None if A is None else lambda x: A(S.d[:, None] * x)
    if isinstance(S, CSR | Tiles) and not isinstance(S, RowBlocks):
        sparse = S.matrix()
        return lambda x: sparse @ x
    if isinstance(S, Dense) and 16 * S.shape[0] * S.shape[1] <= checks.host_memory():
        dense = S.to_dense()
        return lambda x: dense @ x
    return None


def _after(A: Product | None, join: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Product | None:
    return None if A is None else lambda x: join(A(x), x)
