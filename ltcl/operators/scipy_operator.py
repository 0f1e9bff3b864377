# SPDX-License-Identifier: BSD-3-Clause
"""A `scipy.sparse.linalg.LinearOperator` of the user, multiplied on the host."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse.linalg

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.errors import InputError
from ltcl.operators.base import Operator
from ltcl.operators.epilogue import Epilogue
from ltcl.operators.knowledge import Float64Form


class Host(Operator):
    """A `scipy.sparse.linalg.LinearOperator` of the user: each product goes through the host."""

    def __init__(self, device: Device, operator: Any) -> None:
        self.operator = scipy.sparse.linalg.aslinearoperator(operator)
        self._name = type(operator).__name__
        # Complex numbers are refused.
        empty = _namespace(self.operator).empty(0, dtype=self.operator.dtype)
        checks.real(self._name, empty)
        super().__init__(device, self.operator.shape)

    def diagonal(self) -> np.ndarray:
        """The result of the operator's own ``diagonal()``."""
        diagonal = getattr(self.operator, "diagonal", None)
        if diagonal is None:
            raise InputError(f"{self._name} has no diagonal(); give first_bounce as an array (N,)")
        return np.asarray(diagonal(), np.float64)

    def product(self, x: np.ndarray, transpose: bool = False) -> np.ndarray:
        """A x or A^T x on the host, x (N, k) float64; results that are not finite are refused."""
        operator = self.operator.T if transpose else self.operator
        operand = _namespace(operator).asarray(x)
        try:
            # `matvec` would drop masks.
            product = operator.matmat(operand)
        except (NotImplementedError, TypeError) as error:
            # SciPy raises either if there is no rmatvec, the second for several columns.
            if not transpose:
                raise
            raise InputError(f"{self._name} has no rmatvec; its transpose is unknown") from error
        name = f"the product of {self._name}"
        return checks.finite(name, checks.real(name, product))

    def _dense(self) -> np.ndarray:
        return self.product(np.eye(self.shape[1])).astype(np.float64)

    def _float64_form(self, *, reads_blocks: bool = False) -> Float64Form | None:
        return Float64Form(matrix=self)

    def _queue_product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        a, b, y, c = epilogue
        operand = x.get().astype(np.float64)
        product = self.product(operand.reshape(len(operand), -1), transpose)
        total = a * product.reshape(out.shape)
        if c:
            total = total + c * operand
        if y is not None:
            total = total + b * y.get()
        out.set(total)


def _namespace(operator: Any) -> Any:
    """The namespace of the arrays that an operator takes: NumPy before SciPy 1.18."""
    return getattr(operator, "_xp", np)
