# SPDX-License-Identifier: BSD-3-Clause
"""The light of single projector pixels, from a camera of smaller pixels, some of which straddle several.

A camera pixel m shows the mean over its footprint, so with p the radiance of projector pixels, even on each,

    c = C p + e,  C_mn = part of footprint m that lies in pixel n,  var e_m = S^2 + K^2 sum_n C_mn (1 - C_mn)

where the second term is what an error of the map does to pixels that straddle: those that lie inside one
projector pixel count for more. Regularised least squares, `(C^T V^-1 C + I) p = C^T V^-1 c`, is solved for
each pixel with its neighbours, 5 x 5: further ones do not matter. What lies just outside the projector's grid
is unknown, too. Entries below a thousandth of a row's largest are dropped, and rows sum to one. As light is
not quite even within a pixel, camera pixels inside it are weighted so that their middle is its own.

Known limits, measured with maps from Gray code of a corner of 16 x 16 pixels (`bench/geometry.py`): with 1.5
camera pixels to a projector pixel's side noise and stripes have errors of 5.4 %, with 2 of 2 %, with 3 and 4
of 1 %; with 500 electrons at full scale and 3 pixels of 3.5 %. With camera pixels as large as the projector's
nothing finer than two pixels is resolved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse

from ltcl.acquisition.geometry.correspondence import Correspondence

# In brackets: the error of pictures of noise with 2 camera pixels to a side and an exact map, measured.
FINE = 0.85  # length of a camera pixel in projector pixels: above, least squares have 10 % of error and more
PURE = 0.95  # of a camera pixel in one projector pixel: it takes part in centring (0.8: 2.1 %, 0.99: 0.9 %)
NOISE, MAP = 0.02, 0.1  # S and K, of the light (S half, twice: 0.9 %; K half: 0.8 %, twice: 1.1 %)
REACH = 2  # pixels to each side that are solved together (1: 1.0 %, 2 and 3: 0.9 %)
SIDE = 2 * REACH + 1
POINTS = 8  # of a footprint, to each side (4: 1.2 %, 8: 0.9 %, 16: 0.6 % in four times the time)
RIM = REACH + 1  # unknown pixels around the grid, and what a window reads around these
LEAST = 0.001  # of the largest weight of a row (0: 0.9 %, 0.01: 1.2 %)
AT_ONCE = 1 << 12  # pixels solved, or camera pixels cast on the grid: 20 MB of 25 x 25 systems
BREAK = 2.5  # times the other difference: one that crosses the border of an object (perspective: below 1.1)
LARGEST = (
    6.0  # times the median: what no camera pixel spans on a surface that it sees at less than 80 degrees
)
STEEP = 1e-4  # smallest spread of the samples, in squared projector pixels, that determines a slope


@dataclass(frozen=True)
class Unmixed:
    """Rows of weights of all projector pixels, (N, M), and what is known of each, (N,).

    `area` is how much of the pixel camera pixels cover; `resolved` what part of the answer is its own light:
    1 where camera pixels separate it from its neighbours.
    """

    weights: scipy.sparse.csr_array
    area: np.ndarray
    resolved: np.ndarray


def jacobian(mapping: Correspondence) -> tuple[np.ndarray, np.ndarray]:
    """J = d(x, y) / d(u, v) of each camera pixel, (H, W, 2, 2) float64, and where it is known.

    Its footprint is the parallelogram that J spans. Differences to both valid neighbours are averaged; where
    one is far larger than the other it leads across a border, and the smaller one counts. Where a row or a
    column of pixels stands alone, and on a side of 1 of the projector's grid, camera pixels are taken for
    squares. Pixels without any valid neighbour have no footprint, nor have those that would span six times
    what the median one does.

    >>> J, known = jacobian(Correspondence.aligned((3, 4)))
    >>> J[0, 0].tolist(), bool(known.all())
    ([[1.0, 0.0], [0.0, 1.0]], True)
    """
    x = np.stack([mapping.x, mapping.y], axis=-1).astype(np.float64)  # NaN where not valid
    du, dv = _slope(x, 1), _slope(x, 0)
    turned = np.array([1.0, -1.0])
    du = np.where(np.isnan(du), dv[..., ::-1] * turned, du)
    dv = np.where(np.isnan(dv), du[..., ::-1] * -turned, dv)
    if mapping.valid.size == 1:
        du, dv = np.array([[[1.0, 0.0]]]), np.array([[[0.0, 1.0]]])
    J = np.stack([du, dv], axis=-1)
    for axis, n in enumerate(mapping.grid[::-1]):
        if n == 1:
            J[..., axis, :] = J[..., 1 - axis, ::-1] * turned
    known = mapping.valid & np.isfinite(J).all(axis=(2, 3))
    J = np.where(known[..., None, None], J, 0.0)
    span = np.abs(J).max(axis=(2, 3))
    return J, known & (span <= LARGEST * np.median(span[known])) if known.any() else known


def _slope(x: np.ndarray, axis: int) -> np.ndarray:
    """(H, W, 2): from the next and the previous pixel along `axis`; NaN where neither is valid."""
    step = np.diff(x, axis=axis)
    none = np.full_like(np.take(x, [0], axis=axis), np.nan)
    ahead, behind = np.concatenate([step, none], axis=axis), np.concatenate([none, step], axis=axis)
    far, near = (np.linalg.norm(d, axis=-1, keepdims=True) for d in (ahead, behind))
    use_ahead = np.isfinite(far) & ~(far > BREAK * near)
    use_behind = np.isfinite(near) & ~(near > BREAK * far)
    total = np.where(use_ahead, ahead, 0.0) + np.where(use_behind, behind, 0.0)
    count = use_ahead.astype(float) + use_behind
    return np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)


def _straddling(mapping: Correspondence, J: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(H, W): 1 of pixels next to one that is not known, or not next to them on the surface; 0 of others.

    Such a pixel may see two surfaces, in unknown parts.
    """
    x = np.stack([mapping.x, mapping.y], axis=-1).astype(np.float64)
    odd = np.zeros(known.shape, bool)
    for axis, slope in ((0, J[..., 1]), (1, J[..., 0])):
        n = known.shape[axis]
        mean = (slope.take(range(n - 1), axis) + slope.take(range(1, n), axis)) / 2
        deviation, size = (np.linalg.norm(d, axis=-1) for d in (np.diff(x, axis=axis) - mean, mean))
        far = ~(deviation <= (BREAK - 1) * size)  # NaN, too
        none = np.zeros_like(odd.take([0], axis))
        odd |= np.concatenate([far, none], axis) | np.concatenate([none, far], axis)
    return (odd & known).astype(np.float64)


def shares(mapping: Correspondence, J: np.ndarray, known: np.ndarray) -> scipy.sparse.csr_array:
    """C (M, pixels), on the grid with its rim: `inner` are the columns of the projector's pixels."""
    h, w = mapping.grid
    width, pixels = w + 2 * RIM, np.flatnonzero(known)
    i, j = (part.ravel() for part in np.mgrid[:POINTS, :POINTS])
    # Sheared: no two points lie on one line along a side, which a border may be, too.
    du, dv = ((a + (b + 0.5) / POINTS) / POINTS - 0.5 for a, b in ((i, j), (j, i)))
    x, y, slopes = (part.reshape(known.size, -1)[pixels] for part in (mapping.x, mapping.y, J))
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


def inner(grid: tuple[int, int]) -> np.ndarray:
    """Numbers of the projector's pixels on the grid with its rim, (N,)."""
    h, w = grid
    return np.add.outer((np.arange(h) + RIM) * (w + 2 * RIM), np.arange(w) + RIM).ravel()


def unmix(mapping: Correspondence, J: np.ndarray, known: np.ndarray) -> Unmixed | None:
    """Weights by least squares; None of a camera whose pixels are too large for it.

    >>> v, u = np.mgrid[:12, :12] / 3 - 1 / 3
    >>> small = Correspondence(u, v, np.ones((12, 12)), np.ones((12, 12), bool), (4, 4))
    >>> bool((unmix(small, *jacobian(small)).resolved > 0.99).all())
    True
    """
    if not np.median(np.linalg.norm(J[known], 2, axis=(1, 2))) < FINE:
        return None
    C = shares(mapping, J, known)
    mixed = C.copy()
    mixed.data *= 1.0 - mixed.data
    blurred = mixed.sum(axis=1) + _straddling(mapping, J, known).ravel()
    back = (C * (1.0 / (NOISE**2 + MAP**2 * blurred))[:, None]).T.tocsr()  # C^T V^-1
    (h, w), places = mapping.grid, inner(mapping.grid)
    width = w + 2 * RIM
    # Bands G[n, n + offset] of C^T V^-1 C, for the offsets of a window.
    G = (back @ C).tocoo()
    bands = np.zeros(((h + 2 * RIM) * width, SIDE, SIDE))
    n, other = G.coords
    dj, di = other // width - n // width + REACH, other % width - n % width + REACH
    near = (np.abs(dj - REACH) <= REACH) & (np.abs(di - REACH) <= REACH)
    bands[n[near], dj[near], di[near]] = G.data[near]
    Z, resolved = _inverse_rows(bands, places, width)
    area = np.asarray((C * np.abs(np.linalg.det(J)).reshape(-1, 1)).sum(axis=0))[places]
    parts = [_sharpened(Z[n : n + AT_ONCE] @ back) for n in range(0, h * w, AT_ONCE)]
    rows = scipy.sparse.vstack(parts, format="csr")
    inside = rows.multiply(C.T.tocsr()[places] >= PURE).tocsr()
    rest = rows - inside
    return Unmixed(centred(inside, mapping, rest) + rest, area, resolved)


def _inverse_rows(
    bands: np.ndarray, pixels: np.ndarray, width: int
) -> tuple[scipy.sparse.csr_array, np.ndarray]:
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
    """Without entries that are small next to the largest of their row; rows that are not empty sum to 1."""
    count = np.diff(np.asarray(rows.indptr))
    n = np.repeat(np.arange(len(count)), count)
    largest = np.zeros(len(count))
    np.maximum.at(largest, n, np.abs(rows.data))
    data = np.where(np.abs(rows.data) >= LEAST * largest[n], rows.data, 0.0)
    total = np.bincount(n, data, len(count))
    data /= np.where(total > 0, total, 1.0)[n]
    sharp = scipy.sparse.csr_array((data, rows.indices, rows.indptr), shape=rows.shape)
    sharp.eliminate_zeros()
    return sharp


def centred(
    weights: scipy.sparse.csr_array, mapping: Correspondence, fixed: scipy.sparse.csr_array | None = None
) -> scipy.sparse.csr_array:
    """`weights` (N, M), corrected to first order: the centres of `weights + fixed` lie on their pixels.

    A row of weights `w_nm` that sums to one puts the light of projector pixel n `mean = sum_m w_nm d_m` from
    its middle, d_m = n - x_m. Weights `w_nm (1 + b . (d_m - mean))` with `b = -C^-1 mean`, C the spread of d,
    still sum to one and put it on n, so that constant and linear pictures come out exactly; but only as far
    as no weight changes its sign, at the rim for instance. Empty rows stay.

    >>> one = np.ones((1, 3))
    >>> line = Correspondence(np.array([[-0.5, 0.0, 0.25]]), 0 * one, one, one > 0, (1, 1))
    >>> row = centred(scipy.sparse.csr_array(np.full((1, 3), 1 / 3)), line).toarray()
    >>> bool(abs(row @ [-0.5, 0.0, 0.25]) < 1e-3), round(float(row.sum()), 6)
    (True, 1.0)
    """
    n, dx, dy = _offsets(weights, mapping)
    starts = np.asarray(weights.indptr)
    total = np.bincount(n, weights.data, len(starts) - 1)
    data = weights.data / np.where(total != 0, total, 1.0)[n]
    mx, my = (np.bincount(n, data * d, len(total)) for d in (dx, dy))
    xx, xy, yy = (np.bincount(n, data * p, len(total)) for p in (dx * dx, dx * dy, dy * dy))
    xx, xy, yy = xx - mx * mx + STEEP, xy - mx * my, yy - my * my + STEEP
    det = np.maximum(xx * yy - xy * xy, STEEP**2)
    ax, ay = mx, my
    if (
        fixed is not None
    ):  # where it pulls the centre by some way, these weights pull as far to the other side
        m, *distances = _offsets(fixed, mapping)
        part = np.where(total != 0, total, np.inf)
        ax, ay = (
            a + np.bincount(m, fixed.data * d, len(total)) / part
            for a, d in zip((mx, my), distances, strict=True)
        )
    bx, by = -(yy * ax - xy * ay) / det, -(xx * ay - xy * ax) / det
    change = bx[n] * (dx - mx[n]) + by[n] * (dy - my[n])
    worst, some = np.zeros(len(total)), np.flatnonzero(np.diff(starts))
    worst[some] = np.minimum.reduceat(change, starts[some]) if len(some) else 0.0
    data = weights.data * (1 + change / np.maximum(1.0, -worst)[n])
    return scipy.sparse.csr_array((data, weights.indices, weights.indptr), shape=weights.shape)


def _offsets(
    weights: scipy.sparse.csr_array, mapping: Correspondence
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row of each entry, and n - x_m in both axes."""
    count = np.diff(np.asarray(weights.indptr))
    n = np.repeat(np.arange(len(count)), count)
    x, y = (part.ravel()[weights.indices].astype(np.float64) for part in (mapping.x, mapping.y))
    return n, n % mapping.grid[1] - x, n // mapping.grid[1] - y
