# SPDX-License-Identifier: BSD-3-Clause
"""What every linear operator on a device promises.

The contract for subclasses is `_product` and `diagonal`; everything else is made of those.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse.linalg

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.errors import InputError

WIDTHS = (8, 4, 3, 2, 1)  # right-hand sides one launch of a product kernel takes
MOST = (
    1 << 14
)  # items along the second and third dimension where kernels stride: GPUs take 65535 groups there


@dataclass(frozen=True)
class Norms:
    """Largest column sum, largest row sum (both of absolute values), Frobenius norm, smallest entry or 0."""

    one: float
    inf: float
    frobenius: float
    lowest: float


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

    def __init__(self, device: Device, shape: tuple[int, int]) -> None:
        super().__init__(np.float32, shape)
        self.device = device
        self._row_sums: np.ndarray | None = None

    @property
    def nbytes(self) -> int:
        """Bytes of the matrix on the device."""
        return 0

    def _product(self, x: Array, out: Array, scale: float, add: Array | None, transpose: bool) -> None:
        """Queue ``out = scale * (A x) + add``, or with A^T. `out` is never `x`, but may be `add`."""
        raise TypeError(f"{type(self).__name__} does not implement _product")

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (min(M, N),) float64, on the host."""
        raise TypeError(f"{type(self).__name__} does not implement diagonal")

    def apply(
        self, x: Array, out: Array | None = None, *, scale: float = 1.0, add: Array | None = None
    ) -> Array:
        """Queue ``out = scale * (A x) + add`` on the device.

        Parameters
        ----------
        x : Array, (N,) or (N, k)
        out : Array, (M,) or (M, k), optional
            Made when not given; must not be `x`.
        scale : float
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
        return self._checked(x, out, scale, add, transpose=False)

    def apply_transpose(
        self, x: Array, out: Array | None = None, *, scale: float = 1.0, add: Array | None = None
    ) -> Array:
        """Queue ``out = scale * (A^T x) + add`` on the device; see `apply`."""
        return self._checked(x, out, scale, add, transpose=True)

    def norms(self) -> Norms:
        """Norms that need the entries; operators that cannot see theirs refuse."""
        raise InputError(f"{type(self).__name__} cannot see its entries, so their norms are unknown")

    def row_sums(self) -> np.ndarray:
        """A 1, (M,) float32: one product, at the first call only."""
        if self._row_sums is None:
            self._row_sums = self._matvec(np.ones(self.shape[1], np.float32))
        return self._row_sums

    def to_dense(self) -> np.ndarray:
        """The whole matrix as (M, N) float64 on the host, column block by column block."""
        rows, columns = self.shape
        checks.fits_host(f"a dense {rows} x {columns} matrix", 8 * rows * columns)
        return self.between(np.arange(rows), np.arange(columns))

    def between(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """The entries (rows, columns), both lists of indices, in float64: a product for each column."""
        found = np.empty((len(rows), len(columns)))
        for start in range(0, len(columns), 64):
            chosen = columns[start : start + 64]
            block = np.zeros((self.shape[1], len(chosen)), np.float32)
            block[chosen, np.arange(len(chosen))] = 1
            found[:, start : start + 64] = self._matmat(block)[rows]
        return found

    # What SciPy asks for: NumPy in, NumPy out.

    def _matvec(self, x: np.ndarray) -> np.ndarray:
        return self.apply(self._upload(np.ravel(x))).get()

    def _matmat(self, X: np.ndarray) -> np.ndarray:
        return self.apply(self._upload(X)).get()

    def _rmatvec(self, x: np.ndarray) -> np.ndarray:
        return self.apply_transpose(self._upload(np.ravel(x))).get()

    def _rmatmat(self, X: np.ndarray) -> np.ndarray:
        return self.apply_transpose(self._upload(X)).get()

    def _upload(self, x: np.ndarray) -> Array:
        return self.device.upload(checks.real("x", x))

    def _transpose(self) -> Operator:  # pyright: ignore[reportIncompatibleMethodOverride]
        return Transposed(self)

    def _adjoint(self) -> Operator:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self._transpose()  # real numbers

    def _checked(
        self, x: Array, out: Array | None, scale: float, add: Array | None, transpose: bool
    ) -> Array:
        rows, columns = self.shape[::-1] if transpose else self.shape
        if x.shape[0] != columns or len(x.shape) > 2:
            raise InputError(
                f"x has shape {x.shape}; the operator {self.shape} needs ({columns},) or ({columns}, k)"
            )
        if max(rows, columns) * x.columns >= 1 << 31:
            raise InputError(
                f"x has {x.columns} right-hand sides; one product takes {(1 << 31) // max(rows, columns)}"
            )
        self._refuse_foreign(x, *(array for array in (out, add) if array is not None))
        wanted = (rows, *x.shape[1:])
        out = self.device.empty(wanted) if out is None else out
        for name, array in (("out", out), ("add", add)):
            if array is not None and array.shape != wanted:
                raise InputError(f"{name} has shape {array.shape}; it must be {wanted}")
        if out.buffer is x.buffer:
            raise InputError("out is x; a product cannot be written over its own operand")
        self._product(x, out, float(scale), add, transpose)
        return out

    def _refuse_foreign(self, *arrays: Array) -> None:
        for array in arrays:
            if array.dtype != np.float32:
                raise InputError(f"an array holds {array.dtype}; operators take float32")
            if array.device is not self.device:
                raise InputError(
                    f"an array is on another device, {array.device}; it must be on {self.device}"
                )


class Transposed(Operator):
    """A^T of another operator, sharing its memory."""

    def __init__(self, base: Operator) -> None:
        super().__init__(base.device, base.shape[::-1])
        self.base = base
        self.error, self.solution_error = base.error, base.solution_error

    @property
    def nbytes(self) -> int:
        """Bytes of the matrix on the device."""
        return self.base.nbytes

    def _product(self, x: Array, out: Array, scale: float, add: Array | None, transpose: bool) -> None:
        self.base._product(x, out, scale, add, not transpose)

    def diagonal(self) -> np.ndarray:
        """The main diagonal of the transpose is that of the operator."""
        return self.base.diagonal()

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


def lanes_of(run: int) -> int:
    """Neighbouring values that a work-item takes together, of a stretch of `run`; one of `WIDTHS`."""
    return next(width for width in WIDTHS if width <= run)


def group_of(pieces: int) -> tuple[int, int]:
    """A work-group of 64: side by side as many as there are pieces, the others one below the other."""
    across = min(64, 1 << (pieces - 1).bit_length())
    return across, 64 // across
