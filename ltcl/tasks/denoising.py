# SPDX-License-Identifier: BSD-3-Clause
"""Denoising of a measured T: reciprocal pairs averaged, wavelet coefficients and singular values shrunk.

1. The diagonal of a square T, the first bounce, stays as measured; it is left out of all that
   follows.
2. Reciprocity: T_ij d_j = T_ji d_i of a Lambertian scene. Errors of d are the largest of smooth
   pictures, so its fit is linear in T: logarithms of dim entries, as in
   `ltcl.transport.diagnostics`, have a bias, 12 % in d of a path-traced corner. d holds areas and
   irradiance, no albedo: what of its wavelet coefficients the covariance of the fit explains goes.
   In Z = D^-1/2 T D^1/2 both entries of a pair are the same light; they are averaged with weights 1
   / variance, unless sums of Z - Z^T between blocks exceed what noise explains, that of the model
   or of these entries, whichever is larger: gloss.
3. C = K Z K^T, K orthonormal multiwavelets of 1 to 4 vanishing moments (Alpert 1993) at a few
   random shifts, whose results are averaged (cycle spinning, Coifman and Donoho 1995). What is
   below 3 standard deviations goes; with this first estimate P of C the Wiener factor P^2 / (P^2 +
   variance) is applied to the measured C (Ghael, Sayeed and Baraniuk 1997), in bases that do not
   cross the folds between walls: of a reciprocal T in P's own singular vectors along rows and
   columns (De Lathauwer et al. 2000), then, by that estimate, in more multiwavelets. Where T is not
   reciprocal both are left out: they move light of bounces at low noise.
4. Between two walls, light depends on rows and on columns of the picture nearly as few products
   (Van Loan and Pitsianis 1993): singular values of entries in that order, (rows, rows') x
   (columns, columns'), are shrunk (Gavish and Donoho 2017) below those of the noise that step 3
   leaves, simulated. Left out where errors of neighbouring columns cancel, so that sums are known
   better than entries.
5. Negative entries become 0; between the same two blocks of pixels what is dim loses as much light.

Known limits: at low noise or few pixels most coefficients stand out; `bench/denoise.py` prints the
bound. Where d spans a factor of over 20, reciprocity is left out: errors of the fit would cost
bounces.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from itertools import pairwise, product
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from ltcl import checks
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Operator
from ltcl.transport.noise import Noise
from ltcl.transport.transport import Transport, check_transport

SHIFTS = 4, 6  # trees whose results are averaged; in the last estimate of a reciprocal T
THRESHOLD = 3.0  # standard deviations of a coefficient
_BLOCK = 4  # pixels along a side of a block
_EXCESS = (
    1.5  # of the variance of Z - Z^T between blocks over that of noise: the most of a reciprocal T
)
_STEPS, _SCALE, _FINE = (
    3,
    3.0,
    1e-4,
)  # of the fit of d; largest |log d|; least relative error of a pair
_FOLDS, _ALIKE = 3, 0.3  # along an axis at most; cosine of the light of neighbours across one
_ORDERS = (
    (0, 2, 1, 3),
    (0, 3, 1, 2),
)  # axes: rows with rows, columns with columns; rows with columns
_EDGE, _GLOSS = 0.8, 0.5  # of the largest singular value of noise, and where T is not reciprocal
_RANK = 96  # singular values of a large matrix
_ARRAYS = 15  # of the size of T, float32, at once

Grid = tuple[int, int]
Bases = list[tuple[np.ndarray, ...]]
Pair = tuple[np.ndarray, np.ndarray]
Step = Callable[[float], object]  # of the share that is done
Ends = list[list[int]]  # of parts of a picture, along its rows and columns


def denoise(T: Transport, *, progress: Callable[[str, float], object] | None = None) -> Transport:
    """T with less noise, by its noise model ``T.noise``.

    Parameters
    ----------
    T : Transport
        Of entries, (M, N), in 1 or 3 channels; without reciprocity where it is rectangular.
    progress : callable(text, share), optional

    Returns
    -------
    Transport
        float32, on the same grid, with the same first bounce, mixing and masked pixels, without
        negative entries off the diagonal. Its `noise` is that of T, scaled to the estimated error
        of a picture under white; the first bounce itself has that of T, and errors of neighbours
        are alike.

    Raises
    ------
    InputTypeError
        A compressed T, or one of operators.
    InputError
        3 x 3 blocks between colours.
    MemoryLimitError
        The host lacks memory for 15 arrays of float32 of the size of T.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.transport.noise import Noise
    >>> exact = ltcl.scenes.dihedral(8, albedo=0.6).transport().to_numpy()
    >>> error = 0.001 * numpy.random.default_rng(0).standard_normal(exact.shape)
    >>> T = ltcl.Transport(exact + error, (8, 16), noise=Noise.uniform(exact.shape, 0.001))
    >>> bool(numpy.linalg.norm(ltcl.denoise(T).to_numpy() - exact) < 0.5 * numpy.linalg.norm(error))
    True
    """
    check_transport(T, square=False)
    if T.blocks is not None:
        raise InputError("T has blocks between colours; denoise takes a T of 1 or 3 channels")
    for A in T.matrices:
        if isinstance(A, Operator) or not (isinstance(A, np.ndarray) or hasattr(A, "tocsr")):
            text = "it must be of arrays or sparse: denoise, then compress"
            raise InputTypeError(f"T is made of {type(A).__name__}; {text}")
    if progress is not None and not callable(progress):
        raise InputTypeError(f"progress is {progress!r}; it must be callable(text, share), or None")
    checks.fits_host("denoising", 4 * _ARRAYS * T.shape[0] * T.shape[1])
    noise, matrices, left = T.noise, [], np.ones(T.channels)

    def note(share: float) -> None:
        if progress is not None:
            progress("denoising", (len(matrices) + share / 2) / T.channels)

    for c, matrix in enumerate(T.matrices):
        Y = (matrix if isinstance(matrix, np.ndarray) else matrix.tocsr().toarray()).astype(
            np.float32
        )
        unit = np.float32(
            2.0 ** int(np.frexp(np.abs(Y).max(initial=0.0))[1])
        )  # squares fit into float32
        Y /= unit
        model = dataclasses.replace(noise, photons=noise.photons / unit, floor=noise.floor / unit)
        problem = Problem.of(Y, model, c, T.camera_grid, T.grid)
        pilot = shrink(problem, multiwavelets(problem.grids), None, note)[0]
        if problem.symmetric:
            pilot = shrink(problem, [own_basis(pilot, T.grid)], pilot)[0]
        estimate, error = refine(problem, pilot, lambda share: note(1.0 + share))
        white = (error / problem.gauge).sum(axis=1, dtype=float)
        estimate = problem.restore(estimate, Y)
        left[c] = white @ white / (model.variance(estimate, c).sum() or 1.0)
        matrices.append(unit * estimate)
    light = {
        "photons": noise.photons * left,
        "floor": noise.floor * np.sqrt(left),
        "neighbours": 0.0,
    }
    noise = dataclasses.replace(noise, **light)
    settings = {"device": T._requested_device, "mixing": T.mixing, "noise": noise}
    first = T.first_bounce if T.is_square else "diagonal"
    result = Transport(matrices, T.grid, first, T.camera_grid, dark_threshold=0.0, **settings)
    result.first_bounce_error = T.first_bounce_error
    return result


@dataclasses.dataclass(frozen=True)
class Problem:
    """Z = T `gauge` of a channel without its diagonal, (M, N) float32; gauge 1 where T is not reciprocal."""

    Z: np.ndarray
    variance: np.ndarray
    gauge: np.ndarray | float
    symmetric: bool
    grids: tuple[Grid, Grid]
    noise: Noise
    channel: int
    half: np.ndarray | None = None  # of the difference of both entries of a pair

    @classmethod
    def of(
        cls, Y: np.ndarray, noise: Noise, channel: int, camera_grid: Grid, grid: Grid
    ) -> Problem:
        """Of measured entries and their noise."""
        square, grids = camera_grid == grid, (camera_grid, grid)
        X = Y.copy()
        if square:
            np.fill_diagonal(X, 0.0)
        rows, columns = _blocks(camera_grid), _blocks(grid)
        sizes = np.outer(rows.sum(axis=0), columns.sum(axis=0))
        light = rows @ (rows.T @ X @ columns / sizes) @ columns.T  # of a block: hardly any noise
        V = noise.variance(light, channel).astype(np.float32)
        largest = float(np.abs(X).max(initial=0.0))
        if not square or largest == 0.0:
            return cls(X, V, 1.0, False, grids, noise, channel)
        log_d = _log_d(X, V, light, grid)
        r = np.exp(log_d / 2).astype(np.float32)
        gauge = r / r[:, None]
        Z, W = X * gauge, np.maximum(V * gauge**2, np.finfo(np.float32).tiny)
        between = np.triu_indices(rows.shape[1], 1)
        most = np.maximum(rows.T @ (W + W.T) @ rows, rows.T @ (Z - Z.T) ** 2 @ rows)[between]
        excess = (rows.T @ (Z - Z.T) @ rows)[between] ** 2 / np.maximum(
            most, np.finfo(np.float32).tiny
        )
        if np.ptp(log_d) > _SCALE or (len(excess) and excess.mean() > _EXCESS):
            return cls(X, V, 1.0, False, grids, noise, channel)
        mean, half = (
            (Z * W.T + Z.T * W) / (W + W.T),
            (Z - Z.T) / 2 if noise.neighbours[channel] else None,
        )
        return cls(mean, 1.0 / (1.0 / W + 1.0 / W.T), gauge, True, grids, noise, channel, half)

    def coefficients(self, Z: np.ndarray, basis: Any) -> Pair:
        """Of Z in a basis, and their variance: less where errors of neighbouring columns cancel."""
        C, V = _transform(Z, basis), _transform(self.variance, [A * A for A in basis])
        share = self.noise.relative_variance(basis[2:], self.channel)
        if self.symmetric:  # Z_ij is Z_ji: twice the variance on the diagonal
            np.einsum("ii->i", V)[:] *= 2.0
            if self.half is not None:
                C += _transform(self.half, basis) * (
                    (share[:, None] - share) / (share[:, None] + share)
                )
                V *= 2.0 * share * (share[:, None] / (share[:, None] + share))
        else:
            V *= share
        return C, V

    def restore(self, Z: np.ndarray, Y: np.ndarray) -> np.ndarray:
        """Entries of T, without negative ones, the diagonal of a square T as in Y."""
        if self.grids[0] == self.grids[1]:
            Z = Z - np.diag(np.diag(Z))
        rows, columns = map(_blocks, self.grids)
        bright = np.maximum(Z, 0.0)
        dim = np.minimum(bright, 3.0 * np.sqrt(self.variance))  # what may well be 0
        surplus, room = (rows.T @ A @ columns for A in (bright - Z, dim))
        share = np.minimum(surplus / np.maximum(room, np.finfo(np.float32).tiny), 1.0)
        T = (bright - dim * (rows @ share @ columns.T)) / self.gauge
        if self.grids[0] == self.grids[1]:
            np.fill_diagonal(T, np.diag(Y))
        return T


def shrink(
    problem: Problem, bases: Bases, pilot: np.ndarray | None, step: Step = lambda share: None
) -> Pair:
    """Z of less noise, (M, N), by thresholds without a `pilot`, and simulated noise after the last basis."""
    Z, noise = problem.Z, np.random.default_rng(0).standard_normal(problem.Z.shape, np.float32)
    if problem.symmetric:
        noise = (noise + noise.T) * np.float32(0.5**0.5)
    if pilot is not None and problem.grids[0] == problem.grids[1]:
        Z = Z + np.diag(np.diag(pilot))  # smooth where the first bounce was
    result = np.zeros(Z.shape, np.float32)
    for done, basis in enumerate(bases, 1):
        C, V = problem.coefficients(Z, basis)
        if pilot is None:
            C *= C * C > THRESHOLD**2 * V
        else:
            factor = _transform(np.maximum(pilot, 0.0), basis) ** 2
            factor /= np.maximum(factor + V, np.finfo(np.float32).tiny)
            C *= factor
            if done == len(bases):
                noise = _transform(noise * np.sqrt(factor * V), [A.T for A in basis])
        result += _transform(C, [A.T for A in basis])
        step(done / len(bases))
    return result / len(bases), noise


def refine(problem: Problem, pilot: np.ndarray, step: Step = lambda share: None) -> Pair:
    """Z and noise by Wiener factors of a `pilot` and products between walls, whose folds it shows."""
    ends = [_folds(pilot, problem.grids[0]), _folds(pilot.T, problem.grids[1])]
    pair = shrink(
        problem, multiwavelets(problem.grids, ends, SHIFTS[problem.symmetric]), pilot, step
    )
    if problem.noise.neighbours[
        problem.channel
    ]:  # sums are known better than few products keep them
        return pair
    walls, shape = [list(product(*map(pairwise, p))) for p in ends], sum(problem.grids, ())
    before, after = [X.reshape(shape) for X in pair], [np.empty(shape, np.float32) for _ in pair]
    for (p, to), (q, source) in product(*map(enumerate, walls)):
        block, mirror = (
            tuple(slice(*ends) for ends in pair) for pair in ((*to, *source), (*source, *to))
        )
        if problem.symmetric and q < p:
            values = [X[mirror].transpose(2, 3, 0, 1) for X in after]
        else:
            edge = _EDGE if problem.symmetric else _GLOSS
            values = _few_products(edge, *(X[block] for X in before))
        for X, value in zip(after, values, strict=True):
            X[block] = value
    return after[0].reshape(problem.Z.shape), after[1].reshape(problem.Z.shape)


def _few_products(lowest: float, X: np.ndarray, noise: np.ndarray) -> Pair:
    """X and its noise, (h, w, h', w'), by products in the best order, or as they are."""
    least, best = 1.0, (X, noise)
    for order in _ORDERS:
        shape = tuple(X.shape[axis] for axis in order)
        A, E = (Y.transpose(order).reshape(shape[0] * shape[1], -1) for Y in (X, noise))
        (U, S, V), of_noise, beta = _svd(A), _svd(E)[1], min(A.shape) / max(A.shape)
        most = 2.0 * of_noise > of_noise[0]
        level = min(
            1.0, float((S[most] / of_noise[most]).min(initial=1.0))
        )  # the model may state too much
        edge, power = lowest * level * of_noise[0], level**2 * float(np.vdot(E, E)) or 1.0
        k, (m, n) = int(np.sum(edge < S)), A.shape
        U, S, V = U[:, :k], S[:k], V[:k]
        dropped = float(np.vdot(A, A) - S @ S) / power - (m - k) * (n - k) / (
            m * n
        )  # light, not noise
        error = dropped + k * (m + n - k) / (m * n)
        if k == min(m, n, _RANK) or error >= least:
            continue
        x = (edge / ((1.0 + beta**0.5) * S)) ** 2
        S = S * np.sqrt(np.maximum((1.0 - (1.0 + beta) * x) ** 2 - 4.0 * beta * x**2, 0.0))
        EV = E @ V.T
        values = (U * S) @ V, U @ (U.T @ E) + (EV - U @ (U.T @ EV)) @ V
        least, best = error, tuple(Y.reshape(shape).transpose(np.argsort(order)) for Y in values)
    return best[0], best[1]


def _svd(A: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Singular values of A: all, or the largest by subspace iteration (Halko, Martinsson and Tropp 2011)."""
    if min(A.shape) <= 4 * _RANK:
        return np.linalg.svd(A, full_matrices=False)
    Q = A @ np.random.default_rng(0).standard_normal((A.shape[1], _RANK), np.float32)
    for _ in range(2):
        Q = A @ (A.T @ np.linalg.qr(Q)[0])
    Q = np.linalg.qr(Q)[0]
    U, S, V = np.linalg.svd(Q.T @ A, full_matrices=False)
    return Q @ U, S, V


def _folds(Z: np.ndarray, grid: Grid) -> Ends:
    """Ends of walls: where light, rows of Z, comes to neighbouring rows and columns from elsewhere."""
    ends = []
    for axis, size in enumerate(grid):
        A = np.moveaxis(Z.reshape(*grid, -1), axis, 0)
        power = np.einsum("ijk,ijk->i", A, A)
        common, norm = np.einsum("ijk,ijk->i", A[1:], A[:-1]), np.sqrt(power[1:] * power[:-1])
        alike = (common + (norm == 0.0)) / (norm + (norm == 0.0))  # where it is dark
        ends.append(
            [0, *sorted(1 + int(i) for i in np.argsort(alike)[:_FOLDS] if alike[i] < _ALIKE), size]
        )
    return ends


def _log_d(X: np.ndarray, V: np.ndarray, light: np.ndarray, grid: Grid) -> np.ndarray:
    """log d (N,) without what its errors explain, by steps e: Z_ij - Z_ji = Z_ij (e_i - e_j) + noise.

    Weights light / variance are smooth: those that follow the noise would move d. E: covariance of
    e.
    """
    bases, log_d, prior = (
        multiwavelets((grid, grid), count=SHIFTS[1]),
        np.zeros(len(X)),
        _SCALE**-2.0,
    )
    light = np.sqrt(np.maximum(light, 0.0) * np.maximum(light.T, 0.0))  # of Z, whatever d is
    for _ in range(_STEPS):
        r = np.exp(log_d / 2).astype(np.float32)
        Z, W = X * (r / r[:, None]), V * (r / r[:, None]) ** 2
        W += W.T
        weight = light / np.maximum(W, np.maximum((_FINE * light) ** 2, np.finfo(np.float32).tiny))
        pull, Z = weight * (Z - Z.T), np.maximum(Z + Z.T, 0.0) / 2
        weight *= np.where((Z - light) ** 2 > THRESHOLD**2 / 4 * W, Z, light)
        del Z, W
        degree = weight.sum(axis=1, dtype=float)
        E = degree.mean() / len(X) - weight.astype(float)  # one factor of all d is free
        np.einsum("ii->i", E)[:] += degree + prior
        E = np.linalg.inv(E)
        e = (E @ pull.sum(axis=1, dtype=float)).astype(np.float32)
        pull -= weight * (e[:, None] - e)
        excess = np.square(pull, out=pull).sum(dtype=float) / (degree.sum() or 1.0)
        fit, log_d = log_d + e, np.zeros(len(X))
        for basis in bases:
            c, v = _transform(fit, basis[:2]), max(1.0, excess) * np.diag(_transform(E, basis))
            log_d += _transform(c * (c * c > THRESHOLD**2 * v), [A.T for A in basis[:2]]) / len(
                bases
            )
        log_d = np.clip(log_d, -_SCALE, _SCALE)
    return log_d


def own_basis(light: np.ndarray, grid: Grid) -> tuple[np.ndarray, ...]:
    """Singular vectors of `light`, (N, N), along rows and columns of a picture, each wall by itself."""
    light, axes = np.maximum(light, 0.0), []
    for axis, ends in enumerate(_folds(light, grid)):
        A = np.moveaxis(light.reshape(*grid, -1), axis, 0).reshape(grid[axis], -1)
        axes.append(
            block_diag(*(np.linalg.eigh(A[a:b] @ A[a:b].T)[1].T for a, b in pairwise(ends)))
        )
    return (*axes, *axes)


def multiwavelets(
    grids: tuple[Grid, Grid], ends: list[Ends] | None = None, count: int = SHIFTS[0]
) -> Bases:
    """Bases of rows and columns of pictures, camera and projector, at random shifts, each wall by itself."""
    random, bases, least = np.random.default_rng(0), [], 1 if ends is None else 2
    pictures = ends or [[[0, size] for size in grid] for grid in grids]
    for number in range(count):
        order = least + number % (count // 2)  # vanishing moments
        axes = [
            block_diag(*(_multiwavelet(b - a, order, random.random()) for a, b in pairwise(e)))
            for e in (*pictures[0], *pictures[1])
        ]
        bases.append((*axes[:2], *axes[:2]) if pictures[0] == pictures[1] else tuple(axes))
    return bases


def _multiwavelet(n: int, moments: int, shift: float) -> np.ndarray:
    """Orthonormal rows (n, n) on intervals that halve, of lengths 2^k; the first begins `shift` n outside."""
    details, outside = [], int(shift * n)

    def scaling(start: int, length: int) -> np.ndarray:
        """Functions that hold all polynomials on an interval, (at most `moments`, n)."""
        if start >= n or start + length <= 0:
            return np.zeros((0, n))
        if length == 1:
            return np.eye(n)[start : start + 1]
        half = length // 2
        children = np.vstack([scaling(start, half), scaling(start + half, half)])
        x = (np.arange(n) - start) / length
        powers = np.stack([x**k for k in range(min(moments, len(children)))], axis=1)
        Q, _ = np.linalg.qr(children @ powers, "complete")
        details.append(Q.T[moments:] @ children)
        return Q.T[:moments] @ children

    top = scaling(-outside, 1 << (n + outside - 1).bit_length())
    return np.vstack([top, *details]).astype(np.float32)


def _transform(Z: np.ndarray, basis: Any) -> np.ndarray:
    """K Z K'^T, with K and K' the Kronecker products of the first and of the last two of `basis`."""
    shape = Z.shape
    for A in basis:
        Z = Z.reshape(A.shape[1], -1).T @ A.T  # the first axis becomes the last one
    return Z.reshape(shape)


def _blocks(grid: Grid) -> np.ndarray:
    """Which pixel is in which block, (pixels, blocks)."""
    rows, columns = (np.arange(size) // _BLOCK for size in grid)
    number = (rows[:, None] * (columns[-1] + 1) + columns).ravel()
    return (number[:, None] == np.arange(number[-1] + 1)).astype(np.float32)
