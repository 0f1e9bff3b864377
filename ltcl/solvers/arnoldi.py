# SPDX-License-Identifier: BSD-3-Clause
"""One Arnoldi step by classical Gram-Schmidt, twice: a new direction, made orthogonal to those there are.

Twice is enough for orthogonality to rounding (Giraud, Langou, Rozloznik, Comput. Math. Appl. 50, 2005), and
where modified Gram-Schmidt waits for every inner product in turn, each pass here waits once for all of them.

Numbers in comments: Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., algorithm 6.2 in blocks.
"""

from __future__ import annotations

from typing import Any

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
    found = vectors.dots(basis, w)  # 5.
    _subtract(found, basis, step, w)  # 6.
    *again, square = vectors.dots([*basis, w], w)
    _subtract(again, basis, step, w)
    h = np.zeros((w.columns, len(basis) + 1))
    h[:, :-1] = np.where(step, found + again, 0.0).T
    squares = np.sum(h**2, axis=1)
    left = np.sqrt(square - np.minimum(np.sum(np.square(again), axis=0), square))  # 8.
    complete = left <= _LOST * np.sqrt(squares + left**2)
    h[:, -1] = np.where(step & ~complete, left, 0.0)
    basis.append(
        vectors.axpby_columns(ratio(np.ones_like(left), left, step & ~complete), w, 0.0, w, w)
    )  # 10.
    return h


def _subtract(h: Any, basis: list[Array], step: np.ndarray, w: Array) -> None:
    """w = w - sum_i h_i v_i in the columns `step`."""
    for along, v in zip(h, basis, strict=True):
        vectors.axpby_columns(np.where(step, -along, 0.0), v, step, w, w)
