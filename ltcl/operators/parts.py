# SPDX-License-Identifier: BSD-3-Clause
"""Operators whose rows are not all in the memory of one device.

A product brings x to the rows and the partial results back through the host. With the rows A_p of
part p,

    A x = (A_1 x; A_2 x; ...),    A^T x = sum_p A_p^T x_p
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.device import Array, Device, vectors
from ltcl.operators.base import Epilogue, Operator
from ltcl.operators.csr import CSR, Pattern
from ltcl.operators.dense import Dense


class Parts(Operator):
    """An operator (M, N) whose products arrive on the host; subclasses give `_gathered`.

    Methods that read rows on one device refuse it and say `where` the rows are.
    """

    where: str
    exact: tuple[Any, ...] | None = None  # as that of `Dense`
    _gathered: Callable[[Array, bool], np.ndarray]  # A x or A^T x, on the host

    def _product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        a, b, y, c = epilogue.without_shift(x)
        product = out.like().set(self._gathered(x, transpose).reshape(out.shape))
        vectors.axpby(a, product, b, product if y is None or not b else y, out)
        if c:
            vectors.axpy(c, x, out)


def upload_part(device: Device, matrix: Any, pattern: Pattern | None = None) -> CSR | Dense:
    """A sparse matrix as `CSR`, an array as `Dense`."""
    return CSR(device, matrix, pattern) if scipy.sparse.issparse(matrix) else Dense(device, matrix)
