# SPDX-License-Identifier: BSD-3-Clause
"""The light of single projector pixels, from a camera of smaller pixels, some of which straddle several.

A camera pixel m shows the mean over its footprint, so with p the radiance of projector pixels, even on each,

    c = C p + e,  C_mn = part of footprint m that lies in pixel n,  var e_m = S^2 + K^2 sum_n C_mn (1 - C_mn)

where the second term is what an error of the map does to pixels that straddle: those that lie inside one
projector pixel count for more. Regularised least squares, `(C^T V^-1 C + I) p = C^T V^-1 c`, is solved for
each pixel with its neighbours, 5 x 5: further ones do not matter. What lies just outside the projector's grid
is unknown, too. Entries below a thousandth of a row's largest are dropped, and rows sum to one. As light is
not quite even within a pixel, camera pixels inside it are weighted so that their middle is its own.

Known limits, measured with maps that Gray code found of a corner of 16 x 16 pixels (`bench/geometry.py`):
with 1.5 camera pixels to a projector pixel's side noise and stripes come out to 5.4 %, with 2 to 2 %, with 3
and 4 to 1 %; with 500 electrons at full scale and 3 pixels to 3.5 %. With camera pixels as large as the
projector's nothing finer than two pixels is told.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from ltcl.acquisition.geometry.centring import centred
from ltcl.acquisition.geometry.correspondence import Correspondence
from ltcl.acquisition.geometry.footprints import straddling

FINE = 0.85  # length of a camera pixel, in projector pixels: below it they can be told apart
PURE = 0.95  # of a camera pixel in one projector pixel: it takes part in centring
NOISE, MAP = 0.02, 0.1  # S and K, of the light
REACH = 2  # pixels to each side that are solved together
SIDE = 2 * REACH + 1
POINTS = 8  # of a footprint, to each side
RIM = REACH + 1  # unknown pixels around the grid, and what a window reads beside these
LEAST = 0.001  # of the largest weight of a row
AT_ONCE = 1 << 12  # pixels solved, or camera pixels cast on the grid


@dataclass(frozen=True)
class Unmixed:
    """Rows of weights of all projector pixels, (N, M), and what is known of each, (N,).

    `area` is how much of the pixel camera pixels cover; `told` what part of the answer is its own light:
    1 where camera pixels tell it from its neighbours.
    """

    weights: scipy.sparse.csr_array
    area: np.ndarray
    told: np.ndarray


def unmix(found: Correspondence, J: np.ndarray, known: np.ndarray) -> Unmixed | None:
    """Weights by least squares; None of a camera whose pixels are too large for it.

    >>> from ltcl.acquisition.geometry.footprints import jacobian
    >>> v, u = np.mgrid[:12, :12] / 3 - 1 / 3
    >>> small = Correspondence(u, v, np.ones((12, 12)), np.ones((12, 12), bool), (4, 4))
    >>> told = unmix(small, *jacobian(small)).told
    >>> bool((told > 0.99).all())
    True
    """
    if not np.median(np.linalg.norm(J[known], 2, axis=(1, 2))) < FINE:
        return None
    C = shares(found, J, known)
    mixed = C.copy()
    mixed.data *= 1.0 - mixed.data
    blurred = mixed.sum(axis=1) + straddling(found, J, known).ravel()
    back = (C * (1.0 / (NOISE**2 + MAP**2 * blurred))[:, None]).T.tocsr()
    (h, w), places = found.grid, inner(found.grid)
    width = w + 2 * RIM
    Z, told = _solved(_bands((back @ C).tocoo(), (h + 2 * RIM) * width, width), places, width)
    area = np.asarray((C * np.abs(np.linalg.det(J)).reshape(-1, 1)).sum(axis=0))[places]
    parts = [_sharpened(Z[n : n + AT_ONCE] @ back) for n in range(0, h * w, AT_ONCE)]
    rows = scipy.sparse.vstack(parts, format="csr")
    inside = rows.multiply(C.T.tocsr()[places] >= PURE).tocsr()
    rest = rows - inside
    return Unmixed(centred(inside, found, rest) + rest, area, told)


def inner(grid: tuple[int, int]) -> np.ndarray:
    """Numbers of the projector's pixels on the grid with its rim, (N,)."""
    h, w = grid
    return np.add.outer((np.arange(h) + RIM) * (w + 2 * RIM), np.arange(w) + RIM).ravel()


def shares(found: Correspondence, J: np.ndarray, known: np.ndarray) -> scipy.sparse.csr_array:
    """C, on the grid with its rim: `inner` are the columns of the projector's pixels."""
    h, w = found.grid
    width, pixels = w + 2 * RIM, np.flatnonzero(known)
    i, j = (part.ravel() for part in np.mgrid[:POINTS, :POINTS])
    # Sheared: no two points lie on one line along a side, which a border may be, too.
    du, dv = ((a + (b + 0.5) / POINTS) / POINTS - 0.5 for a, b in ((i, j), (j, i)))
    x, y, slopes = (part.reshape(known.size, -1)[pixels] for part in (found.x, found.y, J))
    counts = np.zeros(known.size, np.int64)
    columns, values = [], []
    for start in range(0, len(pixels), AT_ONCE):
        some = slice(start, start + AT_ONCE)
        xu, xv, yu, yv = slopes[some].T[..., None]
        i = np.clip(np.rint(x[some] + xu * du + xv * dv), -1, w).astype(np.int64) + RIM
        j = np.clip(np.rint(y[some] + yu * du + yv * dv), -1, h).astype(np.int64) + RIM
        place = np.sort(j * width + i, axis=1)
        first = np.diff(place, axis=1, prepend=-1) != 0
        counts[pixels[some]] = first.sum(axis=1)
        at = np.append(np.flatnonzero(first), first.size)
        columns.append(place[first])
        values.append(np.diff(at) / POINTS**2)
    indptr = np.concatenate([[0], np.cumsum(counts)])
    shape = (known.size, (h + 2 * RIM) * width)
    return scipy.sparse.csr_array((np.concatenate(values), np.concatenate(columns), indptr), shape=shape)


def _bands(G: scipy.sparse.coo_array, pixels: int, width: int) -> np.ndarray:
    """G[n, n + offset] for the offsets of a window, (pixels, SIDE, SIDE)."""
    bands = np.zeros((pixels, SIDE, SIDE))
    n, other = G.coords
    dj, di = other // width - n // width + REACH, other % width - n % width + REACH
    near = (np.abs(dj - REACH) <= REACH) & (np.abs(di - REACH) <= REACH)
    bands[n[near], dj[near], di[near]] = G.data[near]
    return bands


def _solved(bands: np.ndarray, pixels: np.ndarray, width: int) -> tuple[scipy.sparse.csr_array, np.ndarray]:
    """Rows of (G + I)^-1 within the window of each pixel, and 1 less their diagonal: (G + I)^-1 G."""
    j, i = (part.ravel() for part in np.mgrid[:SIDE, :SIDE] - REACH)
    dj, di = (np.subtract.outer(part, part).T + REACH for part in (j, i))  # from a to b
    near = (dj >= 0) & (dj < SIDE) & (di >= 0) & (di < SIDE)
    dj, di = np.where(near, dj, 0), np.where(near, di, 0)
    centre, one = SIDE * SIDE // 2, np.zeros((SIDE * SIDE, 1))
    one[centre] = 1.0
    rows, places = [], pixels[:, None] + j * width + i
    for start in range(0, len(pixels), AT_ONCE):
        G = bands[places[start : start + AT_ONCE][..., None], dj, di] * near
        rows.append(np.linalg.solve(G + np.eye(SIDE * SIDE), one)[..., 0])
    Z = np.concatenate(rows)
    indptr = np.arange(0, Z.size + 1, SIDE * SIDE)
    matrix = scipy.sparse.csr_array((Z.ravel(), places.ravel(), indptr), shape=(len(pixels), len(bands)))
    return matrix, 1.0 - Z[:, centre]


def _sharpened(rows: scipy.sparse.csr_array) -> scipy.sparse.csr_array:
    """Without entries that are small beside the largest of their row; rows that are not empty sum to 1."""
    count = np.diff(np.asarray(rows.indptr))
    n = np.repeat(np.arange(len(count)), count)
    largest = np.zeros(len(count))
    np.maximum.at(largest, n, np.abs(rows.data))
    data = np.where(np.abs(rows.data) >= LEAST * largest[n], rows.data, 0.0)
    total = np.bincount(n, data, len(count))
    data /= np.where(total > 0, total, 1.0)[n]
    found = scipy.sparse.csr_array((data, rows.indices, rows.indptr), shape=rows.shape)
    found.eliminate_zeros()
    return found
