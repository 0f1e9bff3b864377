# SPDX-License-Identifier: BSD-3-Clause
"""An operator with scaled columns and a diagonal: A diag(d) - diag(shift)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array, vectors
from ltcl.errors import InputError
from ltcl.operators.base import Operator
from ltcl.operators.epilogue import Epilogue
from ltcl.operators.knowledge import Float64Form


class ScaledColumns(Operator):
    """A diag(d) - diag(shift): T = S F (eq. 3) from S and the first bounce, R = T F^-1 - I from T.

    Parameters
    ----------
    A : Operator, (M, N)
    d : (N,)
    shift : number or (N,)
        Not 0 only for a square A.

    Attributes
    ----------
    uploaded_d : Array
        d on the device.
    """

    def __init__(self, A: Operator, d: np.ndarray, shift: Any = 0.0) -> None:
        factors = checks.shape("d", checks.real("d", d), A.shape[1:])
        self.d = checks.finite("d", factors)
        shift = checks.shape("shift", checks.real("shift", shift), (), A.shape[:1])
        self.shift = shift.astype(np.float64)
        has_shift = bool(self.shift.any())
        if has_shift and A.shape[0] != A.shape[1]:
            raise InputError(
                f"the operator has shape {A.shape}; A - diag(shift) needs a square one"
            )
        self.A = A
        self.uploaded_d = A.device.upload(self.d)
        # A single number needs no array: it joins the epilogue.
        self._shift = A.device.upload(self.shift) if self.shift.ndim else None
        super().__init__(A.device, A.shape, A, self.uploaded_d, self._shift)
        self.error = A.error * float(np.max(np.abs(self.d), initial=0.0))
        if not has_shift:
            self.solution_error = _scaled_error(A.solution_error, self.d)
            self.error_bound = _scaled_error(A.error_bound, self.d)

    def diagonal(self) -> np.ndarray:
        """diag(A) d - shift, (min(M, N),) float64."""
        diagonal = self.A.diagonal()
        return diagonal * self.d[: len(diagonal)] - self.shift

    def between(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """The entries (rows, columns): those of A, scaled and shifted."""
        entries = self.A.between(rows, columns) * self.d[columns]
        shift = np.broadcast_to(self.shift, self.shape[:1])
        is_diagonal = np.equal.outer(rows, columns)
        return entries - is_diagonal * shift[rows][:, None]

    def _float64_form(self, *, reads_blocks: bool = False) -> Float64Form | None:
        form = self.A._float64_form(reads_blocks=reads_blocks)
        if form is None:
            return None
        return form.scaled(self.d, -self.shift)

    def _queue_product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        a, b, y, c = epilogue
        if transpose:
            product = self.device.empty(out.shape)
            self.A._queue_product(x, product, Epilogue(a), True)
            vectors.scale_rows(self.uploaded_d, product, product)
            vectors.axpby(1.0, product, b, epilogue.operand(product), out)
        else:
            scaled = vectors.scale_rows(self.uploaded_d, x, x.like())
            self.A._queue_product(scaled, out, Epilogue(a, b, y), False)
        if self._shift is not None:
            shifted = vectors.scale_rows(self._shift, x, x.like())
            vectors.axpy(-a, shifted, out)
        else:
            c -= a * float(self.shift)
        if c:
            vectors.axpy(c, x, out)


def _scaled_error(error: float, d: np.ndarray) -> float:
    """A relative error after a diagonal; no error stays none, also where some d is 0."""
    if error == 0.0:
        return 0.0
    return error * spread(d)


def spread(d: np.ndarray) -> float:
    """max |d| / min |d|, the most by which a diagonal changes relative errors.

    Infinite if some d is 0.
    """
    sizes = np.abs(np.asarray(d, np.float64))
    smallest = float(np.min(sizes, initial=np.inf))
    largest = float(np.max(sizes, initial=0.0))
    return largest / smallest if smallest > 0.0 else math.inf
