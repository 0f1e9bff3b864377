# SPDX-License-Identifier: BSD-3-Clause
"""Hashes by which patterns, photographs and transports are recognized in a later run."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import scipy.sparse


def shot_key(codes: np.ndarray, seconds: float) -> str:
    """128 bits of a photograph's codes and exposure.

    >>> a, b = np.zeros((1, 2), np.float32), np.zeros((2, 1), np.float32)
    >>> shot_key(a, 1.0) == shot_key(a.copy(), 1.0), shot_key(a, 1.0) == shot_key(b, 1.0)
    (True, False)
    """
    content = repr(codes.shape).encode() + codes.tobytes() + np.float64(seconds).tobytes()
    return hashlib.blake2b(content, digest_size=16).hexdigest()


def fingerprint(*matrices: Any) -> str:
    """SHA-256 of all entries of arrays and sparse matrices, and of four sums u . (T v) of operators.

    4096 x 4096 entries in float32 take 0.1 s. Sums keep four digits, more than products in float32 vary.

    Examples
    --------
    >>> T = np.eye(3)
    >>> fingerprint(T) == fingerprint(T.copy()), fingerprint(T) == fingerprint(np.ones(9))
    (True, False)
    >>> fingerprint(scipy.sparse.csr_array(T)) == fingerprint(scipy.sparse.coo_array(T))
    True
    """
    digest = hashlib.sha256()
    for matrix in matrices:
        if scipy.sparse.issparse(matrix):
            rows = scipy.sparse.csr_array(matrix, copy=not getattr(matrix, "has_canonical_format", False))
            rows.sum_duplicates()
            arrays = [rows.data, rows.indices.astype(np.int64), rows.indptr.astype(np.int64)]
        elif isinstance(matrix, np.ndarray):
            arrays = [matrix]
        else:
            random = np.random.default_rng(0)
            v = random.random(matrix.shape[1]).astype(matrix.dtype)
            sums = random.random((4, matrix.shape[0])) @ (matrix @ v)
            arrays = [np.array([f"{number:.4g}" for number in sums], "S16")]
        for array in arrays:
            digest.update(f"{array.dtype.str} {array.shape};".encode())
            digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
