# SPDX-License-Identifier: BSD-3-Clause
"""The contract of every linear operator on a device.

A subclass writes `_queue_product`; all other products derive from it. `_bind_product` is written
as well where a product can be prepared for many calls. A subclass that knows its entries writes
`diagonal`, `norms`, `norm_bound` and `_float64_form`.
"""

from __future__ import annotations

import abc
import functools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse.linalg

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.interop.calls import Differentiable
from ltcl.operators.epilogue import PLAIN, Epilogue
from ltcl.operators.knowledge import (
    Float64Form,
    Knowledge,
    NormBound,
    Norms,
    Product,
    RowSumRange,
)
from ltcl.operators.product_derivative import ProductDerivative
from ltcl.operators.stepper import Stepper

if TYPE_CHECKING:
    from ltcl.operators.bases import Basis
    from ltcl.operators.shared_vector import RowShares

# Columns of a product that computes entries.
ENTRY_COLUMNS = 64
# Bytes up to which a product in float64 on the host takes no longer than a few waits for a device.
CHEAP_PRODUCT_BYTES = 4 << 20


def _derivative_of_dot(self: Operator, x: Any) -> ProductDerivative:
    return ProductDerivative(self, x, is_vector=x.ndim == 1)


def _derivative_of_vectors(self: Operator, x: Any) -> ProductDerivative:
    # SciPy takes (N, 1) for one column.
    return ProductDerivative(self, x, is_vector=tuple(x.shape) != (self.shape[1], 1))


def _derivative_of_matrices(self: Operator, X: Any) -> ProductDerivative:
    return ProductDerivative(self, X, is_vector=False)


_OF_DOT = Differentiable(("x",), _derivative_of_dot)
_OF_VECTORS = Differentiable(("x",), _derivative_of_vectors)
_OF_MATRICES = Differentiable(("X",), _derivative_of_matrices)


class Operator(scipy.sparse.linalg.LinearOperator, metaclass=abc.ABCMeta):
    """An (M, N) linear operator in float32 on an OpenCL device.

    NumPy in, NumPy out, wherever SciPy takes a `LinearOperator`; `apply` takes and gives device
    arrays.

    Attributes
    ----------
    error : float
        Bound on the 2-norm of what a compressed operator dropped; 0 for exact ones.
    solution_error, error_bound : float
        Change of solutions by compression, ``||x~ - x|| / ||x||``: estimated by its norm, and at
        most.
    weights : (N,) float64 or None
        Weights of an inner product <x, y> = sum_i w_i x_i y_i in which the operator should be
        self-adjoint, if one is known.
    core_basis : Basis or None
        The isometric basis W of an operator W^T C W.
    coefficient_basis : Basis or None
        The isometric basis W of an operator I + W^T C W, which can be solved on coefficients. On
        the coefficients that W leaves out it is the identity, as W^T C W itself is not.
    known : Knowledge
        Facts that are found once in the life of the operator.
    """

    error: float = 0.0
    solution_error: float = 0.0
    error_bound: float = 0.0
    weights: np.ndarray | None = None
    core_basis: Basis | None = None
    coefficient_basis: Basis | None = None

    def __init__(
        self, device: Device, shape: tuple[int, int], *components: Operator | Array | None
    ) -> None:
        super().__init__(np.float32, shape)
        self.device = device
        self.known = Knowledge()
        # Operators and arrays that it is made of.
        self._components: tuple[Operator | Array | None, ...] = components

    # The contract.

    @abc.abstractmethod
    def _queue_product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        """Queue ``out = a (A x) + b y + c x``, or with A^T. `out` is never `x`."""

    def _bind_product(
        self, x: Array, out: Array, epilogue: Epilogue, transpose: bool
    ) -> Callable[[], object]:
        """A function that queues the product at each call."""
        return functools.partial(self._queue_product, x, out, epilogue, transpose)

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (min(M, N),) float64, on the host."""
        raise InputError(f"{type(self).__name__} does not know its diagonal")

    def norms(self) -> Norms:
        """Norms that need the entries; operators that cannot see theirs refuse."""
        raise InputError(
            f"{type(self).__name__} cannot see its entries, so their norms are unknown"
        )

    def norm_bound(self) -> NormBound:
        """A bound on the 2-norm of A without its signs, entry by entry, or else an estimate.

        Without entries it is the largest row sum: a bound if A is symmetric and nonnegative.
        """
        row_sums = self.row_sum_range()
        return NormBound(max(1.0, row_sums.largest, -row_sums.least), is_bound=False)

    def _float64_form(self, *, reads_blocks: bool = False) -> Float64Form | None:
        """The numbers as they were given, in float64; None if they are on the device alone.

        `reads_blocks` allows reading the blocks of a store once more.
        """
        return None

    @property
    def has_entries(self) -> bool:
        """True if its entries lie on one device, in rows."""
        return False

    def on_coefficients(self) -> Operator:
        """The same operator between the coefficients of its basis."""
        raise InputError(f"{type(self).__name__} is not between the coefficients of one basis")

    # Memory.

    @property
    def nbytes(self) -> int:
        """Bytes on the device; arrays that several parts share count once."""
        return sum(array.nbytes for array in self.arrays())

    def arrays(self) -> set[Array]:
        """All arrays that it keeps on the device."""
        arrays: set[Array] = set()
        for component in self._components:
            if isinstance(component, Array):
                arrays.add(component)
            elif component is not None:
                arrays |= component.arrays()
        return arrays

    def bytes_read(self) -> int:
        """Bytes that each product reads from a disk."""
        operators = [item for item in self._components if isinstance(item, Operator)]
        return sum(operator.bytes_read() for operator in operators)

    # Products on the device.

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
        """Queue ``out = scale (A x) + add_scale add + shift x``; returns `out`.

        Parameters
        ----------
        x : Array, (N,) or (N, k)
        out : Array, (M,) or (M, k), optional
            A new array when not given. It may be `add`, but not `x`.
        scale : float
        add : Array, like `out`, optional
        add_scale : float
        shift : float
            Not 0 only for a square operator.

        Raises
        ------
        InputError
            If shapes, types or devices do not fit.
        """
        add_factor = 0.0 if add is None else float(add_scale)
        epilogue = Epilogue(a=float(scale), b=add_factor, y=add, c=float(shift))
        self._check_operand(x, epilogue)
        if out is None:
            out = self.device.empty((self.shape[0], *x.shape[1:]))
        self._check_arrays(x, out, epilogue)
        self._bind_product(x, out, epilogue, False)()
        return out

    def apply_transpose(self, x: Array, out: Array | None = None, **epilogue: Any) -> Array:
        """Queue ``out = scale (A^T x) + add_scale add + shift x``; keywords as those of `apply`."""
        return self.T.apply(x, out, **epilogue)

    def bind(
        self, x: Array, out: Array, epilogue: Epilogue = PLAIN, *, transpose: bool = False
    ) -> Callable[[], object]:
        """A function that queues ``out = a (A x) + b y + c x`` in microseconds.

        It refuses what `apply` refuses.
        """
        A = self.T if transpose else self
        A._check_operand(x, epilogue)
        A._check_arrays(x, out, epilogue)
        return A._bind_product(x, out, epilogue, False)

    def stepper(
        self, x: Array, r: Array, slots: int = 8, a: float = 1.0, c: float = 0.0
    ) -> Stepper:
        """Steps of a stationary iteration on S x = b, S = a A + c I.

        They change `x` and its residual `r`. Norms of residuals of up to `slots` steps may wait on
        the device until they are read.
        """
        return Stepper(self, x, r, slots, a, c)

    def row_shares(self, a: float = 1.0, c: float = 0.0) -> RowShares | None:
        """S = a A + c I in shares of rows on several devices; None if A is not in such shares."""
        del a, c
        return None

    def _check_operand(self, x: Array, epilogue: Epilogue) -> None:
        rows, columns = self.shape
        if x.shape[0] != columns or len(x.shape) > 2:
            raise InputError(
                f"x has shape {x.shape}; the operator {self.shape} needs "
                f"({columns},) or ({columns}, k)"
            )
        # Kernels count elements in 32 bits.
        max_columns = ((1 << 31) - 1) // max(rows, columns, 1)
        if x.columns > max_columns:
            raise InputError(f"x has {x.columns} right-hand sides; one product takes {max_columns}")
        if epilogue.c and rows != columns:
            raise InputError(f"shift is {epilogue.c:g}; it must be 0 for the operator {self.shape}")

    def _check_arrays(self, x: Array, out: Array, epilogue: Epilogue) -> None:
        expected = (self.shape[0], *x.shape[1:])
        self._check_array("x", x, x.shape)
        self._check_array("out", out, expected)
        if epilogue.y is not None:
            self._check_array("add", epilogue.y, expected)
        if out.buffer is x.buffer:
            raise InputError("out is x; a product cannot be written over its own operand")

    def _check_array(self, name: str, array: Array, shape: tuple[int, ...]) -> None:
        if array.dtype != np.float32:
            raise InputError(f"{name} holds {array.dtype}; operators take float32")
        if array.device is not self.device:
            raise InputError(
                f"{name} is on another device, {array.device}; it must be on {self.device}"
            )
        if array.shape != shape:
            raise InputError(f"{name} has shape {array.shape}; it must be {shape}")

    # Facts.

    def row_sums(self) -> np.ndarray:
        """A 1, (M,) float32: one product, at the first call only."""
        if self.known.row_sums is None:
            ones = self.device.upload(np.ones(self.shape[1]))
            sums = self.device.empty(self.shape[0])
            self.bind(ones, sums)()
            self.known.row_sums = sums.get()
        return self.known.row_sums

    def row_sum_range(self) -> RowSumRange:
        """The least, the mean and the largest row sum, computed once.

        The mean is the Rayleigh quotient of the even picture, in the inner product of `weights`.
        """
        if self.known.row_sum_range is None:
            sums = self.row_sums()
            # Sums that left float32 stay infinite.
            with np.errstate(all="ignore"):
                mean = np.average(sums.astype(np.float64), weights=self.weights)
            self.known.row_sum_range = RowSumRange(
                least=float(np.min(sums)), mean=float(mean), largest=float(np.max(sums))
            )
        return self.known.row_sum_range

    @property
    def has_cheap_float64_product(self) -> bool:
        """True if a float64 product on the host takes no longer than a few waits."""
        return self.nbytes + self.bytes_read() <= CHEAP_PRODUCT_BYTES

    def product_float64(self) -> Product | None:
        """The function x -> A x, (N, k) -> (M, k) float64, with the numbers as they were given.

        None if they are on the device alone, or the host has no room for them.
        """
        form = self.known.float64_form
        if form is None:
            try:
                form = self._float64_form()
            except MemoryLimitError:
                return None
        if form is None:
            return None
        # An operator that multiplies on the host itself would refer to itself.
        if form.matrix is not self and self.has_cheap_float64_product:
            self.known.float64_form = form
        return form.product()

    def matrix_float64(self) -> tuple[np.ndarray, bool]:
        """A square A as (N, N) float64, and whether its numbers are those given.

        Else they are float32 products. MemoryLimitError if the host has no room.
        """
        n = self.shape[0]
        checks.fits_host(f"a dense S of N = {n}", 8 * n**2)
        form = self._float64_form(reads_blocks=True)
        if form is None:
            return self.to_dense(), False
        return form.to_dense(), True

    def to_dense(self) -> np.ndarray:
        """The whole matrix as (M, N) float64 on the host.

        MemoryLimitError if that has no room for it.
        """
        rows, columns = self.shape
        matrix_name = f"a dense {rows} x {columns} matrix"
        nbytes = 8 * rows * columns
        checks.fits_host(matrix_name, nbytes)
        try:
            return self._dense()
        except MemoryLimitError:
            raise
        except MemoryError as error:
            # A limit of the process, below the memory of the host.
            raise MemoryLimitError(
                f"{matrix_name} needs {checks.size(nbytes)}, more than the host gives"
            ) from error

    def _dense(self) -> np.ndarray:
        rows, columns = self.shape
        return self._between_by_products(np.arange(rows), np.arange(columns))

    def between(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """The entries (rows, columns), two lists of indices, in float64.

        By a product a column, where the operator knows no shorter way.
        """
        return self._between_by_products(rows, columns)

    def _between_by_products(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        entries = np.empty((len(rows), len(columns)))
        for start in range(0, len(columns), ENTRY_COLUMNS):
            stop = start + ENTRY_COLUMNS
            block = columns[start:stop]
            unit_vectors = np.zeros((self.shape[1], len(block)), np.float32)
            unit_vectors[block, np.arange(len(block))] = 1
            entries[:, start:stop] = self._matmat(unit_vectors)[rows]
        return entries

    def __reduce__(self) -> Any:
        raise InputTypeError(
            f"{type(self).__name__} lies on a device and cannot be pickled; pickle its Transport "
            "or Inverse, or the result of to_dense()"
        )

    # The methods that SciPy asks for: NumPy in, NumPy out. It derives the other products from them.

    @checks.takes_arrays("x", differentiable=_OF_DOT)
    def dot(self, x: Any) -> Any:
        """A x for an array or an operator; masked values, which SciPy would fill, are refused."""
        checks.unmasked("x", x)
        return super().dot(x)

    @checks.takes_arrays("x", differentiable=_OF_VECTORS)
    def matvec(self, x: Any) -> Any:
        """A x of a vector (N,); of (..., N) from SciPy 1.18 on."""
        return super().matvec(x)

    @checks.takes_arrays("X", differentiable=_OF_MATRICES)
    def matmat(self, X: Any) -> Any:
        """A X of columns (N, k); of (..., N, k) from SciPy 1.18 on."""
        return super().matmat(X)

    @checks.takes_arrays("x")
    def rmatvec(self, x: Any) -> Any:
        """A^T x, as `matvec`."""
        return super().rmatvec(x)

    @checks.takes_arrays("X")
    def rmatmat(self, X: Any) -> Any:
        """A^T X, as `matmat`."""
        return super().rmatmat(X)

    def _rdot(self, x: Any) -> Any:
        checks.unmasked("x", x)
        return super()._rdot(x)

    def _matmat(self, X: np.ndarray) -> np.ndarray:
        # (..., N, k): all columns in one product.
        columns = np.moveaxis(checks.real("x", X), -2, 0)
        count = math.prod(columns.shape[1:])
        operand = self.device.upload(columns.reshape(len(columns), count))
        product = self.apply(operand).get()
        return np.moveaxis(product.reshape(len(product), *columns.shape[1:]), 0, -2)

    def _transpose(self) -> Operator:  # pyright: ignore[reportIncompatibleMethodOverride]
        return Transposed(self)

    # The adjoint of real numbers is the transpose.
    def _adjoint(self) -> Operator:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self._transpose()


class Transposed(Operator):
    """A^T of another operator, sharing its memory."""

    def __init__(self, base: Operator) -> None:
        rows, columns = base.shape
        super().__init__(base.device, (columns, rows), base)
        if base.known.transposed is None:
            base.known.transposed = self.known
        self.known = base.known.transposed
        self.base = base
        self.error = base.error
        # The estimate is one of A alone.
        self.solution_error = base.error_bound
        self.error_bound = base.error_bound

    def diagonal(self) -> np.ndarray:
        """The diagonal of A."""
        return self.base.diagonal()

    def norm_bound(self) -> NormBound:
        """The bound of A."""
        bound = self.base.norm_bound()
        if bound.is_bound:
            return bound
        return super().norm_bound()

    def matrix_float64(self) -> tuple[np.ndarray, bool]:
        """The transpose of A as (N, N) float64, and whether its numbers are those given."""
        matrix, is_given = self.base.matrix_float64()
        return matrix.T, is_given

    def _queue_product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        self.base._queue_product(x, out, epilogue, not transpose)

    def _bind_product(
        self, x: Array, out: Array, epilogue: Epilogue, transpose: bool
    ) -> Callable[[], object]:
        return self.base._bind_product(x, out, epilogue, not transpose)

    def _transpose(self) -> Operator:
        return self.base
