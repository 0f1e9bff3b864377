# SPDX-License-Identifier: BSD-3-Clause
"""Monte Carlo (section 7 of the paper): every pixel of S^-1 b by random walks over the rows of R.

    l_d(i) = l_out(i) + sum over k >= 1 and paths of (-1)^k R_i i1 R_i1 i2 ... l_out(ik)    (eq. 23)

A walk samples one path, its entries in proportion to |R_ij| (eq. 25), its length by eq. 24. The
forward dual (eq. 22) is the same on I - A. An infinite variance (`ltcl.theory.walks`) is refused.
The standard error of n samples of a pixel with spread s is

    standard_error^2 = s^2 / n + 3 (W_i max |b|)^2 / n^2

A light that no sample has met has a chance of at most about 3 / n (rule of three: Hanley and
Lippman-Hand, 1983), and adds the second term; W_i is the root mean square weight of a walk after
its first step.

Known limit: rows with sums above 3/4 and above the others, that walks seldom meet, are not covered.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ltcl import checks
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import walks
from ltcl.operators.walks import Lengths, Tables, Walker
from ltcl.solvers.result import Solution, Status
from ltcl.solvers.sampling import (
    ADVICE,
    MAX_SAMPLES,
    Channels,
    SampledChannel,
    Sampler,
    Watch,
)
from ltcl.theory.walks import LONGEST, Weights, chance_to_go_on, has_variance, weights

# Samples of a stage: of the first one, and at most. Beyond, alias tables and float32 are biased.
FIRST_STAGE_SAMPLES = 512
MAX_STAGE_SAMPLES = 1 << 20

# A stage has so many times the samples that seem to be needed, so that few pixels need one more.
SPARE_SAMPLES = 1.2

# Times 1 / n, the largest chance of a light that n samples have not met (rule of three).
UNMET_CHANCE = 3.0


@dataclass(frozen=True, kw_only=True, eq=False)
class PixelEstimates:
    """Means and their standard errors, (P, columns), and the samples of each pixel, (P,)."""

    mean: np.ndarray
    standard_error: np.ndarray
    samples: np.ndarray


@dataclass(frozen=True)
class MonteCarlo(Sampler):
    """Estimates with their standard errors.

    An `error` takes stages of fresh samples, each of as many as the one before asks for. Only the
    last stage of a pixel counts: samples chosen by their own spread are biased.
    """

    name: ClassVar[str] = "monte_carlo"
    default_samples: ClassVar[int] = 256
    pixels: Any = None
    error: float | None = None
    albedo: float | None = None
    adjoint: bool = False  # pyright: ignore[reportIncompatibleVariableOverride]

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

    @property
    def max_samples(self) -> int:
        """The most samples of a pixel in one stage."""
        if self.samples is not None:
            return self.samples
        return self.default_samples if self.error is None else MAX_STAGE_SAMPLES

    def check_size(self, n: int) -> None:
        """Refuse options that do not fit S, (n, n)."""
        if self.pixels is not None:
            pixels = checks.real("pixels", self.pixels)
            if pixels.ndim != 1 or pixels.size == 0 or pixels.dtype.kind not in "iu":
                raise InputError(
                    f"pixels is {pixels.shape} of {pixels.dtype}; it must be (P,) whole numbers"
                )
            for extreme in (int(pixels.min()), int(pixels.max())):
                if not 0 <= extreme < n:
                    raise InputError(f"pixels holds {extreme}; they must be in 0..{n - 1}")
        if self.adjoint:
            checks.count("samples", self.sample_count, most=MAX_SAMPLES // n)

    def _refusal(self, channels: Channels, tables: Tables) -> str:
        step = weights(channels[0].R, tables)
        q = chance_to_go_on(step, self.albedo)
        if has_variance(step.radius, q):
            return ""
        walks_over_R = "walks over R"
        if self.albedo is not None:
            walks_over_R += f" with albedo={self.albedo:g}"
        return (
            f"{walks_over_R} have no finite variance: the second moments of their weights "
            f"grow by {step.radius:.3g} a step, which must be below {min(q, 1.0):.3g}"
        )

    def _estimate(
        self, channels: Channels, tables: Tables, sign: float, watch: Watch
    ) -> list[Solution]:
        n = len(channels[0].r)
        columns = channels[0].r.shape[1:]
        step = weights(channels[0].R, tables)
        q = chance_to_go_on(step, self.albedo)
        lengths = Lengths.geometric(q, -sign, from_b=self.adjoint)
        walker = Walker(tables, lengths, self.seed, watch)
        # (N, columns * channels)
        sides = [channel.r for channel in channels]
        light = np.stack(sides, axis=-1).reshape(n, -1)
        square = _mean_square_after_first_step(step, lengths)
        pixels = np.arange(n)
        if self.adjoint:
            estimates = self._estimate_from_b(walker, light, square)
        else:
            if self.pixels is not None:
                pixels = np.asarray(self.pixels, np.int64)
            estimates = self._estimate_in_stages(channels, walker, light, pixels, square)

        shape = (len(pixels), *columns, len(channels))
        means = np.moveaxis(estimates.mean.reshape(shape), -1, 0)
        errors = np.moveaxis(estimates.standard_error.reshape(shape), -1, 0)
        samples = estimates.samples
        reason = (
            f"series of eq. 10, lengths of walks by m = {q / (1.0 + q):.3g} "
            f"({samples.mean():.3g} samples a pixel, {samples.sum():.3g} in all)"
        )
        solutions = []
        for channel, mean, error in zip(channels, means, errors, strict=True):
            solutions.append(self._solution(channel, mean, error, pixels, reason))
        return solutions

    def _estimate_from_b(
        self, walker: Walker, light: np.ndarray, square: np.ndarray
    ) -> PixelEstimates:
        """Estimate by walks from b, one column of the light after the other."""
        n = len(light)
        samples = n * self.sample_count
        mean = np.zeros(light.shape)
        error = np.zeros(light.shape)
        for c, column in enumerate(light.T):
            walker.tables.append(walker.tables.device.upload(column))
            sums = walker.columns(samples, stream=c)
            share = np.abs(column, dtype=np.float64)
            # A walk weighs all of the light.
            unmet = np.sqrt(UNMET_CHANCE * share.sum() * (share @ square[:, 0]))
            mean[:, c] = sums.mean
            error[:, c] = np.hypot(sums.standard_error, unmet / samples)
        return PixelEstimates(mean=mean, standard_error=error, samples=np.full(n, samples // n))

    def _estimate_in_stages(
        self,
        channels: Channels,
        walker: Walker,
        light: np.ndarray,
        pixels: np.ndarray,
        square: np.ndarray,
    ) -> PixelEstimates:
        """Estimate by walks from the pixels, in as many stages as the error asks for."""
        columns = channels[0].r.shape[1:]
        channel_of_column = np.arange(light.shape[1]) % len(channels)
        scores = np.sqrt(square[pixels][:, channel_of_column])
        unmet = UNMET_CHANCE**0.5 * scores * np.abs(light).max(axis=0)
        units = np.stack([np.broadcast_to(c.unit, columns) for c in channels], axis=-1)
        if self.error is None:
            # One stage, after which any error will do.
            error = np.inf
            first = self.max_samples
        else:
            error = self.error
            first = min(FIRST_STAGE_SAMPLES, self.max_samples)
        target = error / units.ravel()
        stages = _Stages(walker, light, pixels, unmet, target, first, self.max_samples)
        return stages.run()

    def _solution(
        self,
        channel: SampledChannel,
        mean: np.ndarray,
        error: np.ndarray,
        pixels: np.ndarray,
        reason: str,
    ) -> Solution:
        """Return the solution of a channel from the mean of its walks, in units of the problem."""
        x = channel.x[pixels] + channel.r[pixels] + mean
        if self.gather:
            x = x + channel.residual(x)
            error = _gathered_error(channel, error)
        missed = 0
        if self.error is not None:
            is_met = (error * channel.unit <= self.error).reshape(len(x), -1).all(axis=1)
            missed = int(np.sum(~is_met))
            reason += f"; {self._error_report(missed, len(x))}"
        if self.pixels is not None:
            return Solution(
                x=x,
                status=Status.SAMPLED,
                iterations=1,
                products=channel.system.products,
                residuals=(np.nan,),
                method=self.name,
                reason=reason,
                lowest=np.inf,
                standard_error=error,
            )
        return channel.solution(
            x,
            standard_error=error,
            iterations=1,
            reason=reason,
            advice=ADVICE,
            met_error=missed == 0,
        )

    def _error_report(self, missed: int, pixels: int) -> str:
        """Say how many pixels have missed the error that was asked for."""
        goal = f"error={self.error:g}"
        if not missed:
            return f"{goal} was reached"
        return f"{missed} of {pixels} pixels missed {goal} within {self.max_samples} samples"


class _Stages:
    """Stages of fresh samples, until each pixel has its target error.

    The error of n samples is sqrt(spread^2 + (unmet / n)^2), where spread falls as 1 / sqrt(n).
    Each stage after the first has the samples that squared errors of a / n + b / n^2 ask for, in
    powers of two.
    """

    def __init__(
        self,
        walker: Walker,
        light: np.ndarray,
        pixels: np.ndarray,
        unmet: np.ndarray,
        target: np.ndarray,
        first: int,
        max_samples: int,
    ) -> None:
        self.walker = walker
        self.light = walker.tables.device.upload(light)
        self.pixels = pixels
        self.unmet = unmet
        self.target = target
        self.max_samples = max_samples
        self.mean = np.zeros(unmet.shape)
        self.spread = np.zeros(unmet.shape)
        # Samples of the last stage of each pixel, and of all.
        self.samples = np.full(len(pixels), first)
        self.spent = np.zeros_like(self.samples)

    def run(self) -> PixelEstimates:
        """Take stages until no pixel needs another one."""
        active = np.arange(len(self.pixels))
        stage = 0
        while True:
            self._sample(active, stage)
            error = np.hypot(self.spread, self.unmet / self.samples[:, None])
            active = self._unmet_pixels(error, stage)
            if active.size == 0:
                return PixelEstimates(mean=self.mean, standard_error=error, samples=self.spent)
            # The first stage tells the spread; each later one has to have more samples.
            min_samples = self.samples[active]
            if stage > 0:
                min_samples = 2 * min_samples
            self.samples[active] = self._next_samples(active, min_samples)
            stage += 1

    def _unmet_pixels(self, error: np.ndarray, stage: int) -> np.ndarray:
        """Return the pixels that need another stage.

        After the first one these are all but those without error, since it chose no samples.
        """
        limit = self.target if stage else 0.0
        is_met = np.all(error <= limit, axis=1)
        return np.flatnonzero((self.samples < self.max_samples) & ~is_met)

    def _sample(self, active: np.ndarray, stage: int) -> None:
        """Take the samples of one stage, together for all pixels that need as many."""
        needed = self.samples[active]
        for count in np.unique(needed):
            same = active[needed == count]
            sums = self.walker.rows(self.light, self.pixels[same], int(count), stage)
            self.mean[same] = sums.mean
            self.spread[same] = sums.standard_error
        self.spent[active] += needed

    def _next_samples(self, active: np.ndarray, min_samples: np.ndarray) -> np.ndarray:
        """Return the samples n with a / n + b / n^2 <= 1, and some to spare."""
        with np.errstate(over="ignore", divide="ignore"):
            a = self.samples[active, None] * (self.spread[active] / self.target) ** 2
            b = (self.unmet[active] / self.target) ** 2
            root = np.max(a + np.sqrt(a**2 + 4.0 * b), axis=1)
            needed = SPARE_SAMPLES / 2 * root
        needed = np.clip(needed, min_samples, self.max_samples)
        return np.minimum(2.0 ** np.ceil(np.log2(needed)), self.max_samples)


def _mean_square_after_first_step(step: Weights, lengths: Lengths) -> np.ndarray:
    """Return the mean squares of scores of walks after their first step, (N, channels)."""
    scores, _ = lengths.scores()
    return step.mean_square.T * scores[0] ** 2


def _gathered_error(channel: SampledChannel, error: np.ndarray) -> np.ndarray:
    """Return the errors after one exact product.

    Errors of pixels are independent: their variances pass through the squares of R.
    """
    if not np.all(np.isfinite(error)):
        return error + np.inf
    return np.sqrt(np.asarray(walks.squares(channel.R) @ error**2))
