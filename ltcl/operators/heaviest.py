# SPDX-License-Identifier: BSD-3-Clause
"""The most that a step of a walk multiplies its weight by, and the most of what it may come to.

Both are found on the host, row by row, from the entries that are not zero.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ltcl.operators.alias import Tables
from ltcl.operators.csr import CSR
from ltcl.operators.dense import Dense
from ltcl.operators.links import Links

_FIRST = 64  # columns that are looked at together; of rows without any zero they are enough


def heaviest(R: CSR | Dense, made: Tables) -> np.ndarray:
    """The most that a step from i multiplies weights by, (channels, N) float64.

    >>> import ltcl
    >>> from ltcl.operators.alias import tables
    >>> R = Dense(ltcl.open_device(), [[0.0, 0.5], [-0.25, 0.5]])
    >>> heaviest(R, tables(R)).tolist(), heaviest(R, tables(R, "uniform")).tolist()
    ([[0.5, 0.75]], [[1.0, 1.0]])
    """
    n = R.shape[0]
    if isinstance(made, Links):
        return np.stack([_row_maxima(made.indptr, factor) for factor in made.factors()])
    if made.sampler != "uniform":
        return made.sums()[None, :n].astype(np.float64)
    if isinstance(R, CSR):
        largest = _row_maxima(R.pattern.indptr, np.abs(R.data))
    else:
        largest = np.concatenate([np.abs(slab.arguments[1].get()).max(axis=1) for slab in R.slabs])
    return (made.counts()[:n] * largest.astype(np.float64))[None]


def reaches(R: CSR | Dense, made: Tables, columns: bool = False) -> list[Callable[[np.ndarray], np.ndarray]]:
    """Of each channel what finds, of values v (N,), not negative, the largest that a step may lead to, (N,).

    >>> import ltcl
    >>> from ltcl.operators.alias import tables
    >>> R = Dense(ltcl.open_device(), [[0.0, 0.5], [0.0, 0.0]])
    >>> reaches(R, tables(R))[0](np.array([7.0, 3.0])).tolist()
    [3.0, 0.0]
    """
    if isinstance(made, Links):
        leads = made.links.get()[:, 0]
        return [_in_entries(made.indptr, leads, factor > 0.0) for factor in made.factors()]
    if isinstance(R, CSR):
        rows = R.transposed_copy() if columns else R
        return [_in_entries(rows.pattern.indptr, rows.pattern.indices, rows.data != 0.0)]
    nonzero = np.concatenate([slab.arguments[1].get() != 0.0 for slab in R.slabs])
    return [lambda v: _largest_reached(nonzero.T if columns else nonzero, v)]


def _in_entries(
    indptr: np.ndarray, leads: np.ndarray, there: np.ndarray
) -> Callable[[np.ndarray], np.ndarray]:
    return lambda v: _row_maxima(indptr, np.where(there, v[leads], 0.0))


def _row_maxima(indptr: Any, values: np.ndarray) -> np.ndarray:
    """Of values in sparse rows the largest of each, 0 where it is empty, float64."""
    found, filled = np.zeros(len(indptr) - 1), np.diff(indptr) > 0
    if filled.any():
        found[filled] = np.maximum.reduceat(values, indptr[:-1][filled])
    return found


def _largest_reached(nonzero: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The same of dense rows: the largest v first, until every row has met one."""
    found, left, order = np.zeros(len(nonzero)), np.arange(len(nonzero)), np.argsort(-v)
    start, width = 0, _FIRST
    while start < len(order) and left.size:
        some = order[start : start + width]
        met = nonzero[np.ix_(left, some)]
        hit = met.any(axis=1)
        found[left[hit]] = v[some][met[hit].argmax(axis=1)]
        left, start, width = left[~hit], start + width, 4 * width
    return found
