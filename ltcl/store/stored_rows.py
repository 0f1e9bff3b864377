# SPDX-License-Identifier: BSD-3-Clause
"""`StoredRows`: a matrix that stays on the disk and is read block by block."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from ltcl import checks
from ltcl.files import read_ahead

if TYPE_CHECKING:
    from ltcl.store.block_store import BlockStore

INDEX_BYTES = 4
POINTER_BYTES = 8


class StoredRows(scipy.sparse.linalg.LinearOperator):
    """T (M, N) of one channel of a final `BlockStore`; all blocks are checked once, here.

    On a device it becomes compressed sparse rows, a block at a time. `nnz` counts its entries, and
    `nbytes` are those on the disk.
    """

    def __init__(self, store: BlockStore, channel: int) -> None:
        sizes = store.layout
        super().__init__(np.dtype(sizes.dtype), sizes.shape)
        self._store = store
        self._channel = channel
        self._cached: tuple[int, scipy.sparse.csr_array] | None = None
        self.nnz = 0
        for block in range(sizes.blocks()):
            self.nnz += self._block(block).nnz
        entry_bytes = INDEX_BYTES + np.dtype(sizes.dtype).itemsize
        pointers = self.shape[0] + sizes.blocks()
        self.nbytes = entry_bytes * self.nnz + POINTER_BYTES * pointers

    def _block(self, block: int) -> scipy.sparse.csr_array:
        """A checked block; the last one is kept."""
        cached = self._cached  # another thread may replace it
        if cached is not None and cached[0] == block:
            return cached[1]
        matrix = self._store.block(self._channel, block).matrix
        self._cached = block, matrix
        return matrix

    def row_blocks(self) -> Iterator[tuple[int, scipy.sparse.csr_array]]:
        """First row and rows of each block."""
        blocks = range(self._store.layout.blocks())
        return read_ahead(lambda block: self._store.rows_again(self._channel, block), blocks)

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Rows start .. stop - 1, (stop - start, N)."""
        size = self._store.layout.block_rows
        parts = []
        for block in range(start // size, -(-stop // size)):
            first = block * size
            part = self._block(block)[max(start - first, 0) : stop - first]
            parts.append(part.toarray())
        return np.concatenate(parts)

    def between(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """The entries where ascending `rows` meet `columns`, (len(rows), len(columns)) float64."""
        entries = [self.rows(row, row + 1)[:, columns] for row in rows.tolist()]
        return np.concatenate(entries).astype(np.float64)

    def diagonal(self) -> np.ndarray:
        """The main diagonal, (min(M, N),)."""
        diagonals = []
        for first, block in self.row_blocks():
            if first < self.shape[1]:
                diagonals.append(block.diagonal(first))
        return np.concatenate(diagonals)[: min(self.shape)]

    def tocsr(self) -> scipy.sparse.csr_array:
        """The whole matrix in memory; MemoryLimitError where it does not fit."""
        checks.fits_host(f"T of {self.nnz} entries", 2 * self.nbytes)
        blocks = [block for _, block in self.row_blocks()]
        return scipy.sparse.csr_array(scipy.sparse.vstack(blocks, "csr"))

    def _matmat(self, X: Any) -> np.ndarray:
        return np.concatenate([block @ X for _, block in self.row_blocks()])

    def _rmatmat(self, X: Any) -> np.ndarray:
        product = np.zeros((self.shape[1], X.shape[1]))
        for first, block in self.row_blocks():
            rows = block.shape[0]
            product += block.T @ X[first : first + rows]
        return product
