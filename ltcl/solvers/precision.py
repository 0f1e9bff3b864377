# SPDX-License-Identifier: BSD-3-Clause
"""S factorized in float64 on the host, and what float32 products hide.

A residual b - S x in float32 deviates from the true one by at most about c eps || |S| || ||x||, eps = 2^-23
(Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., section 3.5, with random signs in
place of the worst case). A claim rests on a residual that is within the tolerance with this added;
where it is not, S x is computed in float64 with the numbers that were given
(`Operator.product_float64`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import scipy.linalg

from ltcl import checks
from ltcl.errors import MemoryLimitError
from ltcl.operators import Operator

EPS = 2.0**-23
# c eps. Measured for rows of CSR, dense and tiles: at most 0.1 eps of random signs; of nonnegative
# numbers, whose sums grow on the way, 0.3 eps at 64 a row, 0.5 at 4096, 0.8 at 16384 and 1.5 at
# 65536.
UNIT = 4.0 * EPS
# c eps of float64.
UNIT_FLOAT64 = 4.0 * 2.0**-52

_getrf, _gecon = scipy.linalg.get_lapack_funcs(("getrf", "gecon"), dtype=np.float64)


@dataclass(frozen=True, kw_only=True)
class Factorization:
    """The LU factors of S, (N, N) float64, as LAPACK gives them.

    `rounding` times the norm of x bounds what rounding hides of a residual.
    """

    matrix: np.ndarray
    lu: np.ndarray
    pivots: np.ndarray
    rounding: float


@dataclass(frozen=True)
class Direct:
    """Dense LU of S in float64 (LAPACK): O(N^3) once per operator, then O(N^2). No options."""

    name: ClassVar[str] = "direct"

    def solve(self, S: Operator, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """x like b in float64, the norms (k,) of b - S x, and what rounding may hide of them.

        None if S is singular to working precision.
        """
        factors = factorize(S)
        if factors is None:
            return None
        right = b.astype(np.float64)
        # LAPACK's wrapper shifts the pivots while it runs; other threads have their own copies.
        pivots = factors.pivots.copy()
        with np.errstate(all="ignore"):
            x = scipy.linalg.lu_solve((factors.lu, pivots), right, check_finite=False)
            hidden = factors.rounding * np.linalg.norm(x, axis=0)
            norms = np.linalg.norm(b - factors.matrix @ x, axis=0)
        return x, np.atleast_1d(norms), np.atleast_1d(hidden)


def factorize(S: Operator) -> Factorization | None:
    """The factors of S, made once in its life: many frames are solved with one S.

    None if S is singular to working precision.
    """
    if S.known.factorization is None:
        S.known.factorization = _factorize(S)
    return S.known.factorization


def _factorize(S: Operator) -> Factorization | None:
    n = S.shape[0]
    what = f"method='direct' factorizes S densely, which for N = {n}"
    nbytes = 3 * 8 * n * n
    checks.fits_host(what, nbytes)
    try:
        matrix, is_given = S.matrix_float64()
        with np.errstate(all="ignore"):
            lu, pivots, info = _getrf(matrix)
            one_norm = np.linalg.norm(matrix, 1)
            rcond, _ = _gecon(lu, one_norm)
            # The 2-norm is at most the smaller of the two.
            norm = math.sqrt(one_norm * np.linalg.norm(matrix, np.inf))
            norm = min(norm, float(np.linalg.norm(matrix)))
    except MemoryLimitError:
        raise
    except MemoryError as error:
        raise MemoryLimitError(
            f"{what} needs {checks.size(nbytes)}, more than the host gives"
        ) from error
    # NaN is no condition either.
    if info != 0 or not rcond >= np.finfo(np.float64).eps:
        return None
    unit = UNIT_FLOAT64 if is_given else UNIT
    return Factorization(matrix=matrix, lu=lu, pivots=pivots, rounding=unit * norm)
