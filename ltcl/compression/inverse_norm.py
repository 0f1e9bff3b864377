# SPDX-License-Identifier: BSD-3-Clause
"""||S^-1||_2, by products with S^-1 and S^-T that are solves; see `ltcl.theory.norms`.

A solve to the relative residual t gives S^-1 (v - d) with ||d|| <= t ||v||. The steps see S^-1 + D, with
||D|| <= t sqrt(products) ||S^-1||, each right-hand side being orthogonal to those before: the bound is
widened by that.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from ltcl.device import Array
from ltcl.errors import ConvergenceError
from ltcl.operators import Compressed, IdentityPlus, Operator
from ltcl.solvers import solve
from ltcl.theory.norms import CONFIDENCE, TwoNorm, two_norm

_RTOL = 1e-3
_MAXITER = 400


def inverse_norm(
    S: IdentityPlus, *, confidence: float = CONFIDENCE, factor: float = 1.1, seed: int = 0
) -> TwoNorm:
    """||S^-1||_2 = 1 / smallest singular value of S = I + R, with an upper bound.

    Parameters
    ----------
    S : IdentityPlus, (N, N)
        Between two equal orthonormal bases, the solves are with its core.
    confidence, factor, seed : float, float, int
        As of `ltcl.theory.two_norm`.

    Raises
    ------
    ConvergenceError
        A solve fails: S is singular, or nearly so.

    Examples
    --------
    >>> from ltcl.operators import as_operator
    >>> n = inverse_norm(IdentityPlus(as_operator([[0.0, 0.5], [0.5, 0.0]])))
    >>> round(n.estimate, 2), n.upper < 2.3  # eigenvalues of S are 1/2 and 3/2
    (2.0, True)
    """
    core = S.R.core if isinstance(S.R, Compressed) and S.R.two_sided else S.R
    found = two_norm(_Inverse(core, S.sign), confidence=confidence, factor=factor, seed=seed)
    widened = found.upper / (1.0 - _RTOL * math.sqrt(found.products))
    # Of some coefficients: S is the identity on the others.
    least = 1.0 if core.shape[0] < S.shape[0] else 0.0
    return dataclasses.replace(found, estimate=max(found.estimate, least), upper=max(widened, least))


class _Inverse(Operator):
    """S^-1 of S = I + sign R."""

    def __init__(self, R: Operator, sign: float) -> None:
        super().__init__(R.device, R.shape)
        self._systems = (IdentityPlus(R, sign), IdentityPlus(R.T, sign))

    def _product(self, x: Array, out: Array, scale: float, add: Array | None, transpose: bool) -> None:
        try:
            solved = solve(self._systems[transpose], x.get(), "gmres", rtol=_RTOL, maxiter=_MAXITER).x
        except ConvergenceError as error:
            raise ConvergenceError(
                "S is singular, or nearly so: a solve for the norm of its inverse left "
                f"{error.solution.residual:.2g} of a light; check the first bounce",
                error.solution,
            ) from None
        product = scale * np.asarray(solved, np.float64)
        out.set(product if add is None else product + add.get())
