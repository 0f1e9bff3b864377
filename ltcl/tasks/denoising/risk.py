# SPDX-License-Identifier: BSD-3-Clause
"""Decision whether pictures of a denoised T are nearer to the truth than those of the measured one.

With measured entries Y, denoised D, and independent errors of Y of known variance, Stein's unbiased
estimate of the squared error of a picture D p, over that of Y p, is

    |Y p - D p|^2 / V - 1 + 2 C / V

with the variance V of Y p, and the covariance C of D p with the errors of Y p (Stein, Estimation of
the mean of a multivariate normal distribution, 1981). Noise that is left in D after linear
shrinking has the variance C.
"""

from __future__ import annotations

import numpy as np

from ltcl.tasks.denoising.multiwavelets import Grid
from ltcl.tasks.denoising.problem import DenoisingProblem

# Factor within which an estimated noise is right.
NOISE_MARGIN = 1.25
# Random patterns of each kind.
PATTERNS = 4
# Waves across a smooth pattern, at most.
MAX_WAVES = 2.0
# Side of a lit patch, as a part of that of the picture.
PATCH_SIDE = 0.25


def picture_risk(
    moved: np.ndarray, left: np.ndarray, variance: np.ndarray, problem: DenoisingProblem
) -> float:
    """Estimated squared error of pictures by D over that by Y, a mean over kinds of patterns.

    `moved` is Y - D, `left` noise as it may be left in D, and `variance` that of Y, (M, N) each. If
    the noise of Y is less than stated, light seems to be noise: the risk is that for a noise that
    is smaller by NOISE_MARGIN.
    """
    risks = []
    for patterns in _patterns(problem.grid):
        filtered = problem.noise.filtered(patterns, problem.grid, problem.channel)
        V = np.sum(variance @ filtered**2)
        if V > 0.0:
            change = NOISE_MARGIN**2 * np.sum((moved @ patterns) ** 2)
            kept = np.sum((left @ patterns) ** 2)
            risks.append((change + 2.0 * kept) / V - 1.0)
    return float(np.mean(risks)) if risks else 0.0


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
