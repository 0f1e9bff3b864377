# SPDX-License-Identifier: BSD-3-Clause
"""What is large in a dense block, as sparse columns.

A block is looked at in pieces that stay in the cache, which each go through several times.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse

from ltcl.compression.sources import cut

_CACHED = 512  # rows of a piece


def sieve(block: np.ndarray, threshold: float) -> tuple[scipy.sparse.csc_array, list[float]]:
    """What is at least `threshold` as sparse columns, and the sum of squares of the rest in each column.

    >>> kept, rest = sieve(np.array([[3.0, 0.5], [0.0, 4.0]], np.float32), 1.0)
    >>> kept.toarray().tolist(), rest
    ([[3.0, 0.0], [0.0, 4.0]], [0.0, 0.25])
    """
    found = [_piece(block, start, stop, threshold) for start, stop in cut(len(block), _CACHED)]
    places, values, squares = zip(*found, strict=True)
    rows, columns = np.divmod(np.concatenate(places), block.shape[1])
    kept = scipy.sparse.coo_array((np.concatenate(values), (rows.astype(np.int32), columns)), block.shape)
    return scipy.sparse.csc_array(kept), np.sum(squares, axis=0).tolist()


def _piece(block: np.ndarray, start: int, stop: int, threshold: float) -> tuple[np.ndarray, ...]:
    """Of some rows: places in the block and values of what is kept, and sums of squares of the rest."""
    part = np.ascontiguousarray(block[start:stop])
    keep = np.abs(part) >= threshold
    keep &= part != 0.0
    places = np.flatnonzero(keep)
    rest = part.astype(np.float64)
    rest.flat[places] = 0.0
    # Summed row by row: a column has the same sum in any block.
    return start * part.shape[1] + places, part.flat[places], np.sum(np.square(rest, out=rest), axis=0)
