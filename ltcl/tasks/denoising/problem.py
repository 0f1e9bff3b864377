# SPDX-License-Identifier: BSD-3-Clause
"""A channel of a noisy T as a denoising problem: entries Z with their variances, (M, N) float32.

In a reciprocal scene Z = D^-1/2 T D^1/2 is symmetric, and both entries of a pair are averaged with
weights 1 / variance. Else Z is T. The diagonal of a square T is 0 in Z.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ltcl.tasks.denoising.multiwavelets import Grid, SeparableBasis
from ltcl.tasks.denoising.reciprocity import MAX_LOG_FACTOR, TINY, fit_log_factors, pair_gauge
from ltcl.transport.noise import Noise

# Pixels along a side of a block, whose mean light has hardly any noise.
BLOCK_SIDE = 4
# Variance of Z - Z^T between blocks, at most, over that of noise, if the scene is reciprocal.
MAX_RECIPROCITY_EXCESS = 1.5
# Standard deviations, and photons, from which on an entry, or a pair, stands out.
OUTSTANDING = 6.0
# Times that d is fitted, without the pairs that stand out.
PAIR_PASSES = 3
# Standard deviations up to which an entry may well be 0.
DIM_DEVIATIONS = 3.0


@dataclass(frozen=True, kw_only=True)
class DenoisingProblem:
    """A channel of T to be denoised.

    Attributes
    ----------
    Z, variance : (M, N) float32
        Entries T * gauge without the diagonal of a square T, and their variance.
    gauge : (N, N) float32, or 1 where T is not reciprocal
    is_reciprocal : bool
        True if Z is symmetric.
    camera_grid, grid : (h, w)
    noise : Noise
    channel : int
    half_difference : (N, N) float32, optional
        (Z - Z^T) / 2 as measured, where errors of neighbouring columns cancel, so that one entry
        of a pair may be known better than the other in some coefficients.
    is_outstanding : (M, N) bool
        Entries that no noise explains beside their neighbours, as of dead pixels or small shadows.
        They stay as measured.
    """

    Z: np.ndarray
    variance: np.ndarray
    gauge: np.ndarray | float
    is_reciprocal: bool
    camera_grid: Grid
    grid: Grid
    noise: Noise
    channel: int
    is_outstanding: np.ndarray
    half_difference: np.ndarray | None = None

    @classmethod
    def from_entries(
        cls,
        Y: np.ndarray,
        noise: Noise,
        channel: int,
        camera_grid: Grid,
        grid: Grid,
        may_be_reciprocal: bool = True,
    ) -> DenoisingProblem:
        """Fit reciprocity to the measured entries Y, (M, N) float32."""
        is_square = camera_grid == grid
        X = Y.copy()
        if is_square:
            np.fill_diagonal(X, 0.0)
        light = _light_of_blocks(X, camera_grid, grid)
        variance = noise.variance(light, channel).astype(np.float32)
        without_reciprocity = cls(
            Z=X,
            variance=variance,
            gauge=1.0,
            is_reciprocal=False,
            camera_grid=camera_grid,
            grid=grid,
            noise=noise,
            channel=channel,
            is_outstanding=np.zeros(X.shape, bool),
        )
        if not (is_square and may_be_reciprocal and X.any()):
            return without_reciprocity

        pairs = X
        passes = 0
        while True:
            log_d = fit_log_factors(pairs, variance, light, grid)
            if np.ptp(log_d) > MAX_LOG_FACTOR:
                return without_reciprocity
            gauge = pair_gauge(log_d)
            Z = X * gauge
            Z_variance = np.maximum(variance * gauge**2, TINY)
            photon = _photon_light(noise, channel) * gauge
            pair_deviation = np.sqrt(Z_variance + Z_variance.T) + photon + photon.T
            is_unlike = np.abs(Z - Z.T) > OUTSTANDING * pair_deviation
            passes += 1
            if passes == PAIR_PASSES or not is_unlike.any():
                break
            # Such pairs say nothing of d.
            pairs = np.where(is_unlike, (Z + Z.T) / 2 / gauge, X)
        if _is_glossy(Z, Z_variance, grid):
            return without_reciprocity

        pair_variance = Z_variance + Z_variance.T
        mean = (Z * Z_variance.T + Z.T * Z_variance) / pair_variance
        half_difference = None
        if noise.neighbours[channel]:
            half_difference = (Z - Z.T) / 2
        return cls(
            Z=mean,
            variance=1.0 / (1.0 / Z_variance + 1.0 / Z_variance.T),
            gauge=gauge,
            is_reciprocal=True,
            camera_grid=camera_grid,
            grid=grid,
            noise=noise,
            channel=channel,
            half_difference=half_difference,
            is_outstanding=is_unlike,
        )

    @property
    def grids(self) -> tuple[Grid, Grid]:
        """Grids of camera and projector."""
        return self.camera_grid, self.grid

    @property
    def has_cancelling_errors(self) -> bool:
        """True if errors of neighbouring columns cancel: sums are known better than entries."""
        return bool(self.noise.neighbours[self.channel])

    def coefficients(self, Z: np.ndarray, basis: SeparableBasis) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients of Z and their variances, less where errors of neighbours cancel."""
        C = basis.forward(Z)
        variance = basis.forward_variance(self.variance)
        share = self.noise.relative_variance(basis.projector, self.channel)
        if not self.is_reciprocal:
            variance *= share
            return C, variance
        # Z_ij is Z_ji: twice the variance on the diagonal.
        np.einsum("ii->i", variance)[:] *= 2.0
        if self.half_difference is not None:
            # C_ij and C_ji have the shares of their columns, and get the weights 1 / share.
            row_share = share[:, None]
            total = row_share + share
            C += basis.forward(self.half_difference) * ((row_share - share) / total)
            variance *= 2.0 * share * (row_share / total)
        return C, variance

    def without_outstanding(self, pilot: np.ndarray) -> DenoisingProblem:
        """The problem with `pilot` in the place of entries that stand out of it."""
        photon = _photon_light(self.noise, self.channel) * self.gauge
        deviation = np.sqrt(self.variance) + photon
        is_outstanding = np.abs(self.Z - pilot) > OUTSTANDING * deviation
        is_outstanding |= self.is_outstanding
        if self.is_square:
            np.fill_diagonal(is_outstanding, False)
        Z = np.where(is_outstanding, pilot, self.Z)
        return replace(self, Z=Z, is_outstanding=is_outstanding)

    @property
    def is_square(self) -> bool:
        """True if T has a diagonal, the first bounce."""
        return self.camera_grid == self.grid

    def restore_entries(self, Z: np.ndarray, Y: np.ndarray) -> np.ndarray:
        """Entries of T without negative ones; the diagonal of a square T is that of Y."""
        if self.is_square:
            Z = Z - np.diag(np.diag(Z))
        # Negative entries become 0; dim entries of the same blocks lose the light that adds.
        not_negative = np.maximum(Z, 0.0)
        dim = np.minimum(not_negative, DIM_DEVIATIONS * np.sqrt(self.variance))
        camera_blocks = block_membership(self.camera_grid)
        projector_blocks = block_membership(self.grid)
        surplus = camera_blocks.T @ (not_negative - Z) @ projector_blocks
        available = camera_blocks.T @ dim @ projector_blocks
        share = np.minimum(surplus / np.maximum(available, TINY), 1.0)
        T = (not_negative - dim * (camera_blocks @ share @ projector_blocks.T)) / self.gauge
        T = np.where(self.is_outstanding, np.maximum(Y, 0.0), T)
        if self.is_square:
            np.fill_diagonal(T, np.diag(Y))
        return T


def _light_of_blocks(X: np.ndarray, camera_grid: Grid, grid: Grid) -> np.ndarray:
    """Mean light between the blocks of each entry, (M, N)."""
    camera_blocks = block_membership(camera_grid)
    projector_blocks = block_membership(grid)
    sizes = np.outer(camera_blocks.sum(axis=0), projector_blocks.sum(axis=0))
    means = camera_blocks.T @ X @ projector_blocks / sizes
    return camera_blocks @ means @ projector_blocks.T


def _photon_light(noise: Noise, channel: int) -> np.ndarray:
    """Light of one photon, (M, N): entries of few photons deviate by one of them."""
    photons = noise.photons[channel] * noise.rows[channel]
    return np.outer(photons, noise.columns[channel]).astype(np.float32)


def _is_glossy(Z: np.ndarray, variance: np.ndarray, grid: Grid) -> bool:
    """True if sums of Z - Z^T between blocks exceed noise, by the model and by these entries."""
    blocks = block_membership(grid)
    pairs = np.triu_indices(blocks.shape[1], 1)
    of_model = blocks.T @ (variance + variance.T) @ blocks
    of_entries = blocks.T @ (Z - Z.T) ** 2 @ blocks
    explained = np.maximum(of_model, of_entries)[pairs]
    differences = (blocks.T @ (Z - Z.T) @ blocks)[pairs]
    excess = differences**2 / np.maximum(explained, TINY)
    return len(excess) > 0 and bool(excess.mean() > MAX_RECIPROCITY_EXCESS)


def block_membership(grid: Grid) -> np.ndarray:
    """Matrix (pixels, blocks) of ones where a pixel is in a block."""
    height, width = grid
    rows = np.arange(height) // BLOCK_SIDE
    columns = np.arange(width) // BLOCK_SIDE
    blocks_per_row = columns[-1] + 1
    number = (rows[:, None] * blocks_per_row + columns).ravel()
    return (number[:, None] == np.arange(number[-1] + 1)).astype(np.float32)
