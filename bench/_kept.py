# SPDX-License-Identifier: BSD-3-Clause
"""Which numbers of a matrix to keep, the largest ones, so that its product with one vector has some error.

One pass over the matrix tells it for every threshold: numbers are sorted into bins by size, and what each bin
adds to each row of the product is summed. A matrix is dense or sparse; 64 rows are handled at once. The error
of a solve is asked for at one threshold after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import scipy.sparse
from rich.console import Console

from ltcl.compression.coefficients import drop_below
from ltcl.operators import Wavelet

ROWS = 64  # more, and the system hands out and takes back memory at every step
SHIFT, LOWEST, BINS = 16, 95 << 7, 4096  # 128 bins an octave of float32, by its bits, from 2^-32 up to 1


note = Console(stderr=True).print


def analysis(W: Wavelet) -> Callable[[np.ndarray], np.ndarray]:
    """W of arrays on the host, in float32."""
    return lambda x: W.apply(W.device.upload(x)).get()


def errors(matrix: Any, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Relative error of matrix @ x, which should be y, by numbers of each bin and beyond alone, (BINS,)."""
    squares = np.zeros(BINS)
    for number, rows in enumerate(_blocks(matrix, 0.0)):
        count = rows.shape[0]
        keys = np.clip((np.abs(rows.data).view(np.int32) >> SHIFT) - LOWEST, 0, BINS - 1)
        keys += BINS * np.repeat(np.arange(count, dtype=np.int32), np.diff(rows.indptr))
        added = np.bincount(keys, rows.data * x[rows.indices], BINS * count).reshape(count, BINS)
        products = np.cumsum(added[:, ::-1], axis=1)[:, ::-1]
        squares += np.sum((products - y[number * ROWS :][:count, None]) ** 2, axis=0)
    return np.sqrt(squares) / np.linalg.norm(y)


def kept(matrix: Any, found: np.ndarray, wanted: float) -> scipy.sparse.csr_array:
    """As few of the largest numbers of a matrix as have the error wanted, by its `errors`."""
    first = np.flatnonzero(found <= wanted)[-1]
    threshold = float(np.int32((LOWEST + first) << SHIFT).view(np.float32)) if first else 0.0
    return scipy.sparse.csr_array(scipy.sparse.vstack(list(_blocks(matrix, threshold)), format="csr"))


def bisect(error: Callable[[float], float], wanted: float, high: float) -> float:
    """About the largest threshold whose error is at most `wanted`; `high` drops everything."""
    low = high * 2.0**-40
    for _ in range(18):
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if error(middle) <= wanted else (low, middle)
    return low


def _blocks(matrix: Any, threshold: float) -> Iterator[Any]:
    """Sparse rows without what is below a threshold."""
    for start in range(0, matrix.shape[0], ROWS):
        rows = matrix[start : start + ROWS]
        yield drop_below(rows, threshold)[0]
