# SPDX-License-Identifier: BSD-3-Clause
"""Compressed sparse rows of a matrix that comes a block of rows at a time, as from a file.

Blocks go to the device one after the other; the host keeps row pointers and norms alone. What needs the
entries on the host (a transposed product, a part, the places of nonzeros) has all blocks read again and kept.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Device
from ltcl.operators.base import Norms
from ltcl.operators.csr import CSR, Pattern
from ltcl.operators.rows import RowOperator, Slab

Blocks = Callable[[], Iterator[tuple[int, Any]]]
_SLAB = 1 << 26  # bytes: smaller blocks are joined, since each slab is a launch


class RowBlocks(CSR):
    """A sparse (M, N) matrix on the device, uploaded block by block.

    Parameters
    ----------
    device : Device
    shape : (M, N)
    blocks : function
        Gives (first row, csr_array) of all blocks, in order; each is gone from memory before the next comes.
    nnz : int
        Nonzeros there are at most.

    Raises
    ------
    InputError
        A block that is malformed or holds NaN.
    MemoryLimitError
        More than the device holds; said before anything is allocated.

    Examples
    --------
    >>> import ltcl
    >>> A = scipy.sparse.csr_array([[1.0, 2.0], [0.0, 3.0]])
    >>> rows = RowBlocks(ltcl.open_device(), (2, 2), lambda: ((i, A[i : i + 1]) for i in range(2)), A.nnz)
    >>> (rows @ np.array([1.0, 1.0])).tolist()
    [3.0, 3.0]
    """

    def __init__(self, device: Device, shape: tuple[int, int], blocks: Blocks, nnz: int) -> None:
        RowOperator.__init__(self, device, shape)
        device.require(8 * nnz, f"a sparse matrix of {nnz} nonzeros")
        self._blocks = blocks
        self._transposed_copy: CSR | None = None
        self._diagonal = np.zeros(min(shape))
        self._norms = _Norms(shape[1])
        self.slabs, uploaded, pointers = [], [], [np.zeros(1, np.int64)]
        for first, block in _joined(blocks()):
            block = checks.csr(f"rows from {first}", block)
            pattern = Pattern(device, block)
            uploaded.append((first, pattern))
            self.slabs += [
                Slab(first + slab.first, slab.rows, slab.arguments)
                for slab in pattern.with_values(block.data)
            ]
            pointers.append(pattern.indptr[1:] + pointers[-1][-1])
            on_diagonal = block.diagonal(first)
            self._diagonal[first : first + len(on_diagonal)] = on_diagonal
            self._norms.add(block)
        self.pattern = _PatternOfBlocks(self, np.concatenate(pointers), uploaded)
        self.nnz = int(self.pattern.indptr[-1])

    @cached_property
    def _host(self) -> scipy.sparse.csr_array:
        checks.fits_host(f"a sparse matrix of {self.nnz} nonzeros", 24 * self.nnz)
        found = scipy.sparse.csr_array(scipy.sparse.vstack([block for _, block in self._blocks()], "csr"))
        return checks.csr("the blocks", found)

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (min(M, N),) float64."""
        return self._diagonal.copy()

    def norms(self) -> Norms:
        """Norms of the matrix as it was given."""
        return self._norms.found()


class _PatternOfBlocks(Pattern):
    """The pattern of all blocks; places of nonzeros are read again when they are asked for."""

    def __init__(self, owner: RowBlocks, indptr: np.ndarray, blocks: list[tuple[int, Pattern]]) -> None:
        self.device, self.shape, self.indptr, self._owner = owner.device, owner.shape, indptr, owner
        self.cuts = [(first + start, first + stop) for first, block in blocks for start, stop in block.cuts]
        self.slabs = [slab for _, block in blocks for slab in block.slabs]

    @property
    def indices(self) -> np.ndarray:
        return self._owner._host.indices

    def matches(self, matrix: Any) -> bool:
        """Not asked: it would take all blocks in memory."""
        return False


class _Norms:
    """Norms, a block at a time."""

    def __init__(self, columns: int) -> None:
        self._columns = np.zeros(columns)
        self._inf = self._squares = self._lowest = 0.0

    def add(self, block: Any) -> None:
        absolute = abs(block)
        self._columns += np.asarray(absolute.sum(axis=0), np.float64)
        self._inf = max(self._inf, float(np.max(absolute.sum(axis=1), initial=0.0)))
        self._squares += float(np.sum(np.square(block.data, dtype=np.float64)))
        self._lowest = min(self._lowest, float(np.min(block.data, initial=0.0)))

    def found(self) -> Norms:
        one = float(np.max(self._columns, initial=0.0))
        return Norms(one=one, inf=self._inf, frobenius=self._squares**0.5, lowest=self._lowest)


def _joined(blocks: Iterator[tuple[int, Any]]) -> Iterator[tuple[int, Any]]:
    """Neighbouring blocks in one, up to `_SLAB` bytes."""
    held: list[Any] = []
    start = 0
    for first, block in blocks:
        if held and 8 * (sum(part.nnz for part in held) + block.nnz) > _SLAB:
            yield start, scipy.sparse.vstack(held, "csr")
            held, start = [], first
        held.append(block)
    yield start, scipy.sparse.vstack(held, "csr")
