# SPDX-License-Identifier: BSD-3-Clause
"""A `scipy.sparse.linalg.LinearOperator` of the user, multiplied on the host."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse.linalg

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.errors import InputError
from ltcl.operators.base import Epilogue, Operator


class Host(Operator):
    """Somebody's own `scipy.sparse.linalg.LinearOperator`: each product goes through the host."""

    def __init__(self, device: Device, operator: Any) -> None:
        self.operator = scipy.sparse.linalg.aslinearoperator(operator)
        self._name = type(operator).__name__
        checks.real(self._name, np.zeros(0, self.operator.dtype))
        super().__init__(device, self.operator.shape)

    def diagonal(self) -> np.ndarray:
        """What the operator's own ``diagonal()`` gives."""
        diagonal = getattr(self.operator, "diagonal", None)
        if diagonal is None:
            raise InputError(f"{self._name} has no diagonal(); give first_bounce as an array (N,)")
        return np.asarray(diagonal(), np.float64)

    def product(self, x: np.ndarray, transpose: bool = False) -> np.ndarray:
        """A x or A^T x on the host, of x (N, k) float64; what is not real and finite is refused."""
        name = f"the product of {self._name}"
        try:
            product = (self.operator.T if transpose else self.operator).matmat(
                x
            )  # matvec drops masks
        except (
            NotImplementedError,
            TypeError,
        ) as error:  # what SciPy raises, the second for several columns
            if not transpose:
                raise
            raise InputError(f"{self._name} has no rmatvec; its transpose is unknown") from error
        return checks.finite(name, checks.real(name, product))

    def _product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        host, (a, b, y, c) = x.get().astype(np.float64), epilogue
        product = self.product(host.reshape(len(host), -1), transpose).reshape(out.shape)
        total = a * product + c * host if c else a * product
        out.set(total if y is None else total + b * y.get())
