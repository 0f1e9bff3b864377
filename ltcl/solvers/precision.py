# SPDX-License-Identifier: BSD-3-Clause
"""S in float64 on the host, where its numbers are at hand: products, LU, and what float32 products hide.

A residual b - S x in float32 deviates from the true one by at most about c eps || |S| || ||x||, eps = 2^-23
(Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., section 3.5, with random signs in
place of the worst case). A claim rests on a residual that is within the tolerance with this added;
where it is not, S x is computed in float64 with the numbers that were given.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import scipy.linalg
import scipy.sparse

from ltcl import checks
from ltcl.errors import MemoryLimitError
from ltcl.operators import CSR, Dense, Host, IdentityPlus, Operator, RowBlocks, ScaledColumns, Tiles
from ltcl.operators.base import Transposed
from ltcl.operators.multi_device import MultiDevice
from ltcl.operators.out_of_core import Streamed

Product = Callable[[np.ndarray], np.ndarray]  # (N, k) float64 -> (M, k) float64
EPS = 2.0**-23
# c eps. Measured for rows of CSR, dense and tiles: at most 0.1 eps of random signs; of nonnegative
# numbers, whose sums grow on the way, 0.3 eps at 64 a row, 0.5 at 4096, 0.8 at 16384 and 1.5 at
# 65536.
UNIT = 4.0 * EPS
_SMALL = (
    4 << 20
)  # bytes of S on the device, up to which a float64 product takes no longer than a few waits
_FINE = 4.0 * 2.0**-52  # c eps of float64

_Factors = tuple[
    np.ndarray, np.ndarray, np.ndarray, float
]  # S, LU, pivots; what rounding hides, over |x|
_getrf, _gecon = scipy.linalg.get_lapack_funcs(("getrf", "gecon"), dtype=np.float64)
# What is known of operators, as long as they live; nothing in it may refer to its operator.
_known: weakref.WeakKeyDictionary[Operator, tuple[Any, Any, Any]] = weakref.WeakKeyDictionary()
factors: weakref.WeakKeyDictionary[Operator, _Factors] = weakref.WeakKeyDictionary()


def _numbers(S: Operator, read: bool = False) -> tuple[Any, Any, Any] | None:
    """(A, d, e) with S = A diag(d) + diag(e), as they were given; None where only the device has them.

    A is an array, a csr_array, a Host or Streamed; d and e are numbers or (N,). Blocks of a store
    are read on demand.
    """
    if isinstance(S, IdentityPlus | ScaledColumns):
        if (inner := _numbers(S.R if isinstance(S, IdentityPlus) else S.A, read)) is None:
            return None
        A, d, e = inner
        if isinstance(S, IdentityPlus):
            return A, S.sign * d, S.sign * e + 1.0
        return A, d * S.d, e * S.d - S.shift
    if isinstance(S, Dense | MultiDevice) and S.exact is not None:
        A, d, e = S.exact
        return (A, 1.0 / d, 0.0 - e) if np.all(np.abs(d) > 1e-300) else None
    if isinstance(S, Dense) or (read and isinstance(S, RowBlocks | MultiDevice)):
        A = S.to_dense()
    elif isinstance(S, CSR) and not isinstance(S, RowBlocks):
        A = scipy.sparse.csr_array((S.data, S.pattern.indices, S.pattern.indptr), shape=S.shape)
    elif isinstance(S, Tiles):
        A = S.matrix()
    else:
        A = S if isinstance(S, Host | Streamed) else None
    return None if A is None else (A, 1.0, 0.0)


def product(S: Operator) -> Product | None:
    """x -> S x in float64; None where the numbers are on the device alone, or the host has no room."""
    try:
        numbers = _known[S] if S in _known else _numbers(S)
    except MemoryLimitError:
        return None
    if numbers is None:
        return None
    A, d, e = numbers
    multiply = A.product if isinstance(A, Host | Streamed) else A.__matmul__
    if is_small(S) and A is not S:
        _known[S] = numbers
    d, e = np.reshape(d, (-1, 1)), np.reshape(e, (-1, 1))
    return lambda x: multiply(d * x).astype(np.float64) + e * x


def dense(S: Operator) -> tuple[np.ndarray, bool]:
    """S as (N, N) float64, and whether its numbers are those that were given, not float32 products."""
    n = S.shape[0]
    checks.fits_host(f"a dense S of N = {n}", 8 * n**2)
    if isinstance(S, Transposed):
        matrix, is_exact = dense(S.base)
        return matrix.T, is_exact
    if (numbers := _numbers(S, read=True)) is None:
        return S.to_dense(), False
    A, d, e = numbers
    A: Any = A.to_dense() if isinstance(A, Streamed) else A
    A = (
        A.product(np.eye(n))
        if isinstance(A, Host)
        else A.toarray()
        if scipy.sparse.issparse(A)
        else A
    )
    matrix = np.multiply(A, d, dtype=np.float64)
    matrix[np.diag_indices(n)] += e
    return matrix, True


def is_small(S: Operator) -> bool:
    """Whether a float64 product with S is cheap; one with a LinearOperator goes through the host anyway."""
    return S.nbytes + S.bytes_read() <= _SMALL


@dataclass(frozen=True)
class Direct:
    """Dense LU of S in float64 (LAPACK): O(N^3) once per operator, then O(N^2). No options."""

    name: ClassVar[str] = "direct"

    def solve(self, S: Operator, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """x like b in float64, the norms (k,) of b - S x, and what rounding may hide of them.

        None where S is singular to working precision.
        """
        if (factorization := _factorize(S)) is None:
            return None
        numbers, lu, pivots, rounding = factorization
        with np.errstate(all="ignore"):
            # LAPACK's wrapper shifts the pivots while it runs; other threads have their own copies.
            x = scipy.linalg.lu_solve((lu, pivots.copy()), b.astype(np.float64), check_finite=False)
            hidden = rounding * np.linalg.norm(x, axis=0)
            norms = np.linalg.norm(b - numbers @ x, axis=0)
        return x, np.atleast_1d(norms), np.atleast_1d(hidden)


def _factorize(S: Operator) -> _Factors | None:
    """Made once and kept as long as S lives: many frames are solved with one S."""
    if S in factors:
        return factors[S]
    n = S.shape[0]
    what = f"method='direct' factorizes S densely, which for N = {n}"
    checks.fits_host(what, 3 * 8 * n * n)
    try:
        numbers, is_exact = dense(S)
        with np.errstate(all="ignore"):
            lu, pivots, info = _getrf(numbers)
            rcond, _ = _gecon(lu, np.linalg.norm(numbers, 1))
            norm = math.sqrt(np.linalg.norm(numbers, 1) * np.linalg.norm(numbers, np.inf))
    except MemoryLimitError:
        raise
    except MemoryError as error:
        raise MemoryLimitError(
            f"{what} needs {checks.size(24 * n * n)}, more than the host gives"
        ) from error
    if info != 0 or not rcond >= np.finfo(np.float64).eps:
        return None
    norm = min(norm, float(np.linalg.norm(numbers)))
    factors[S] = numbers, lu, pivots, (_FINE if is_exact else UNIT) * norm
    return factors[S]
