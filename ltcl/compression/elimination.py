# SPDX-License-Identifier: BSD-3-Clause
"""The inverse of coefficients by a dense elimination, then thresholds: for matrices that are small or full.

Noise of a measured transport is in all coefficients: sparse products of these are dense ones, and slower.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.compression.iterated import Iterated, NoInverse
from ltcl.compression.residual import Residual, certify
from ltcl.compression.thresholds import above, norm_2, random_start, threshold_for
from ltcl.device import Device
from ltcl.solvers.result import Status

_DENSE = 2.0e10  # additions and multiplications in a second of dense elimination, roughly, on two cores
_SPARSE = 1.5e8  # multiplications of sparse products; only the ratio of the two decides
_PRODUCTS = 6
_MATRICES = 4  # dense ones in memory at once
_LARGEST = 8192  # rows
_SHARE, _AIM, _LEAST, _MOST = 0.7, 0.8, 0.1, 0.7  # as of `iteration`


def fits(C: Any) -> bool:
    """Whether there is room and time for elimination."""
    n = C.shape[0]
    return n <= _LARGEST and 8 * _MATRICES * n * n < checks.host_memory()


def pays(C: Any) -> bool:
    """Whether elimination takes less time than sparse products, and there is room for it."""
    multiplications = float(np.diff(C.indptr)[C.indices].sum(dtype=np.int64))
    return fits(C) and 2.0 * C.shape[0] ** 3 / _DENSE < _PRODUCTS * multiplications / _SPARSE


def eliminate(C: Any, sign: float, rtol: float, device: Device) -> Iterated:
    """D of (I + sign C)^-1 = I - sign D, within `rtol` where rounding of C's type allows.

    Raises
    ------
    NoInverse
        I + sign C is singular.
    """
    exact = _exact(C, sign)
    threshold, witness = threshold_for(exact, _SHARE * rtol), random_start(C.shape[0])
    residuals, dropped = [], []
    while True:
        D, lost = above(exact, threshold)
        G = Residual(C, D, sign)
        norm, witness = norm_2(G.matvec, G.rmatvec, witness)
        residuals.append(norm)
        dropped.append(math.sqrt(lost))
        bound = certify(G, device, rtol)
        if bound.upper <= rtol or lost == 0.0:
            break
        threshold *= min(max(_AIM * rtol / max(norm, rtol), _LEAST), _MOST)
    status = Status.CONVERGED if bound.upper <= rtol else Status.STAGNATED
    how = (status, 0, tuple(residuals), tuple(dropped), threshold, "elimination")
    return Iterated(D, bound.upper, bound.confidence, *how)


def _exact(C: Any, sign: float) -> Any:
    n = C.shape[0]
    dense = sign * C.toarray().astype(np.float64)
    dense[np.diag_indices(n)] += 1.0
    try:
        inverse = np.linalg.inv(dense)
    except np.linalg.LinAlgError:
        inverse = np.full((1, 1), np.nan)
    if not np.all(np.isfinite(inverse)):
        name = "I + C" if sign > 0 else "I - C"
        raise NoInverse(name, "is singular", "it must have an inverse: check the first bounce")
    inverse *= -sign
    inverse[np.diag_indices(n)] += sign
    return scipy.sparse.csr_array(inverse.astype(C.dtype))
