# SPDX-License-Identifier: BSD-3-Clause
"""What each pixel of a camera sees of the projector's pixels, by area: C of a `VirtualRig`.

    C_mn = part of the rays through camera pixel m that end in projector pixel n

A pixel of a camera integrates radiance over its square. Many rays through each stand for that, on a regular
lattice, so that nothing is random; each ends in a projector pixel, or in the dark beside the grid.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.errors import InputError

Place = Callable[[np.ndarray, np.ndarray], tuple[Any, Any]]


def camera_map(
    place: Place, camera_grid: tuple[int, int], grid: tuple[int, int], *, points: int = 12
) -> scipy.sparse.csr_array:
    """C for `VirtualRig`, (H W, h w) float64.

    Parameters
    ----------
    place : function of u, v
        Column and row of the projector (x, y) that the ray through column u and row v of the camera hits:
        pixels, centres at integers, arrays of any shape. NaN, or a place beside the grid: nothing lit. Folds
        and occluders are jumps of it.
    camera_grid, grid : (H, W), (h, w)
        Of the camera and of the projector.
    points : int
        Rays to each side of a camera pixel: entries are good to about 1 / points^1.5.

    Raises
    ------
    InputError
        `place` gives arrays of another shape.

    Examples
    --------
    A camera twice as coarse as the projector sees two pixels evenly:

    >>> camera_map(lambda u, v: (2 * u + 0.5, v), (1, 2), (1, 4)).toarray()
    array([[0.5, 0.5, 0. , 0. ],
           [0. , 0. , 0.5, 0.5]])
    """
    (H, W), (h, w) = checks.grid("camera_grid", camera_grid), checks.grid("grid", grid)
    k = checks.count("points", points)
    v, u = np.mgrid[:H, :W].astype(np.float64)
    offsets = (np.arange(k) + 0.5) / k - 0.5
    C = scipy.sparse.csr_array((H * W, h * w))
    for dv in offsets:  # a row of rays at a time
        C = C + sum((_seen(place, u + du, v + dv, (h, w)) for du in offsets), start=0 * C)
    return scipy.sparse.csr_array(C / k**2)


def _seen(place: Place, u: np.ndarray, v: np.ndarray, grid: tuple[int, int]) -> scipy.sparse.csr_array:
    """One ray through each camera pixel: 1 at what it hits."""
    x, y = (np.asarray(part, np.float64) for part in place(u, v))
    if x.shape != u.shape or y.shape != u.shape:
        raise InputError(f"place gives {x.shape} and {y.shape}; they must be {u.shape}, as u and v are")
    h, w = grid
    column, row = np.floor(x + 0.5).ravel(), np.floor(y + 0.5).ravel()
    hit = np.flatnonzero((column >= 0) & (column < w) & (row >= 0) & (row < h))  # NaN is nowhere
    n = (row[hit] * w + column[hit]).astype(np.int64)
    return scipy.sparse.csr_array((np.ones(len(hit)), (hit, n)), shape=(u.size, h * w))
