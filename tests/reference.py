# SPDX-License-Identifier: BSD-3-Clause
"""NumPy twins, in float64, of every OpenCL kernel, and how far float32 may stray from them.

A twin is named after its kernel; the `_stream` and `_group` variants of a kernel have the same twin.
"""

from __future__ import annotations

import itertools

import numpy as np
import scipy.sparse

UNIT = 2.0**-24  # largest relative error of rounding to float32
_LEAVES = 4096  # work-items among which the dot product spreads its rows, where there are that many


def csr_matvec(
    pointers: np.ndarray,
    columns: np.ndarray,
    values: np.ndarray,
    x: np.ndarray,
    scale: float = 1.0,
    add: np.ndarray | None = None,
) -> np.ndarray:
    """out = scale * (A x) + add, row by row; x is (N,) or (N, k)."""
    x, values = np.asarray(x, np.float64), np.asarray(values, np.float64)
    rows = itertools.pairwise(pointers)
    out = scale * np.array([values[start:stop] @ x[columns[start:stop]] for start, stop in rows])
    return out if add is None else out + add


def dense_matvec(
    matrix: np.ndarray, x: np.ndarray, scale: float = 1.0, add: np.ndarray | None = None
) -> np.ndarray:
    """out = scale * (A x) + add."""
    out = scale * (np.asarray(matrix, np.float64) @ np.asarray(x, np.float64))
    return out if add is None else out + add


def dense_rmatvec(
    matrix: np.ndarray, x: np.ndarray, scale: float = 1.0, add: np.ndarray | None = None
) -> np.ndarray:
    """out = scale * (A^T x) + add."""
    return dense_matvec(matrix.T, x, scale, add)


def vector_fill(count: int, value: float) -> np.ndarray:
    return np.full(count, np.float64(value))


def vector_axpby(a: float, x: np.ndarray, b: float, y: np.ndarray) -> np.ndarray:
    return a * np.asarray(x, np.float64) + b * np.asarray(y, np.float64)


def vector_axpby_columns(a: np.ndarray, x: np.ndarray, b: np.ndarray, y: np.ndarray) -> np.ndarray:
    """a_c x_c + b_c y_c in every column c of (N,) or (N, k), operands with coefficient 0 left out."""
    terms = [
        np.where(c == 0, 0.0, c * np.asarray(v, np.float64).reshape(len(v), -1)) for c, v in ((a, x), (b, y))
    ]
    return (terms[0] + terms[1]).reshape(x.shape)


def vector_scale_rows(d: np.ndarray, x: np.ndarray) -> np.ndarray:
    """diag(d) x with d (N,), x (N,) or (N, k)."""
    return (np.asarray(d, np.float64) * np.asarray(x, np.float64).T).T


def vector_dot(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """<x_c, y_c> of every column c, (k,)."""
    return np.atleast_1d(np.sum(np.asarray(x, np.float64) * np.asarray(y, np.float64), axis=0))


def vector_keep(
    weights: np.ndarray, squares: np.ndarray, slot: int, lowest: float, x: np.ndarray, best: np.ndarray
) -> np.ndarray:
    """x where the weighted residual of row `slot` is at most `lowest` and those before, all finite."""
    worst = np.max(np.float32(weights) * np.float32(squares[: slot + 1]), axis=1)  # NaN comes through
    whole = np.isfinite(worst[:-1]).all()
    return x if whole and worst[-1] <= min([np.float32(lowest), *worst[:-1]]) else best


def vector_triad(a: float, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    return vector_axpby(a, b, 1.0, c)


def relax_dense(
    M: np.ndarray,
    start: int,
    shift: float,
    scale: float,
    x: np.ndarray,
    y: np.ndarray,
    b: np.ndarray,
    carry: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """s, r and the next carry of all rows; S = shift I + scale M, times y before column `start`."""
    M, x, y = (np.asarray(values, np.float64) for values in (M, x, y))
    lower, upper = scale * (M[:, :start] @ y[:start]), shift * x + scale * (M[:, start:] @ x[start:])
    return b - lower - upper, carry - upper, b - lower


def relax_csr(pointers: np.ndarray, columns: np.ndarray, values: np.ndarray, *arguments):
    """The same of a sparse M."""
    n = len(pointers) - 1
    return relax_dense(
        scipy.sparse.csr_array((values, columns, pointers), shape=(n, n)).toarray(), *arguments
    )


def relax_substitute(
    S: np.ndarray, omega: float | None, before: int, start: int, stop: int, s: np.ndarray, delta: np.ndarray
) -> np.ndarray:
    """The delta of P_AA delta_A = s_A - S_AO delta_O: of relax_substitute, where O is empty, and the others.

    P is the triangle with D / omega, or S where omega is None.
    """
    own = np.asarray(S, np.float64)[start:stop, start:stop]
    P = own if omega is None else np.tril(own, -1) + np.diag(own.diagonal() / omega)
    return np.linalg.solve(P, s[start:stop] - S[start:stop, before:start] @ delta[before:start])


def block_gauss_seidel(
    S: np.ndarray, x: np.ndarray, b: np.ndarray, block: int, sweeps: int = 1
) -> np.ndarray:
    """Sweeps of block Gauss-Seidel as in a textbook, block after block in place."""
    x = np.array(x, np.float64)
    for _ in range(sweeps):
        for start in range(0, len(x), block):
            B = slice(start, start + block)
            x[B] += np.linalg.solve(S[B, B], b[B] - S[B] @ x)
    return x


def sor(S: np.ndarray, x: np.ndarray, b: np.ndarray, omega: float = 1.0, sweeps: int = 1) -> np.ndarray:
    """Sweeps of SOR as in a textbook, row after row in place; with omega = 1 of Gauss-Seidel."""
    x = np.array(x, np.float64)
    for _ in range(sweeps):
        for i in range(len(x)):
            x[i] += omega * (b[i] - S[i] @ x) / S[i, i]
    return x


def southwell_pick(
    rows: int, parts: int, shift: float, diagonal: np.ndarray, x: np.ndarray, r: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """x, r, picked and delta after one pick in each part; x and r are (N, k)."""
    edges = np.arange(parts + 1) * rows // parts
    picked = np.array([a + np.argmax(np.abs(r[a:b]), axis=0) for a, b in itertools.pairwise(edges)])
    here = (picked, np.arange(r.shape[1]))
    delta = r[here] / diagonal[picked]
    x, r = x.copy(), r.copy()
    x[here] += delta
    r[here] -= shift * delta
    return x, r, picked, delta


def southwell_dense(
    M: np.ndarray, scale: float, picked: np.ndarray, delta: np.ndarray, r: np.ndarray
) -> np.ndarray:
    """r - scale M[:, picked] delta, each right-hand side with its own."""
    columns = range(r.shape[1])
    return r - scale * np.stack([M[:, picked[:, c]] @ delta[:, c] for c in columns], axis=1)


def southwell_csr(pointers: np.ndarray, columns: np.ndarray, values: np.ndarray, *arguments):
    """The same with the sparse rows of M^T."""
    n = len(pointers) - 1
    return southwell_dense(
        scipy.sparse.csr_array((values, columns, pointers), shape=(n, n)).toarray().T, *arguments
    )


def form_factor_pair(
    p: np.ndarray, q: np.ndarray, n: np.ndarray, m: np.ndarray, clip: bool = True
) -> np.ndarray:
    """cos cos / (pi r^2) of all points p (M, 3) with normals n and points q (N, 3) with normals m: (M, N)."""
    d = q[None] - p[:, None]
    r2 = (d**2).sum(axis=2)
    here, there = np.einsum("mnc,mc->mn", d, n), -np.einsum("mnc,nc->mn", d, m)
    faces = (here > 1e-6) & (there > 1e-6) if clip else r2 > 0
    return np.divide(here * there, np.pi * r2**2, out=np.zeros_like(r2), where=faces)


def form_factor_pairs(G: np.ndarray, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """G_ij of listed pairs, (P,)."""
    return G[i, j]


def form_factor_entries(
    geometry: np.ndarray, blocks: np.ndarray, outer: float = 64, inner: float = 12
) -> np.ndarray:
    """G (N, N) of what the kernel reads: geometry (13, N), blocks (B, 6); see `kernels/form_factor.cl`."""
    centre, right, down, normal = (geometry[3 * k : 3 * k + 3].T.astype(np.float64) for k in range(4))
    angle = np.arange(8) * np.pi / 4
    place = np.sqrt(2 / 3) / 2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)  # on a circle, in edges
    points = [centre + u * right + v * down for u, v in place]

    def between(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return form_factor_pair(p, q, normal, normal) * ~blocked(p[:, None], q[None], blocks)

    eight = sum(between(points[k], points[3 * k % 8]) for k in range(8)) / 8
    one = between(centre, centre)
    # Half the second derivative along each edge times its variance, 1 / 12, by differences.
    curved, step = form_factor_pair(centre, centre, normal, normal, clip=False), 1e-2
    middle = curved.copy()
    for edge in (right, down):
        for end in (-step * edge, step * edge):
            curved += (form_factor_pair(centre + end, centre, normal, normal, clip=False) - middle) / (
                24 * step**2
            )
            curved += (form_factor_pair(centre, centre + end, normal, normal, clip=False) - middle) / (
                24 * step**2
            )
    curved *= ~blocked(centre[:, None], centre[None], blocks)
    d = centre[None] - centre[:, None]
    height = np.einsum("mnc,mc->mn", d, normal)
    rise = sum(np.abs(normal @ edge.T) for edge in (right, down)) / 2
    above, below = height + rise > 1e-6, height - rise < -1e-6
    r2, sizes = (d**2).sum(axis=2), geometry[12] + geometry[12][:, None]
    hard = (r2 < inner**2 * sizes) | below | below.T
    close = np.where(above & above.T, np.where(hard, eight, curved), 0.0)
    return np.where(r2 < outer**2 * sizes, close, one)


def form_factor_weigh(right: np.ndarray, x: np.ndarray) -> np.ndarray:
    """diag(right) x, each of k right-hand sides as a row: (k, N)."""
    return (right * np.asarray(x, np.float64).T).reshape(-1, len(right))


def form_factor_matvec(
    G: np.ndarray, left: np.ndarray, right: np.ndarray, x: np.ndarray, scale: float, add: np.ndarray | None
) -> np.ndarray:
    """out = scale * diag(left) G diag(right) x + add."""
    return dense_matvec(left[:, None] * G * right, x, scale, add)


def blocked(p: np.ndarray, q: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """Whether the way from p to q (..., 3) passes through a box (B, 6) given as centre and half sides.

    By slabs: the stretches of the way within each pair of faces have a part in common.
    """
    p, q = np.broadcast_arrays(np.asarray(p, np.float64), np.asarray(q, np.float64))
    result = np.zeros(p.shape[:-1], bool)
    for box in np.asarray(blocks, np.float64):
        low, high = box[:3] - box[3:], box[:3] + box[3:]
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (low - p) / (q - p), (high - p) / (q - p)
        along = q == p  # never leaves the slab, or never enters it
        inside = (low <= p) & (p <= high)
        enter = np.where(along, np.where(inside, -np.inf, np.inf), np.minimum(a, b)).max(axis=-1)
        leave = np.where(along, np.where(inside, np.inf, -np.inf), np.maximum(a, b)).min(axis=-1)
        result |= np.maximum(enter, 0) <= np.minimum(leave, 1)
    return result


def visibility_rows(
    starts: np.ndarray, ends: np.ndarray, normals: np.ndarray, blocks: np.ndarray
) -> np.ndarray:
    """Of the rays from starts to ends (rays, 3, N) before both normals (3, N), the share that meet no box."""
    faced, count = np.zeros((2, starts.shape[2], ends.shape[2]))
    for a, b in zip(starts.astype(np.float64), ends.astype(np.float64), strict=True):
        d = b.T[None] - a.T[:, None]
        facing = (np.einsum("mnc,cm->mn", d, normals) > 1e-6) & (np.einsum("mnc,cn->mn", d, normals) < -1e-6)
        faced += facing
        count += facing & ~blocked(a.T[:, None], b.T[None], blocks)
    return np.divide(count, faced, out=np.ones_like(count), where=faced > 0)


def visibility_pairs(i: np.ndarray, j: np.ndarray, *rays: np.ndarray) -> np.ndarray:
    """The same of listed pairs, (P,)."""
    starts, ends, normals, blocks = rays
    return visibility_rows(starts, ends, normals, blocks)[i, j]


def gamma(roundings: float) -> float:
    """Relative error of that many roundings in a row.

    Higham, Accuracy and Stability of Numerical Algorithms, 2nd ed., lemma 3.1.
    """
    return roundings * UNIT / (1.0 - roundings * UNIT)


def product_error(
    matrix: np.ndarray, x: np.ndarray, scale: float = 1.0, add: np.ndarray | None = None
) -> np.ndarray:
    """Largest error of float32 in each value of out = scale * (A x) + add, in whatever order it sums.

    A sum of n products passes through n roundings at most, `scale` and `add` bring two each and a composed
    operator a few more: gamma_(n + 8) (|scale| |A| |x| + |add|), Higham, section 3.5.
    """
    magnitude = abs(scale) * (np.abs(np.asarray(matrix, np.float64)) @ np.abs(np.asarray(x, np.float64)))
    if add is not None:
        magnitude = magnitude + np.abs(add)
    return gamma(matrix.shape[1] + 8) * magnitude


def dot_error(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Largest error of float32 in `vector_dot` by trees, (k,).

    Each work-item sums its rows in turn, then two trees add up the items and the groups: the number of
    roundings a product passes through grows with rows / 4096, not with rows.
    """
    roundings = np.ceil(len(x) / _LEAVES) + 2 * np.log2(_LEAVES) + 2
    return gamma(roundings) * vector_dot(np.abs(x), np.abs(y))


def bounded_look(
    lower: np.ndarray, upper: np.ndarray, x: np.ndarray, g: np.ndarray, d: np.ndarray, h: np.ndarray
) -> np.ndarray:
    """Gap, z.z, z.h and z.d of every column, (4, k); bounds are (N,), the rest (N, k)."""
    lower, upper, x, g, d, h = (np.asarray(part, np.float64) for part in (lower, upper, x, g, d, h))
    lower, upper = lower[:, None], upper[:, None]
    z = _free(lower, upper, x, g)
    gap = np.maximum(g * (x - lower), g * (x - upper))
    return np.stack([part.sum(axis=0) for part in (gap, z * z, z * h, z * d)])


def bounded_direction(
    alpha: np.ndarray,
    beta: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    x: np.ndarray,
    g: np.ndarray,
    d: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """d (N, k); then g.d, d.d and the largest share of the way to a bound of every column, (3, k)."""
    lower, upper, x, g, d = (np.asarray(part, np.float64) for part in (lower, upper, x, g, d))
    lower, upper = lower[:, None], upper[:, None]
    z = _free(lower, upper, x, g)
    step = np.clip(x + alpha * np.where(z == 0, 0, z + beta * d), lower, upper) - x
    way = np.where(step > 0, upper, lower) - x
    share = np.divide(step, way, out=np.zeros_like(step), where=step != 0)
    return step, np.stack([(g * step).sum(axis=0), (step * step).sum(axis=0), share.max(axis=0)])


def bounded_move(
    step: np.ndarray, lower: np.ndarray, upper: np.ndarray, d: np.ndarray, x: np.ndarray
) -> np.ndarray:
    """x + step d, clipped, with (k,) steps."""
    return np.clip(np.asarray(x, np.float64) + step * d, lower[:, None], upper[:, None])


def _free(lower: np.ndarray, upper: np.ndarray, x: np.ndarray, g: np.ndarray) -> np.ndarray:
    """-g, 0 where x is at a bound and -g points out."""
    return np.where(((x <= lower) & (g > 0)) | ((x >= upper) & (g < 0)), 0.0, -g)
