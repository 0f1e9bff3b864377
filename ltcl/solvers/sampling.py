# SPDX-License-Identifier: BSD-3-Clause
"""The common part of methods that draw random numbers: options, channels, results.

Right-hand sides share their walks, and so do three colours if that leaves a finite variance. If
not, each channel takes walks of its own.
"""

from __future__ import annotations

import abc
import dataclasses
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ltcl import checks
from ltcl.errors import InputError, MemoryLimitError
from ltcl.operators import walks
from ltcl.operators.walks import Tables
from ltcl.solvers.method import Method
from ltcl.solvers.problem import LinearProblem, naming_channel, unscale
from ltcl.solvers.result import Solution, Status
from ltcl.solvers.stopping import CountedOperator, Monitor, relative_residual

Callback = Callable[[int, float], object]
# Called after each step.
Watch = Callable[[], object]

MAX_SAMPLES = (1 << 32) - 1
ADVICE = "try more samples=, or gather=True"


class SampledChannel:
    """A problem to be sampled: S = I + sign R, the start x, and its residual r.

    x and r are in units of the problem; errors are asked for in units of the caller.
    """

    def __init__(self, method: str, problem: LinearProblem) -> None:
        self.method = method
        self.S = problem.S
        self.b = problem.b
        self.unit = problem.unit
        self.rtol = min(problem.required_rtol, 1.0)
        self.maxiter = problem.rule.maxiter
        self.R, self.sign = walks.rows_of_R(self.S, method)
        right = self.S.device.upload(self.b)
        norms = np.atleast_1d(np.linalg.norm(self.b.astype(np.float64), axis=0))
        self.system = CountedOperator(S=self.S, b=right, norms=norms, host=self.b)
        # Callbacks are called by the method.
        self._rule = dataclasses.replace(problem.rule, callback=None)
        self._r = right.like()
        if problem.x0 is None:
            self.x = np.zeros(self.b.shape)
            self.r = right.get()
        else:
            self.x = problem.x0.astype(np.float32).astype(np.float64)
            self.r = self.residual(self.x)

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Compute b - S x by one product."""
        self.system.residual(x, self._r)
        return self._r.get()

    def solution(
        self,
        x: np.ndarray,
        *,
        standard_error: np.ndarray | None = None,
        iterations: int,
        reason: str,
        advice: str,
        met_error: bool = True,
    ) -> Solution:
        """Return a whole picture x.

        It has converged if its true residual is within rtol and standard errors were met.
        """
        if not np.all(np.abs(x) <= np.finfo(np.float32).max):
            raise InputError(
                "the estimate has grown beyond float32; rescale, or use method='chebyshev'"
            )
        system = self.system
        monitor = Monitor(system=system, rule=self._rule)
        norms = system.residual(x, self._r)
        norms, is_solved = monitor.confirm(x, self._r, norms, is_last=True)
        residual = relative_residual(norms, system.norms)
        status = Status.CONVERGED
        if not (met_error and is_solved):
            status = Status.SAMPLED
            reason = f"{reason}; {advice}"
        return Solution(
            x=x,
            status=status,
            iterations=iterations,
            products=system.products,
            residuals=(1.0, residual),
            method=self.method,
            reason=reason,
            # The residual of x, even if that is worse than the start.
            lowest=residual,
            standard_error=standard_error,
        )


Channels = Sequence[SampledChannel]


@dataclass(frozen=True)
class Sampler(Method):
    """A method that draws random numbers, and the options of all such; see `ltcl.solve`."""

    default_samples: ClassVar[int]
    adjoint: ClassVar[bool] = False
    samples: int | None = None
    seed: int = 0
    gather: bool = False

    def __post_init__(self) -> None:
        if self.samples is not None:
            checks.count("samples", self.samples, most=MAX_SAMPLES)
        checks.count("seed", self.seed, least=0, most=(1 << 64) - 1)
        checks.flag("gather", self.gather)

    @abc.abstractmethod
    def _refusal(self, channels: Channels, tables: Tables) -> str:
        """Return why walks over these tables give no estimate; empty if they do."""

    @abc.abstractmethod
    def _estimate(
        self, channels: Channels, tables: Tables, sign: float, watch: Watch
    ) -> list[Solution]:
        """Estimate one channel, or three that share their walks."""

    @property
    def sample_count(self) -> int:
        """The samples asked for, or those of the method."""
        return self.default_samples if self.samples is None else self.samples

    def check_size(self, n: int) -> None:
        """Refuse options that do not fit S, (n, n)."""
        del n

    def solve(self, problem: LinearProblem) -> Solution:
        """Return an estimate in the units of the caller."""
        return self.solve_channels([problem])[0]

    def solve_channels(self, problems: Sequence[LinearProblem]) -> list[Solution]:
        """Return one estimate a colour channel; all have one size."""
        channels = [SampledChannel(self.name, problem) for problem in problems]
        estimates = self._sample(channels, problems[0].rule.callback)
        solutions = []
        for problem, estimate in zip(problems, estimates, strict=True):
            error = estimate.standard_error
            if error is not None:
                error = unscale(error, problem.unit)
            x = unscale(estimate.x, problem.unit)
            solutions.append(dataclasses.replace(estimate, x=x, standard_error=error))
        return solutions

    def _sample(self, channels: Channels, callback: Callback | None) -> list[Solution]:
        """Return one estimate a channel; call the callback at the start, each step, and the end."""
        numbers = itertools.count()

        def report(residual: float) -> None:
            if callback is not None:
                callback(next(numbers), residual)

        report(1.0)
        estimates = self._estimate_channels(channels, lambda: report(np.nan))
        residuals = [estimate.residuals[-1] for estimate in estimates]
        if not np.isnan(residuals[0]):
            report(max(residuals))
        return estimates

    def _estimate_channels(self, channels: Channels, watch: Watch) -> list[Solution]:
        """Estimate channels by walks that they share, or apart if that is impossible."""
        if len(channels) == 1:
            return self._estimate_alone(channels[0], watch)
        cause = "those from b are of one channel"
        try:
            if not self.adjoint:
                tables = walks.linked([c.R for c in channels], [c.sign for c in channels])
                cause = self._refusal(channels, tables)
                if not cause:
                    return self._estimate(channels, tables, 1.0, watch)
        except MemoryLimitError as error:
            cause = str(error)

        solutions = []
        for number, channel in enumerate(channels):
            with naming_channel(number):
                (solution,) = self._estimate_alone(channel, watch)
            reason = f"{solution.reason}; channels share no walks: {cause}"
            solutions.append(dataclasses.replace(solution, reason=reason))
        return solutions

    def _estimate_alone(self, channel: SampledChannel, watch: Watch) -> list[Solution]:
        """Estimate one channel by walks of its own."""
        make_tables = walks.tables_of_columns if self.adjoint else walks.tables
        tables = make_tables(channel.R)
        refusal = self._refusal([channel], tables)
        if refusal:
            raise InputError(f"{refusal}; use method='auto'")
        return self._estimate([channel], tables, channel.sign, watch)
