# SPDX-License-Identifier: BSD-3-Clause
"""Decision whether pictures of a denoised T are nearer to the truth than those of the measured one.

With measured entries Y, denoised D, and errors of Y of known variance, Stein's unbiased estimate of
the squared error of a picture D p, over that of Y p, is

    |Y p - D p|^2 / V - 1 + 2 C / V

with the variance V of Y p, and the covariance C of D p with the errors of Y p (Stein, Estimation of
the mean of a multivariate normal distribution, 1981). C is measured on the whole way from Y to D,
the fit of reciprocity included: noise that is added to Y moves D as that of Y itself does (Ramani,
Blu and Unser, Monte-Carlo SURE, 2008).

A noise that was estimated from T alone may be wrong, and the entries judge it: if Y - D were noise
alone, its variance would be 1 - r of that of Y, with the share r of noise that stays in entries of
D. That counts in the place of the noise model, within NOISE_MARGIN.

What is removed must look like noise, whatever the model says: sums of Y - D over each row, and over
each column, must not be larger than those of blocks of independent signs. Light that was taken for
noise, as the gains of projector pixels or of dim walls, has one sign along its row or column, and
bounces, which have no such estimate, would lose it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ltcl.tasks.denoising.multiwavelets import Grid
from ltcl.tasks.denoising.problem import block_membership
from ltcl.transport.noise import Noise

# Factor within which an estimated noise is right.
NOISE_MARGIN = 1.25
# Standard deviations of the estimated risk that the gain must exceed.
GAIN_SIGMAS = 3.0
# Standard deviation of added noise, in those of the noise of T: less meets too few thresholds.
ADDED_NOISE = 0.5
# Camera pixels times probes, at least: fewer leave the share of noise that stays to chance.
PROBED_PIXELS = 256
# Share of the noise of entries that is removed, at least.
MIN_REMOVED_SHARE = 0.05
# Standard deviations by which sums of removed noise may exceed those of independent blocks.
STRUCTURE_SIGMAS = 3.0
# Random patterns of each kind.
PATTERNS = 4
# Waves across a smooth pattern, at most.
MAX_WAVES = 2.0
# Side of a lit patch, as a part of that of the picture.
PATCH_SIDE = 0.25


@dataclass(frozen=True, kw_only=True)
class NoiseProbe:
    """Noise `added` to measured entries, and the `change` of denoised ones by it, (M, N) each."""

    added: np.ndarray
    change: np.ndarray


def probe_count(rows: int) -> int:
    """Number of probes that tell how much noise stays, for pictures of so many rows of T."""
    return max(1, -(-PROBED_PIXELS // rows))


def noise_to_add(
    variance: np.ndarray, noise: Noise, grid: Grid, channel: int, seed: int
) -> np.ndarray:
    """Random noise (M, N) float32 like that of entries with this variance, but smaller."""
    normal = np.random.default_rng(seed).standard_normal(variance.shape, np.float32)
    normal = noise.filtered(np.ascontiguousarray(normal.T), grid, channel).T
    return (ADDED_NOISE * np.sqrt(variance) * normal).astype(np.float32)


def _share_in_pictures(probes: Sequence[NoiseProbe], patterns: np.ndarray) -> float:
    """The share C / V of noise that stays in pictures under patterns (N, k)."""
    stays = 0.0
    power = 0.0
    for probe in probes:
        added = probe.added @ patterns
        stays += float(np.vdot(added, probe.change @ patterns))
        power += float(np.vdot(added, added))
    return stays / power if power > 0.0 else 0.0


def _share_in_entries(probes: Sequence[NoiseProbe]) -> float:
    """The share of noise that stays in entries."""
    stays = sum(float(np.vdot(probe.added, probe.change)) for probe in probes)
    power = sum(float(np.vdot(probe.added, probe.added)) for probe in probes)
    return stays / power if power > 0.0 else 0.0


def max_risk(rows: int) -> float:
    """Largest `picture_risk` that shows a gain; errors of so many `rows` are known so well."""
    return 1.0 - GAIN_SIGMAS * (2.0 / rows) ** 0.5


def picture_risk(
    Y: np.ndarray,
    D: np.ndarray,
    variance: np.ndarray,
    probes: Sequence[NoiseProbe],
    filtered: Callable[[np.ndarray], np.ndarray],
    grid: Grid,
    noise_margin: float,
) -> float:
    """Estimated squared error of pictures by D over that by Y, for the worst kind of patterns.

    `variance` is that of Y within a factor `noise_margin` of deviations; all (M, N). `filtered`
    gives patterns (N, k) as independent errors see them. 0 if T has no noise.
    """
    removed_share = max(1.0 - _share_in_entries(probes), MIN_REMOVED_SHARE)
    moved = Y.astype(np.float64) - D
    largest = 0.0
    for patterns in _patterns(grid):
        squares = filtered(patterns) ** 2
        stated = float(np.sum(variance @ squares))
        if stated == 0.0:
            continue
        shown = float(np.sum(moved**2 @ squares)) / removed_share
        V = np.clip(shown, stated / noise_margin**2, stated * noise_margin**2)
        change = np.sum((moved @ patterns) ** 2) / V
        risk = change - 1.0 + 2.0 * _share_in_pictures(probes, patterns)
        largest = max(largest, float(risk))
    return largest


def has_structure(removed: np.ndarray, grids: tuple[Grid, Grid]) -> bool:
    """True if entries (M, N) that were removed as noise have sums that are no noise.

    `grids` are those of camera and projector. Errors of neighbouring pixels may be alike: sums over
    blocks of pixels are taken as they are, and must have independent signs.
    """
    camera_grid, grid = grids
    of_rows = _sum_excess(removed, grid)
    of_columns = _sum_excess(removed.T, camera_grid)
    return max(of_rows, of_columns) > STRUCTURE_SIGMAS


def _sum_excess(removed: np.ndarray, grid: Grid) -> float:
    """Excess of squared sums over pixels of a grid (n, pixels), in standard deviations."""
    sums_of_blocks = removed @ block_membership(grid)
    independent = float(np.sum(sums_of_blocks**2, dtype=np.float64))
    if independent == 0.0:
        return 0.0
    sums = sums_of_blocks.sum(axis=1, dtype=np.float64)
    return float(sums @ sums / independent - 1.0) / (2.0 / len(removed)) ** 0.5


def _patterns(grid: Grid) -> list[np.ndarray]:
    """White, random, smooth patterns and patches, (N, k) each."""
    random = np.random.default_rng(0)
    h, w = grid
    y, x = np.mgrid[:h, :w]
    smooth = []
    patches = []
    for _ in range(PATTERNS):
        waves = random.uniform(-MAX_WAVES, MAX_WAVES, 2)
        phase = 2.0 * np.pi * (waves[0] * y / h + waves[1] * x / w + random.random())
        smooth.append(1.0 + np.cos(phase))
        side = max(1, round(PATCH_SIDE * max(grid)))
        top = random.integers(max(h - side, 0) + 1)
        start = random.integers(max(w - side, 0) + 1)
        patches.append((top <= y) & (y < top + side) & (start <= x) & (x < start + side))
    kinds = [np.ones((1, h, w)), random.integers(0, 2, (PATTERNS, h, w)), smooth, patches]
    return [np.array(kind, np.float64).reshape(-1, h * w).T for kind in kinds]
