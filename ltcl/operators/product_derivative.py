# SPDX-License-Identifier: BSD-3-Clause
"""The derivative of A x in x: A itself, whose adjoint is A^T."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ltcl.interop.linear_map import Derivative, LinearMap

if TYPE_CHECKING:
    from ltcl.operators.base import Operator


class ProductDerivative(Derivative):
    """The derivative of a product with vectors (..., N), or with matrices (..., N, k)."""

    def __init__(self, A: Operator, x: Any, *, is_vector: bool) -> None:
        self.source = x
        self._A = A
        self._is_vector = is_vector
        axis = x.ndim - (1 if is_vector else 2)
        self.out_shape = (*self.shape[:axis], A.shape[0], *self.shape[axis + 1 :])

    def linear_map(self, state: np.ndarray | None) -> LinearMap:
        """A, which has no state."""
        return LinearMap(
            shape=self.shape,
            out_shape=self.out_shape,
            forward=lambda x: self._multiply(self._A, x),
            adjoint=lambda y: self._multiply(self._A.T, y),
        )

    def _multiply(self, A: Operator, x: np.ndarray) -> np.ndarray:
        if self._is_vector:
            return A._matmat(x[..., None])[..., 0]
        return A._matmat(x)
