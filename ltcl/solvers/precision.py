# SPDX-License-Identifier: BSD-3-Clause
"""S in float64 on the host, where its numbers are at hand: products, LU, and what float32 products hide.

A residual b - S x that was computed in float32 deviates from the true one by at most about

    c eps || |S| || ||x||,   eps = 2^-23

(Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., section 3.5, with the random signs that
rounding errors have in practice in place of the worst case). A claim rests on a residual that is within the
tolerance with this added; where it is not, S x is computed in float64 with the numbers that were given.
"""

from __future__ import annotations

import dataclasses
import math
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import scipy.linalg
import scipy.sparse

from ltcl import checks
from ltcl.device import Device, vectors
from ltcl.errors import MemoryLimitError
from ltcl.operators import (
    CSR,
    Compressed,
    Dense,
    Host,
    IdentityPlus,
    Operator,
    RowBlocks,
    ScaledColumns,
    Shifted,
    Tiles,
    as_operator,
)
from ltcl.theory import row_sum_range

Product = Callable[[np.ndarray], np.ndarray]  # (N, k) float64 -> (M, k) float64

EPS = 2.0**-23
# c eps. Measured for rows of CSR, dense and tiles: at most 0.1 eps of random signs; of nonnegative numbers,
# whose sums grow on the way, 0.3 eps at 64 a row, 0.5 at 4096, 0.8 at 16384 and 1.5 at 65536.
UNIT = 4.0 * EPS
_SMALL = 4 << 20  # bytes of S on the device, up to which a float64 product takes no longer than a few waits
_SQUARES = 1e-14  # Frobenius norm, below which squares may have underflowed
_DENORMAL = 2.0**-126  # entries of S below are 0 on the device
_FINE = 4.0 * 2.0**-52  # c eps of float64

_getrf, _gecon = scipy.linalg.get_lapack_funcs(("getrf", "gecon"), dtype=np.float64)
_given: weakref.WeakKeyDictionary[Operator, np.ndarray] = weakref.WeakKeyDictionary()
_products: weakref.WeakKeyDictionary[Operator, Product] = weakref.WeakKeyDictionary()
_norms: weakref.WeakKeyDictionary[Operator, float] = weakref.WeakKeyDictionary()
_factors: weakref.WeakKeyDictionary[Operator, _Factors] = weakref.WeakKeyDictionary()


def operator(S: Any, device: Device | None = None) -> Operator:
    """`as_operator`, which remembers the numbers of an array as they were before they became float32."""
    A = as_operator(S, device)
    if isinstance(A, Dense) and A is not S:
        _given[A] = np.asarray(S)
    return A


def dense(S: Operator) -> np.ndarray:
    """S as (N, N) float64, with the numbers that were given."""
    checks.fits_host(f"a dense S of N = {S.shape[0]}", 8 * S.shape[0] ** 2)
    if S in _given:
        return _given[S].astype(np.float64)
    if isinstance(S, IdentityPlus):
        R = S.sign * dense(S.R)
        R[np.diag_indices_from(R)] += 1.0
        return R
    if isinstance(S, Shifted):
        return dense(S.A) - np.diag(S.d)
    if isinstance(S, ScaledColumns):
        return dense(S.A) * S.d
    return np.asarray(S.operator @ np.eye(S.shape[0]), np.float64) if isinstance(S, Host) else S.to_dense()


def product(S: Operator) -> Product | None:
    """x -> S x in float64; None where the numbers are on the device alone, or the host has no room for them.

    >>> times = product(IdentityPlus(as_operator([[0.0, 0.5], [0.5, 0.0]])))
    >>> times(np.array([[1.0], [1e-9]])).ravel().tolist()
    [1.0000000005, 0.500000001]
    """
    times = _products[S] if S in _products else _product(S)
    if times is not None and is_small(S):
        _products[S] = times
    return times


def _product(S: Operator) -> Product | None:
    # Nothing here may refer to S, which would then live as long as what is remembered of it.
    if isinstance(S, Host):
        host = S.operator
        return lambda x: np.asarray(host @ x, np.float64)
    if isinstance(S, IdentityPlus | Shifted | ScaledColumns):
        times = product(S.R if isinstance(S, IdentityPlus) else S.A)
        if times is None:
            return None
        if isinstance(S, IdentityPlus):
            return lambda x, sign=S.sign: x + sign * times(x)
        if isinstance(S, Shifted):
            return lambda x, d=S.d[:, None]: times(x) - d * x
        return lambda x, d=S.d[:, None]: times(d * x)
    if isinstance(S, RowBlocks) or not isinstance(S, CSR | Tiles | Dense):
        return None
    if isinstance(S, CSR):
        numbers = scipy.sparse.csr_array((S.data, S.pattern.indices, S.pattern.indptr), shape=S.shape)
    else:
        try:
            numbers = S.matrix() if isinstance(S, Tiles) else dense(S)
        except MemoryLimitError:
            return None
    return lambda x: numbers @ x


def is_small(S: Operator) -> bool:
    """Whether a float64 product with S is cheap; one with a LinearOperator goes through the host anyway."""
    inner = getattr(S, "R", getattr(S, "A", None))
    return is_small(inner) if isinstance(inner, Operator) else S.nbytes <= _SMALL  # a Host has none


def is_bounded(S: Operator) -> bool:
    """Whether `norm_bound` is one."""
    if isinstance(S, IdentityPlus | Compressed):
        return is_bounded(S.R) if isinstance(S, IdentityPlus) else S.two_sided and is_bounded(S.core)
    return isinstance(S, CSR | Dense | Tiles)


def norm_bound(S: Operator) -> float:
    """A bound on the 2-norm of |S|, entry by entry, found once in the life of S.

    The Frobenius norm of the numbers, of those between two bases that of the core; of other operators, for
    want of better, the largest row sum: a bound of symmetric S >= 0, an estimate else.
    """
    if S not in _norms:
        _norms[S] = _norm_bound(S)
    return _norms[S]


def _norm_bound(S: Operator) -> float:
    if not is_bounded(S):
        least, _, most = row_sum_range(S)
        return max(1.0, most, -least)
    if isinstance(S, IdentityPlus):
        return 1.0 + norm_bound(S.R)
    if isinstance(S, Compressed):
        return norm_bound(S.core)
    if isinstance(S, Tiles):
        return S.frobenius + _DENORMAL * S.shape[0]
    assert isinstance(S, CSR | Dense)  # noqa: S101 - is_bounded says so
    values = [slab.arguments[-1] for slab in S.slabs if slab.arguments[-1].size]
    flat = [dataclasses.replace(one, shape=(one.size,)) for one in values]
    norm = math.sqrt(math.fsum(float(vectors.dot(one, one)[0]) for one in flat))
    return 1.01 * norm + _DENORMAL * S.shape[0] if norm > _SQUARES else math.inf


class _Factors(NamedTuple):
    """LU of S, S itself for residuals, and its norm."""

    S: np.ndarray
    lu: tuple[np.ndarray, np.ndarray]
    norm: float


@dataclass(frozen=True)
class Direct:
    """Dense LU of S in float64 (LAPACK): O(N^3) once per operator, then O(N^2). No options."""

    name: ClassVar[str] = "direct"

    def solve(self, S: Operator, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """x like b in float64, the norms (k,) of b - S x, and what rounding may hide of them.

        Raises
        ------
        LinAlgError
            S is singular to working precision.
        MemoryLimitError
            N^2 numbers do not fit.
        """
        factors = _factorize(S)
        with np.errstate(all="ignore"):
            x = scipy.linalg.lu_solve(factors.lu, b.astype(np.float64), check_finite=False)
            hidden = _FINE * factors.norm * np.linalg.norm(x, axis=0)
            norms = np.linalg.norm(b - factors.S @ x, axis=0)
        return x, np.atleast_1d(norms), np.atleast_1d(hidden)


def is_factorized(S: Operator) -> bool:
    """Whether S was factorized already."""
    return S in _factors


def _factorize(S: Operator) -> _Factors:
    """Factors of S, kept as long as S lives: bounces and frames solve with one S many times."""
    if S in _factors:
        return _factors[S]
    n = S.shape[0]
    what = f"method='direct' factorizes S densely, which for N = {n}"
    checks.fits_host(what, 3 * 8 * n * n)
    try:
        numbers = dense(S)
        with np.errstate(all="ignore"):
            lu, pivots, info = _getrf(numbers)
            rcond, _ = _gecon(lu, np.linalg.norm(numbers, 1))
            norm = float(np.linalg.norm(numbers))
    except MemoryError as error:
        if isinstance(error, MemoryLimitError):
            raise
        raise MemoryLimitError(f"{what} needs {checks.size(24 * n * n)}, more than the host gives") from error
    if info != 0 or not rcond >= np.finfo(np.float64).eps:
        raise np.linalg.LinAlgError("S is singular to working precision")
    _factors[S] = _Factors(numbers, (lu, pivots), norm)
    return _factors[S]
