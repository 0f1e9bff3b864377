# SPDX-License-Identifier: BSD-3-Clause
"""Which cells may be lit together: no camera pixel answers to two of one colour (Sen et al. 2005).

Two cells conflict where some camera pixel is active in both; colouring the graph of conflicts gives groups
without any. Greedy, the cells with most active pixels first, each into the first colour that has room. The
graph is never built: a colour keeps which camera pixels it has taken.
"""

from __future__ import annotations

import numpy as np


def colour(starts: np.ndarray, pixels: np.ndarray, count: int) -> np.ndarray:
    """A colour of each of n cells.

    Parameters
    ----------
    starts : (n + 1,), pixels : (entries,)
        Cell k is active at the camera pixels ``pixels[starts[k]:starts[k + 1]]``.
    count : int
        Of camera pixels.

    Returns
    -------
    (n,) int
        From 0; at least as many as the pixel with most active cells has, which no colouring goes below.

    Examples
    --------
    Cells 0 and 1 share pixel 2, cells 1 and 2 pixel 0:

    >>> colour(np.array([0, 1, 3, 4]), np.array([2, 2, 0, 0]), 3).tolist()
    [1, 0, 1]
    """
    n = len(starts) - 1
    found = np.zeros(n, np.int64)
    taken = np.zeros((0, count), bool)
    used = 0
    for cell in np.argsort(-np.diff(starts), kind="stable"):
        own = pixels[starts[cell] : starts[cell + 1]]
        free = np.flatnonzero(~taken[:used, own].any(axis=1))
        if len(free) == 0 and used == len(taken):
            taken = np.concatenate([taken, np.zeros((max(8, used), count), bool)])
        place = int(free[0]) if len(free) else used
        used = max(used, place + 1)
        taken[place, own] = True
        found[cell] = place
    return found
