# SPDX-License-Identifier: BSD-3-Clause
"""Parts of projector pixels that camera pixels see, by casting rays through a known map."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks

Place = Callable[[np.ndarray, np.ndarray], tuple[Any, Any]]


def camera_map(
    place: Place, camera_grid: tuple[int, int], grid: tuple[int, int], *, points: int = 12
) -> scipy.sparse.csr_array:
    """Part of the rays through camera pixel m that end in projector pixel n: C for `VirtualRig`.

    Parameters
    ----------
    place : callable
        place(u, v) returns the column x and the row y of the projector that the ray through column
        u and row v of the camera hits. All are arrays of one shape, with centres of pixels at
        integers; NaN, or a place outside the grid, if the ray hits nothing lit.
    camera_grid : (int, int)
        Height and width of the camera, H and W.
    grid : (int, int)
        Height and width of the projector, h and w.
    points : int
        Rays along each side of a camera pixel. Entries are good to about 1 / points^1.5.

    Returns
    -------
    (H W, h w) csr_array
        float64.

    Raises
    ------
    InputError
        A grid is not two positive integers, or `points` is not a positive integer.

    Examples
    --------
    >>> camera_map(lambda u, v: (2 * u + 0.5, v), (1, 2), (1, 4)).toarray()  # twice as coarse
    array([[0.5, 0.5, 0. , 0. ],
           [0. , 0. , 0.5, 0.5]])
    """
    H, W = checks.grid("camera_grid", camera_grid)
    h, w = checks.grid("grid", grid)
    checks.count("points", points)
    v, u = np.mgrid[:H, :W].astype(np.float64)
    offsets = (np.arange(points) + 0.5) / points - 0.5
    C = scipy.sparse.csr_array((H * W, h * w))
    for dv, du in itertools.product(offsets, offsets):
        x, y, _ = np.broadcast_arrays(*place(u + du, v + dv), u)
        column = np.floor(x + 0.5).ravel()
        row = np.floor(y + 0.5).ravel()
        # NaN hits nothing.
        is_hit = (column >= 0) & (column < w) & (row >= 0) & (row < h)
        camera_pixels = np.flatnonzero(is_hit)
        projector_pixels = row[is_hit] * w + column[is_hit]
        places = camera_pixels, projector_pixels.astype(np.int64)
        ones = np.ones(len(camera_pixels))
        C = C + scipy.sparse.csr_array((ones, places), shape=C.shape)
    return scipy.sparse.csr_array(C / points**2)
