# SPDX-License-Identifier: BSD-3-Clause
"""The hybrid method (section 7 of the paper): Jacobi (eq. 20) with sampled products.

Each iteration draws fresh columns j of each row by eq. 25:

    l^(k+1)_i = l_out(i) - |R_i| mean of sign(R_ij) l^(k)_j over a few columns j

The noise of the last product remains, unless final gather computes that exactly; no standard error
is known. It converges in the mean where rho(R) < 1, with bounded noise from enough samples on;
fewer are refused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ltcl import theory
from ltcl.operators import walks
from ltcl.operators.walks import Lengths, Tables, Walker
from ltcl.solvers.result import Solution
from ltcl.solvers.sampling import ADVICE, Channels, Sampler, Watch
from ltcl.theory.walks import enough_samples, weights

# Smallest tolerance that iterations are counted for.
MIN_RTOL = 1e-6


@dataclass(frozen=True)
class Hybrid(Sampler):
    """Jacobi with sampled products, for as many iterations as Jacobi takes to rtol."""

    name: ClassVar[str] = "hybrid"
    default_samples: ClassVar[int] = 32

    def _refusal(self, channels: Channels, tables: Tables) -> str:
        rho = _largest_radius(channels)
        if not rho < 1.0:
            return (
                f"the spectral radius of R is {rho:.3g}; for method='hybrid', Jacobi, it must be "
                "below 1"
            )
        if weights(channels[0].R, tables).radius < 1.0:
            # Noise dies away with any number of samples.
            return ""
        enough = enough_samples([channel.R for channel in channels], tables)
        if self.sample_count >= enough:
            return ""
        return (
            f"samples is {self.sample_count}; the noise of products by this R may grow below "
            f"samples={enough:g}"
        )

    def _estimate(
        self, channels: Channels, tables: Tables, sign: float, watch: Watch
    ) -> list[Solution]:
        samples = self.sample_count
        required = _required_iterations(channels)
        iterations = min(max(1, required), channels[0].maxiter)
        walker = Walker(tables, Lengths(np.array([-sign])), self.seed, watch)
        residuals = np.stack([channel.r.astype(np.float64) for channel in channels], axis=-1)
        rows = len(residuals)
        # (N, columns * channels)
        l_out = residuals.reshape(rows, -1)
        l = l_out
        for k in range(iterations):
            on_device = tables.device.upload(l)
            product = walker.rows(on_device, np.arange(rows), samples, stream=k)
            l = l_out + product.mean

        reason = f"Jacobi, {samples} columns of each row drawn in each of {iterations} iterations"
        advice = ADVICE
        if iterations < required:
            advice = (
                f"stopped at {iterations} of the {required} iterations that rtol asks for: "
                "raise maxiter="
            )
        estimates = []
        corrections = np.moveaxis(l.reshape(residuals.shape), -1, 0)
        for channel, correction in zip(channels, corrections, strict=True):
            x = channel.x + correction
            if self.gather:
                x = x + channel.residual(x)
            estimate = channel.solution(x, iterations=iterations, reason=reason, advice=advice)
            estimates.append(estimate)
        return estimates


def _required_iterations(channels: Channels) -> int:
    """Return the iterations that Jacobi takes to the smallest tolerance of the channels."""
    rho = _largest_radius(channels)
    if rho <= 0.0:
        return 1
    rtol = min(channel.rtol for channel in channels)
    rtol = min(max(rtol, MIN_RTOL), 1.0)
    return math.ceil(math.log(rtol) / math.log(rho))


def _largest_radius(channels: Channels) -> float:
    """Return the largest spectral radius of R, which is kept with each."""
    radii = []
    for channel in channels:
        R = channel.R
        radii.append(walks.cached(R, "radius", lambda R=R: theory.spectral_radius(R).value))
    return max(radii)
