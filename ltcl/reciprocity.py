# SPDX-License-Identifier: BSD-3-Clause
"""How far a measured T is from reciprocal: Helmholtz reciprocity without knowing areas, albedos or gains.

Of a Lambertian scene A = W G, W = diag(albedo / area) and G = G^T by reciprocity of the form factors, so
that S W = W + W G W + ... is symmetric, and so is T D with D = F^-1 W: T_ij d_j = T_ji d_i (eq. 4 and 5;
only there is the theory exact for one projector and one camera, section 8.4). Gains of camera or
projector pixels join D. As d is unknown it is fitted; then R = T F^-1 - I is compared with its transpose

    N = D^-1/2 R D^1/2,    defect = ||N - N^T||_F / (sqrt(2) ||N||_F), diagonals left out

which is 0 of a reciprocal T, about e where every entry has independent relative noise e, and 1 where light
goes one way only. A view-dependent (glossy) surface breaks it, as does a camera off the projector's pixels.

The fit minimises the same norm to first order: sum N_ij^2 (log d_i - log d_j - log R_ij / R_ji)^2 with
N_ij^2 = R_ij R_ji, a graph Laplacian solved by conjugate gradients. O(nnz) a step.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

ALL, QUICK = 1 << 22, 1 << 18  # entries to compare at most, in `analyze` and in passing
_DEARER = 16  # times an entry that is found by products
_STEPS, _RTOL = 200, 1e-10  # of conjugate gradients
_LARGEST = 60.0  # of |log d|: beyond, there is nothing but noise to fit


def defect(T: Any, F: np.ndarray, *, entries: int = ALL, seed: int = 0) -> float:
    """The defect of T, (N, N), in the module's first lines; NaN where T does not show its entries.

    Operators of `ltcl.operators` show theirs, at a product for each pixel of the sample.

    Parameters
    ----------
    T : array, csr_array, Operator, or LinearOperator
    F : (N,)
        First bounce; pixels where it is 0 are left out.
    entries : int
        Of a T with more, the pixels of a random sample that has about so many: any part of a reciprocal T
        is reciprocal.
    seed : int
        Of the sample.

    Examples
    --------
    >>> S = np.array([[1.0, 0.2, 0.1], [0.2, 1.0, 0.3], [0.1, 0.3, 1.0]])
    >>> defect(np.diag([1.0, 2.0, 3.0]) @ S @ np.diag([0.5, 0.4, 0.3]), np.ones(3)) < 1e-6
    True
    >>> round(defect(np.array([[1.0, 0.2], [0.0, 1.0]]), np.ones(2)), 3)
    1.0
    """
    lit = np.flatnonzero(F > 0)
    if hasattr(T, "between"):
        pixels = _sample(lit, len(F) ** 2, len(F), entries // _DEARER, seed)
        R = _indirect(T.between(pixels, pixels), F[pixels], np.arange(len(pixels)))
    elif isinstance(T, (np.ndarray, scipy.sparse.csr_array)):
        R = _indirect(T, F, _sample(lit, _stored(T), len(F), entries, seed))
    else:
        return float("nan")
    root = np.exp(_log_scale(R) / 2)
    if isinstance(R, np.ndarray):
        N = R * root / root[:, None]
        apart, whole = np.linalg.norm(N - N.T), np.linalg.norm(N)
    else:
        N = scipy.sparse.diags_array(1 / root) @ R @ scipy.sparse.diags_array(root)
        apart, whole = scipy.sparse.linalg.norm(N - N.T), scipy.sparse.linalg.norm(N)
    return float(apart / (np.sqrt(2) * whole)) if whole > 0 else 0.0


def _stored(T: Any) -> int:
    return T.size if isinstance(T, np.ndarray) else T.nnz


def _sample(pixels: np.ndarray, stored: int, n: int, entries: int, seed: int) -> np.ndarray:
    """All pixels, or so many at random that about `entries` of the entries lie between them."""
    if stored <= entries:
        return pixels
    some = min(len(pixels), int(n * (entries / stored) ** 0.5))
    return np.sort(np.random.default_rng(seed).choice(pixels, some, replace=False))


def _indirect(T: Any, F: np.ndarray, pixels: np.ndarray) -> Any:
    """R between the pixels without its diagonal, float64, largest entry 1."""
    if isinstance(T, np.ndarray):
        R = T[np.ix_(pixels, pixels)] / F[pixels]
        np.fill_diagonal(R, 0.0)
        return R / (np.abs(R).max(initial=0.0) or 1.0)
    R = T[pixels][:, pixels] @ scipy.sparse.diags_array(1.0 / F[pixels])
    R = scipy.sparse.csr_array(R - scipy.sparse.diags_array(R.diagonal()))
    return R / (np.abs(R.data).max(initial=0.0) or 1.0)


def _log_scale(R: Any) -> np.ndarray:
    """log d of the fit; 0 where a pixel shares no light with others in both directions."""
    if isinstance(R, np.ndarray):
        light = np.maximum(R, 0.0)
        weight = light * light.T
        logs = np.log(light, out=np.zeros_like(light), where=light > 0)
        pull = (weight * (logs - logs.T)).sum(axis=1)
    else:
        light = R.maximum(0.0).tocsr()
        light.eliminate_zeros()
        weight, logs = light.multiply(light.T).tocsr(), light.copy()
        logs.data = np.log(logs.data)
        pull = (weight.multiply(logs) - weight.multiply(logs.T)).sum(axis=1)
    degree = weight.sum(axis=1)
    return np.clip(_laplacian_solve(weight, degree, np.asarray(pull)), -_LARGEST, _LARGEST)


def _laplacian_solve(weight: Any, degree: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """x of (diag(degree) - weight) x = pull, singular but consistent."""
    diagonal = np.where(degree > 0, degree, 1.0)
    jacobi = scipy.sparse.diags_array(1.0 / diagonal)
    if isinstance(weight, np.ndarray):
        laplacian = -weight
        laplacian[np.diag_indices_from(laplacian)] = diagonal
    else:
        laplacian = scipy.sparse.diags_array(diagonal) - weight
    x, _ = scipy.sparse.linalg.cg(laplacian, pull, rtol=_RTOL, maxiter=_STEPS, M=jacobi)
    return x
