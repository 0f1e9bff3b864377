# SPDX-License-Identifier: BSD-3-Clause
"""Dense matrices: float32, row-major, y = A x and y = A^T x by `kernels/dense.cl`, one copy for both."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.errors import InputError
from ltcl.operators import slabs
from ltcl.operators.base import Norms, widths
from ltcl.operators.rows import RowOperator, Slab


class Dense(RowOperator):
    """A dense (M, N) matrix on the device.

    Parameters
    ----------
    device : Device
    matrix : (M, N) array of real numbers

    Raises
    ------
    InputError
        Not two-dimensional, NaN or infinite values.
    MemoryLimitError
        More than the device holds; said before anything is allocated.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.operators import Dense
    >>> A = Dense(ltcl.open_device(), [[1.0, 2.0], [0.0, 3.0]])
    >>> (A.T @ numpy.array([1.0, 1.0])).tolist()
    [1.0, 5.0]
    """

    file = "dense"

    def __init__(self, device: Device, matrix: Any) -> None:
        host = checks.real("matrix", matrix)
        if host.ndim != 2:
            raise InputError(f"matrix has shape {host.shape}; it must be (M, N)")
        checks.finite("matrix", host)
        super().__init__(device, host.shape)
        device.require(4 * host.size, f"a dense matrix {host.shape}")
        self.defines = {"LANES": 8 if device.is_cpu else 1}
        rows, width = host.shape
        cuts = slabs.cut(np.full(rows, 4 * max(width, 1)), slabs.largest(device), "the dense matrix")
        self.slabs = [Slab(a, b - a, (width, device.upload(host[a:b]))) for a, b in cuts]

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (min(M, N),) float64."""
        return np.concatenate([np.diagonal(block, first) for first, block in self._blocks()])

    def norms(self) -> Norms:
        """Norms of the matrix, in float64, slab by slab."""
        columns, row, squares, lowest = np.zeros(self.shape[1]), 0.0, 0.0, 0.0
        for _, block in self._blocks():
            lowest = min(lowest, float(block.min(initial=0.0)))
            np.abs(block, out=block)
            columns += block.sum(axis=0)
            row = max(row, float(block.sum(axis=1).max(initial=0.0)))
            squares += float(np.vdot(block, block))
        return Norms(float(columns.max(initial=0.0)), row, squares**0.5, lowest)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Plain arrays, of which `from_arrays` makes the same again, to the bit."""
        checks.fits_host(f"a dense matrix {self.shape}", 4 * self.shape[0] * self.shape[1])
        return {"matrix": np.concatenate([slab.arguments[1].get() for slab in self.slabs])}

    @classmethod
    def from_arrays(cls, device: Device, arrays: Mapping[str, np.ndarray]) -> Dense:
        """Of what `to_arrays` gave; what does not fit together is refused."""
        return cls(device, arrays["matrix"])

    def to_dense(self) -> np.ndarray:
        """The whole matrix, (M, N) float64, on the host."""
        checks.fits_host(f"a dense matrix {self.shape}", 8 * self.shape[0] * self.shape[1])
        dense = np.empty(self.shape)
        for first, block in self._blocks():
            dense[first : first + len(block)] = block
        return dense

    def parts(self, places: Iterable[tuple[slice, slice]]) -> Iterator[np.ndarray]:
        """Float64 copies of the places (rows, columns), rows ascending, so that a slab is read once."""
        slabs = iter(self._blocks())
        first, block = next(slabs)
        for rows, columns in places:
            while rows.start >= first + len(block):
                first, block = next(slabs)
            pieces = [block[rows.start - first : rows.stop - first, columns]]
            while rows.stop > first + len(block):
                first, block = next(slabs)
                pieces.append(block[: rows.stop - first, columns])
            yield np.concatenate(pieces)

    def _blocks(self):
        for slab in self.slabs:
            yield slab.first, slab.arguments[1].get().astype(np.float64)

    def _product(self, x: Array, out: Array, scale: float, add: Array | None, transpose: bool) -> None:
        if not transpose:
            self._forward(x, out, scale, add)
            return
        for offset, width in widths(x.columns):
            self._transposed_columns(x, out, scale, add, offset, width)

    def _transposed_columns(
        self, x: Array, out: Array, scale: float, add: Array | None, offset: int, width: int
    ) -> None:
        lanes = self.defines["LANES"]
        kernel = self.kernel("dense_rmatvec", width, x.columns)
        items = -(-self.shape[1] // lanes)
        for slab in self.slabs:
            adds, added = (0, out) if add is None else (1, add)
            kernel(
                items,
                16,
                slab.rows,
                slab.first,
                x.columns,
                offset,
                scale,
                adds,
                *slab.arguments,
                x,
                added,
                out,
            )
            add = out  # the following slabs add to what the first has written
