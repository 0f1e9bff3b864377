# SPDX-License-Identifier: BSD-3-Clause
"""Covariances of the light that the errors of a measured T make of a pattern.

A measured T (M, N) is the true one and an error E, whose entries have the variances v_ij of
`T.noise`. The errors E a and E b of camera pixel i under patterns a and b have the covariance

    q_ab = sum_j v_ij a_j b_j = rows_i (photons T (columns a b) + floor^2 columns . (a b))_i

with a and b as `Noise.filtered` has them. Rows that were made to add up to a measured white of
variance u have the covariance, with V = q_11 of the pattern 1,

    q_ab + (u / V - 1) q_a1 q_b1 / V
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ltcl.solvers import Inverse, solve
from ltcl.transport.noise import Noise
from ltcl.transport.transport import Transport

# Tolerance of solves, whose solutions are the smaller part of a variance.
SOLVE_RTOL = 0.05


class EntryErrors:
    """The errors E of the entries of T: variances of E a, and the light S^-1 E a that they become.

    `solve` and `products` are the only operations with T; a subclass may do them without a device.
    """

    def __init__(self, T: Transport, noise: Noise, inverse: Inverse | None = None) -> None:
        self.T = T
        self.noise = noise
        self.inverse = inverse

    def products(self, channel: int, patterns: np.ndarray) -> Any:
        """T of a channel times float32 patterns (N, k), or (3 N, k) of blocks."""
        T = self.T
        if T.is_square:
            F = np.atleast_2d(T.first_bounce)[channel]
            return T.systems[channel].matmat(F[:, None] * patterns)
        matrices = channel_matrices(T, channel)
        light = np.split(patterns, len(matrices))
        return sum(A @ x for A, x in zip(matrices, light, strict=True))

    def solve(self, channel: int, light: np.ndarray) -> np.ndarray:
        """S^-1 of light (N, k, draws), float64."""
        b = light.reshape(len(light), -1)
        if self.inverse is not None:
            solution = self.inverse.solve(b, channel)
        else:
            error = self.T.error
            rtol = max(SOLVE_RTOL, error) if error < 1.0 else SOLVE_RTOL
            solution = solve(self.T.systems[channel], b, rtol=rtol)
        return solution.x.astype(np.float64).reshape(light.shape)

    def diagonal_variance(self, channel: int) -> np.ndarray:
        """Variance (N,) of diag(E); (1,) zero for a T without S."""
        if not self.T.is_square:
            return np.zeros(1)
        return self.noise.diagonal(self.T.first_bounce)[channel] ** 2

    def variance(self, channel: int, squares: np.ndarray) -> np.ndarray:
        """sum_j v_ij squares_j, (M, k), of squares (N, k), or (3 N, k) of blocks."""
        T = self.T
        noise = self.noise
        block_count = len(channel_matrices(T, channel))
        columns = np.tile(noise.columns[channel], block_count)[:, None]
        light = np.zeros((T.shape[0], squares.shape[1]))
        light += noise.floor[channel] ** 2 * (columns.T @ squares)
        if noise.photons[channel] > 0.0:
            weighted = (columns * squares).astype(np.float32)
            light += noise.photons[channel] * self.products(channel, weighted)
        light *= noise.rows[channel][:, None]
        if T.is_square:
            light -= noise.less_direct(T.first_bounce)[channel][:, None] * squares
        return light

    def covariance(
        self, channel: int, patterns: np.ndarray, with_diagonal: bool = False
    ) -> np.ndarray:
        """Covariances (M, k, n, n) of E a for n patterns a (N, k, n); of diag(E) as one more."""
        n = patterns.shape[-1]
        has_white = np.isfinite(self.noise.white[channel])
        if has_white.any():
            white_pattern = np.ones((*patterns.shape[:2], 1))
            patterns = np.concatenate([patterns, white_pattern], axis=-1)
        q = self._independent_covariance(channel, patterns)
        if with_diagonal:
            q = self._append_diagonal(channel, q, patterns)
        if not has_white.any():
            return q
        return self._subtract_white(channel, q, n)

    def deviation(self, channel: int, pattern: np.ndarray) -> np.ndarray:
        """Standard deviation (M,) of the picture under one pattern (N,), or (3 N,) of blocks."""
        q = self.covariance(channel, pattern[:, None, None])
        return np.sqrt(np.maximum(q, 0.0))[:, 0, 0, 0]

    def _independent_covariance(self, channel: int, patterns: np.ndarray) -> np.ndarray:
        """Covariances (M, k, n, n) if rows do not add up to a measured white."""
        n = patterns.shape[-1]
        i, j = np.triu_indices(n)
        filtered = self.noise.filtered(patterns, self.T.grid, channel)
        products = filtered[..., i] * filtered[..., j]
        sums = self.variance(channel, products.reshape(len(products), -1))
        sums = sums.reshape(-1, *products.shape[1:])
        if self.noise.neighbours[channel] and self.T.is_square:
            # The first bounce has no part in its neighbours.
            direct = self.diagonal_variance(channel)[:, None, None]
            sums += direct * (patterns[..., i] * patterns[..., j] - products)
        q = np.zeros((*sums.shape[:2], n, n))
        q[..., i, j] = sums
        q[..., j, i] = sums
        return q

    def _append_diagonal(self, channel: int, q: np.ndarray, patterns: np.ndarray) -> np.ndarray:
        """`q` with diag(E) as its last row and column."""
        direct = self.diagonal_variance(channel)[:, None]
        extended = np.zeros((*q.shape[:2], q.shape[2] + 1, q.shape[3] + 1))
        extended[..., :-1, :-1] = q
        extended[..., -1, :-1] = direct[..., None] * patterns
        extended[..., :-1, -1] = direct[..., None] * patterns
        extended[..., -1, -1] = direct
        return extended

    def _subtract_white(self, channel: int, q: np.ndarray, white: int) -> np.ndarray:
        """`q` of rows that add up to a measured white; pattern 1, number `white`, is dropped."""
        white_variance = self.noise.white[channel]
        has_white = np.isfinite(white_variance)[:, None]
        V = q[..., white, white]
        change = np.where(has_white, white_variance[:, None], V) - V
        # Rows without noise have no share in that of white.
        shares = ratio(q[..., white, :], V[..., None])
        q += change[..., None, None] * shares[..., :, None] * shares[..., None, :]
        return np.delete(np.delete(q, white, axis=-1), white, axis=-2)


def entry_errors(T: Transport, noise: Noise, inverse: Inverse | None = None) -> EntryErrors:
    """The errors of T: several projectors know those of each."""
    errors_of = getattr(T, "errors_of", None)
    if errors_of is not None:
        return errors_of(noise, inverse)
    return EntryErrors(T, noise, inverse)


def channel_matrices(T: Transport, channel: int) -> Any:
    """The matrices whose light a channel of the camera sees: one, or three of blocks."""
    if T.blocks is None:
        return [T.matrices[channel]]
    return T.blocks[channel]


def ratio(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """a / b, broadcast; 0 where b is not above 0."""
    shape = np.broadcast_shapes(a.shape, b.shape)
    return np.divide(a, b, out=np.zeros(shape), where=b > 0)
