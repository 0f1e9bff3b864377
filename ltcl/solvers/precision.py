# SPDX-License-Identifier: BSD-3-Clause
"""S in float64 on the host, where its numbers are at hand: products, LU, and what float32 products hide.

A residual b - S x in float32 deviates from the true one by at most about c eps || |S| || ||x||, eps = 2^-23
(Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., section 3.5, with random signs in place of
the worst case). A claim rests on a residual that is within the tolerance with this added; where it is not,
S x is computed in float64 with the numbers that were given.
"""

from __future__ import annotations

import dataclasses
import math
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import scipy.linalg
import scipy.sparse

from ltcl import checks
from ltcl.device import Device, vectors
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators import (
    CSR,
    Compressed,
    Dense,
    Host,
    IdentityPlus,
    Operator,
    RowBlocks,
    ScaledColumns,
    Tiles,
    as_operator,
)
from ltcl.operators.base import Transposed
from ltcl.operators.rows import RowOperator
from ltcl.theory import row_sum_range

Product = Callable[[np.ndarray], np.ndarray]  # (N, k) float64 -> (M, k) float64

EPS = 2.0**-23
# c eps. Measured for rows of CSR, dense and tiles: at most 0.1 eps of random signs; of nonnegative numbers,
# whose sums grow on the way, 0.3 eps at 64 a row, 0.5 at 4096, 0.8 at 16384 and 1.5 at 65536.
UNIT = 4.0 * EPS
_SMALL = 4 << 20  # bytes of S on the device, up to which a float64 product takes no longer than a few waits
_LARGEST = 1e18  # Frobenius norm whose square stays in float32
_LEAST = 2.0**-63  # entries of S below have squares that are 0 on the device
_FINE = 4.0 * 2.0**-52  # c eps of float64

_Factors = tuple[np.ndarray, np.ndarray, np.ndarray, float]  # S, LU, pivots; what rounding hides, over |x|
_getrf, _gecon = scipy.linalg.get_lapack_funcs(("getrf", "gecon"), dtype=np.float64)
# What is known of operators, as long as they live; nothing in it may refer to its operator.
_products: weakref.WeakKeyDictionary[Operator, Product] = weakref.WeakKeyDictionary()
_norms: weakref.WeakKeyDictionary[Operator, tuple[float, bool]] = weakref.WeakKeyDictionary()
factors: weakref.WeakKeyDictionary[Operator, _Factors] = weakref.WeakKeyDictionary()


def operator(S: Any, device: Device | None = None) -> Operator:
    """`as_operator`, which remembers the numbers of an array as they were before they became float32."""
    A = as_operator(S, device)
    if isinstance(A, Dense) and A is not S:
        A.given = np.asarray(S), np.ones(A.shape[1]), np.zeros(A.shape[0])
    return A


def shape(name: str, S: Any) -> tuple[int, ...]:
    """The shape of a square S before it becomes an operator on a device."""
    if hasattr(type(S), "interreflection"):  # asked of the object, it would upload
        raise InputTypeError(f"{name} is a {type(S).__name__}; give its operator, T.interreflection")
    own = getattr(S, "shape", None) or checks.real(name, S).shape
    if len(own) != 2 or own[0] != own[1]:
        raise InputError(f"{name} has shape {own}; it must be square, (N, N)")
    return own


def _composition(S: Operator) -> tuple[Operator, float, Any, Any] | None:
    """(A, a, d, e) where S is a A diag(d) + diag(e); d and e are numbers or (N, 1)."""
    if isinstance(S, IdentityPlus):
        return S.R, S.sign, 1.0, 1.0
    return (S.A, 1.0, S.d[:, None], -S.shift.reshape(-1, 1)) if isinstance(S, ScaledColumns) else None


def dense(S: Operator) -> tuple[np.ndarray, bool]:
    """S as (N, N) float64, and whether its numbers are those that were given, not float32 products."""
    n = S.shape[0]
    checks.fits_host(f"a dense S of N = {n}", 8 * n**2)
    if (parts := _composition(S)) is not None:
        A, a, d, e = parts
        numbers, is_exact = dense(A)
        numbers = numbers * (a * np.ravel(d))
        numbers[np.diag_indices(n)] += np.ravel(e)
        return numbers, is_exact
    if isinstance(S, Transposed):
        numbers, is_exact = dense(S.base)
        return numbers.T, is_exact
    if isinstance(S, Dense) and S.given is not None:
        A, d, e = S.given
        numbers = np.divide(A, d, dtype=np.float64)
        numbers[np.diag_indices(n)] -= e
        return numbers, True
    if isinstance(S, Host):
        return S.product(np.eye(n)).astype(np.float64), True
    return S.to_dense(), isinstance(S, RowOperator)


def product(S: Operator) -> Product | None:
    """x -> S x in float64; None where the numbers are on the device alone, or the host has no room."""
    times = _products[S] if S in _products else _product(S)
    if times is not None and is_small(S) and not isinstance(S, Host):  # whose product refers to it
        _products[S] = times
    return times


def _product(S: Operator) -> Product | None:
    parts = _composition(S)
    if parts is not None:
        A, a, d, e = parts
        times = product(A)
        return None if times is None else lambda x: a * times(d * x) + e * x
    if isinstance(S, Host):
        return lambda x: S.product(x).astype(np.float64)
    if isinstance(S, RowBlocks) or not isinstance(S, CSR | Tiles | Dense):
        return None
    if isinstance(S, CSR):
        numbers = scipy.sparse.csr_array((S.data, S.pattern.indices, S.pattern.indptr), shape=S.shape)
    elif isinstance(S, Dense) and S.given is not None and S.given[0].dtype == np.float64:
        A, d, e = S.given  # no second copy of it
        return lambda x: A @ (x / d[:, None]) - e[:, None] * x
    else:
        try:
            numbers = S.matrix() if isinstance(S, Tiles) else dense(S)[0]
        except MemoryLimitError:
            return None
    return lambda x: numbers @ x


def is_small(S: Operator) -> bool:
    """Whether a float64 product with S is cheap; one with a LinearOperator goes through the host anyway."""
    parts = _composition(S)
    return S.nbytes <= _SMALL if parts is None else is_small(parts[0])  # a Host has none


def norm_bound(S: Operator) -> tuple[float, bool]:
    """A bound on the 2-norm of |S|, entry by entry, and whether it is one, found once in the life of S.

    The Frobenius norm of the numbers, between isometric bases that of the core; of other operators the
    largest row sum, a bound of symmetric S >= 0, an estimate else.
    """
    if S not in _norms:
        _norms[S] = _norm_bound(S)
    return _norms[S]


def _norm_bound(S: Operator) -> tuple[float, bool]:
    if isinstance(S, IdentityPlus):
        norm, is_bound = norm_bound(S.R)
        return 1.0 + norm, is_bound
    if isinstance(S, Compressed) and all(W is None or W.isometric for W in (S.out, S.into)):
        return norm_bound(S.core)
    if isinstance(S, Tiles):
        norm = S.frobenius
    elif isinstance(S, CSR | Dense):
        values = [slab.arguments[-1] for slab in S.slabs if slab.arguments[-1].size]
        flat = [dataclasses.replace(one, shape=(one.size,)) for one in values]
        norm = math.sqrt(math.fsum(float(vectors.dot(one, one)[0]) for one in flat))
    else:
        least, _, most = row_sum_range(S)
        return max(1.0, most, -least), False
    return (1.01 * norm + _LEAST * max(S.shape) if norm < _LARGEST else math.inf), True


@dataclass(frozen=True)
class Direct:
    """Dense LU of S in float64 (LAPACK): O(N^3) once per operator, then O(N^2). No options."""

    name: ClassVar[str] = "direct"

    def solve(self, S: Operator, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """x like b in float64, the norms (k,) of b - S x, and what rounding may hide of them.

        LinAlgError where S is singular to working precision.
        """
        numbers, lu, pivots, rounding = _factorize(S)
        with np.errstate(all="ignore"):
            # LAPACK's wrapper shifts the pivots while it runs; other threads have their own copies.
            x = scipy.linalg.lu_solve((lu, pivots.copy()), b.astype(np.float64), check_finite=False)
            hidden = rounding * np.linalg.norm(x, axis=0)
            norms = np.linalg.norm(b - numbers @ x, axis=0)
        return x, np.atleast_1d(norms), np.atleast_1d(hidden)


def _factorize(S: Operator) -> _Factors:
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
    except MemoryError as error:
        if isinstance(error, MemoryLimitError):
            raise
        raise MemoryLimitError(f"{what} needs {checks.size(24 * n * n)}, more than the host gives") from error
    if info != 0 or not rcond >= np.finfo(np.float64).eps:
        raise np.linalg.LinAlgError("S is singular to working precision")
    norm = min(norm, float(np.linalg.norm(numbers)))
    factors[S] = numbers, lu, pivots, (_FINE if is_exact else UNIT) * norm
    return factors[S]
