# SPDX-License-Identifier: BSD-3-Clause
"""Hybrid of iteration and Monte Carlo (section 7 of the paper): Jacobi, eq. 20, whose product R l is sampled.

    l^(k+1)_i = l_out(i) - |R_i| mean of sign(R_ij) l^(k)_j over a few columns j, drawn by eq. 25

Each iteration draws fresh columns, so that noise of one is damped by those after it as light is. It costs
`samples` loads a pixel in place of a row, and leaves the noise of the last product; final gather makes that
product exactly. It converges in the mean where rho(R) < 1, as Jacobi does. Its noise stays bounded with
enough samples (`ltcl.theory.sampled_products`); with fewer it is refused. It has no standard error. The three
S of a transport in colour draw the same columns (`ltcl.operators.links`), where the samples are enough for
that: where they are not, or memory is not, each draws its own, and the reason is told.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ltcl import checks, theory
from ltcl.errors import InputError, MemoryLimitError
from ltcl.operators.alias import SAMPLERS, Tables
from ltcl.operators.entrywise import rows_of_R
from ltcl.operators.walks import Walker, whole
from ltcl.solvers import sampled
from ltcl.solvers.sampled import Channel, Estimate
from ltcl.solvers.stopping import System
from ltcl.theory.sampled_products import least_samples, noise_of_iteration
from ltcl.theory.walks import second_moment_radius, second_moments

_MOST = 10_000  # iterations


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
        As many as Jacobi needs to rtol when not given, and at most maxiter. `reason` tells of too few.
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
            checks.count("iterations", self.iterations, most=_MOST)
        checks.one_of("sampler", self.sampler, SAMPLERS)
        checks.flag("gather", self.gather)

    def estimate(self, channels: Sequence[Channel]) -> list[Estimate]:
        """The start plus what the iterations make of its residual r, begun at zero; columns are shared."""
        try:  # rows that overflow have no spectral radius either
            made, sign = sampled.tables_of(channels, self)
            wanted = max(self._wanted(one) for one in channels)
            self._check_noise(channels, made)
        except (InputError, MemoryLimitError) as error:
            if len(channels) == 1:
                raise
            why = sampled.cause(error)
        else:
            return self._iterate(channels, made, sign, wanted)
        return sampled.each_alone(self, channels, why)

    def _iterate(self, channels: Sequence[Channel], made: Tables, sign: float, wanted: int) -> list[Estimate]:
        count = self.iterations or min(wanted, channels[0].rule.maxiter)
        watch = sampled.watch(channels)
        walker = Walker(made, whole(np.array([-sign])), "endpoint", self.seed, watch=watch)
        l = start = sampled.side_by_side([one.r.get().astype(np.float64) for one in channels])
        for k in range(count):
            product = walker.rows(made.device.upload(l), np.arange(len(l)), 0, self.samples, stream=k)
            l = sampled.within_float32(start + product.mean)
        found = zip(channels, sampled.each(l, channels), strict=True)
        return [self._estimate(one.system, one.x.get() + l, count, wanted) for one, l in found]

    def _check_noise(self, channels: Sequence[Channel], made: Tables) -> None:
        """Refuse as few samples as let noise of a channel grow from product to product."""
        Rs = [rows_of_R(one.system.S, self.name)[0] for one in channels]
        if second_moment_radius(Rs[0], made) < 1.0:
            return
        if made.least is None:
            each = zip(Rs, second_moments(Rs[0], made), strict=True)
            made.least = max(least_samples(R, Q) for R, Q in each)
        if not self.samples >= made.least:
            least = "more than can be told"
            if math.isfinite(made.least):
                least = f"{made.least:.0f} at least"
                noise = noise_of_iteration(Rs[0], made.least, second_moment_radius(Rs[0], made))
                least += f", which leave noise of about {noise:.2g} times the light"
            raise InputError(
                f"samples is {self.samples}; over this R noise grows from one product to the next then: "
                f"samples= must be {least}, or use method='auto'"
            )

    def _estimate(self, system: System, x: np.ndarray, count: int, wanted: int) -> Estimate:
        x = sampled.gathered(system, x) if self.gather else x
        reason = f"Jacobi, {self.samples} columns of each row drawn in each of {count} iterations"
        advice = "try more samples=" + ("" if self.gather else ", or gather=True")
        if count < wanted:
            more = "maxiter" if self.iterations is None else "iterations"
            advice = f"stopped at {count} of the {wanted} iterations that rtol asks for: raise {more}="
        return Estimate(x, iterations=count, reason=reason, advice=advice)

    def _wanted(self, channel: Channel) -> int:
        """Iterations that rtol asks for."""
        (R, _), rule = rows_of_R(channel.system.S, self.name), channel.rule
        key = "spectral radius"
        if key not in R.tables:
            R.tables[key] = theory.spectral_radius(R).value
        rho = R.tables[key]
        if not rho < 1.0:
            raise InputError(
                f"the spectral radius of R is {rho:.3g}; method='hybrid' is Jacobi with noise and needs one "
                "below 1: use method='auto'"
            )
        wanted = math.log(max(rule.rtol, 1e-6)) / math.log(rho) if rho > 0.0 else 1.0
        return max(1, math.ceil(wanted))
