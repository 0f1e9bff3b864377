# SPDX-License-Identifier: BSD-3-Clause
"""`fingerprint`: a SHA-256 that tells whether matrices have the same entries.

Arrays and sparse matrices are digested entry by entry. An operator has no entries to read, so
four sums u . (T v) with random u and v stand for it, to four digits: products in float32 vary
with the device.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import scipy.sparse


def fingerprint(*matrices: Any) -> str:
    """SHA-256 of all entries of arrays and sparse matrices, or of four sums of an operator."""
    digest = hashlib.sha256()
    for matrix in matrices:
        for array in _content(matrix):
            digest.update(f"{array.dtype.str} {array.shape};".encode())
            digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def _content(matrix: Any) -> list[np.ndarray]:
    """Arrays that are equal if, and nearly only if, the matrices are."""
    if scipy.sparse.issparse(matrix):
        return _csr_arrays(matrix)
    if isinstance(matrix, np.ndarray):
        return [matrix]
    return [_random_sums(matrix)]


def _csr_arrays(matrix: Any) -> list[np.ndarray]:
    """The three arrays of a sparse matrix as canonical CSR; `matrix` itself stays as it is."""
    is_canonical = getattr(matrix, "has_canonical_format", False)
    rows = scipy.sparse.csr_array(matrix, copy=not is_canonical)
    rows.sum_duplicates()
    return [rows.data, rows.indices.astype(np.int64), rows.indptr.astype(np.int64)]


def _random_sums(operator: Any) -> np.ndarray:
    """Four sums u . (T v) as texts of four digits."""
    random = np.random.default_rng(0)
    v = random.random(operator.shape[1]).astype(operator.dtype)
    weights = random.random((4, operator.shape[0]))
    sums = weights @ (operator @ v)
    return np.array([f"{number:.4g}" for number in sums], "S16")
