# SPDX-License-Identifier: BSD-3-Clause
"""What every linear operator on a device promises.

A subclass implements `_product`, which queues a product, or `_bound`, which prepares one that is queued again
and again; either makes the other. `diagonal` is its own, too; everything else is made of these.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.sparse.linalg

from ltcl import checks
from ltcl.device import Array, Device, vectors
from ltcl.errors import InputError

WIDTHS = (8, 4, 3, 2, 1)  # right-hand sides one launch of a product kernel takes
_BLOCK = 64  # columns of a product that makes entries


@dataclass(frozen=True)
class Norms:
    """Largest column sum, largest row sum (both of absolute values), Frobenius norm, smallest entry or 0."""

    one: float
    inf: float
    frobenius: float
    lowest: float


class Epilogue(NamedTuple):
    """What becomes of a product: out = a (A x) + b y + c x, in the same launch.

    y is not read where b is 0, and may be `out`; c needs a square A.
    """

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

    NumPy in, NumPy out, wherever SciPy takes a `LinearOperator`; device arrays in, device arrays out
    through `apply`, with no host copy between products.

    Attributes
    ----------
    device : Device
        Where it lives.
    shape : tuple of int
        (M, N).
    nbytes : int
        Bytes of its matrix on the device.
    error : float
        Bound on the 2-norm of what a compressed operator dropped; 0 for exact ones.
    solution_error : float
        Bound on ``||x~ - x|| / ||x||`` for every right-hand side, x~ the solution with this operator, x with
        the one that it was compressed from; 0 for exact ones.
    weights : (N,) float64 or None
        Of an inner product <x, y> = sum_i w_i x_i y_i in which it should be self-adjoint, where one is known.
    """

    error = 0.0
    solution_error = 0.0
    weights: np.ndarray | None = None

    def __init__(self, device: Device, shape: tuple[int, int], *parts: Operator | Array | None) -> None:
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
        own = {part for part in self._parts if isinstance(part, Array)}
        return own.union(*(part.arrays() for part in self._parts if isinstance(part, Operator)))

    def _product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        """Queue ``out = a (A x) + b y + c x``, or with A^T. `out` is never `x`."""
        self._bound(x, out, epilogue, transpose)()

    def _bound(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> Callable[[], object]:
        """What queues the product at each call."""
        return functools.partial(self._product, x, out, epilogue, transpose)

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (min(M, N),) float64, on the host."""
        raise InputError(f"{type(self).__name__} does not know its diagonal")

    def norms(self) -> Norms:
        """Norms that need the entries; operators that cannot see theirs refuse."""
        raise InputError(f"{type(self).__name__} cannot see its entries, so their norms are unknown")

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
        """Queue ``out = scale (A x) + add_scale add + shift x`` on the device.

        Parameters
        ----------
        x : Array, (N,) or (N, k)
        out : Array, (M,) or (M, k), optional
            Made when not given; must not be `x`.
        scale, add_scale, shift : float
            `shift` needs a square operator.
        add : Array like `out`, optional
            May be `out` itself, which is then added to.

        Returns
        -------
        Array
            `out`. A residual is ``S.apply(x, r, scale=-1, add=b)``: one launch, no extra pass.

        Raises
        ------
        InputError
            Shapes that do not fit.
        """
        epilogue = Epilogue(float(scale), 0.0 if add is None else float(add_scale), add, float(shift))
        out = self._checked(x, out, epilogue)
        self._bound(x, out, epilogue, False)()
        return out

    def apply_transpose(self, x: Array, out: Array | None = None, **epilogue: Any) -> Array:
        """Queue ``out = scale (A^T x) + add_scale add + shift x``; see `apply`, also for keywords."""
        return self.T.apply(x, out, **epilogue)

    def bind(
        self, x: Array, out: Array, epilogue: Epilogue = PLAIN, *, transpose: bool = False
    ) -> Callable[[], object]:
        """A product of fixed arrays: each call of what is returned queues it, in microseconds.

        ``out = a (A x) + b y + c x`` with what the arrays hold by then; refuses what `apply` refuses.
        """
        A = self.T if transpose else self
        A._checked(x, out, epilogue)
        return A._bound(x, out, epilogue, False)

    def stepper(self, x: Array, r: Array, slots: int = 8) -> Stepper:
        """Steps of a stationary iteration on S x = b, whose residual is `r`; both are changed in place.

        Parameters
        ----------
        x, r : Array, (N,) or (N, k)
        slots : int
            Steps whose residual norms may wait on the device until they are read.
        """
        return self._stepper(x, r, slots, 1.0, 0.0)

    def _stepper(self, x: Array, r: Array, slots: int, a: float, c: float) -> Stepper:
        """Steps of S = a A + c I."""
        return Stepper(self, x, r, slots, a, c)

    def row_sums(self) -> np.ndarray:
        """A 1, (M,) float32: one product, at the first call only."""
        if self._row_sums is None:
            ones, sums = self.device.upload(np.ones(self.shape[1])), self.device.empty(self.shape[0])
            self.bind(ones, sums)()
            self._row_sums = sums.get()
        return self._row_sums

    def to_dense(self) -> np.ndarray:
        """The whole matrix as (M, N) float64 on the host, column block by column block."""
        rows, columns = self.shape
        checks.fits_host(f"a dense {rows} x {columns} matrix", 8 * rows * columns)
        return self.between(np.arange(rows), np.arange(columns))

    def between(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """The entries (rows, columns), both lists of indices, in float64: a product for each column."""
        entries = np.empty((len(rows), len(columns)))
        for start in range(0, len(columns), _BLOCK):
            some = columns[start : start + _BLOCK]
            unit = np.zeros((self.shape[1], len(some)), np.float32)
            unit[some, np.arange(len(some))] = 1
            entries[:, start : start + _BLOCK] = self._matmat(unit)[rows]
        return entries

    # What SciPy asks for: NumPy in, NumPy out.

    def _matmat(self, X: np.ndarray) -> np.ndarray:
        return self.apply(self.device.upload(checks.real("x", X))).get()

    def _rmatmat(self, X: np.ndarray) -> np.ndarray:
        return self.apply_transpose(self.device.upload(checks.real("x", X))).get()

    def _matvec(self, x: np.ndarray) -> np.ndarray:
        return self._matmat(np.ravel(x))

    def _rmatvec(self, x: np.ndarray) -> np.ndarray:
        return self._rmatmat(np.ravel(x))

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
                raise InputError(f"{name} is on another device, {array.device}; it must be on {self.device}")
            if array is not x and array.shape != expected:
                raise InputError(f"{name} has shape {array.shape}; it must be {expected}")
        if out.buffer is x.buffer:
            raise InputError("out is x; a product cannot be written over its own operand")
        return out


class Stepper:
    """Steps of a stationary iteration: x += d; r -= S d; d = keep d + gain r.

    With keep = 0 they are Jacobi's (gain 1, eq. 20) or Richardson's; with the right numbers Chebyshev's.
    Norms of residuals stay on the device until several are read at once.

    Attributes
    ----------
    waiting : int
        Steps since norms were read last.
    """

    def __init__(self, A: Operator, x: Array, r: Array, slots: int, a: float, c: float) -> None:
        self.A, self.x, self.r, self.slots = A, x, r, slots
        self.d, self.other = x.like(), x.like()
        self.waiting = 0
        self._a, self._c = a, c
        self._prepare()

    def _prepare(self) -> None:
        """Set up `_partials` (slots, groups, k) and whatever a step needs."""
        self._partials = self.A.device.empty((self.slots, vectors.step_groups(self.x), self.x.columns))
        self._product = self.A.bind(self.d, self.other, Epilogue(self._a, c=self._c))

    def start(self, gain: float) -> None:
        """Queue d = gain r, the first direction."""
        vectors.axpby(gain, self.r, 0.0, self.r, self.d)

    def step(self, keep: float, gain: float) -> None:
        """Queue one step: x moves along d, and the next d is keep d + gain r with the new r."""
        self._queue(keep, gain)
        self.waiting += 1

    def _queue(self, keep: float, gain: float) -> None:
        self._product()
        vectors.queue_step(self.other, self.x, self.r, self.d, keep, gain, self._partials, self.waiting)

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
        self.error, self.solution_error = base.error, base.solution_error

    def diagonal(self) -> np.ndarray:
        """That of A."""
        return self.base.diagonal()

    def _bound(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> Callable[[], object]:
        return self.base._bound(x, out, epilogue, not transpose)

    def _transpose(self) -> Operator:
        return self.base


def widths(columns: int) -> list[tuple[int, int]]:
    """Cut k right-hand sides into launches: (offset, width) pairs.

    >>> widths(11)
    [(0, 8), (8, 3)]
    """
    pieces, offset = [], 0
    while offset < columns:
        width = next(w for w in WIDTHS if w <= columns - offset)
        pieces.append((offset, width))
        offset += width
    return pieces
