# SPDX-License-Identifier: BSD-3-Clause
"""Reciprocity of a measured T = S F, without knowing areas, albedos or gains.

In a Lambertian scene A = W G with G = G^T by reciprocity of the form factors and W = diag(albedo /
area), so that S W = W + W G W + ... is symmetric, and so is T D with D = F^-1 W:

    T_ij d_j = T_ji d_i                                                        (eq. 4 and 5)

Gains of camera or projector pixels join D. As d is unknown it is fitted. Then R = T F^-1 - I is
compared with its transpose:

    N = D^-1/2 R D^1/2,    defect = ||N - N^T||_F / (sqrt(2) ||N||_F), diagonals left out

The defect is 0 for a reciprocal T, about e if every entry has independent relative noise e, and 1
if light goes one way only. Noise of known variances is subtracted: ||N - N^T||^2 is expected to be
twice their sum. A view-dependent (glossy) surface breaks reciprocity, as does a camera
off the projector's pixels: only for one projector and one camera at one place is the theory exact
(section 8.4).

The fit minimises the same norm to first order: sum N_ij^2 (log d_i - log d_j - log R_ij / R_ji)^2
with N_ij^2 = R_ij R_ji, a graph Laplacian solved by conjugate gradients.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from ltcl import checks

# Variances of entries of T, (n,), by their rows, columns and light.
EntryVariance = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]

# Entries to compare at most, in `analyze` and in passing.
ALL_ENTRIES = 1 << 22
QUICK_ENTRIES = 1 << 18
# Cost of an entry that is found by products, in entries that are read: of few pixels, and of many.
PRODUCT_COST = 16
LARGE_PRODUCT_COST = 64
LARGE = 1 << 16
# Conjugate gradients of the fit.
FIT_STEPS = 200
FIT_RTOL = 1e-10
# Bound on |log d|: beyond, there is nothing but noise to fit.
MAX_LOG_SCALE = 60.0


def reciprocity_defect(
    T: Any,
    F: np.ndarray,
    *,
    entries: int = ALL_ENTRIES,
    seed: int = 0,
    variance: EntryVariance | None = None,
) -> float:
    """The defect of T, (N, N), as this module defines it; NaN if T does not show its entries.

    Operators of `ltcl.operators` show theirs, at a product for each pixel of the sample.

    Parameters
    ----------
    T : array, csr_array, Operator, or LinearOperator
    F : (N,)
        First bounce; pixels where it is 0 are left out.
    entries, seed : int
        Size of a random sample and its seed. If T has more `entries`, only the pixels of a sample
        count that has about so many: any part of a reciprocal T is reciprocal.
    variance : function of rows, columns and light, optional
        Variances of entries of T by noise; the defect is what is left beyond theirs.

    Examples
    --------
    >>> S = np.array([[1.0, 0.2, 0.1], [0.2, 1.0, 0.3], [0.1, 0.3, 1.0]])
    >>> reciprocity_defect(
    ...     np.diag([1.0, 2.0, 3.0]) @ S @ np.diag([0.5, 0.4, 0.3]), np.ones(3)
    ... ) < 1e-6
    True
    >>> round(reciprocity_defect(np.array([[1.0, 0.2], [0.0, 1.0]]), np.ones(2)), 3)
    1.0
    """
    lit = np.flatnonzero(F > 0)
    n = len(F)
    if hasattr(T, "between"):
        # An Operator, or the rows of a store.
        cost = LARGE_PRODUCT_COST if n > LARGE else PRODUCT_COST
        pixels = _sample(lit, n**2, n, entries // cost, seed)
        light = T.between(pixels, pixels)
    elif isinstance(T, np.ndarray):
        pixels = _sample(lit, T.size, n, entries, seed)
        light = T[np.ix_(pixels, pixels)]
    elif isinstance(T, scipy.sparse.csr_array):
        pixels = _sample(lit, T.nnz, n, entries, seed)
        light = T[pixels][:, pixels]
    else:
        return float("nan")
    R = _indirect(light, F[pixels])
    largest = np.abs(R.data).max(initial=0.0)
    if largest == 0.0:
        return 0.0
    R = R / largest
    root = np.exp(_log_scale(R) / 2)
    N = scipy.sparse.diags_array(1 / root) @ R @ scipy.sparse.diags_array(root)
    norm = scipy.sparse.linalg.norm(N)
    if not norm > 0:
        return 0.0
    defect = float(scipy.sparse.linalg.norm(N - N.T) / (np.sqrt(2) * norm))
    if variance is None:
        return defect
    entries_of_T = scipy.sparse.coo_array(light)
    i, j = entries_of_T.coords
    # From variances of T to those of N.
    factor = root[j] / root[i] / F[pixels][j] / largest
    noise = factor**2 * variance(pixels[i], pixels[j], entries_of_T.data)
    noise_power = float(noise[i != j].sum())
    return math.sqrt(max(defect**2 - noise_power / norm**2, 0.0))


def _sample(pixels: np.ndarray, count: int, n: int, entries: int, seed: int) -> np.ndarray:
    """All pixels, or a random sample with about `entries` of the `count` entries between them."""
    if count <= entries:
        return pixels
    size = min(len(pixels), int(n * (entries / count) ** 0.5))
    random = np.random.default_rng(checks.count("seed", seed, least=0))
    return np.sort(random.choice(pixels, size, replace=False))


def _indirect(T: Any, F: np.ndarray) -> Any:
    """R without its diagonal, csr_array float64."""
    R = scipy.sparse.csr_array(T) @ scipy.sparse.diags_array(1.0 / F)
    return scipy.sparse.csr_array(R - scipy.sparse.diags_array(R.diagonal()))


def _log_scale(R: Any) -> np.ndarray:
    """log d of the fit; 0 where a pixel shares no light with others in both directions."""
    light = R.maximum(0.0).tocsr()
    light.eliminate_zeros()
    weight = light.multiply(light.T).tocsr()
    logs = light.copy()
    logs.data = np.log(logs.data)
    pull = (weight.multiply(logs) - weight.multiply(logs.T)).sum(axis=1)
    degree = weight.sum(axis=1)
    diagonal = np.where(degree > 0, degree, 1.0)
    laplacian = scipy.sparse.diags_array(diagonal) - weight
    jacobi = scipy.sparse.diags_array(1.0 / diagonal)
    x, _ = scipy.sparse.linalg.cg(
        laplacian, np.asarray(pull), rtol=FIT_RTOL, maxiter=FIT_STEPS, M=jacobi
    )
    return np.clip(x, -MAX_LOG_SCALE, MAX_LOG_SCALE)
