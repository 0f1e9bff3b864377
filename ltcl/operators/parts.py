# SPDX-License-Identifier: BSD-3-Clause
"""Operators whose rows are not all in the memory of one device.

A product brings x to the rows and the partial results back through the host. With the rows A_p of
part p,

    A x = (A_1 x; A_2 x; ...),    A^T x = sum_p A_p^T x_p
"""

from __future__ import annotations

import abc
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array, Device, vectors
from ltcl.operators.base import Operator
from ltcl.operators.csr import CSR, Pattern
from ltcl.operators.dense import Dense, Filled, is_filled
from ltcl.operators.epilogue import Epilogue
from ltcl.operators.knowledge import Float64Form


class Parts(Operator):
    """An operator (M, N) whose products arrive on the host; subclasses write `_host_product`.

    Methods that read rows on one device refuse it, naming the place of its rows, `where`.
    """

    where: str

    @abc.abstractmethod
    def _host_product(self, x: Array, transpose: bool) -> np.ndarray:
        """A x or A^T x, on the host."""

    def _queue_product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        a, b, y, c = epilogue.without_shift(x)
        host_product = self._host_product(x, transpose)
        product = out.like().set(host_product.reshape(out.shape))
        # axpby reads y also where b is 0.
        added = product if y is None or not b else y
        vectors.axpby(a, product, b, added, out)
        if c:
            vectors.axpy(c, x, out)


def upload_part(device: Device, matrix: Any, pattern: Pattern | None = None) -> CSR | Dense:
    """A sparse matrix as `CSR`, an array or a matrix with few zeros as `Dense`, on one device."""
    if not scipy.sparse.issparse(matrix):
        return Dense(device, matrix)
    if not is_filled(matrix.shape, matrix.nnz):
        return CSR(device, matrix, pattern)
    rows = checks.csr("matrix", matrix)
    height, width = matrix.shape
    A = Filled(device, (height, width), lambda: iter([(0, rows)]))
    A.exact_form = Float64Form(matrix=rows)
    return A
