# SPDX-License-Identifier: BSD-3-Clause
"""Dense matrices: float32, row-major, y = A x and y = A^T x by `kernels/dense.cl`.

One copy serves both products.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar

import numpy as np

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.errors import InputError
from ltcl.operators.csr import Blocks, joined_blocks
from ltcl.operators.epilogue import Epilogue, widths
from ltcl.operators.knowledge import Float64Form
from ltcl.operators.rows import ReadableRows, RowOperator, Slab, cut

# Columns of a work-item of a transposed product, and work-items side by side: a CPU reads its
# columns as a stream.
CPU_STRIPS = {"STRIP": 256, "STRIPS": 1}
GPU_STRIPS = {"STRIP": 1, "STRIPS": 16}
# Slices of rows of a transposed product on a GPU: enough items for a large one, none too short.
MAX_SLICES = 64
MIN_SLICE_ROWS = 32
# Share of nonzeros from which on the dense form has fewer bytes than `CSR`, which adds an index.
MIN_FILLED_SHARE = 0.5
# Smaller matrices take no longer in either form.
MIN_FILLED_SIZE = 1 << 18


def strips_of(device: Device) -> dict[str, int]:
    """The strips of columns of a transposed product."""
    if device.is_cpu:
        return CPU_STRIPS
    return GPU_STRIPS


class Dense(RowOperator):
    """A dense (M, N) matrix on the device.

    Parameters
    ----------
    device : Device
    matrix : (M, N) array of real numbers

    Raises
    ------
    InputError
        If some numbers are not finite.
    MemoryLimitError
        If the device has no room for it.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import Dense
    >>> A = Dense(ltcl.open_device(), [[1.0, 2.0], [0.0, 3.0]])
    >>> (A.T @ numpy.array([1.0, 1.0])).tolist()
    [1.0, 5.0]
    """

    file: ClassVar[str] = "dense"
    numbers: ClassVar[str] = "matrix"

    def __init__(self, device: Device, matrix: Any) -> None:
        values = checks.real("matrix", matrix)
        if values.ndim != 2:
            raise InputError(f"matrix has shape {values.shape}; it must be (M, N)")
        checks.finite("matrix", values)
        super().__init__(device, values.shape)
        device.require(4 * values.size, f"a dense matrix {values.shape}")
        self.defines = strips_of(device)
        self.begin(device, values.shape)
        self.slabs = self.upload(values)

    @classmethod
    def begin(cls, device: Device, shape: tuple[int, int]) -> None:
        """Begin to build programs for a matrix that is still to come."""
        cls.build_ahead(device, shape, 4 * shape[0] * shape[1], strips_of(device))

    def upload(self, matrix: np.ndarray, first: int = 0) -> list[Slab]:
        """Slabs of rows from `first` on."""
        rows, width = matrix.shape
        row_bytes = np.full(rows, 4 * max(width, 1))
        slabs = []
        for start, stop in cut(self.device, row_bytes, "the dense matrix"):
            buffer = self.device.upload(matrix[start:stop])
            arguments = {"width": width, "matrix": buffer}
            slabs.append(Slab(first + start, stop - start, arguments))
        return slabs

    def blocks(self) -> Iterator[tuple[int, np.ndarray]]:
        """(first row, rows) of every slab, read from the device."""
        for slab in self.slabs:
            yield slab.first, slab.arguments["matrix"].get().astype(np.float64)

    def matrix(self) -> np.ndarray:
        """The matrix (M, N) float32, read from the device."""
        return np.concatenate([slab.arguments["matrix"].get() for slab in self.slabs])

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Plain arrays, from which `from_arrays` makes the same operator, to the bit."""
        checks.fits_host(f"a dense matrix {self.shape}", 4 * self.shape[0] * self.shape[1])
        return {"matrix": self.matrix()}

    @classmethod
    def from_arrays(cls, device: Device, arrays: Mapping[str, np.ndarray]) -> Dense:
        """The operator whose `to_arrays` gave `arrays`; arrays that do not fit are refused."""
        return cls(device, arrays["matrix"])

    def _float64_form(self, *, reads_blocks: bool = False) -> Float64Form | None:
        if self.exact_form is not None:
            return self.exact_form
        return Float64Form(matrix=self.to_dense())

    def _bind_transpose(self, x: Array, out: Array, epilogue: Epilogue) -> Callable[[], object]:
        return functools.partial(self._queue_transpose, x, out, epilogue)

    def _queue_transpose(self, x: Array, out: Array, epilogue: Epilogue) -> None:
        for slab in self.slabs:
            self._queue_transposed_slab(slab, x, out, epilogue)
            # The following slabs add to what the first has written.
            epilogue = epilogue.added_to(out)

    def _queue_transposed_slab(self, slab: Slab, x: Array, out: Array, epilogue: Epilogue) -> None:
        """Queue the product of one slab, on a GPU with items for slices of rows."""
        strips = self.defines["STRIPS"]
        slices = 1
        if not self.device.is_cpu:
            slices = max(1, min(MAX_SLICES, -(-slab.rows // MIN_SLICE_ROWS)))
        for offset, width in widths(x.columns):
            kernel = self.kernel("dense_rmatvec", width, x.columns)
            local_items = self.device.local_memory // (4 * width)
            group = kernel.group(min(strips * slices, local_items))
            columns_of_group = self.defines["STRIP"] * min(strips, group)
            kernel(
                -(-self.shape[1] // columns_of_group) * group,
                group,
                rows=slab.rows,
                first=slab.first,
                stride=x.columns,
                offset=offset,
                a=epilogue.a,
                b=epilogue.b,
                c=epilogue.c,
                x=x,
                y=epilogue.operand(out),
                out=out,
                scratch=self.device.local(width * group),
                **slab.arguments,
            )


def is_filled(shape: tuple[int, int], nnz: int) -> bool:
    """True if a sparse matrix of `nnz` entries is multiplied faster in the dense form.

    >>> is_filled((1024, 1024), 900_000), is_filled((1024, 1024), 100_000)
    (True, False)
    """
    size = shape[0] * shape[1]
    return size >= MIN_FILLED_SIZE and nnz > MIN_FILLED_SHARE * size


class Filled(Dense):
    """A sparse (M, N) matrix with few zeros, such as a measured T, which is dense on the device.

    The host reads all blocks again for diagonal and norms. It refuses what `CSR` refuses.

    Parameters
    ----------
    device : Device
    shape : (M, N)
    blocks : function
        Gives (first row, csr_array) of all blocks, in order.

    Examples
    --------
    >>> import ltcl, numpy, scipy.sparse
    >>> A = scipy.sparse.csr_array([[1.0, 2.0], [0.0, 3.0]])
    >>> blocks = lambda: ((row, A[row : row + 1]) for row in range(2))
    >>> (Filled(ltcl.open_device(), (2, 2), blocks) @ numpy.array([1.0, 1.0])).tolist()
    [3.0, 3.0]
    """

    def __init__(self, device: Device, shape: tuple[int, int], blocks: Blocks) -> None:
        RowOperator.__init__(self, device, shape)
        device.require(4 * shape[0] * shape[1], f"a matrix {shape} with few zeros")
        self.defines = strips_of(device)
        self._blocks = blocks
        self.begin(device, shape)
        self.slabs = self._empty_slabs()
        for first, rows in self.blocks():
            self._fill(first, rows)

    def blocks(self) -> Iterator[tuple[int, Any]]:
        """All blocks, read again; neighbouring small ones are joined."""
        return joined_blocks(self._blocks)

    def _empty_slabs(self) -> list[Slab]:
        rows, width = self.shape
        slabs = []
        for start, stop in cut(self.device, np.full(rows, 4 * width), "the matrix"):
            arguments = {"width": width, "matrix": self.device.empty((stop - start, width))}
            slabs.append(Slab(start, stop - start, arguments))
        return slabs

    def _fill(self, first: int, rows: Any) -> None:
        """Write a block of rows into the slabs."""
        end = first + rows.shape[0]
        for slab in self.slabs:
            start = max(first, slab.first)
            stop = min(end, slab.end)
            if start < stop:
                block = self.device.upload(rows[start - first : stop - first].toarray())
                slab.arguments["matrix"].set_rows(start - slab.first, block)

    def _float64_form(self, *, reads_blocks: bool = False) -> Float64Form | None:
        return ReadableRows._float64_form(self, reads_blocks=reads_blocks)
