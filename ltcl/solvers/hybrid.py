# SPDX-License-Identifier: BSD-3-Clause
"""Hybrid of iteration and Monte Carlo (section 7 of the paper): Jacobi, eq. 20, whose product R l is sampled.

    l^(k+1)_i = l_out(i) - |R_i| mean of sign(R_ij) l^(k)_j over a few columns j, drawn by eq. 25

Each iteration draws fresh columns, `samples` loads a pixel in place of a row, so that later ones damp its
noise as they damp light. That of the last product is left, and no standard error known; final gather makes
that product exactly. It converges in the mean where rho(R) < 1, as Jacobi does, with bounded noise from
enough samples on (`ltcl.theory.walks`); fewer are refused. The three S of a transport in colour draw the same
columns where samples and memory are enough for that; else each draws its own, and says why.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ltcl import checks, theory
from ltcl.operators import CSR, Dense
from ltcl.operators.walks import SAMPLERS, Lengths, Tables, Walker
from ltcl.solvers.monte_carlo import Sampled, Sampler, Start, Watch, check_seed
from ltcl.theory.walks import enough_samples, weights

_MOST = 10_000  # iterations


@dataclass(frozen=True)
class Hybrid(Sampler):
    """Jacobi with sampled products; `ltcl.solve` tells the options.

    Iterations: those of Jacobi to rtol when not given. A seed gives the same bits everywhere, final gather
    aside.
    """

    name: ClassVar[str] = "hybrid"
    usual: ClassVar[int] = 32
    samples: int = usual
    seed: int = 0
    iterations: int | None = None
    sampler: str = "alias"
    gather: bool = False

    def __post_init__(self) -> None:
        checks.count("samples", self.samples, most=(1 << 32) - 1)
        check_seed(self.seed)
        if self.iterations is not None:
            checks.count("iterations", self.iterations, most=_MOST)
        checks.one_of("sampler", self.sampler, SAMPLERS)
        checks.flag("gather", self.gather)

    def _refusal(self, starts: list[Start], made: Tables) -> str:
        rho = max(_spectral_radius(one.R) for one in starts)
        if not rho < 1.0:
            return (
                f"the spectral radius of R is {rho:.3g}; method='hybrid' is Jacobi with noise and needs < 1"
            )
        if weights(starts[0].R, made).radius < 1.0:  # then any number of samples will do
            return ""
        if "enough" not in made.kept:
            each = zip(starts, made.second_moments(starts[0].R), strict=True)
            made.kept["enough"] = max(enough_samples(one.R, Q) for one, Q in each)
        if self.samples >= made.kept["enough"]:
            return ""
        return (
            f"samples is {self.samples}; over this R noise may grow from one product to the next; it does "
            f"not from samples={made.kept['enough']:g} on"
        )

    def _estimate(self, starts: list[Start], made: Tables, sign: float, watch: Watch) -> list[Sampled]:
        rho, rtol = max(_spectral_radius(one.R) for one in starts), min(one.channel.rtol for one in starts)
        wanted = math.ceil(math.log(min(max(rtol, 1e-6), 1.0)) / math.log(rho)) if rho > 0.0 else 1
        count = self.iterations or min(max(1, wanted), starts[0].channel.maxiter)
        walker = Walker(made, Lengths(np.array([-sign])), "endpoint", self.seed, watch)
        r = np.stack([one.r.astype(np.float64) for one in starts], axis=-1)
        l = start = r.reshape(len(r), -1)  # (N, columns * channels)
        for k in range(count):
            l = start + walker.rows(made.device.upload(l), np.arange(len(l)), self.samples, stream=k).mean
        reason = f"Jacobi, {self.samples} columns of each row drawn in each of {count} iterations"
        advice = "try more samples=" + ("" if self.gather else ", or gather=True")
        if count < wanted:
            more = "maxiter" if self.iterations is None else "iterations"
            advice = f"stopped at {count} of the {wanted} iterations that rtol asks for: raise {more}="
        found = []
        for one, rest in zip(starts, np.moveaxis(l.reshape(r.shape), -1, 0), strict=True):
            x = one.x + rest
            x = x + one.residual(x) if self.gather else x
            found.append(one.sampled(x, None, count, reason, advice))
        return found


def _spectral_radius(R: CSR | Dense) -> float:
    """Found once, and kept with R."""
    if "spectral radius" not in R.tables:
        R.tables["spectral radius"] = theory.spectral_radius(R).value
    return R.tables["spectral radius"]
