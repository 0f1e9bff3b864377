# SPDX-License-Identifier: BSD-3-Clause
"""Light between two walls as a sum of few products (Van Loan and Pitsianis 1993).

Between walls of (h, w) and (h', w') pixels, light depends on rows and on columns of the picture
nearly as few products: unfolded as (rows, rows') x (columns, columns'), T has few large singular
values. Those are shrunk (Gavish and Donoho, Optimal shrinkage of singular values, 2017) below the
largest singular value of the noise that is left, which is simulated.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ltcl.tasks.denoising.multiwavelets import Grid, WallEnds

# Orders of the axes (rows, columns, rows', columns') before unfolding: rows with rows' against
# columns with columns', and rows with columns' against columns with rows'.
AXIS_ORDERS = ((0, 2, 1, 3), (0, 3, 1, 2))
# Of the largest singular value of noise: singular values below are dropped.
EDGE_SHARE = 0.8
# The same where T is not reciprocal, whose gloss has many small singular values.
EDGE_SHARE_OF_GLOSS = 0.5
# Singular values of a large matrix that are computed.
MAX_RANK = 96

# A wall in a picture: its rows and its columns.
Wall = tuple[slice, slice]


@dataclass(frozen=True, kw_only=True)
class LowRankFit:
    """The `rank` singular triplets U (m, rank), S, Vt (rank, n) of a matrix that exceed `edge`.

    `error` is the mean square error left by the fit, over the variance of the noise before it.
    """

    U: np.ndarray
    S: np.ndarray
    Vt: np.ndarray
    edge: float
    error: float
    has_all_values: bool

    def shrunk_matrix(self) -> np.ndarray:
        """The matrix with optimally shrunk singular values, (m, n)."""
        m, n = len(self.U), self.Vt.shape[1]
        beta = min(m, n) / max(m, n)
        x = (self.edge / ((1.0 + beta**0.5) * self.S)) ** 2
        factor = (1.0 - (1.0 + beta) * x) ** 2 - 4.0 * beta * x**2
        S = self.S * np.sqrt(np.maximum(factor, 0.0))
        return (self.U * S) @ self.Vt

    def project_noise(self, E: np.ndarray) -> np.ndarray:
        """The part of noise E, (m, n), that stays: U U^T E + (I - U U^T) E V V^T."""
        in_columns = self.U @ (self.U.T @ E)
        EV = E @ self.Vt.T
        outside = EV - self.U @ (self.U.T @ EV)
        return in_columns + outside @ self.Vt


def shrink_wall_products(
    Z: np.ndarray,
    noise: np.ndarray,
    *,
    grids: tuple[Grid, Grid],
    folds: tuple[WallEnds, WallEnds],
    is_reciprocal: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Z and its noise, (M, N), as few products between each two walls of both pictures."""
    camera_grid, grid = grids
    pictures = (*camera_grid, *grid)
    Z_before = Z.reshape(pictures)
    noise_before = noise.reshape(pictures)
    Z_after = np.empty(pictures, np.float32)
    noise_after = np.empty(pictures, np.float32)
    camera_walls = _walls(folds[0])
    projector_walls = _walls(folds[1])
    edge_share = EDGE_SHARE if is_reciprocal else EDGE_SHARE_OF_GLOSS
    for i, camera_wall in enumerate(camera_walls):
        for j, projector_wall in enumerate(projector_walls):
            block = (*camera_wall, *projector_wall)
            if is_reciprocal and j < i:
                # Z is symmetric, and the mirrored block is already there.
                mirror = (*projector_wall, *camera_wall)
                Z_after[block] = Z_after[mirror].transpose(2, 3, 0, 1)
                noise_after[block] = noise_after[mirror].transpose(2, 3, 0, 1)
                continue
            light, remaining = _shrink_block(Z_before[block], noise_before[block], edge_share)
            Z_after[block] = light
            noise_after[block] = remaining
    return Z_after.reshape(Z.shape), noise_after.reshape(Z.shape)


def _walls(ends: WallEnds) -> list[Wall]:
    row_ends, column_ends = ends
    walls = []
    for top, bottom in pairwise(row_ends):
        for left, right in pairwise(column_ends):
            walls.append((slice(top, bottom), slice(left, right)))
    return walls


def _shrink_block(
    X: np.ndarray, noise: np.ndarray, edge_share: float
) -> tuple[np.ndarray, np.ndarray]:
    """X and its noise, (h, w, h', w'), as products in the better order, or as they are."""
    best_X = X
    best_noise = noise
    least_error = 1.0
    for order in AXIS_ORDERS:
        A = _unfold(X, order)
        E = _unfold(noise, order)
        fit = _fit_low_rank(A, E, edge_share)
        if fit.has_all_values or fit.error >= least_error:
            continue
        least_error = fit.error
        best_X = _fold(fit.shrunk_matrix(), X.shape, order)
        best_noise = _fold(fit.project_noise(E), X.shape, order)
    return best_X, best_noise


def _unfold(X: np.ndarray, order: tuple[int, ...]) -> np.ndarray:
    """X (h, w, h', w') as a matrix of its first two axes in `order` by its last two."""
    ordered = X.transpose(order)
    return ordered.reshape(ordered.shape[0] * ordered.shape[1], -1)


def _fold(matrix: np.ndarray, shape: tuple[int, ...], order: tuple[int, ...]) -> np.ndarray:
    """The inverse of `_unfold`."""
    ordered_shape = [shape[axis] for axis in order]
    return matrix.reshape(ordered_shape).transpose(np.argsort(order))


def _fit_low_rank(A: np.ndarray, E: np.ndarray, edge_share: float) -> LowRankFit:
    """The singular values of A, (m, n), that stand out of those of the noise E."""
    m, n = A.shape
    U, S, Vt = _largest_singular_triplets(A)
    _, noise_values, _ = _largest_singular_triplets(E)
    # The noise model may state too much: no large singular value of A is below that of its noise.
    is_large = 2.0 * noise_values > noise_values[0]
    ratios = S[is_large] / noise_values[is_large]
    level = min(1.0, float(ratios.min(initial=1.0)))
    edge = edge_share * level * noise_values[0]
    noise_power = level**2 * float(np.vdot(E, E))
    if noise_power == 0.0:
        noise_power = 1.0

    rank = int(np.sum(edge < S))
    U = U[:, :rank]
    S = S[:rank]
    Vt = Vt[:rank]
    # What is dropped is light where it is more than the noise outside of both subspaces.
    dropped_power = float(np.vdot(A, A) - S @ S) / noise_power
    dropped_light = dropped_power - (m - rank) * (n - rank) / (m * n)
    error = dropped_light + rank * (m + n - rank) / (m * n)
    return LowRankFit(
        U=U,
        S=S,
        Vt=Vt,
        edge=edge,
        error=error,
        has_all_values=rank == min(m, n, MAX_RANK),
    )


def _largest_singular_triplets(A: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """U, S and V^T of A, all or the largest.

    The largest are found by subspace iteration (Halko, Martinsson and Tropp 2011).
    """
    if min(A.shape) <= 4 * MAX_RANK:
        return np.linalg.svd(A, full_matrices=False)
    Q = A @ np.random.default_rng(0).standard_normal((A.shape[1], MAX_RANK), np.float32)
    for _ in range(2):
        Q, _ = np.linalg.qr(Q)
        Q = A @ (A.T @ Q)
    Q, _ = np.linalg.qr(Q)
    U, S, Vt = np.linalg.svd(Q.T @ A, full_matrices=False)
    return Q @ U, S, Vt
