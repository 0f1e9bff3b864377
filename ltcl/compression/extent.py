# SPDX-License-Identifier: BSD-3-Clause
"""Between which the eigenvalues of I + C and I - C lie, for sparse C: by Arnoldi's method on the host.

Light transport has nearly real eigenvalues; only their real parts are told.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse.linalg

from ltcl.compression.iterated import NoInverse

_DENSE = 64  # rows: fewer are quicker all at once, and ARPACK wants some
_ACCURACY = 1e-2  # of an eigenvalue
_WIDER = 0.02  # of the width, on each side: what Arnoldi's method does not see
_LEAST = 1e-3  # of the upper end: the lower one at least, or no number of steps would do


def extent(C: Any, sign: float) -> tuple[float, float]:
    """(lower, upper) of the real parts of the eigenvalues of I + sign C, slightly widened.

    Raises
    ------
    NoInverse
        The lower one is not above 0.

    Examples
    --------
    >>> import scipy.sparse
    >>> lower, upper = extent(scipy.sparse.diags_array([-0.5, 0.0, 1.0]), 1)
    >>> round(lower, 2), round(upper, 2)
    (0.47, 2.03)
    """
    least, most = _real_parts(C)
    lower, upper = sorted((1.0 + sign * least, 1.0 + sign * most))
    if not lower > 0.0:
        name = "I + C" if sign > 0 else "I - C"
        raise NoInverse(
            name,
            f"has an eigenvalue of real part {lower:.3g}",
            "all must be above 0, as of every scene: check the first bounce, and whether C is R (sign 1) or "
            "A (sign -1)",
        )
    room = _WIDER * (upper - lower)
    return max(lower - room, lower / 2.0, _LEAST * upper), upper + room


def _real_parts(C: Any) -> tuple[float, float]:
    n = C.shape[0]
    if C.nnz == 0:
        return 0.0, 0.0
    if n <= _DENSE:
        values = np.linalg.eigvals(C.toarray().astype(np.float64)).real
        return float(values.min()), float(values.max())
    return _outermost(C, "SR"), _outermost(C, "LR")


def _outermost(C: Any, which: str) -> float:
    """The smallest ("SR") or largest ("LR") real part; of a run that did not settle, what it has found."""
    arpack: Any = scipy.sparse.linalg.eigs
    start = np.random.default_rng(0).uniform(0.5, 1.5, C.shape[0]).astype(C.dtype)
    try:
        values = arpack(C, k=1, which=which, tol=_ACCURACY, v0=start, return_eigenvectors=False)
    except scipy.sparse.linalg.ArpackNoConvergence as stopped:
        values = stopped.eigenvalues
    if not len(values):  # all inside the disc of the norm
        sign = 1.0 if which == "LR" else -1.0
        return sign * float(np.sqrt(abs(C).sum(axis=0).max() * abs(C).sum(axis=1).max()))
    return float(np.real(values[0]))
