# SPDX-License-Identifier: BSD-3-Clause
"""The interreflection operator S = I + R."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array
from ltcl.errors import InputError
from ltcl.operators.base import Epilogue, Operator, Stepper


class IdentityPlus(Operator):
    """S = I + R, the interreflection operator (eq. 6), or I - A with ``sign=-1``; the identity is not stored.

    S^-1 undoes all bounces, (I - A)^-1 adds them (eq. 4 and 7).

    Parameters
    ----------
    R : Operator, (N, N)
    sign : 1 or -1
    weights : (N,), optional, all positive, see `Operator`
    solution_error : float
        ``||S^-1|| ||E||`` with E what was dropped; infinite where nothing is known. Also the `error_bound`.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import Dense, IdentityPlus
    >>> S = IdentityPlus(Dense(ltcl.open_device(), [[0.0, 0.5], [0.5, 0.0]]))
    >>> (S @ numpy.array([1.0, 0.0])).tolist()
    [1.0, 0.5]
    """

    def __init__(
        self, R: Operator, sign: float = 1.0, weights: Any = None, *, solution_error: float = 0.0
    ) -> None:
        if R.shape[0] != R.shape[1]:
            raise InputError(f"R has shape {R.shape}; S = I + R needs a square one")
        if sign not in (1.0, -1.0):
            raise InputError(f"sign is {sign!r}; it must be 1 for I + R or -1 for I - R")
        if not solution_error >= 0.0:
            raise InputError(
                f"solution_error is {solution_error!r}; it must be a number of at least 0"
            )
        super().__init__(R.device, R.shape, R)
        self.R, self.sign, self.error, self.solution_error = (
            R,
            float(sign),
            R.error,
            float(solution_error),
        )
        self.error_bound = self.solution_error
        self.weights = None if weights is None else checks.shape("weights", weights, R.shape[:1])

    def diagonal(self) -> np.ndarray:
        """1 + sign diag(R), (N,) float64."""
        return 1.0 + self.sign * self.R.diagonal()

    def as_it_stands(self) -> IdentityPlus:
        """The same S taken for exact."""
        return self if self.solution_error == 0.0 else IdentityPlus(self.R, self.sign, self.weights)

    def _dense(self) -> np.ndarray:
        dense = self.R.to_dense()
        dense *= self.sign
        dense[np.diag_indices_from(dense)] += 1.0
        return dense

    def _bound(
        self, x: Array, out: Array, epilogue: Epilogue, transpose: bool
    ) -> Callable[[], object]:
        a, b, y, c = epilogue
        return self.R._bound(x, out, Epilogue(a * self.sign, b, y, c + a), transpose)

    def stepper(
        self, x: Array, r: Array, slots: int = 8, a: float = 1.0, c: float = 0.0
    ) -> Stepper:
        """Those of R with the identity in the same launch; see `Operator.stepper`."""
        return self.R.stepper(x, r, slots, a * self.sign, c + a)
