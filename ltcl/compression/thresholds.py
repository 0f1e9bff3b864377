# SPDX-License-Identifier: BSD-3-Clause
"""What is dropped of a sparse matrix, and how much: Frobenius norms exactly, 2-norms by power iteration.

The 2-norm of what a threshold drops is a few times below its Frobenius norm, so that thresholds chosen by it
keep far fewer numbers. Power iteration comes from below: good enough to choose by, no bound.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse

Product = Callable[[np.ndarray], np.ndarray]
_STEPS = 8
_SEED = 0
_CLOSE = 0.9  # a threshold that costs so much of what it may is taken
_TRIALS = 12


def above(C: Any, threshold: float) -> tuple[scipy.sparse.csr_array, float]:
    """C without what is smaller than `threshold`, and the squares of that summed.

    >>> kept, lost = above(scipy.sparse.csr_array([[3.0, 0.5], [0.0, -2.0]]), 1.0)
    >>> kept.toarray().tolist(), lost
    ([[3.0, 0.0], [0.0, -2.0]], 0.25)
    """
    keep = np.abs(C.data) >= threshold
    if keep.all():
        return C, 0.0
    gone = C.data[~keep].astype(np.float64)
    ends = np.concatenate([[0], np.cumsum(keep)]).astype(C.indptr.dtype)[C.indptr]
    return scipy.sparse.csr_array((C.data[keep], C.indices[keep], ends), C.shape), float(gone @ gone)


def norm_2(
    multiply: Product, transposed: Product, start: np.ndarray, steps: int = _STEPS
) -> tuple[float, np.ndarray]:
    """The 2-norm from below, and the vector that shows it: where the next, similar one may start.

    >>> A = np.diag([3.0, 1.0])
    >>> round(norm_2(A.__matmul__, A.T.__matmul__, np.ones(2))[0], 3)
    3.0
    """
    v, norm = start / np.linalg.norm(start), 0.0
    for _ in range(steps):
        u = multiply(v)
        norm = float(np.linalg.norm(u))
        w = transposed(u)
        length = float(np.linalg.norm(w))
        if not 0.0 < length < math.inf:
            break
        v = w / length
    return norm, v


def random_start(n: int) -> np.ndarray:
    """A vector that leaves no direction out, (n,), always the same."""
    return np.random.default_rng(_SEED).standard_normal(n)


def threshold_for(C: Any, error: float) -> float:
    """About the largest threshold that drops no more than `error` of C in the 2-norm; 0 where none does.

    >>> threshold_for(scipy.sparse.diags_array([1.0, 0.1, 0.01]).tocsr(), 0.05) <= 0.1
    True
    """
    sizes = np.sort(np.abs(C.data[C.data != 0.0]))
    if not len(sizes):
        return 0.0
    beyond = np.nextafter(sizes[-1], sizes.dtype.type(np.inf))
    v = random_start(C.shape[1])
    # All thresholds that the Frobenius norm allows are safe; those that drop one entry too large are not.
    low = int(np.searchsorted(np.cumsum(sizes.astype(np.float64) ** 2), error**2, side="right"))
    high = int(np.searchsorted(sizes, error, side="right"))
    for _ in range(_TRIALS):
        if high - low <= 1:
            break
        middle = round(math.sqrt((low + 1) * (high + 1))) - 1 if low else (low + high) // 2
        middle = min(max(middle, low + 1), high - 1)
        dropped = _below(C, sizes[middle])
        norm, v = norm_2(dropped.__matmul__, dropped.T.__matmul__, v)
        if norm > error:
            high = middle
        else:
            low = middle
            if norm > _CLOSE * error:
                break
    return min(float(sizes[low]), error) if low < len(sizes) else float(beyond)


def _below(C: Any, threshold: float) -> scipy.sparse.csr_array:
    """What `above` leaves out."""
    keep = np.abs(C.data) < threshold
    ends = np.concatenate([[0], np.cumsum(keep)]).astype(C.indptr.dtype)[C.indptr]
    return scipy.sparse.csr_array((C.data[keep], C.indices[keep], ends), C.shape)
