# SPDX-License-Identifier: BSD-3-Clause
"""The product of two operators, A B, which is not formed."""

from __future__ import annotations

from collections.abc import Callable

from ltcl.device import Array, vectors
from ltcl.errors import InputError
from ltcl.operators.base import Operator
from ltcl.operators.epilogue import PLAIN, Epilogue


class Product(Operator):
    """A B: the light of a scene S from the direct light F of all projectors, T = S F.

    Parameters
    ----------
    A : Operator, (M, L)
    B : Operator, (L, N)
        On the device of A.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import Dense, Product
    >>> device = ltcl.open_device()
    >>> T = Product(Dense(device, [[1.0, 0.5]]), Dense(device, [[2.0], [4.0]]))
    >>> (T @ numpy.array([1.0])).tolist()
    [4.0]
    """

    def __init__(self, A: Operator, B: Operator) -> None:
        if A.shape[1] != B.shape[0]:
            raise InputError(
                f"A has shape {A.shape} and B {B.shape}; B must have {A.shape[1]} rows"
            )
        if A.device is not B.device:
            raise InputError(f"A is on {A.device} and B on {B.device}; both must be on one device")
        super().__init__(A.device, (A.shape[0], B.shape[1]), A, B)
        self.A = A
        self.B = B
        self.error = A.error * max(B.norm_bound().value, 1.0) if A.error else 0.0

    def _queue_product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        self._bind_product(x, out, epilogue, transpose)()

    def _bind_product(
        self, x: Array, out: Array, epilogue: Epilogue, transpose: bool
    ) -> Callable[[], object]:
        first, second = self.B, self.A
        if transpose:
            first, second = self.A, self.B
        middle = self.device.empty((self.B.shape[0], *x.shape[1:]))
        queue_first = first._bind_product(x, middle, PLAIN, transpose)
        if epilogue.c:
            # The operand of the second product is not x.
            epilogue = epilogue.without_shift(x)
        a, b, y, c = epilogue
        queue_second = second._bind_product(middle, out, Epilogue(a, b, y), transpose)

        def multiply() -> None:
            queue_first()
            queue_second()
            if c:
                vectors.axpy(c, x, out)

        return multiply
