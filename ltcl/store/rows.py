# SPDX-License-Identifier: BSD-3-Clause
"""One channel of a store as a matrix whose blocks are read when they are needed: T is never loaded whole.

On a device it becomes compressed sparse rows, a block at a time (`ltcl.operators`); `ltcl.compress` reads its
rows. Everything else may use it as a SciPy `LinearOperator`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from ltcl import checks

if TYPE_CHECKING:
    from ltcl.store.block_store import BlockStore


class StoredRows(scipy.sparse.linalg.LinearOperator):
    """T (M, N) of one channel, float32 or float64, in blocks of rows on the disk; all are checked once, here.

    Examples
    --------
    >>> import tempfile
    >>> from ltcl.store import BlockStore
    >>> store = BlockStore.create(tempfile.mkdtemp(), shape=(4, 4), grid=(2, 2), block_rows=2)
    >>> for block in range(2):
    ...     store.write(0, block, scipy.sparse.eye_array(2, 4, k=2 * block))  # columns
    >>> store.finalize()
    >>> T = StoredRows(store, 0)
    >>> T.nnz, (T @ np.arange(4.0)).tolist()
    (4, [0.0, 1.0, 2.0, 3.0])
    """

    dtype: np.dtype
    shape: tuple[int, int]

    def __init__(self, store: BlockStore, channel: int) -> None:
        super().__init__(np.dtype(store.layout.dtype), store.layout.shape)
        self.store, self.channel = store, channel
        self._newest: tuple[int, Any] = (-1, None)
        self.nnz = sum(block.nnz for _, block in self.row_blocks())

    @property
    def nbytes(self) -> int:
        """Bytes of the blocks on the disk, without their descriptions."""
        entry = 4 + self.dtype.itemsize
        return entry * self.nnz + 8 * (self.shape[0] + self.store.layout.blocks())

    def row_blocks(self) -> Iterator[tuple[int, scipy.sparse.csr_array]]:
        """Each block with its first row; gone from memory when the next one comes."""
        for block in range(self.store.layout.blocks()):
            yield self.store.layout.span(block)[0], self._read(block)

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Rows start .. stop - 1, (stop - start, N)."""
        size = self.store.layout.block_rows
        parts = []
        for block in range(start // size, -(-stop // size)):
            first = self.store.layout.span(block)[0]
            parts.append(self._read(block)[max(start - first, 0) : stop - first].toarray())
        return np.concatenate(parts)

    def between(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """The entries where ascending `rows` meet `columns`, (len(rows), len(columns)) float64."""
        entries = np.zeros((len(rows), len(columns)))
        for first, block in self.row_blocks():
            here = slice(*np.searchsorted(rows, (first, first + len(block.indptr) - 1)))
            entries[here] = block[rows[here] - first][:, columns].toarray()
        return entries

    def diagonal(self) -> np.ndarray:
        """The main diagonal."""
        parts = [block.diagonal(first) for first, block in self.row_blocks() if first < self.shape[1]]
        return np.concatenate(parts)[: min(self.shape)]

    def tocsr(self) -> scipy.sparse.csr_array:
        """All of it in memory."""
        checks.fits_host(f"T of {self.nnz} entries", 2 * self.nbytes)
        return scipy.sparse.csr_array(scipy.sparse.vstack([block for _, block in self.row_blocks()], "csr"))

    def _read(self, block: int) -> Any:
        if self._newest[0] != block:  # neighbouring rows are asked for a few at a time
            self._newest = (-1, None)
            self._newest = (block, self.store.read(self.channel, block))
        return self._newest[1]

    def _matmat(self, X: Any) -> np.ndarray:
        return np.concatenate([block @ X for _, block in self.row_blocks()])

    def _matvec(self, x: Any) -> np.ndarray:
        return self._matmat(x.reshape(-1, 1))

    def _rmatmat(self, X: Any) -> np.ndarray:
        total = np.zeros((self.shape[1], X.shape[1]))
        for first, block in self.row_blocks():
            total += block.T @ X[first : first + len(block.indptr) - 1]
        return total

    def _rmatvec(self, x: Any) -> np.ndarray:
        return self._rmatmat(x.reshape(-1, 1))
