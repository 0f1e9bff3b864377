# SPDX-License-Identifier: BSD-3-Clause
"""Denoising of a measured T: reciprocal pairs averaged, wavelet coefficients shrunk by the noise model.

1. The diagonal of a square T, the first bounce, stays as measured; it is left out of all that follows.
2. Reciprocity: T_ij d_j = T_ji d_i of a Lambertian scene (`ltcl.diagnostics` fits d). In Z = D^-1/2 T D^1/2
   both entries of a pair are the same light; they are averaged with weights 1 / variance, unless sums of
   Z - Z^T between blocks of pixels exceed what the noise explains: a glossy scene, or another set-up.
3. C = K Z K^T, K orthonormal multiwavelets of 1 or 2 vanishing moments (Alpert 1993) on the trees of a few
   random shifts, whose results are averaged (cycle spinning, Coifman and Donoho 1995). What is below 3
   standard deviations goes; with this first estimate P of C the Wiener factor P^2 / (P^2 + variance) is
   applied to the measured C (Ghael, Sayeed and Baraniuk 1997). Sharp parts have large coefficients and stay.
4. Negative entries become 0; between the same two blocks of pixels what is dim loses as much light.

Known limit: where most coefficients stand out of the noise, at low noise or at few pixels, little is gained.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.diagnostics import log_scale
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Operator
from ltcl.transport import Transport, require

SHIFTS = 8  # trees whose results are averaged
THRESHOLD = 3.0  # standard deviations of a coefficient
_BLOCK = 4  # pixels along a side of a block
_EXCESS = 1.5  # of the variance of Z - Z^T between blocks over that of noise: the most of a reciprocal T
_SCALE = 3.0  # largest |log d|; beyond, d is fitted to noise
_ARRAYS = 16  # of the size of T, float32, at once

Grid = tuple[int, int]
Bases = list[tuple[np.ndarray, ...]]


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
        float32, on the same grid, with the same first bounce, mixing and masked pixels, without negative
        entries off the diagonal. Its `noise` is that of T, scaled to the estimated error of a picture under
        white; the first bounce itself has that of T, and errors of neighbours are alike.

    Raises
    ------
    InputTypeError
        A compressed T, or one of operators.
    InputError
        3 x 3 blocks between colours.
    MemoryLimitError
        The host lacks memory for 16 arrays of float32 of the size of T.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.noise import Noise
    >>> exact = ltcl.scenes.dihedral(8, albedo=0.6).transport().to_numpy()
    >>> error = 0.001 * numpy.random.default_rng(0).standard_normal(exact.shape)
    >>> T = ltcl.Transport(exact + error, (8, 16), noise=Noise.uniform(exact.shape, 0.001))
    >>> bool(numpy.linalg.norm(ltcl.denoise(T).to_numpy() - exact) < 0.5 * numpy.linalg.norm(error))
    True
    """
    require(T, square=False)
    if T.blocks is not None:
        raise InputError("T has blocks between colours; denoise takes a T of 1 or 3 channels")
    for A in T.matrices:
        if isinstance(A, Operator) or not (isinstance(A, np.ndarray) or hasattr(A, "tocsr")):
            kind = type(A).__name__
            raise InputTypeError(
                f"T is made of {kind}; it must be of arrays or sparse: denoise, then compress"
            )
    if progress is not None and not callable(progress):
        raise InputTypeError(f"progress is {progress!r}; it must be callable(text, share), or None")
    checks.fits_host("denoising", 4 * _ARRAYS * T.shape[0] * T.shape[1])
    noise, bases = T.noise, multiwavelets(T.camera_grid, T.grid)
    matrices, left = [], np.ones(T.channels)

    def note(done: int) -> None:
        if progress is not None:
            progress("denoising", (len(matrices) + done / (2 * SHIFTS)) / T.channels)

    for c, matrix in enumerate(T.matrices):
        Y = (matrix if isinstance(matrix, np.ndarray) else matrix.tocsr().toarray()).astype(np.float32)
        problem = Problem.of(Y, partial(noise.variance, channel=c), T.camera_grid, T.grid)
        pilot, _ = shrink(problem, bases, None, note)
        estimate, left[c] = shrink(problem, bases, pilot, lambda done: note(SHIFTS + done))
        matrices.append(problem.restore(estimate, Y))
    noise = dataclasses.replace(noise, photons=noise.photons * left, floor=noise.floor * np.sqrt(left))
    settings = {"device": T._requested_device, "mixing": T.mixing, "noise": noise}
    first = T.first_bounce if T.is_square else "diagonal"
    result = Transport(matrices, T.grid, first, T.camera_grid, dark=0.0, **settings)
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

    @classmethod
    def of(
        cls, Y: np.ndarray, variance: Callable[[np.ndarray], np.ndarray], camera_grid: Grid, grid: Grid
    ) -> Problem:
        """Of measured entries, and the variance of entries of so much light."""
        square, grids = camera_grid == grid, (camera_grid, grid)
        X = Y.copy()
        if square:
            np.fill_diagonal(X, 0.0)
        rows, columns = _blocks(camera_grid), _blocks(grid)
        sizes = np.outer(rows.sum(axis=0), columns.sum(axis=0))
        light = rows @ (_sums(X, rows, columns) / sizes) @ columns.T  # of a block: hardly any noise
        V = variance(light).astype(np.float32)
        largest = float(np.abs(X).max(initial=0.0))
        if not square or largest == 0.0:
            return cls(X, V, 1.0, False, grids)
        log_d = log_scale(scipy.sparse.csr_array(X / largest))
        r = np.exp(np.clip(log_d, -_SCALE, _SCALE) / 2).astype(np.float32)
        gauge = r / r[:, None]
        Z, W = X * gauge, np.maximum(V * gauge**2, np.finfo(np.float32).tiny)
        between = np.triu_indices(rows.shape[1], 1)
        excess = _sums(Z - Z.T, rows, rows)[between] ** 2 / _sums(W + W.T, rows, rows)[between]
        if len(excess) and excess.mean() > _EXCESS:
            return cls(X, V, 1.0, False, grids)
        mean = (Z * W.T + Z.T * W) / (W + W.T)
        return cls(mean, 1.0 / (1.0 / W + 1.0 / W.T), gauge, True, grids)

    def restore(self, Z: np.ndarray, Y: np.ndarray) -> np.ndarray:
        """Entries of T, without negative ones, the diagonal of a square T as in Y."""
        if self.grids[0] == self.grids[1]:
            Z = Z - np.diag(np.diag(Z))
        rows, columns = map(_blocks, self.grids)
        bright = np.maximum(Z, 0.0)
        dim = np.minimum(bright, 3.0 * np.sqrt(self.variance))  # what may well be 0
        surplus, room = _sums(bright - Z, rows, columns), _sums(dim, rows, columns)
        share = np.minimum(np.divide(surplus, room, out=np.zeros_like(room), where=room > 0.0), 1.0)
        T = (bright - dim * (rows @ share @ columns.T)) / self.gauge
        if self.grids[0] == self.grids[1]:
            np.fill_diagonal(T, np.diag(Y))
        return T


def shrink(
    problem: Problem,
    bases: Bases,
    pilot: np.ndarray | None,
    step: Callable[[int], object] = lambda done: None,
) -> tuple[np.ndarray, float]:
    """Z of less noise, (M, N), by thresholds without a `pilot`; and the share of the variance that is left.

    Of a picture under white: by Stein's unbiased estimate, or that of a Wiener filter where this is more.
    """
    Z = problem.Z
    if pilot is not None and problem.grids[0] == problem.grids[1]:
        Z = Z + np.diag(np.diag(pilot))  # smooth where the first bounce was
    result, sums = np.zeros(Z.shape, np.float32), np.zeros(3)
    for done, basis in enumerate(bases, 1):
        C = _transform(Z, basis)
        V = _transform(problem.variance, [A * A for A in basis])
        if problem.symmetric:  # Z_ij is Z_ji: twice the variance on the diagonal
            np.einsum("ii->i", V)[:] *= 2.0
        if pilot is None:
            factor = (C * C > THRESHOLD**2 * V).astype(np.float32)
        else:
            P = _transform(np.maximum(pilot, 0.0), basis) ** 2
            factor = P / np.maximum(P + V, np.finfo(np.float32).tiny)
        white = np.kron(basis[2].sum(axis=1), basis[3].sum(axis=1)) ** 2
        risks = (1.0 - factor) ** 2 * C * C + (2.0 * factor - 1.0) * V, factor * V, V
        sums += [float((risk @ white).sum()) for risk in risks]
        result += _transform(C * factor, [A.T for A in basis])
        step(done)
    result /= len(bases)
    return result, max(sums[:2]) / sums[2] if sums[2] else 1.0


def multiwavelets(camera_grid: Grid, grid: Grid, shifts: int = SHIFTS) -> Bases:
    """Bases of columns and rows of pictures of camera and projector, at random shifts."""
    random, bases = np.random.default_rng(0), []
    for number in range(shifts):
        rows, columns = (
            [_multiwavelet(n, 1 + number % 2, int(random.integers(n))) for n in g]
            for g in (camera_grid, grid)
        )
        bases.append((*(columns if camera_grid == grid else rows), *columns))
    return bases


def _multiwavelet(n: int, moments: int, shift: int) -> np.ndarray:
    """Orthonormal rows (n, n) on intervals that halve, of lengths 2^k, the first `shift` pixels outside."""
    details = []

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

    top = scaling(-shift, 1 << (n + shift - 1).bit_length())
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


def _sums(Z: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Between blocks."""
    return rows.T @ Z @ columns
