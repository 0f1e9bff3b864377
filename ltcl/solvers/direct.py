# SPDX-License-Identifier: BSD-3-Clause
"""Dense LU on the host in float64 (LAPACK): the reference, O(N^3) once per operator and then O(N^2)."""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import scipy.linalg

from ltcl import checks
from ltcl.operators import Operator

_getrf, _gecon = scipy.linalg.get_lapack_funcs(("getrf", "gecon"), dtype=np.float64)
_factors: weakref.WeakKeyDictionary[Operator, Factors] = weakref.WeakKeyDictionary()


@dataclass(frozen=True)
class Factors:
    """LU of S, and S itself for residuals."""

    S: np.ndarray
    lu: tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Direct:
    """No options. Solves at once instead of iterating."""

    name: ClassVar[str] = "direct"

    def solve(self, S: Operator, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """x and the residual b - S x, both (N, k) float64; refuses a singular S with LinAlgError."""
        factors = _factorize(S)
        x = scipy.linalg.lu_solve(factors.lu, b, check_finite=False)
        return x, b - factors.S @ x


def known(S: Operator) -> bool:
    """Whether S was factorized already."""
    return S in _factors


def _factorize(S: Operator) -> Factors:
    """Factors of S, kept as long as S lives: bounces and frames solve with one S many times."""
    if S not in _factors:
        n = S.shape[0]
        checks.fits_host(f"method='direct' factorizes S densely, which for N = {n}", 3 * 8 * n * n)
        dense = S.to_dense()
        with np.errstate(all="ignore"):
            lu, pivots, info = _getrf(dense)
            rcond, _ = _gecon(lu, np.linalg.norm(dense, 1))
        if info != 0 or rcond < np.finfo(np.float64).eps:
            raise np.linalg.LinAlgError("S is singular to working precision")
        _factors[S] = Factors(dense, (lu, pivots))
    return _factors[S]
