# SPDX-License-Identifier: BSD-3-Clause
"""One Arnoldi step by modified Gram-Schmidt: a new direction, made orthogonal to those there are.

Numbers in comments: Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., algorithm 6.2.
"""

from __future__ import annotations

import numpy as np

from ltcl.device import Array, vectors
from ltcl.solvers.columns import ratio

_LOST = 2.0**-20  # of its length: what orthogonalization left is rounding, the space holds S v already


def extend(basis: list[Array], w: Array, step: np.ndarray) -> np.ndarray:
    """Make `w` = S v_j, the newest of `basis`, orthogonal to it and append it with unit length.

    Parameters
    ----------
    basis : j orthonormal arrays (N, k), column by column; gets the next one, which is `w`
    w : Array, (N, k)
    step : (k,) bool
        Columns to extend; the others, and those whose `w` lies in the space already, get a direction of 0.

    Returns
    -------
    (k, j + 1) float64
        The new columns of the Hessenberg matrices, h_1j to h_(j+1)j; the last is 0 where a space is complete.
    """
    h = np.zeros((w.columns, len(basis) + 1))
    squares = np.zeros(w.columns)
    for i, v in enumerate(basis):
        h[:, i] = np.where(step, vectors.dot(w, v), 0.0)  # 5.
        squares += h[:, i] ** 2
        vectors.axpby_columns(-h[:, i], v, step, w, w)  # 6.
    left = vectors.norm(w)  # 8.
    complete = left <= _LOST * np.sqrt(squares + left**2)
    h[:, -1] = np.where(step & ~complete, left, 0.0)
    basis.append(
        vectors.axpby_columns(ratio(np.ones_like(left), left, step & ~complete), w, 0.0, w, w)
    )  # 10.
    return h
