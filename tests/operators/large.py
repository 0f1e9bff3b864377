# SPDX-License-Identifier: BSD-3-Clause
"""A transport that is too large for memory, as a file and as a store."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

# Too many pixels for "auto" to factorize S at once.
GRID = (24, 32)
PIXELS = GRID[0] * GRID[1]


class Stored(scipy.sparse.linalg.LinearOperator):
    """A matrix as rows of a store that counts how often it is read."""

    def __init__(self, matrix: Any, rows: int = 20) -> None:
        self.matrix = scipy.sparse.csr_array(matrix)
        self.rows = rows
        self.readings = 0
        self.nnz = self.matrix.nnz
        self.nbytes = 8 * self.matrix.nnz
        super().__init__(self.matrix.dtype, matrix.shape)

    def row_blocks(self) -> Iterator[tuple[int, Any]]:
        self.readings += 1
        for first in range(0, self.shape[0], self.rows):
            yield first, self.matrix[first : first + self.rows]

    def diagonal(self) -> np.ndarray:
        return self.matrix.diagonal()

    def _matvec(self, x: np.ndarray) -> np.ndarray:
        return self.matrix @ x


def mapped(folder: Path, matrix: Any) -> Any:
    """A matrix as a mapped file."""
    np.save(folder / "T.npy", matrix)
    return np.load(folder / "T.npy", mmap_mode="r")


def transport(pixels: int = PIXELS, dtype: Any = np.float32) -> np.ndarray:
    """T of a scene in which all pixels see each other, with another first bounce each."""
    i = np.arange(pixels, dtype=np.float32)
    R = np.exp(-np.abs(i[:, None] - i) / (0.2 * pixels)) / pixels
    first_bounce = 1.0 + 0.5 * np.sin(i)
    T = (np.eye(pixels, dtype=np.float32) + R) * first_bounce
    return T.astype(dtype)
