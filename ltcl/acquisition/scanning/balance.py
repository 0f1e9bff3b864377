# SPDX-License-Identifier: BSD-3-Clause
"""Columns that add up to white: what a scan by columns drops or gets wrong alike in all, row by row.

Row sums of T are photographed under white, many times, while those of N columns add up whatever is wrong
with each: what thresholds dropped, and an error a of the ambient light, which is in all columns and of
S-matrices 2 N / (n + 1) times in their sum. Of a row with entries x_j of variance v_j and white w of variance
u the best estimate takes

    x_j + v_j r / (V + u),    of variance v_j - v_j^2 / (V + u),    r = w - sum_j x_j,    V = sum_j v_j

for independent errors; those of a batch are not, and weak entries then take a larger part than they should.
Entries that were dropped count in V, each with the median v_j of its row; their part of r goes to the others.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse

from ltcl.acquisition.scanning.pictures import UNKNOWN, Picture
from ltcl.errors import ScanRefused
from ltcl.store import BlockStore

_REFUSED = 0.3  # of white
SUMS = "scanned.sums"
"""Extra array (channels, N) of a store: row sums of T by its columns, before they were made to add up."""


def rows(
    matrix: scipy.sparse.csr_array, variance: np.ndarray, white: Picture
) -> tuple[scipy.sparse.csr_array, np.ndarray]:
    """Rows of T and the variance of their entries, which add up to white.

    Rows stay as they are where white is not known, or an entry of theirs is not.

    Parameters
    ----------
    matrix : (rows, N)
    variance : (nnz,)
        NaN where unknown.
    white : Picture of (rows,)

    Examples
    --------
    >>> T = scipy.sparse.csr_array([[0.5, 0.1]])
    >>> found, v = rows(T, np.array([3.0, 1.0]), Picture(np.array([0.7]), np.array([1.0])))
    >>> found.toarray().round(3).tolist(), v.round(3).tolist()
    ([[0.56, 0.12]], [1.2, 0.8])
    """
    V: Any = scipy.sparse.csr_array((variance, matrix.indices, matrix.indptr), shape=matrix.shape)
    kept, dropped = V.sum(axis=1), _dropped(V)
    total = kept + dropped + white.variance
    known = np.isfinite(total) & (white.variance < 1e-3 * UNKNOWN) & (kept > 0)
    kept, total = np.where(known, kept, 1.0), np.where(known, total, np.inf)
    each = np.diff(matrix.indptr)
    move = np.where(known, (white.value - matrix.sum(axis=1)) * (1.0 + dropped / kept) / total, 0.0)
    spread = np.nan_to_num(variance)  # unknown ones are in rows that stay
    values = matrix.data + spread * np.repeat(move, each)
    found = scipy.sparse.csr_array((values, matrix.indices, matrix.indptr), shape=matrix.shape)
    return found, variance - spread**2 / np.repeat(total, each)


def _dropped(V: Any) -> np.ndarray:
    """Variance of all entries together that rows of csr (rows, N) do not have, of each row."""
    parts = np.split(V.data, V.indptr[1:-1])
    middle = np.array([np.median(part) if len(part) else 0.0 for part in parts])
    return middle * (V.shape[1] - np.diff(V.indptr))


def sums(store: BlockStore, channel: int) -> np.ndarray:
    """Row sums (M,) of the columns in a store, float64: what white is compared with."""
    total = np.zeros(store.layout.shape[0])
    for block in range(store.layout.blocks("columns")):
        found = store.block(channel, block, "columns").matrix
        total += np.bincount(found.indices, found.data, minlength=len(total))
    return total


def deviation(sums: np.ndarray, white: Picture) -> float:
    """Relative root mean square deviation of `sums` (channels, N) from white, NaN without light.

    >>> deviation(np.array([[3.0]]), Picture(np.array([[2.0]]), np.array([[0.0]])))
    0.5
    """
    known = white.variance < 1e-3 * UNKNOWN
    light = np.sum(white.value[known] ** 2, dtype=np.float64)
    return float(np.sqrt(np.sum((sums - white.value)[known] ** 2) / light)) if light > 0 else float("nan")


def check_row_sums(name: str, sums: np.ndarray, white: Picture) -> None:
    """Refuse a scan whose row sums (channels, N) mostly deviate from white by more than 30 %.

    It takes a camera of one exposure: others are refused before a batch is kept.

    Raises
    ------
    ScanRefused
        What is committed already cannot be used.

    Examples
    --------
    >>> check_row_sums(
    ...     "T.zarr", np.ones((1, 1)), Picture(2 * np.ones((1, 1)), np.zeros((1, 1)))
    ... )  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ltcl.errors.ScanRefused: T.zarr: row sums of T mostly deviate by 50 % from the photograph under white ...
    """
    lit = (white.variance < 1e-3 * UNKNOWN) & (white.value > 0)
    if not lit.any():
        return
    median = float(np.median(np.abs(sums - white.value)[lit]) / np.median(white.value[lit]))
    if median > _REFUSED:
        raise ScanRefused(
            f"{name}: row sums of T mostly deviate by {100 * median:.0f} % from the photograph under white "
            f"(allowed: {100 * _REFUSED:.0f} %); the scene, the light or the exposure changed during the "
            "scan: acquire into another store"
        )
