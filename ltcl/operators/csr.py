# SPDX-License-Identifier: BSD-3-Clause
"""Compressed sparse rows: float32 values, 32-bit column indices, y = A x by `kernels/csr.cl`.

A transposed product uses A^T in the same format, built and uploaded at the first one: twice the memory,
but the same speed and the same bits at every call, which scattered additions would not give.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.operators import slabs
from ltcl.operators.base import Norms
from ltcl.operators.rows import RowOperator, Slab


class Pattern:
    """Where the nonzeros are, on the device. Colour channels with one pattern store it once.

    Made from a checked `csr_array`. Slabs are (start, stop) rows; each has pointers (rows + 1,) from 0 and
    columns (nnz,).
    """

    def __init__(self, device: Device, matrix: Any) -> None:
        self.device = device
        self.shape: tuple[int, int] = matrix.shape
        self.indptr = matrix.indptr.astype(np.int64)
        self.indices = matrix.indices
        row_bytes = np.maximum(4 * np.diff(self.indptr), 4)  # pointers weigh as much as one nonzero
        # There is one pointer more than rows.
        self.cuts = slabs.cut(row_bytes, slabs.largest(device) - 4, "the sparse matrix")
        self.slabs = [self._upload(start, stop) for start, stop in self.cuts]

    def _upload(self, start: int, stop: int) -> tuple[Array, Array]:
        pointers = self.indptr[start : stop + 1] - self.indptr[start]
        columns = self.indices[self.indptr[start] : self.indptr[stop]]
        return self.device.upload(pointers, np.int32), self.device.upload(columns, np.int32)

    def with_values(self, data: np.ndarray) -> list[Slab]:
        """The slabs of a matrix of this pattern with values `data` (nnz,)."""
        slabs = []
        for (start, stop), (pointers, columns) in zip(self.cuts, self.slabs, strict=True):
            values = self.device.upload(data[self.indptr[start] : self.indptr[stop]])
            slabs.append(Slab(start, stop - start, (pointers, columns, values)))
        return slabs

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return sum(pointers.nbytes + columns.nbytes for pointers, columns in self.slabs)

    def matches(self, matrix: Any) -> bool:
        """Whether `matrix` has its nonzeros in the same places."""
        if self.shape != matrix.shape or len(self.indices) != matrix.nnz:
            return False
        same = self.indices is matrix.indices or np.array_equal(self.indices, matrix.indices)
        return same and np.array_equal(self.indptr, matrix.indptr)


class CSR(RowOperator):
    """A sparse (M, N) matrix on the device.

    Parameters
    ----------
    device : Device
    matrix : scipy.sparse matrix or array, (M, N)
        Checked before anything is uploaded.
    pattern : Pattern, optional
        That of another channel; used, and so stored once, where the nonzeros are in the same places.

    Raises
    ------
    InputError
        Column indices out of range, row pointers that fall, NaN or infinite values.
    MemoryLimitError
        More than the device holds; said before anything is allocated.

    Examples
    --------
    >>> import ltcl, numpy, scipy.sparse
    >>> from ltcl.operators import CSR
    >>> A = CSR(ltcl.open_device(), scipy.sparse.csr_array([[1.0, 2.0], [0.0, 3.0]]))
    >>> (A @ numpy.array([1.0, 1.0])).tolist()
    [3.0, 3.0]
    """

    file = "csr"
    defines: Mapping[str, Any] = MappingProxyType({})

    def __init__(self, device: Device, matrix: Any, pattern: Pattern | None = None) -> None:
        matrix = checks.csr("matrix", matrix)
        super().__init__(device, matrix.shape)
        shared = pattern is not None and pattern.device is device and pattern.matches(matrix)
        device.require(matrix.nnz * (4 if shared else 8), f"a sparse matrix of {matrix.nnz} nonzeros")
        self.pattern = pattern if pattern is not None and shared else Pattern(device, matrix)
        self.slabs = self.pattern.with_values(matrix.data)
        self.nnz: int = matrix.nnz
        self._host = matrix
        self._transposed_copy: CSR | None = None

    @property
    def nbytes(self) -> int:
        """Bytes on the device, those of the transpose included once it was asked for."""
        return super().nbytes + (self._transposed_copy.nbytes if self._transposed_copy is not None else 0)

    @property
    def data(self) -> np.ndarray:
        """The values on the host, (nnz,), in the order of `pattern`."""
        return self._host.data

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (min(M, N),) float64."""
        return self._host.diagonal().astype(np.float64)

    def parts(self, places: Iterable[tuple[slice, slice]]) -> Iterator[np.ndarray]:
        """Dense float64 copies of the places (rows, columns)."""
        for rows, columns in places:
            yield self._host[rows, columns].toarray().astype(np.float64)

    def norms(self) -> Norms:
        """Norms of the matrix as it was given."""
        absolute = abs(self._host)
        return Norms(
            one=float(np.max(absolute.sum(axis=0), initial=0.0)),
            inf=float(np.max(absolute.sum(axis=1), initial=0.0)),
            frobenius=float(np.linalg.norm(self._host.data)),
            lowest=float(np.min(self._host.data, initial=0.0)),
        )

    def matrix(self) -> scipy.sparse.csr_array:
        """What it stands for: (M, N), float32 values on the host."""
        values = self._host.data.astype(np.float32)
        return scipy.sparse.csr_array((values, self._host.indices, self._host.indptr), shape=self.shape)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Plain arrays, of which `from_arrays` makes the same again, to the bit."""
        return {
            "shape": np.array(self.shape, np.int64),
            "data": self.data.astype(np.float32),
            "indices": self.pattern.indices.astype(np.int32),
            "indptr": self.pattern.indptr,
        }

    @classmethod
    def from_arrays(
        cls, device: Device, arrays: Mapping[str, np.ndarray], pattern: Pattern | None = None
    ) -> CSR:
        """Of what `to_arrays` gave; what does not fit together is refused."""
        rows, columns = (int(n) for n in arrays["shape"])
        data, indices, indptr = (arrays[name] for name in ("data", "indices", "indptr"))
        checks.compressed("the stored matrix", indptr, indices, checks.real("data", data), (rows, columns))
        return cls(device, scipy.sparse.csr_array((data, indices, indptr), shape=(rows, columns)), pattern)

    def to_dense(self) -> np.ndarray:
        """The whole matrix, (M, N) float64, on the host."""
        checks.fits_host(f"a dense matrix {self.shape}", 8 * self.shape[0] * self.shape[1])
        return self._host.toarray().astype(np.float64)

    def _product(self, x: Array, out: Array, scale: float, add: Array | None, transpose: bool) -> None:
        if not transpose:
            self._forward(x, out, scale, add)
            return
        self.transposed_copy()._forward(x, out, scale, add)

    def transposed_copy(self) -> CSR:
        """A^T in sparse rows of its own, made at the first call."""
        if self._transposed_copy is None:
            self._transposed_copy = CSR(self.device, scipy.sparse.csr_array(self._host.T))
        return self._transposed_copy
