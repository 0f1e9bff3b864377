# SPDX-License-Identifier: BSD-3-Clause
"""Hybrid of iteration and Monte Carlo (section 7 of the paper): Jacobi, eq. 20, whose product R l is sampled.

    l^(k+1)_i = l_out(i) - |R_i| mean of sign(R_ij) l^(k)_j over a few columns j, drawn by eq. 25

Each iteration draws fresh columns, so that noise of one is damped by those after it as light is. It costs
`samples` loads a pixel in place of a row, and leaves the noise of the last product; final gather makes that
product exactly. It converges in the mean where rho(R) < 1, as Jacobi does. Its noise stays bounded with
enough samples (`ltcl.theory.sampled_products`); with fewer it is refused. It has no standard error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ltcl import checks, theory
from ltcl.device import Array
from ltcl.errors import InputError
from ltcl.operators import CSR, Dense
from ltcl.operators.alias import SAMPLERS, Tables, tables
from ltcl.operators.entrywise import rows_of_R
from ltcl.operators.walks import Walker, whole
from ltcl.solvers import sampled
from ltcl.solvers.sampled import Estimate
from ltcl.solvers.stopping import Rule, System
from ltcl.theory.sampled_products import least_samples
from ltcl.theory.walks import SecondMoments, second_moment_radius


@dataclass(frozen=True)
class Hybrid:
    """Options.

    Parameters
    ----------
    samples : int
        Columns drawn of each row in an iteration.
    seed : int
        Below 2^64. The same seed gives the same bits on every device, but for final gather.
    iterations : int, optional
        As many as Jacobi needs to rtol when not given, and at most maxiter.
    sampler : str
        "alias" (eq. 25), "uniform" or "cdf"; see `MonteCarlo`.
    gather : bool
        Final gather: one exact product at the end, b - R x.
    """

    name: ClassVar[str] = "hybrid"
    usual: ClassVar[int] = 32
    samples: int = usual
    seed: int = 0
    iterations: int | None = None
    sampler: str = "alias"
    gather: bool = False

    def __post_init__(self) -> None:
        sampled.check_samples(self.samples)
        sampled.check_seed(self.seed)
        if self.iterations is not None:
            checks.count("iterations", self.iterations)
        checks.one_of("sampler", self.sampler, SAMPLERS)
        checks.flag("gather", self.gather)

    def estimate(self, system: System, x: np.ndarray, r: Array, rule: Rule, unit: np.ndarray) -> Estimate:
        """`x` plus what the iterations make of its residual r, started from zero."""
        R, sign = rows_of_R(system.S, self.name)
        made = tables(R, self.sampler)  # rows that overflow have no spectral radius either
        count = self._iterations(R, rule)
        self._check_noise(R, made)
        walker = Walker(made, whole(np.array([-sign])), "endpoint", self.seed, watch=sampled.watch(rule))
        pixels, start = np.arange(len(x)), r.get().astype(np.float64)
        l = start
        for k in range(count):
            product = walker.rows(system.S.device.upload(l), pixels, 0, self.samples, stream=k)
            l = sampled.within_float32(start + product.mean)
        x = x + l
        x = sampled.gathered(system, x) if self.gather else x
        reason = f"Jacobi, {self.samples} columns of each row drawn in each of {count} iterations"
        advice = "try more samples=" + ("" if self.gather else ", or gather=True")
        return Estimate(x, iterations=count, reason=reason, advice=advice)

    def _check_noise(self, R: CSR | Dense, made: Tables) -> None:
        """Refuse as few samples as let noise grow from product to product."""
        if second_moment_radius(R, made) < 1.0:
            return
        key = f"least samples, {self.sampler}"
        if key not in R.tables:
            R.tables[key] = least_samples(R, SecondMoments(R, made))
        if not self.samples >= R.tables[key]:
            least = (
                f"{R.tables[key]:.0f} at least" if math.isfinite(R.tables[key]) else "more than can be told"
            )
            raise InputError(
                f"samples is {self.samples}; over this R noise grows from one product to the next then: "
                f"samples= must be {least}, or use method='chebyshev'"
            )

    def _iterations(self, R: CSR | Dense, rule: Rule) -> int:
        key = "spectral radius"
        if key not in R.tables:
            R.tables[key] = theory.spectral_radius(R).value
        rho = R.tables[key]
        if not rho < 1.0:
            raise InputError(
                f"the spectral radius of R is {rho:.3g}; method='hybrid' is Jacobi with noise and needs one "
                "below 1: use method='chebyshev', or 'monte_carlo' with series='chebyshev'"
            )
        if self.iterations is not None:
            return self.iterations
        wanted = math.log(max(rule.rtol, 1e-6)) / math.log(rho) if rho > 0.0 else 1.0
        return min(max(1, math.ceil(wanted)), rule.maxiter)
