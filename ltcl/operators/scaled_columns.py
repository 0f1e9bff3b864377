# SPDX-License-Identifier: BSD-3-Clause
"""An operator with scaled columns and a diagonal: A diag(d) - diag(shift)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array, vectors
from ltcl.errors import InputError
from ltcl.operators.base import Epilogue, Operator


class ScaledColumns(Operator):
    """A diag(d) - diag(shift): T = S F (eq. 3) of S and the first bounce, R = T F^-1 - I of T.

    A is (M, N), d (N,), shift a number or (N,), which needs a square A where it is not 0.
    """

    def __init__(self, A: Operator, d: np.ndarray, shift: Any = 0.0) -> None:
        self.d = checks.finite("d", checks.shape("d", checks.real("d", d), A.shape[1:]))
        self.shift = checks.shape("shift", checks.real("shift", shift), (), A.shape[:1]).astype(
            np.float64
        )
        if self.shift.any() and A.shape[0] != A.shape[1]:
            raise InputError(
                f"the operator has shape {A.shape}; A - diag(shift) needs a square one"
            )
        self.A, self._d = A, A.device.upload(self.d)
        self._shift = A.device.upload(self.shift) if self.shift.ndim else None
        super().__init__(A.device, A.shape, A, self._d, self._shift)
        self.error = A.error * float(np.max(np.abs(self.d), initial=0.0))
        if not self.shift.any():
            errors = (A.solution_error, A.error_bound)
            self.solution_error, self.error_bound = (
                error and error * spread(self.d) for error in errors
            )

    def diagonal(self) -> np.ndarray:
        """diag(A) d - shift, (min(M, N),) float64."""
        diagonal = self.A.diagonal()
        return diagonal * self.d[: len(diagonal)] - self.shift

    def _product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        a, b, y, c = epilogue
        if transpose:
            product = self.device.empty(out.shape)
            self.A._product(x, product, Epilogue(a), True)
            vectors.scale_rows(self._d, product, product)
            vectors.axpby(1.0, product, b, product if y is None else y, out)
        else:
            self.A._product(vectors.scale_rows(self._d, x, x.like()), out, Epilogue(a, b, y), False)
        if self._shift is not None:
            vectors.axpy(-a, vectors.scale_rows(self._shift, x, x.like()), out)
        else:
            c -= a * float(self.shift)
        if c:
            vectors.axpy(c, x, out)


def spread(d: np.ndarray) -> float:
    """max |d| / min |d|, what a diagonal may change relative errors by; infinite where some d is 0."""
    sizes = np.abs(np.asarray(d, np.float64))
    least = float(np.min(sizes, initial=np.inf))
    return float(np.max(sizes, initial=0.0)) / least if least > 0.0 else math.inf
