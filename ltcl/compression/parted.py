# SPDX-License-Identifier: BSD-3-Clause
"""R = P + W_out^T C W_in + small: what is sharp in pixels, the smooth rest in wavelets, each in few numbers.

Morphological component analysis (Starck, Elad and Donoho 2005): both parts in turn take what is large in what
the other leaves,

    C = hard(W_out (R - P) W_in^T, t),    P = hard(R - W_out^T C W_in, t),

while t falls. It must fall slowly: a part that takes small numbers early takes those of the other for its
own. R is held on the host as N x N numbers, a few times; transforms run on the device.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.compression.coefficients import Coefficients
from ltcl.compression.sources import RowSource, at_once, cut
from ltcl.operators import Basis

_START = 0.5  # of the largest number, where t begins
_FALL = 0.7  # of t is the next one
_BLOCK = 64  # columns in a transform
_COPIES = 5  # of R at once: R, P, what is worked on, and what NumPy needs for it
_LEAST = 1e-7  # of the largest number: float32 has nothing to tell below


@dataclass(frozen=True)
class Parted(Coefficients):
    """`core` is [P C], (N, 2 N): numbers of pixels, and coefficients.

    Attributes
    ----------
    residual : float
        Frobenius norm of R - P - W_out^T C W_in as it was found, before any more was dropped.
    """

    residual: float = 0.0

    @property
    def dropped(self) -> float:
        """Bound on ||R~ - R||_F: what is dropped of both parts may add up."""
        return self.residual + math.sqrt(2.0) * self.second

    @property
    def parts(self) -> tuple[scipy.sparse.csr_array, scipy.sparse.csr_array]:
        """P and C, (N, N)."""
        return halves(self.core)


def halves(core: scipy.sparse.csr_array) -> tuple[scipy.sparse.csr_array, scipy.sparse.csr_array]:
    """The left and the right half of the columns, (N, N) each of (N, 2 N).

    >>> [half.toarray().tolist() for half in halves(scipy.sparse.csr_array([[1.0, 2.0]]))]
    [[[1.0]], [[2.0]]]
    """
    n = len(core.indptr) - 1
    return scipy.sparse.csr_array(core[:, :n]), scipy.sparse.csr_array(core[:, n:])


def require_room(pixels: int) -> None:
    """Refuse, by a MemoryLimitError, to part R of so many pixels where the host has no room for it."""
    checks.fits_host(f"R of {pixels} pixels in two parts", 4 * _COPIES * pixels**2)


def part(
    R: RowSource,
    out: Basis,
    into: Basis,
    drop: float,
    memory: int | None = None,
    progress: Callable[[float], object] | None = None,
) -> Parted:
    """P and C, down to the first threshold that leaves at most the Frobenius norm `drop`.

    Parameters
    ----------
    R : RowSource, (N, N)
    out, into : Basis
        W_out and W_in, orthonormal.
    drop : float
        Where float32 does not reach it, `residual` is above.
    memory : int, optional
        Bytes for a block of rows as they are read.
    progress : callable, optional
        Called with the share that is done, about.

    Raises
    ------
    MemoryLimitError
        The host has no room for R, a few times.

    Examples
    --------
    >>> import ltcl
    >>> from ltcl.compression.sources import source
    >>> from ltcl.operators import Wavelet
    >>> W = Wavelet(ltcl.open_device(), (4, 4), "haar")
    >>> R = np.full((16, 16), 1 / 16)  # one coefficient
    >>> R[3, 5] = 2.0  # and one pixel
    >>> [found.nnz for found in part(source("R", R), W, W, 1e-3).parts]
    [1, 1]
    """
    n = R.shape[0]
    require_room(n)
    A = _all(R, memory)
    largest = float(np.abs(A).max(initial=0.0))
    P, t, left = np.zeros_like(A), _START * largest, _norm(A)
    C, first = scipy.sparse.csr_array(A.shape, dtype=np.float32), left
    while left > drop and t > _LEAST * largest:
        C, left = _round(A, P, out, into, t)
        _tell(progress, first, left, drop)
        t *= _FALL
    core = scipy.sparse.csr_array(scipy.sparse.hstack([scipy.sparse.csr_array(P), C], format="csr"))
    return Parted(core, 0.0, 0.0, min(t / _FALL, largest), left)


def _round(
    A: np.ndarray, P: np.ndarray, out: Basis, into: Basis, t: float
) -> tuple[scipy.sparse.csr_array, float]:
    """C of what P leaves, then P, in place, of what C leaves; and the norm of what both do."""
    work = A - P
    _both_sides(work, out, into, False)
    work[np.abs(work) < t] = 0.0
    C = scipy.sparse.csr_array(work)
    _both_sides(work, out, into, True)
    np.subtract(A, work, out=work)
    large = np.abs(work) >= t
    np.copyto(P, 0.0)
    P[large] = work[large]
    work[large] = 0.0
    return C, _norm(work)


def _both_sides(X: np.ndarray, out: Basis, into: Basis, transpose: bool) -> None:
    """X becomes W_out X W_in^T, or W_out^T X W_in."""
    for start, stop in cut(len(X), _BLOCK):
        X[start:stop] = _transformed(into, X[start:stop].T, transpose).T
    for start, stop in cut(X.shape[1], _BLOCK):
        X[:, start:stop] = _transformed(out, X[:, start:stop], transpose)


def _transformed(W: Basis, columns: np.ndarray, transpose: bool) -> np.ndarray:
    x = W.device.upload(np.ascontiguousarray(columns))
    return (W.apply_transpose(x) if transpose else W.apply(x)).get()


def _norm(X: np.ndarray) -> float:
    """Frobenius, summed in float64."""
    return math.sqrt(math.fsum(float(np.einsum("i,i", row, row, dtype=np.float64)) for row in X))


def _all(R: RowSource, memory: int | None) -> np.ndarray:
    n = R.shape[0]
    A = np.empty((n, n), np.float32)
    for start, stop in cut(n, at_once(n, memory)):
        A[start:stop] = R.rows(start, stop)
    return A


def _tell(progress: Callable[[float], object] | None, first: float, left: float, drop: float) -> None:
    """By how much of the way, in powers, has been gone."""
    if progress is not None:
        way = math.log(first / drop) if drop > 0.0 else math.inf
        progress(min(1.0, math.log(first / left) / way) if left > drop else 1.0)
