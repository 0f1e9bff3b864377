# SPDX-License-Identifier: BSD-3-Clause
"""What every linear operator on a device promises.

A subclass implements `_product`, which queues a product, or `_bound`, which prepares one for many
calls.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse.linalg

from ltcl import checks
from ltcl.device import Array, Device, vectors
from ltcl.errors import InputError, InputTypeError, MemoryLimitError

WIDTHS = (8, 4, 3, 2, 1)  # right-hand sides one launch of a product kernel takes
_BLOCK = 64  # columns of a product that makes entries


class Norms(NamedTuple):
    """Norms of a matrix, and its smallest entry where one is negative, else 0."""

    one: float
    inf: float
    frobenius: float
    lowest: float


class Epilogue(NamedTuple):
    """out = a (A x) + b y + c x in one launch; y, which may be `out`, is not read where b is 0."""

    a: float = 1.0
    b: float = 0.0
    y: Array | None = None
    c: float = 0.0

    def without_shift(self, x: Array) -> Epilogue:
        """The same for a product that is not of x itself: x takes the place of y where that is free."""
        return Epilogue(self.a, self.c, x) if self.b == 0.0 else self


PLAIN = Epilogue()  # out = A x


class Operator(scipy.sparse.linalg.LinearOperator):
    """An (M, N) linear operator in float32 on an OpenCL device.

    NumPy in, NumPy out, wherever SciPy takes a `LinearOperator`; `apply` takes and gives device
    arrays.

    Attributes
    ----------
    error : float
        Bound on the 2-norm of what a compressed operator dropped; 0 for exact ones.
    solution_error, error_bound : float
        What compression changes solutions by, ``||x~ - x|| / ||x||``: as its norm states, and at most.
    weights : (N,) float64 or None
        Of an inner product <x, y> = sum_i w_i x_i y_i in which it should be self-adjoint, where one
        is known.
    """

    error = solution_error = error_bound = 0.0
    weights: np.ndarray | None = None

    def __init__(
        self, device: Device, shape: tuple[int, int], *parts: Operator | Array | None
    ) -> None:
        super().__init__(np.float32, shape)
        self.device = device
        self._parts: tuple[Operator | Array | None, ...] = parts  # what it is made of
        self._row_sums: np.ndarray | None = None

    @property
    def nbytes(self) -> int:
        """Bytes on the device; what several parts share counts once."""
        return sum(array.nbytes for array in self.arrays())

    def arrays(self) -> set[Array]:
        """All that it keeps on the device."""
        members = (x for x in self._parts if x is not None)
        return set[Array]().union(*({x} if isinstance(x, Array) else x.arrays() for x in members))

    def bytes_read(self) -> int:
        """Bytes that each product reads from a disk."""
        return sum(part.bytes_read() for part in self._parts if isinstance(part, Operator))

    def _product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        """Queue ``out = a (A x) + b y + c x``, or with A^T. `out` is never `x`."""
        self._bound(x, out, epilogue, transpose)()

    def _bound(
        self, x: Array, out: Array, epilogue: Epilogue, transpose: bool
    ) -> Callable[[], object]:
        """What queues the product at each call."""
        return functools.partial(self._product, x, out, epilogue, transpose)

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (min(M, N),) float64, on the host."""
        raise InputError(f"{type(self).__name__} does not know its diagonal")

    def norms(self) -> Norms:
        """Norms that need the entries; operators that cannot see theirs refuse."""
        raise InputError(
            f"{type(self).__name__} cannot see its entries, so their norms are unknown"
        )

    def apply(
        self,
        x: Array,
        out: Array | None = None,
        *,
        scale: float = 1.0,
        add: Array | None = None,
        add_scale: float = 1.0,
        shift: float = 0.0,
    ) -> Array:
        """Queue ``out = scale (A x) + add_scale add + shift x``; returns `out`, made when not given.

        x is (N,) or (N, k), `add` and `out` are (M,) or (M, k); `out` may be `add`, but not `x`.
        `shift` needs a square operator. InputError for shapes that do not fit.
        """
        epilogue = Epilogue(
            float(scale), 0.0 if add is None else float(add_scale), add, float(shift)
        )
        out = self._checked(x, out, epilogue)
        self._bound(x, out, epilogue, False)()
        return out

    def apply_transpose(self, x: Array, out: Array | None = None, **epilogue: Any) -> Array:
        """Queue ``out = scale (A^T x) + add_scale add + shift x``; keywords are those of `apply`."""
        return self.T.apply(x, out, **epilogue)

    def bind(
        self, x: Array, out: Array, epilogue: Epilogue = PLAIN, *, transpose: bool = False
    ) -> Callable[[], object]:
        """A function that queues ``out = a (A x) + b y + c x`` in microseconds; refuses what `apply` does."""
        A = self.T if transpose else self
        A._checked(x, out, epilogue)
        return A._bound(x, out, epilogue, False)

    def stepper(
        self, x: Array, r: Array, slots: int = 8, a: float = 1.0, c: float = 0.0
    ) -> Stepper:
        """Steps of a stationary iteration on S x = b, S = a A + c I, which change `x` and its residual `r`.

        Norms of residuals of up to `slots` steps may wait on the device until they are read.
        """
        return Stepper(self, x, r, slots, a, c)

    def row_sums(self) -> np.ndarray:
        """A 1, (M,) float32: one product, at the first call only."""
        if self._row_sums is None:
            ones, sums = (
                self.device.upload(np.ones(self.shape[1])),
                self.device.empty(self.shape[0]),
            )
            self.bind(ones, sums)()
            self._row_sums = sums.get()
        return self._row_sums

    def to_dense(self) -> np.ndarray:
        """The whole matrix as (M, N) float64 on the host; MemoryLimitError where that has no room for it."""
        rows, columns = self.shape
        what, nbytes = f"a dense {rows} x {columns} matrix", 8 * rows * columns
        checks.fits_host(what, nbytes)
        try:
            return self._dense()
        except MemoryLimitError:
            raise
        except MemoryError as error:  # a limit of the process, below what the host has
            raise MemoryLimitError(
                f"{what} needs {checks.size(nbytes)}, more than the host gives"
            ) from error

    def _dense(self) -> np.ndarray:
        return self.between(*map(np.arange, self.shape))

    def between(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """The entries (rows, columns), both lists of indices, in float64: a product for each column."""
        entries = np.empty((len(rows), len(columns)))
        for start in range(0, len(columns), _BLOCK):
            some = columns[start : start + _BLOCK]
            unit = np.zeros((self.shape[1], len(some)), np.float32)
            unit[some, np.arange(len(some))] = 1
            entries[:, start : start + _BLOCK] = self._matmat(unit)[rows]
        return entries

    def __reduce__(self) -> Any:
        raise InputTypeError(
            f"{type(self).__name__} lies on a device and cannot be pickled; pickle its Transport or "
            "Inverse, or what to_dense() gives"
        )

    # What SciPy asks for: NumPy in, NumPy out. It makes the other products of these.

    def dot(self, x: Any) -> Any:
        """A x, of an array or an operator; masked values, which SciPy would fill, are refused."""
        checks.unmasked("x", x)
        return super().dot(x)

    def _rdot(self, x: Any) -> Any:
        checks.unmasked("x", x)
        return super()._rdot(x)

    def _matmat(self, X: np.ndarray) -> np.ndarray:
        return self.apply(self.device.upload(checks.real("x", X))).get()

    def _transpose(self) -> Operator:  # pyright: ignore[reportIncompatibleMethodOverride]
        return Transposed(self)

    def _adjoint(self) -> Operator:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self._transpose()  # real numbers

    def _checked(self, x: Array, out: Array | None, epilogue: Epilogue) -> Array:
        """`out`, made where it is None; operands that do not fit are refused."""
        rows, columns = self.shape
        if x.shape[0] != columns or len(x.shape) > 2:
            raise InputError(
                f"x has shape {x.shape}; the operator {self.shape} needs ({columns},) or ({columns}, k)"
            )
        most = ((1 << 31) - 1) // max(rows, columns, 1)
        if x.columns > most:
            raise InputError(f"x has {x.columns} right-hand sides; one product takes {most}")
        if epilogue.c and rows != columns:
            raise InputError(f"shift is {epilogue.c:g}; it must be 0 for the operator {self.shape}")
        expected = (rows, *x.shape[1:])
        out = self.device.empty(expected) if out is None else out
        for name, array in (("x", x), ("out", out), ("add", epilogue.y)):
            if array is None:
                continue
            if array.dtype != np.float32:
                raise InputError(f"{name} holds {array.dtype}; operators take float32")
            if array.device is not self.device:
                raise InputError(
                    f"{name} is on another device, {array.device}; it must be on {self.device}"
                )
            if array is not x and array.shape != expected:
                raise InputError(f"{name} has shape {array.shape}; it must be {expected}")
        if out.buffer is x.buffer:
            raise InputError("out is x; a product cannot be written over its own operand")
        return out


class Stepper:
    """Steps of a stationary iteration: x += d; r -= S d; d = keep d + gain r.

    With keep = 0 they are Jacobi's (gain 1, eq. 20) or Richardson's; with the right numbers
    Chebyshev's. `waiting` counts the steps whose norms were not read yet.
    """

    def __init__(self, A: Operator, x: Array, r: Array, slots: int, a: float, c: float) -> None:
        self.A, self.x, self.r, self.slots = A, x, r, slots
        self.d, self.other = x.like(), x.like()
        self.waiting = 0
        self._a, self._c = a, c
        self._prepare()

    def _prepare(self) -> None:
        # (slots, groups, k) squares of residuals
        self._partials = self.A.device.empty(
            (self.slots, vectors.step_groups(self.x), self.x.columns)
        )
        self._product = self.A.bind(self.d, self.other, Epilogue(self._a, c=self._c))

    def start(self, gain: float) -> None:
        """Queue d = gain r, the first direction."""
        vectors.axpby(gain, self.r, 0.0, self.r, self.d)

    def step(self, keep: float, gain: float) -> None:
        """Queue one step: x moves along d, and the next d is keep d + gain r with the new r."""
        self._product()
        vectors.queue_step(
            self.other, self.x, self.r, self.d, keep, gain, self._partials, self.waiting
        )
        self.waiting += 1

    def norms(self) -> np.ndarray:
        """Norms (waiting, k) float64 of the residuals since the last call, newest last; waits once."""
        squares = self.A.device.empty((self.slots, self.x.columns))
        vectors.queue_sum_partials(self._partials, self.waiting, squares)
        host = squares.get()[: self.waiting]
        self.waiting = 0
        return np.sqrt(host.astype(np.float64))


class Transposed(Operator):
    """A^T of another operator, sharing its memory."""

    def __init__(self, base: Operator) -> None:
        super().__init__(base.device, base.shape[::-1], base)
        self.base = base
        self.error, self.solution_error, self.error_bound = (
            base.error,
            base.error_bound,
            base.error_bound,
        )

    def diagonal(self) -> np.ndarray:
        """That of A."""
        return self.base.diagonal()

    def _bound(
        self, x: Array, out: Array, epilogue: Epilogue, transpose: bool
    ) -> Callable[[], object]:
        return self.base._bound(x, out, epilogue, not transpose)

    def _transpose(self) -> Operator:
        return self.base


def widths(columns: int) -> list[tuple[int, int]]:
    """Launches of k right-hand sides, as (offset, width) pairs: (0, 8) and (8, 3) of 11."""
    pieces, offset = [], 0
    while offset < columns:
        width = next(w for w in WIDTHS if w <= columns - offset)
        pieces.append((offset, width))
        offset += width
    return pieces
