# SPDX-License-Identifier: BSD-3-Clause
"""NumPy twins, in float64, of every OpenCL kernel, and how far float32 may stray from them.

A twin is named after its kernel; the `_group` variant of a kernel has the same twin.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import scipy.sparse

UNIT = 2.0**-24  # largest relative error of rounding to float32
_LEAVES = 4096  # work-items among which the dot product spreads its rows, where there are that many


def csr_matvec(
    pointers: np.ndarray, columns: np.ndarray, values: np.ndarray, x: np.ndarray
) -> np.ndarray:
    """A x; x is (N,) or (N, k)."""
    matrix = (np.asarray(values, np.float64), columns, pointers)
    return scipy.sparse.csr_array(matrix, shape=(len(pointers) - 1, len(x))) @ x


def tile_matvec(
    pointers: np.ndarray, columns: np.ndarray, values: np.ndarray, x: np.ndarray
) -> np.ndarray:
    """A x; columns are the first of each tile, values (tiles, width)."""
    width = values.shape[1]
    places = columns[:, None] + np.arange(width)
    return csr_matvec(pointers * width, places.ravel(), values.ravel(), x)


def dense_matvec(matrix, x, scale: float = 1.0, add: np.ndarray | None = None) -> np.ndarray:
    """out = scale * (A x) + add."""
    out = scale * (np.asarray(matrix, np.float64) @ np.asarray(x, np.float64))
    return out if add is None else out + add


def dense_rmatvec(matrix: np.ndarray, x: np.ndarray) -> np.ndarray:
    """A^T x."""
    return dense_matvec(matrix.T, x)


def vector_fill(count: int, value: float) -> np.ndarray:
    return np.full(count, np.float64(value))


def vector_axpby(a: float, x: np.ndarray, b: float, y: np.ndarray) -> np.ndarray:
    return a * np.asarray(x, np.float64) + b * np.asarray(y, np.float64)


def vector_scale_rows(d: np.ndarray, x: np.ndarray) -> np.ndarray:
    """diag(d) x with d (N,), x (N,) or (N, k)."""
    return (np.asarray(d, np.float64) * np.asarray(x, np.float64).T).T


def vector_dot(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """<x_c, y_c> of every column c, (k,)."""
    return np.atleast_1d(np.sum(np.asarray(x, np.float64) * np.asarray(y, np.float64), axis=0))


def vector_step(p, x, r, d, keep: float, gain: float) -> tuple[np.ndarray, ...]:
    """x + d, r - p, keep d + gain (r - p), and the squares of r - p added up, (k,)."""
    p, x, r, d = _float64(p, x, r, d)
    return x + d, r - p, keep * d + gain * (r - p), vector_dot(r - p, r - p)


def vector_sums(sums: np.ndarray) -> np.ndarray:
    """(slots, groups, k) added up over the groups, (slots, k)."""
    return np.sum(np.asarray(sums, np.float64), axis=1)


def relax_rows(S: np.ndarray, split: np.ndarray, x, y, b, carry) -> tuple[np.ndarray, np.ndarray]:
    """r and the next carry of a sweep from x to y, with row i split before column split[i]."""
    lower = np.where(np.arange(len(S)) < split[:, None], S, 0.0)
    return carry - (S - lower) @ x, b - lower @ y


def relax_strips(S, block: int, omega, x, b, carry, *, in_place: bool) -> tuple[np.ndarray, ...]:
    """The next iterate, r and the next carry; of block Gauss-Seidel where omega is None."""
    y = block_gauss_seidel(S, x, b, block) if omega is None else sor(S, x, b, omega)
    i = np.arange(len(S))
    return y, *relax_rows(S, i if in_place else i - i % block, x, y, b, carry)


def relax_correct(inverse: np.ndarray, s: np.ndarray, x: np.ndarray) -> np.ndarray:
    """The block of x with its correction."""
    return x + inverse @ s


def triangle_products(L: np.ndarray, A_inverse: np.ndarray) -> np.ndarray:
    """T = L A^-1 of one pair of triangles."""
    return np.asarray(L, np.float64) @ A_inverse


def triangle_join(A_inverse: np.ndarray, C_inverse: np.ndarray, T: np.ndarray) -> np.ndarray:
    """The inverse of [[A, 0], [L, C]] with T = L A^-1."""
    above = np.hstack([A_inverse, np.zeros((len(A_inverse), len(C_inverse)))])
    return np.vstack([above, np.hstack([-C_inverse @ T, C_inverse])])


def relax_windows(M: np.ndarray, block: int, panel: int, *, inverses: bool) -> np.ndarray:
    """First entry of each row from its panel on, and from its block or its diagonal on, (N, 2)."""
    i = np.arange(len(M))
    edges = np.stack([i - i % panel, i - i % block if inverses else i], axis=1)
    # Entries of a row, left of each column.
    before = np.cumsum(np.pad(M != 0, ((0, 0), (1, 0))), axis=1)
    starts = np.cumsum(before[:, -1]) - before[:, -1]
    return starts[:, None] + np.take_along_axis(before, edges, axis=1)


def block_gauss_seidel(
    S: np.ndarray, x, b, block: int, sweeps: int = 1, omega: float = 1.0
) -> np.ndarray:
    """Sweeps of block Gauss-Seidel as in a textbook, block after block in place."""
    x = np.array(x, np.float64)
    for start in [*range(0, len(x), block)] * sweeps:
        B = slice(start, start + block)
        x[B] = relax_correct(omega * np.linalg.inv(S[B, B]), b[B] - S[B] @ x, x[B])
    return x


def sor(S: np.ndarray, x, b, omega: float = 1.0, sweeps: int = 1) -> np.ndarray:
    """Sweeps of SOR, row after row in place; with omega = 1 of Gauss-Seidel."""
    return block_gauss_seidel(S, x, b, 1, sweeps, omega)


def southwell_step(
    S: np.ndarray, parts: int, x: np.ndarray, r: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """x and r, (N, k), after the largest residual of each part was made zero."""
    edges = np.arange(parts + 1) * len(S) // parts
    picked = np.array([a + np.argmax(np.abs(r[a:b]), axis=0) for a, b in itertools.pairwise(edges)])
    d = np.zeros(r.shape)
    here = (picked, np.arange(r.shape[1]))
    d[here] = r[here] / S.diagonal()[picked]
    return x + d, r - S @ d


def philox(counters: np.ndarray, seed: int) -> np.ndarray:
    """Philox4x32-10 of counters (n, 4) and a key of 64 bits, as (n, 4) uint32."""
    c = [counters[:, i].astype(np.uint64) for i in range(4)]
    low = np.uint64(0xFFFFFFFF)
    key = [seed & 0xFFFFFFFF, seed >> 32]
    for _ in range(10):
        a = np.uint64(0xD2511F53) * c[0]
        b = np.uint64(0xCD9E8D57) * c[2]
        high_a = a >> np.uint64(32)
        high_b = b >> np.uint64(32)
        c = [high_b ^ c[1] ^ np.uint64(key[0]), b & low, high_a ^ c[3] ^ np.uint64(key[1]), a & low]
        key = [(key[0] + 0x9E3779B9) & 0xFFFFFFFF, (key[1] + 0xBB67AE85) & 0xFFFFFFFF]
    return np.stack(c, axis=1).astype(np.uint32)


def walk_tables(
    columns: np.ndarray, values: np.ndarray, n: int
) -> tuple[int, np.float32, np.ndarray]:
    """Entries that count, |R_i|, and the chance to draw each column with each sign, (n, 2)."""
    sizes = np.abs(values.astype(np.float64))
    exact = math.fsum(sizes)
    chances = np.zeros((n, 2))
    if np.float32(exact) < np.finfo(np.float32).tiny:
        return 0, np.float32(0), chances
    np.add.at(chances, (columns, np.signbit(values).astype(int)), sizes / exact)
    return len(values), np.float32(exact), chances


def walk(
    tables, steps, b, pixels, samples, seed: int, stream: int
) -> tuple[np.ndarray, np.ndarray]:
    """Walks from pixels[w], sample samples[w], all at once: scores (w, k) float32, and ends (w,).

    `tables` are records, entries, channels and links or None; column j of b is of channel j %
    channels. steps are (L, 2) uint32. A walk scores b at every step; without b its weight where it
    ends, the adjoint.
    """
    records, entries, channels, links = tables
    row = np.array(pixels)
    step = np.zeros(len(pixels), np.int64)
    weight = np.ones((len(row), channels), np.float32)
    scores = np.zeros((len(row), 1 if b is None else b.shape[1]), np.float32)
    alive = np.ones(len(row), bool)
    while alive.any():
        counters = np.stack([pixels, samples, step, np.full(len(row), stream)], axis=1)
        block = philox(counters.astype(np.uint32), seed).astype(np.uint64)
        word = block[:, 0] | block[:, 1] << np.uint64(32)
        target, factor = _draw(records[row], entries, word)
        factor = factor[:, None]
        if links is not None:
            target, factor = _linked(links, records[row], target)
            factor = factor[:, :channels]
        alive &= np.any(factor != 0, axis=1)
        here = np.flatnonzero(alive)
        row[here] = target[here] >> 1
        weight[here] *= np.where(target[here, None] & 1, -factor[here], factor[here])
        worth = weight[here] * np.ascontiguousarray(steps[step[here], 0]).view(np.float32)[:, None]
        goes_on = (word[here] & np.uint64(2**22 - 1)) < steps[step[here], 1]
        step[here] += 1
        if b is None:
            scores[here[~goes_on]] += worth[~goes_on]
        else:
            scores[here] += np.tile(worth, scores.shape[1] // channels) * b[row[here]]
        alive[here] = goes_on
    return scores, row


def walk_rows(tables, steps, b, pixels, samples, seed: int, stream: int, chunk: int) -> np.ndarray:
    """Sum and sum of squares of each chunk, (P, chunks, k, 2) float32."""
    count = len(samples)
    which = np.repeat(pixels, count), np.tile(samples, len(pixels))
    scores, _ = walk(tables, steps, b, *which, seed, stream)
    scores = scores.reshape(len(pixels), count, -1).swapaxes(0, 1)
    chunks = [scores[start : start + chunk] for start in range(0, count, chunk)]
    in_order = [
        np.stack([np.add.accumulate(part)[-1] for part in (c, c**2)], axis=-1) for c in chunks
    ]
    return np.stack(in_order, axis=1)


def walk_columns(tables, steps, source: int, samples, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Ends of samples from row `source`, and what they bring there, float32."""
    scores, ends = walk(tables, steps, None, np.full(len(samples), source), samples, seed, 0)
    return ends, scores[:, 0]


def _draw(
    records: np.ndarray, entries: np.ndarray, word: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Column and sign in one number, and the factor of weights, of one entry of each row."""
    count = records[:, 2].astype(np.uint64)
    start = records[:, 0].astype(np.uint64) | records[:, 1].astype(np.uint64) << np.uint64(32)
    factor = np.ascontiguousarray(records[:, 3]).view(np.float32)
    place = (word >> np.uint64(22)) * count
    slot = np.where(count > 0, start + (place >> np.uint64(42)), 0)
    entry = entries[slot] if entries.size else np.zeros(len(slot), np.uint64)
    fraction = place >> np.uint64(24) & np.uint64(2**18 - 1)
    own = fraction < entry >> np.uint64(46)
    target = np.where(own, entry >> np.uint64(23), entry) & np.uint64(2**23 - 1)
    return target.astype(np.int64), factor


def _linked(
    links: np.ndarray, records: np.ndarray, target: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Column, doubled, and three factors of the entries drawn; 0 of rows without."""
    start = records[:, 0].astype(np.int64) | records[:, 1].astype(np.int64) << 32
    full = records[:, 2] > 0
    links = np.append(links, np.zeros((1, 4), np.uint32), axis=0)
    link = links[np.where(full, start + (target >> 1), -1)]
    return link[:, 0].astype(np.int64) << 1, np.ascontiguousarray(link[:, 1:]).view(np.float32)


def form_factor_pair(p, q, n, m, clip: bool = True) -> np.ndarray:
    """cos cos / (pi r^2) of points p (M, 3) with normals n and q (N, 3) with normals m: (M, N)."""
    d = q[None] - p[:, None]
    r2 = (d**2).sum(axis=2)
    here = np.einsum("mnc,mc->mn", d, n)
    there = -np.einsum("mnc,nc->mn", d, m)
    faces = (here > 1e-6) & (there > 1e-6) if clip else r2 > 0
    return np.divide(here * there, np.pi * r2**2, out=np.zeros_like(r2), where=faces)


def form_factor_pairs(G: np.ndarray, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """G_ij of listed pairs, (P,)."""
    return G[i, j]


def form_factor_entries(geometry, blocks, outer: float = 64, inner: float = 12) -> np.ndarray:
    """G (N, N) of what `kernels/form_factor.cl` reads: geometry (13, N), blocks (B, 6)."""
    centre, right, down, normal = (
        geometry[3 * k : 3 * k + 3].T.astype(np.float64) for k in range(4)
    )
    angle = np.arange(8) * np.pi / 4
    # On a circle, in edges.
    place = np.sqrt(2 / 3) / 2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = [centre + u * right + v * down for u, v in place]

    def between(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return form_factor_pair(p, q, normal, normal) * ~blocked(p[:, None], q[None], blocks)

    eight = sum(between(points[k], points[3 * k % 8]) for k in range(8)) / 8
    one = between(centre, centre)

    # Half the second derivative along each edge times its variance, 1 / 12, by differences.
    def smooth(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return form_factor_pair(p, q, normal, normal, clip=False)

    curved = smooth(centre, centre)
    step = 1e-2
    ends = [move for edge in (step * right, step * down) for move in (-edge, edge)]
    bends = [smooth(centre + e, centre) + smooth(centre, centre + e) - 2 * curved for e in ends]
    curved = curved + sum(bends) / (24 * step**2)
    curved *= ~blocked(centre[:, None], centre[None], blocks)
    d = centre[None] - centre[:, None]
    height = np.einsum("mnc,mc->mn", d, normal)
    rise = sum(np.abs(normal @ edge.T) for edge in (right, down)) / 2
    above = height + rise > 1e-6
    below = height - rise < -1e-6
    r2 = (d**2).sum(axis=2)
    sizes = geometry[12] + geometry[12][:, None]
    hard = (r2 < inner**2 * sizes) | below | below.T
    close = np.where(above & above.T, np.where(hard, eight, curved), 0.0)
    return np.where(r2 < outer**2 * sizes, close, one)


def form_factor_weigh(right: np.ndarray, x: np.ndarray) -> np.ndarray:
    """diag(right) x, each of k right-hand sides as a row: (k, N)."""
    return (right * np.asarray(x, np.float64).T).reshape(-1, len(right))


def form_factor_matvec(G, left, right, x, scale: float, add: np.ndarray | None) -> np.ndarray:
    """out = scale * diag(left) G diag(right) x + add."""
    return dense_matvec(left[:, None] * G * right, x, scale, add)


def blocked(p: np.ndarray, q: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """True where the way from p to q (..., 3) passes a box (B, 6) given as centre and half sides.

    By slabs: the stretches of the way within each pair of faces have a part in common.
    """
    p, q = np.broadcast_arrays(np.asarray(p, np.float64), np.asarray(q, np.float64))
    result = np.zeros(p.shape[:-1], bool)
    for box in np.asarray(blocks, np.float64):
        low = box[:3] - box[3:]
        high = box[:3] + box[3:]
        with np.errstate(divide="ignore", invalid="ignore"):
            a = (low - p) / (q - p)
            b = (high - p) / (q - p)
        along = q == p  # never leaves the slab, or never enters it
        inside = (low <= p) & (p <= high)
        enter = np.where(along, np.where(inside, -np.inf, np.inf), np.minimum(a, b)).max(axis=-1)
        leave = np.where(along, np.where(inside, np.inf, -np.inf), np.maximum(a, b)).min(axis=-1)
        result |= np.maximum(enter, 0) <= np.minimum(leave, 1)
    return result


def form_factor_visible(starts, ends, normals, blocks: np.ndarray) -> np.ndarray:
    """Share of the rays from starts to ends (rays, 3, N) before both normals that meet no box."""
    faced, count = np.zeros((2, starts.shape[2], ends.shape[2]))
    for a, b in zip(starts.astype(np.float64), ends.astype(np.float64), strict=True):
        d = b.T[None] - a.T[:, None]
        facing = (np.einsum("mnc,cm->mn", d, normals) > 1e-6) & (
            np.einsum("mnc,cn->mn", d, normals) < -1e-6
        )
        faced += facing
        count += facing & ~blocked(a.T[:, None], b.T[None], blocks)
    return np.divide(count, faced, out=np.ones_like(count), where=faced > 0)


def gamma(roundings: float) -> float:
    """Relative error of that many roundings in a row.

    Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., lemma 3.1.
    """
    return roundings * UNIT / (1.0 - roundings * UNIT)


def product_error(matrix, x, scale: float = 1.0, add: np.ndarray | None = None) -> np.ndarray:
    """Largest float32 error of each value of out = scale * (A x) + add, in any order of the sum.

    A sum of n products passes through n roundings at most, `scale` and `add` bring two each and a
    composed operator a few more: gamma_(n + 8) (|scale| |A| |x| + |add|), Higham, section 3.5.
    """
    magnitude = abs(scale) * (
        np.abs(np.asarray(matrix, np.float64)) @ np.abs(np.asarray(x, np.float64))
    )
    if add is not None:
        magnitude = magnitude + np.abs(add)
    return gamma(matrix.shape[1] + 8) * magnitude


def dot_error(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Largest error of float32 in `vector_dot` by trees, (k,).

    Each work-item sums its rows in turn, then two trees add up the items and the groups: the number
    of roundings a product passes through grows with rows / 4096, not with rows.
    """
    roundings = np.ceil(len(x) / _LEAVES) + 2 * np.log2(_LEAVES) + 2
    return gamma(roundings) * vector_dot(np.abs(x), np.abs(y))


def vector_dots(pairs: list[tuple[np.ndarray, np.ndarray]], weights: np.ndarray) -> np.ndarray:
    """sum_i weights_i x_i y_i of every column for each pair."""
    return np.stack([np.sum(weights.astype(np.float64) * x * y, axis=0) for x, y in pairs])


def krylov_subtract(V, w, h, square: np.ndarray | None = None) -> np.ndarray:
    """w - sum_j h_j v_j, h (J, k); of length 1 if `square`, <w, w> of orthonormal v_j, is given."""
    left = w - np.einsum("jk,jnk->nk", h, V, dtype=np.float64)
    if square is None:
        return left
    squares_of_h = np.sum(h.astype(np.float64) ** 2, axis=0)
    return left / np.sqrt(square - squares_of_h)


def krylov_cg(sums, previous, last, moves, *vectors: np.ndarray) -> tuple[np.ndarray, ...]:
    """alpha (k,), then p, q, x and r after a step.

    `sums` are <r, r> and <w, r>, `vectors` w, p, q, x and r before the step.
    """
    square, product = sums
    w, p, q, x, r = _float64(*vectors)
    beta = square / previous
    alpha = square / (product - beta * square / last)
    alpha = np.where(moves, alpha, 0.0)
    p = np.where(moves, r + beta * p, p)
    q = np.where(moves, w + beta * q, q)
    return alpha, p, q, x + alpha * p, r - alpha * q


def krylov_half(rho: np.ndarray, sigma: np.ndarray, r: np.ndarray, v: np.ndarray) -> np.ndarray:
    """s = r - alpha v with alpha = rho / <r*, v>."""
    return r - rho / sigma * v.astype(np.float64)


def krylov_bicgstab(sums, rho, alpha, *vectors: np.ndarray) -> tuple[np.ndarray, ...]:
    """The next rho (k,), then x, r and p.

    `sums` are <t, s>, <t, t>, <r*, s> and <r*, t>, `vectors` s, t, v, p and x.
    """
    ts, tt, shadow_s, shadow_t = sums
    s, t, v, p, x = _float64(*vectors)
    omega = ts / tt
    next_rho = shadow_s - omega * shadow_t
    r = s - omega * t
    beta = next_rho / rho * alpha / omega
    x = x + alpha * p + omega * s
    p = r + beta * (p - omega * v)
    return next_rho, x, r, p


def bounded_look(lower, upper, x, g, h) -> np.ndarray:
    """Gap and z.h of every column, (2, k); bounds are (N,), the rest (N, k)."""
    lower, upper, x, g, h = _float64(lower[:, None], upper[:, None], x, g, h)
    gap = np.maximum(g * (x - lower), g * (x - upper))
    return np.stack([gap.sum(axis=0), (_free(lower, upper, x, g) * h).sum(axis=0)])


def bounded_direction(alpha, beta, lower, upper, x, g, d) -> tuple[np.ndarray, np.ndarray]:
    """d (N, k); then g.d, d.d and the largest share of the way to a bound per column, (3, k)."""
    lower, upper, x, g, d = _float64(lower[:, None], upper[:, None], x, g, d)
    z = _free(lower, upper, x, g)
    step = np.clip(x + alpha * np.where(z == 0, 0, z + beta * d), lower, upper) - x
    way = np.where(step > 0, upper, lower) - x
    share = np.divide(step, way, out=np.zeros_like(step), where=step != 0)
    return step, np.stack([(g * step).sum(axis=0), (step * step).sum(axis=0), share.max(axis=0)])


def bounded_move(step, lower, upper, d, x) -> np.ndarray:
    """x + step d, clipped, with (k,) steps."""
    return np.clip(np.asarray(x, np.float64) + step * d, lower[:, None], upper[:, None])


def _float64(*arrays: np.ndarray) -> list[np.ndarray]:
    return [np.asarray(array, np.float64) for array in arrays]


def _free(lower: np.ndarray, upper: np.ndarray, x: np.ndarray, g: np.ndarray) -> np.ndarray:
    """-g, 0 where x is at a bound and -g points out."""
    return np.where(((x <= lower) & (g > 0)) | ((x >= upper) & (g < 0)), 0.0, -g)


def wavelet_side(pixels: int, level: int, taps: np.ndarray) -> np.ndarray:
    """Orthonormal matrix that splits a side halved `level` times: approximation above details.

    What is regular goes round in a circle of its own, however often the filters wrap around it. The
    last sample stands for the pixels left over; joined to another by weights, it keeps a constant
    constant.
    """
    size = 2**level
    rest = pixels % 2**level
    n = -(-pixels // size)
    regular = pixels // size // 2
    half = (n + 1) // 2
    M = np.zeros((n, n))
    for m, t in itertools.product(range(regular), range(taps.shape[1])):
        M[[m, half + m], (2 * m + 1 - taps.shape[1] // 2 + t) % (2 * regular)] += taps[:, t]
    if half > regular and n % 2:
        M[half - 1, n - 1] = 1
    elif half > regular:
        weights = np.sqrt([size, rest]) / np.sqrt(size + rest)
        M[half - 1, n - 2 :] = weights
        M[n - 1, n - 2 :] = weights[::-1] * [1, -1]
    return M


def wavelet_split(grid: tuple[int, int], levels: int, taps: np.ndarray) -> np.ndarray:
    """W (N, N), from pictures of h x w pixels to their coefficients after all levels."""
    h, w = grid
    n = grid[0] * grid[1]
    W = np.eye(n).reshape(h, w, n)
    for level in range(levels):
        corner = np.s_[: -(-h // 2**level), : -(-w // 2**level)]
        down, across = (wavelet_side(side, level, taps) for side in grid)
        W[corner] = np.einsum("ij,jlk,ml->imk", down, W[corner], across, optimize=True)
    return W.reshape(n, n)


def wavelet_join(grid: tuple[int, int], levels: int, taps: np.ndarray) -> np.ndarray:
    """W^T, which is the inverse of an orthonormal W."""
    return wavelet_split(grid, levels, taps).T


def ordered_gather(order: np.ndarray, x: np.ndarray) -> np.ndarray:
    """x[order]."""
    return np.asarray(x, np.float64)[order]


def ordered_scatter(order: np.ndarray, x: np.ndarray, rows: int) -> np.ndarray:
    """Rows of x at their places among `rows` of zeros."""
    out = np.zeros((rows, *x.shape[1:]))
    out[order] = x
    return out


def frames_decode(
    codes: np.ndarray, table: np.ndarray, gain: float, background: np.ndarray
) -> np.ndarray:
    """Light to add, (pixels, channels), of whole-number codes (pixels, colours)."""
    return gain * np.asarray(table, np.float64)[codes] - background


def frames_between(target: np.ndarray, bounces: np.ndarray, share: float) -> np.ndarray:
    """Direct light of a frame in between, by the bounces that an earlier one takes off."""
    return np.asarray(target, np.float64) + share * bounces


def frames_light(factors: np.ndarray, direct: np.ndarray, mixing: np.ndarray) -> np.ndarray:
    """Projector light without bounds, (pixels, channels); 0 at masked pixels."""
    return np.where(factors == 0.0, 0.0, (factors * direct) @ mixing.T)


def frames_clip(light: np.ndarray, low: float, high: float, scales: np.ndarray) -> np.ndarray:
    """Unknowns of light within the bounds; scales are 0 at masked pixels."""
    return scales * np.clip(light, low, high)


def frames_encode(light: np.ndarray, low: float, high: float, thresholds: np.ndarray) -> np.ndarray:
    """Codes of light that is lit everywhere: places in an ascending list, one for all channels."""
    return np.searchsorted(thresholds, np.clip(light, low, high), side="right")


def frames_peaks(light: np.ndarray, high: float, shift: np.ndarray, span: int) -> np.ndarray:
    """The largest share of the way to `high` in each `span` of pixels, and 0 at least."""
    shares = np.maximum((light + shift) / (high + shift), 0.0).max(axis=1)
    return np.maximum.reduceat(shares, range(0, len(shares), span))


def pyramid_gather(x: np.ndarray) -> np.ndarray:
    """Sums of pictures (h, w, k) over cells of all levels, (cells, k), each from its pixels."""
    h, w, k = x.shape
    sizes = [2**level for level in range((max(h, w) - 1).bit_length() + 1)]
    rows = [np.add.reduceat(np.asarray(x, np.float64), range(0, h, size), axis=0) for size in sizes]
    cells = [
        np.add.reduceat(sums, range(0, w, size), axis=1)
        for sums, size in zip(rows, sizes, strict=True)
    ]
    return np.concatenate([sums.reshape(-1, k) for sums in cells])


def pyramid_spread(grid: tuple[int, int]) -> np.ndarray:
    """W^T (N, cells): pictures of cells, the transpose of pyramid_gather."""
    return pyramid_gather(np.eye(grid[0] * grid[1]).reshape(*grid, -1)).T


def hats_gather(grid: tuple[int, int]) -> np.ndarray:
    """W (nodes, N): the bilinear hats of all levels, from their formula."""
    h, w = grid
    rows, columns = np.indices(grid, float)
    hats = []
    height, width, scale = h, w, 1
    while True:
        for i in range(height):
            for j in range(width):
                vertical = np.maximum(1.0 - np.abs(rows / scale - i), 0.0)
                horizontal = np.maximum(1.0 - np.abs(columns / scale - j), 0.0)
                hats.append((vertical * horizontal).ravel())
        if max(height, width) <= 2:
            return np.array(hats)
        height, width, scale = height // 2 + 1, width // 2 + 1, 2 * scale


def colour_hats_scale(x: np.ndarray, inner: np.ndarray, mixing: np.ndarray) -> np.ndarray:
    """diag(inner) M x of planes x (3, N)."""
    return inner * (mixing @ x)


def colour_hats_rows(cores: np.ndarray, sums: np.ndarray) -> np.ndarray:
    """K of each colour, (3, nodes, nodes), times sums under hats (3, nodes)."""
    return np.einsum("cij,cj->ci", cores, sums)


def colour_hats_finish(W: np.ndarray, light: np.ndarray, outer: np.ndarray) -> np.ndarray:
    """diag(outer) W^T of the light (3, nodes) of the nodes of all levels."""
    return outer * (light @ W)


def patch_hats(grid: tuple[int, int], walls: int, detail: int) -> np.ndarray:
    """W (patches, N) of `PatchHats`, from its formula."""

    def along(pixels: int) -> np.ndarray:
        """Hats of one side of a wall, (patches, pixels)."""
        middles = np.arange(pixels // detail)[:, None]
        places = (np.arange(pixels) + 0.5) / detail - 0.5
        within = np.clip(places, 0, len(middles) - 1)
        return np.maximum(1.0 - np.abs(within - middles), 0.0)

    h, w = grid
    across = np.kron(np.eye(walls), along(w // walls))
    return np.kron(along(h), across)


def hats_spread(grid: tuple[int, int]) -> np.ndarray:
    """W^T (N, nodes): pictures of hats, the transpose of hats_gather."""
    return hats_gather(grid).T
