# SPDX-License-Identifier: BSD-3-Clause
"""The interreflection operator S = I + R (eq. 6), whose identity is not stored.

S^-1 undoes all bounces of light, (I - A)^-1 adds them (eq. 4 and 7).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array
from ltcl.errors import InputError
from ltcl.operators.base import Operator
from ltcl.operators.epilogue import Epilogue
from ltcl.operators.knowledge import Float64Form, NormBound
from ltcl.operators.shared_vector import RowShares
from ltcl.operators.stepper import Stepper


class IdentityPlus(Operator):
    """S = I + R, the interreflection operator (eq. 6), or I - A with ``sign=-1``.

    Parameters
    ----------
    R : Operator, (N, N)
    sign : 1 or -1
    weights : (N,), optional
        All positive, see `Operator`.
    solution_error : float
        ``||S^-1|| ||E||`` with E what was dropped; infinite if unknown. Also the `error_bound`.

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
        # Random walks take their moments from R itself, which only a sign leaves as they are.
        if sign not in (1.0, -1.0):
            raise InputError(f"sign is {sign!r}; it must be 1 for I + R or -1 for I - R")
        if not solution_error >= 0.0:
            raise InputError(
                f"solution_error is {solution_error!r}; it must be a number of at least 0"
            )
        super().__init__(R.device, R.shape, R)
        self.R = R
        self.sign = float(sign)
        self.coefficient_basis = R.core_basis
        self.error = R.error
        self.solution_error = float(solution_error)
        self.error_bound = self.solution_error
        if weights is not None:
            self.weights = checks.shape("weights", weights, R.shape[:1])

    def diagonal(self) -> np.ndarray:
        """1 + sign diag(R), (N,) float64."""
        return 1.0 + self.sign * self.R.diagonal()

    def norm_bound(self) -> NormBound:
        """1 + the bound of R."""
        bound = self.R.norm_bound()
        return NormBound(1.0 + bound.value, bound.is_bound)

    def between(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """The entries (rows, columns): those of R, and 1 on the diagonal."""
        is_diagonal = np.equal.outer(rows, columns)
        return self.sign * self.R.between(rows, columns) + is_diagonal

    @property
    def has_entries(self) -> bool:
        """True if the entries of R lie on one device, in rows."""
        return self.R.has_entries

    def as_it_stands(self) -> IdentityPlus:
        """The same S, taken as exact."""
        if self.solution_error == 0.0:
            return self
        return IdentityPlus(self.R, self.sign, self.weights)

    def on_coefficients(self) -> Operator:
        """I + sign C, where R = W^T C W in an isometric basis W; made once."""
        if self.known.coefficient_system is None:
            system = IdentityPlus(self.R.on_coefficients(), self.sign)
            # Weights and row sums in pixels bound the spectrum.
            system.weights = self.weights
            system.known.row_sums = self.row_sums()
            self.known.coefficient_system = system
        return self.known.coefficient_system

    def stepper(
        self, x: Array, r: Array, slots: int = 8, a: float = 1.0, c: float = 0.0
    ) -> Stepper:
        """Steps of R with the identity in the same launch; see `Operator.stepper`."""
        return self.R.stepper(x, r, slots, a * self.sign, c + a)

    def row_shares(self, a: float = 1.0, c: float = 0.0) -> RowShares | None:
        """Shares of R with the identity added; see `Operator.row_shares`."""
        return self.R.row_shares(a * self.sign, c + a)

    def _dense(self) -> np.ndarray:
        dense = self.R.to_dense()
        dense *= self.sign
        dense[np.diag_indices_from(dense)] += 1.0
        return dense

    def _float64_form(self, *, reads_blocks: bool = False) -> Float64Form | None:
        form = self.R._float64_form(reads_blocks=reads_blocks)
        if form is None:
            return None
        return form.scaled(self.sign, 1.0)

    def _epilogue_of_R(self, epilogue: Epilogue) -> Epilogue:
        a, b, y, c = epilogue
        return Epilogue(a * self.sign, b, y, c + a)

    def _queue_product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        self.R._queue_product(x, out, self._epilogue_of_R(epilogue), transpose)

    def _bind_product(
        self, x: Array, out: Array, epilogue: Epilogue, transpose: bool
    ) -> Callable[[], object]:
        return self.R._bind_product(x, out, self._epilogue_of_R(epilogue), transpose)
