# SPDX-License-Identifier: BSD-3-Clause
"""Monte Carlo (section 7 of the paper): every pixel of S^-1 b on its own, by random walks over the rows of R.

    l_d(i) = l_out(i) + sum over k >= 1 and paths of (-1)^k R_i i1 R_i1 i2 ... l_out(ik)    (eq. 23)

A walk samples one path, its entries in proportion to |R_ij| (eq. 25), its length by eq. 24. The forward dual
(eq. 22) is the same on I - A. Right-hand sides share their walks, and so do three colours where
that leaves a finite variance. An infinite one (`ltcl.theory.walks`) is refused. Of n samples of a
pixel with spread s

    standard_error^2 = s^2 / n + 3 (W_i max |b|)^2 / n^2

A light that no sample has met has a chance of at most about 3 / n (rule of three: Hanley and
Lippman-Hand, 1983), and the second term of the variance; W_i is the root mean square weight of a
walk after its first step. Rows with sums above 3/4 and above the others, that walks seldom meet,
are not covered.

The hybrid samples the products of Jacobi (eq. 20), with fresh columns j in each iteration, drawn by
eq. 25:

    l^(k+1)_i = l_out(i) - |R_i| mean of sign(R_ij) l^(k)_j over a few columns j

The noise of the last product remains, unless final gather makes that exactly; no standard error is
known. It converges in the mean where rho(R) < 1, with bounded noise from enough samples on; fewer
are refused.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ltcl import checks, theory
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators import walks
from ltcl.operators.walks import Lengths, Tables, Walker
from ltcl.solvers.result import Solution, Status
from ltcl.solvers.stopping import relative
from ltcl.theory.walks import LONGEST, chance_to_go_on, enough_samples, has_variance, weights

Callback = Callable[[int, float], object]
Watch = Callable[[], object]  # called after each step
Estimate = tuple[
    np.ndarray, np.ndarray, np.ndarray
]  # means, standard errors, samples of each pixel

_MOST = 1 << 20  # samples of a stage
_FIRST = 512  # of the first
_SPARE = 1.2  # times the samples that a stage seems to need, so that few pixels need one more
_ADVICE = "try more samples=, or gather=True"


class Channel:
    """A problem of `solve` to be sampled, S = I + sign R, from a start x with residual r.

    Errors are asked for in the caller's units; those of b and x are `unit` of them.
    """

    def __init__(self, method: str, problem: Any) -> None:
        self.method, self.S, self.b, self.unit = method, problem.S, problem.b, problem.unit
        self.rtol, self.maxiter = min(problem.required, 1.0), problem.rule.maxiter
        self.R, self.sign = walks.rows_of_R(self.S, method)
        self.products, self._right = 0, self.S.device.upload(self.b)
        self.r, self.x = self._right.get(), np.zeros(self.b.shape)
        if problem.x0 is not None:
            self.x = problem.x0.astype(np.float32).astype(np.float64)
            self.r = self.residual(self.x)

    def residual(self, x: np.ndarray) -> np.ndarray:
        """b - S x, by one product."""
        self.products += 1
        return self.S.apply(self.S.device.upload(x), scale=-1.0, add=self._right).get()

    def picture(
        self,
        x: np.ndarray,
        error: np.ndarray | None,
        count: int,
        reason: str,
        advice: str,
        met: bool = True,
    ) -> Solution:
        """Of a whole picture x; converged where its true residual is within rtol and errors were `met`."""
        if not np.all(np.abs(x) <= np.finfo(np.float32).max):
            raise InputError(
                "what was sampled has grown beyond float32; rescale, or use method='chebyshev'"
            )
        norms = np.linalg.norm(self.b.astype(np.float64), axis=0)
        residual = relative(np.linalg.norm(self.residual(x).astype(np.float64), axis=0), norms)
        status = Status.CONVERGED if met and residual <= self.rtol else Status.SAMPLED
        reason = reason if status is Status.CONVERGED else f"{reason}; {advice}"
        facts = x, status, count, self.products, (1.0, residual), 0.0, self.method, reason
        return Solution(
            *facts, lowest=residual, standard_error=error
        )  # of x, be it worse than the start


Channels = Sequence[Channel]


@dataclass(frozen=True)
class Sampler:
    """What the methods that draw random numbers share, and options of both; see `ltcl.solve`.

    `_refusal` says why tables give no estimate, empty where they do; `_estimate` is of one channel,
    or three.
    """

    name: ClassVar[str]
    usual: ClassVar[int]
    _refusal: ClassVar[Callable[..., str]]
    _estimate: ClassVar[Callable[..., list[Solution]]]
    adjoint = False
    samples: int | None = None
    seed: int = 0
    gather: bool = False

    def __post_init__(self) -> None:
        if self.samples is not None:
            checks.count("samples", self.samples, most=(1 << 32) - 1)
        checks.count("seed", self.seed, least=0, most=(1 << 64) - 1)
        checks.flag("gather", self.gather)

    def sample(self, channels: Channels, callback: Callback | None = None) -> list[Solution]:
        """One estimate a channel, in units of its b; the callback hears of the start, steps, and the end."""
        steps, hear = itertools.count(), callback or (lambda step, residual: None)
        hear(next(steps), 1.0)
        estimates = self._together(channels, lambda: hear(next(steps), np.nan))
        if not np.isnan(estimates[0].residuals[-1]):
            hear(next(steps), max(estimate.residuals[-1] for estimate in estimates))
        return estimates

    def _together(self, channels: Channels, watch: Watch) -> list[Solution]:
        if len(channels) == 1:
            return self._alone(channels[0], watch)
        why = "those from b are of one channel"
        try:
            if not self.adjoint:
                tables = walks.linked([c.R for c in channels], [c.sign for c in channels])
                why = self._refusal(channels, tables)
                if not why:
                    return self._estimate(channels, tables, 1.0, watch)
        except MemoryLimitError as error:
            why = str(error)
        each = [of_channel(c, self._alone, channel, watch)[0] for c, channel in enumerate(channels)]
        return [
            dataclasses.replace(s, reason=f"{s.reason}; channels share no walks: {why}")
            for s in each
        ]

    def _alone(self, channel: Channel, watch: Watch) -> list[Solution]:
        tables = (walks.tables_of_columns if self.adjoint else walks.tables)(channel.R)
        if refusal := self._refusal([channel], tables):
            raise InputError(f"{refusal}; use method='auto'")
        return self._estimate([channel], tables, channel.sign, watch)


@dataclass(frozen=True)
class MonteCarlo(Sampler):
    """Estimates with their standard errors.

    An `error` takes stages of fresh samples, as many as the one before asks for; only the last one
    of a pixel counts: samples chosen by their own spread are biased. So are alias tables and
    float32, beyond 2^20.
    """

    name: ClassVar[str] = "monte_carlo"
    usual: ClassVar[int] = 256
    pixels: Any = None
    error: float | None = None
    albedo: float | None = None
    adjoint: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.error is not None:
            checks.number("error", self.error, above=0.0)
        checks.flag("adjoint", self.adjoint)
        if self.albedo is not None:
            checks.number("albedo", self.albedo, above=0.0, most=LONGEST / (1.0 + LONGEST))
        if self.gather and self.pixels is not None:
            raise InputTypeError("gather=True needs x at every pixel; leave pixels= out")
        if self.adjoint and (self.pixels is not None or self.error is not None):
            raise InputTypeError(
                "adjoint=True estimates whole pictures; leave pixels= and error= out"
            )

    def check(self, n: int) -> None:
        """Refuse what does not fit S, (n, n)."""
        if self.pixels is not None:
            pixels = checks.real("pixels", self.pixels)
            if pixels.ndim != 1 or pixels.size == 0 or pixels.dtype.kind not in "iu":
                raise InputError(
                    f"pixels is {pixels.shape} of {pixels.dtype}; it must be (P,) whole numbers"
                )
            worst = int(pixels.min() if pixels.min() < 0 else pixels.max())
            if not 0 <= worst < n:
                raise InputError(f"pixels holds {worst}; they must be in 0..{n - 1}")
        if self.adjoint:
            checks.count("samples", self.samples or self.usual, most=((1 << 32) - 1) // n)

    def _refusal(self, channels: Channels, tables: Tables) -> str:
        step = weights(channels[0].R, tables)
        radius, q = step.radius, chance_to_go_on(step, self.albedo)
        if has_variance(radius, q):
            return ""
        lengths = "" if self.albedo is None else f" with albedo={self.albedo:g}"
        return (
            f"walks over R{lengths} have no finite variance: the second moments of their weights grow by "
            f"{radius:.3g} a step, which must be below {min(q, 1.0):.3g}"
        )

    def _estimate(
        self, channels: Channels, tables: Tables, sign: float, watch: Watch
    ) -> list[Solution]:
        n, count, columns = len(channels[0].r), len(channels), channels[0].r.shape[1:]
        step = weights(channels[0].R, tables)
        q = chance_to_go_on(step, self.albedo)
        lengths = Lengths.geometric(q, -sign, from_b=self.adjoint)
        walker = Walker(tables, lengths, self.seed, watch)
        light = np.stack([c.r for c in channels], axis=-1).reshape(n, -1)  # (N, columns * channels)
        pixels = np.arange(n) if self.pixels is None else np.asarray(self.pixels, np.int64)
        score = lengths.scores()[0][0]  # what weights are multiplied by after the first step
        square = step.mean_square.T * score**2  # (N, channels)
        if self.adjoint:
            samples = n * (self.samples or self.usual)  # one column of the light after the other
            x, error, spent = np.zeros(light.shape), np.zeros(light.shape), np.full(n, samples // n)
            for c, column in enumerate(light.T):
                walker.tables.append(walker.tables.device.upload(column))
                sums, share = walker.columns(samples, stream=c), np.abs(column, dtype=np.float64)
                unmet = np.sqrt(
                    3.0 * share.sum() * (share @ square[:, 0])
                )  # a walk weighs all of the light
                x[:, c], error[:, c] = sums.mean, np.hypot(sums.standard_error, unmet / samples)
        else:
            scores = np.sqrt(square[pixels][:, np.arange(light.shape[1]) % count])
            unmet = 3.0**0.5 * scores * np.abs(light).max(axis=0)
            units = np.stack([np.broadcast_to(c.unit, columns) for c in channels], axis=-1)
            x, error, spent = self._in_stages(walker, light, pixels, unmet, units.ravel())
        x, error = (np.moveaxis(a.reshape(len(pixels), *columns, count), -1, 0) for a in (x, error))
        reason = f"series of eq. 10, lengths of walks by m = {q / (1.0 + q):.3g}"
        reason += f" ({spent.mean():.3g} samples a pixel, {spent.sum():.3g} in all)"
        return [self._result(*of, pixels, reason) for of in zip(channels, x, error, strict=True)]

    def _in_stages(
        self,
        walker: Walker,
        light: np.ndarray,
        pixels: np.ndarray,
        unmet: np.ndarray,
        units: np.ndarray,
    ) -> Estimate:
        """Means, standard errors and samples of all stages; of n samples `unmet` / n is part of the errors.

        Each after the first has the samples that squared errors of a / n + b / n^2 ask for, in
        powers of two.
        """
        r, target = walker.tables.device.upload(light), (self.error or np.inf) / units
        most = self.samples or (self.usual if self.error is None else _MOST)
        x, spread, active = np.zeros(unmet.shape), np.zeros(unmet.shape), np.arange(len(pixels))
        last = np.full(
            len(pixels), most if self.error is None else min(_FIRST, most)
        )  # samples of a stage
        spent = np.zeros_like(last)
        for stage in itertools.count():
            for count in np.unique(last[active]):
                here = active[last[active] == count]
                sums = walker.rows(r, pixels[here], int(count), stage)
                x[here], spread[here] = sums.mean, sums.standard_error
            spent[active] += last[active]
            error = np.hypot(spread, unmet / last[:, None])
            met = np.all(error <= (target if stage else 0.0), axis=1)
            active = np.flatnonzero((last < most) & ~met)
            if active.size == 0:
                return x, error, spent
            with np.errstate(over="ignore", divide="ignore"):
                a, b = (
                    last[active, None] * (spread[active] / target) ** 2,
                    (unmet[active] / target) ** 2,
                )
                needed = _SPARE / 2 * np.max(a + np.sqrt(a**2 + 4.0 * b), axis=1)
            needed = np.clip(needed, last[active] * (2 if stage else 1), most)
            last[active] = np.minimum(2.0 ** np.ceil(np.log2(needed)), most)
        raise AssertionError

    def _result(
        self, channel: Channel, rest: np.ndarray, error: np.ndarray, pixels: np.ndarray, reason: str
    ) -> Solution:
        x = channel.x[pixels] + channel.r[pixels] + rest
        if (
            self.gather
        ):  # errors of pixels are independent: their variances pass through the squares of R
            x, known = x + channel.residual(x), np.all(np.isfinite(error))
            error = (
                np.sqrt(np.asarray(walks.squares(channel.R) @ error**2))
                if known
                else error + np.inf
            )
        missed = 0
        if self.error is not None:
            missed = np.sum(
                ~np.all((error * channel.unit <= self.error).reshape(len(x), -1), axis=1)
            )
            goal, most = f"error={self.error:g}", self.samples or _MOST
            missing = f"{missed} of {len(x)} pixels missed {goal} within {most} samples"
            reason += f"; {missing if missed else f'{goal} was reached'}"
        if self.pixels is not None:
            facts = Status.SAMPLED, 1, channel.products, (np.nan,), 0.0, self.name, reason, np.inf
            return Solution(x, *facts, standard_error=error)
        return channel.picture(x, error, 1, reason, _ADVICE, not missed)


@dataclass(frozen=True)
class Hybrid(Sampler):
    """Jacobi with sampled products, as many as Jacobi takes to rtol."""

    name: ClassVar[str] = "hybrid"
    usual: ClassVar[int] = 32

    def _refusal(self, channels: Channels, tables: Tables) -> str:
        rho = _largest_radius(channels)
        if not rho < 1.0:
            return f"the spectral radius of R is {rho:.3g}; for method='hybrid', Jacobi, it must be below 1"
        if weights(channels[0].R, tables).radius < 1.0:  # then any number of samples will do
            return ""
        samples, enough = (
            self.samples or self.usual,
            enough_samples([c.R for c in channels], tables),
        )
        if samples >= enough:
            return ""
        return f"samples is {samples}; the noise of products by this R may grow below samples={enough:g}"

    def _estimate(
        self, channels: Channels, tables: Tables, sign: float, watch: Watch
    ) -> list[Solution]:
        rho, rtol = _largest_radius(channels), min(c.rtol for c in channels)
        required = (
            math.ceil(math.log(min(max(rtol, 1e-6), 1.0)) / math.log(rho)) if rho > 0.0 else 1
        )
        count, samples = min(max(1, required), channels[0].maxiter), self.samples or self.usual
        walker = Walker(tables, Lengths(np.array([-sign])), self.seed, watch)
        r = np.stack([c.r.astype(np.float64) for c in channels], axis=-1)
        l = start = r.reshape(len(r), -1)  # (N, columns * channels)
        for k in range(count):
            l = (
                start
                + walker.rows(tables.device.upload(l), np.arange(len(l)), samples, stream=k).mean
            )
        reason, advice = (
            f"Jacobi, {samples} columns of each row drawn in each of {count} iterations",
            _ADVICE,
        )
        if count < required:
            advice = f"stopped at {count} of the {required} iterations that rtol asks for: raise maxiter="
        estimates = []
        for channel, rest in zip(channels, np.moveaxis(l.reshape(r.shape), -1, 0), strict=True):
            x = channel.x + rest
            x = x + channel.residual(x) if self.gather else x
            estimates.append(channel.picture(x, None, count, reason, advice))
        return estimates


def _largest_radius(channels: Channels) -> float:
    """Of the spectra of R, kept with each."""
    return max(
        walks.cached(c.R, "radius", lambda R=c.R: theory.spectral_radius(R).value) for c in channels
    )


def of_channel(channel: int, f: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """f(...) of one channel of several; its refusals say of which."""
    try:
        return f(*arguments, **options)
    except (InputError, MemoryLimitError) as error:
        raise type(error)(f"in channel {channel}: {error}") from None
