# SPDX-License-Identifier: BSD-3-Clause
"""Monte Carlo (section 7 of the paper): every pixel of S^-1 b on its own, by random walks over the rows of R.

    l_d(i) = l_out(i) + sum over k >= 1 and paths of (-1)^k R_i i1 R_i1 i2 ... l_out(ik)    (eq. 23)

A walk samples one path, its entries in proportion to |R_ij| (eq. 25), its length by eq. 24. The forward dual
(eq. 22) is the same on I - A. A pixel costs the same whether others are asked for or not: it is for a few
pixels and for previews, not for a whole picture to 1 %, where any iteration is faster. All right-hand sides
share their walks, and so do the three S of a transport in colour, where that leaves a finite variance; else,
and from b, each has walks of its own, and says why. An infinite variance (`ltcl.theory.walks`) is refused.

The standard error has two parts, of n samples of a pixel with spread s:

    s^2 / n + 3 (W_i max |b|)^2 / n^2

Samples tell nothing of a light that none of them has met, but then its chance is at most about 3 / n (rule
of three: Hanley and Lippman-Hand, 1983), and its share of the variance at most the second term; W_i is the
root mean square weight of a walk after its first step. That is little of the variance in ordinary pictures,
and most of it where few pixels are lit. It does not cover heavy rows of R that walks seldom meet.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import numpy as np

from ltcl import checks
from ltcl.device import Array
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators import CSR, Dense, Operator
from ltcl.operators.walks import (
    ESTIMATORS,
    SAMPLERS,
    Lengths,
    Tables,
    Walker,
    linked,
    rows_of_R,
    squares,
    tables,
    tables_of_columns,
)
from ltcl.theory.walks import LONGEST, chance_to_go_on, has_variance, weights

Result = TypeVar("Result")
Callback = Callable[[int, float], object]
Watch = Callable[[], object]  # called after each step

_MOST = 1 << 20  # samples of a stage
_FIRST = 512  # of the first
_SPARE = 1.2  # times the samples that a stage seems to need, so that few pixels need one more


@dataclass(frozen=True)
class Channel:
    """A system S x = b to be sampled, b (N,) or (N, k), from x0, alone or with the other colour channels.

    `unit`, one number or one a column, is that of b and x0 in the caller's, in which errors are asked for.
    """

    S: Operator
    b: Array
    x0: Array | None = None
    rtol: float = 1e-2
    unit: np.ndarray | float = 1.0
    maxiter: int = 1000


@dataclass(frozen=True)
class Sampled:
    """What was sampled of a channel, float64, in the units of its b; of some pixels alone (P,) or (P, k).

    `residual` is the true relative one, the largest of all columns, NaN of some pixels alone; `converged`: it
    is within rtol, and errors are as small as asked for.
    """

    x: np.ndarray
    standard_error: np.ndarray | None
    residual: float
    iterations: int
    products: int
    converged: bool
    reason: str


@dataclass
class Start:
    """A channel with its R, S = I + sign R, and the residual of where it starts; counts products."""

    channel: Channel
    R: CSR | Dense
    sign: float
    x: np.ndarray
    r: np.ndarray
    products: int = 0

    @classmethod
    def of(cls, channel: Channel, name: str) -> Start:
        """For a method of this name, which reads rows."""
        R, sign = rows_of_R(channel.S, name)
        b = channel.b.get()
        start = cls(channel, R, sign, np.zeros(b.shape), b)
        if channel.x0 is not None:
            start.x = channel.x0.get().astype(np.float64)
            start.r = start.residual(start.x)
        return start

    def residual(self, x: np.ndarray) -> np.ndarray:
        """b - S x, by one product."""
        self.products += 1
        S = self.channel.S
        return S.apply(S.device.upload(x), scale=-1.0, add=self.channel.b).get()

    def sampled(
        self, x: np.ndarray, error: np.ndarray | None, count: int, reason: str, advice: str, met: bool = True
    ) -> Sampled:
        """A whole picture x, with its true residual."""
        if not np.all(np.abs(x) <= np.finfo(np.float32).max):
            raise InputError("what was sampled has grown beyond float32; rescale, or use method='chebyshev'")
        norms = np.linalg.norm(self.channel.b.get().astype(np.float64), axis=0)
        left = np.linalg.norm(self.residual(x).astype(np.float64), axis=0)
        relative = float(np.max(left / np.where(norms > 0.0, norms, 1.0)))
        converged = met and relative <= self.channel.rtol
        reason = reason if converged else f"{reason}; {advice}"
        return Sampled(x, error, relative, count, self.products, converged, reason)


class Sampler:
    """What the methods that draw random numbers share."""

    name: ClassVar[str]
    sampler: str
    adjoint: bool = False

    def sample(self, channels: Sequence[Channel], callback: Callback | None = None) -> list[Sampled]:
        """One estimate a channel, of three at once by samples that they share where they can.

        The callback hears of one beginning, of every step, whose residual is NaN, and of the end.
        """
        steps, hear = itertools.count(), callback or (lambda step, residual: None)
        hear(next(steps), 1.0)
        starts = [Start.of(one, self.name) for one in channels]
        found = self._together(starts, lambda: hear(next(steps), np.nan))
        if not np.isnan(found[0].residual):
            hear(next(steps), max(one.residual for one in found))
        return found

    def _together(self, starts: list[Start], watch: Watch) -> list[Sampled]:
        if len(starts) == 1:
            return self._alone(starts[0], watch)
        why = "those from b are of one channel"
        try:
            if not self.adjoint:
                made = linked([one.R for one in starts], [one.sign for one in starts], self.sampler)
                why = self._refusal(starts, made)
                if not why:
                    return self._estimate(starts, made, 1.0, watch)
        except MemoryLimitError as error:
            why = str(error)
        each = [of_channel(c, self._alone, one, watch)[0] for c, one in enumerate(starts)]
        why = f"channels share no walks: {why}"
        return [dataclasses.replace(one, reason=f"{one.reason}; {why}") for one in each]

    def _alone(self, start: Start, watch: Watch) -> list[Sampled]:
        if self.sampler != "alias":
            made, sign = linked([start.R], [start.sign], self.sampler), 1.0
        else:
            made, sign = (tables_of_columns if self.adjoint else tables)(start.R), start.sign
        refusal = self._refusal([start], made)
        if refusal:
            other = "sampler='alias' or " if self.sampler != "alias" else ""
            raise InputError(f"{refusal}; use {other}method='auto'")
        return self._estimate([start], made, sign, watch)

    def _refusal(self, starts: list[Start], made: Tables) -> str:
        """Why these tables give no estimate, empty where they do."""
        raise NotImplementedError

    def _estimate(self, starts: list[Start], made: Tables, sign: float, watch: Watch) -> list[Sampled]:
        """Of one channel, or of three that share their samples; S is I + sign times what walks go over."""
        raise NotImplementedError


@dataclass(frozen=True)
class MonteCarlo(Sampler):
    """Estimates with their standard errors; `ltcl.solve` tells the options.

    An `error` takes as many samples as it needs, in stages. Each draws fresh samples, as many as the stage
    before asks for, at most `samples`, 2^20 when not given, and only the last stage of a pixel counts:
    samples chosen by their own spread would be biased. Alias tables round chances to 2^-19 or so: a bias that
    may show beyond 2^20.
    """

    name: ClassVar[str] = "monte_carlo"
    usual: ClassVar[int] = 256
    samples: int | None = None
    seed: int = 0
    pixels: Any = None
    error: float | None = None
    estimator: str | None = None
    sampler: str = "alias"
    albedo: float | None = None
    adjoint: bool = False
    gather: bool = False

    def __post_init__(self) -> None:
        check_seed(self.seed)
        if self.samples is not None:
            checks.count("samples", self.samples, most=(1 << 32) - 1)
        if self.error is not None:
            checks.number("error", self.error, above=0.0)
        if self.estimator is not None:
            checks.one_of("estimator", self.estimator, ESTIMATORS)
        checks.one_of("sampler", self.sampler, SAMPLERS)
        checks.flag("adjoint", self.adjoint)
        checks.flag("gather", self.gather)
        if self.albedo is not None:
            checks.number("albedo", self.albedo, above=0.0, most=LONGEST / (1.0 + LONGEST))
        if self.gather and self.pixels is not None:
            raise InputTypeError("gather=True needs x at every pixel; leave pixels= out")
        if self.adjoint and (self.pixels is not None or self.error is not None):
            raise InputTypeError("adjoint=True estimates whole pictures; leave pixels= and error= out")
        if self.adjoint and (self.estimator == "collision" or self.sampler != "alias"):
            raise InputTypeError("adjoint=True has estimator='endpoint' and sampler='alias'; leave them out")

    def check(self, n: int) -> None:
        """Refuse what does not fit S, (n, n)."""
        if self.pixels is not None:
            pixels = checks.real("pixels", self.pixels)
            if pixels.ndim != 1 or pixels.size == 0 or pixels.dtype.kind not in "iu":
                raise InputError(f"pixels is {pixels.shape} of {pixels.dtype}; it must be (P,) whole numbers")
            worst = int(pixels.min() if pixels.min() < 0 else pixels.max())
            if not 0 <= worst < n:
                raise InputError(f"pixels holds {worst}; they must be in 0..{n - 1}")
        if self.adjoint:
            checks.count("samples", self.samples or self.usual, most=((1 << 32) - 1) // n)

    def _refusal(self, starts: list[Start], made: Tables) -> str:
        radius = weights(starts[0].R, made).radius
        q = chance_to_go_on(radius, self.albedo)
        if has_variance(radius, q):
            return ""
        lengths = "" if self.albedo is None else f" with albedo={self.albedo:g}"
        return (
            f"walks over R{lengths} have no finite variance: the second moments of their weights grow by "
            f"{radius:.3g} a step, which must be below {min(q, 1.0):.3g}"
        )

    def _estimate(self, starts: list[Start], made: Tables, sign: float, watch: Watch) -> list[Sampled]:
        n, count = len(starts[0].r), len(starts)
        self.check(n)
        step = weights(starts[0].R, made)
        q = chance_to_go_on(step.radius, self.albedo)
        lengths = Lengths.geometric(q, -sign, from_b=self.adjoint)
        estimator = "endpoint" if self.adjoint else self.estimator or "collision"
        walker = Walker(made, lengths, estimator, self.seed, watch)
        light = np.stack([one.r for one in starts], axis=-1).reshape(n, -1)  # (N, columns * channels)
        pixels = np.arange(n) if self.pixels is None else np.asarray(self.pixels, np.int64)
        score = lengths.scores(estimator)[0][0]  # what weights are multiplied by after the first step
        square = step.mean_square.T * score**2  # (N, channels)
        if self.adjoint:
            found = self._from_light(walker, light, square[:, 0])
        else:
            scores = np.sqrt(square[pixels][:, np.arange(light.shape[1]) % count])
            units = np.stack([np.broadcast_to(one.channel.unit, one.r.shape[1:]) for one in starts], axis=-1)
            wanted = np.inf if self.error is None else self.error / units.ravel()
            found = self._staged(walker, light, pixels, 3.0**0.5 * scores * np.abs(light).max(axis=0), wanted)
        shape = (len(pixels), *starts[0].r.shape[1:], count)
        x, error = (np.moveaxis(part.reshape(shape), -1, 0) for part in found[:2])
        m = q / (1.0 + q)
        return [self._result(one, x[c], error[c], pixels, found[2], m) for c, one in enumerate(starts)]

    def _staged(
        self, walker: Walker, light: np.ndarray, pixels: np.ndarray, missed: np.ndarray, wanted: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means, standard errors and samples of all stages; of n samples `missed` / n is part of the errors.

        Without an error to meet there is one stage. Else the first is never the last, and each that follows
        has the samples that squared errors of a / n + b / n^2 ask for, rounded up to powers of two.
        """
        r = walker.tables.device.upload(light)
        x, error, spent = np.zeros(missed.shape), np.zeros(missed.shape), np.zeros(len(pixels), np.int64)
        most = self.samples or (self.usual if self.error is None else _MOST)
        counts, stage = np.full(len(pixels), most if self.error is None else min(_FIRST, most)), 0
        while counts.any():
            following = np.zeros_like(counts)
            for count in np.unique(counts[counts > 0]):
                here = np.flatnonzero(counts == count)
                sums = walker.rows(r, pixels[here], int(count), stage)
                error[here] = np.hypot(sums.standard_error, missed[here] / count)
                x[here], spent[here] = sums.mean, spent[here] + count
                if count < most:
                    with np.errstate(over="ignore", divide="ignore"):
                        a, b = count * (sums.standard_error / wanted) ** 2, (missed[here] / wanted) ** 2
                        needed = _SPARE / 2 * np.max(a + np.sqrt(a**2 + 4.0 * b), axis=1)
                    needed = 2.0 ** np.ceil(np.log2(np.clip(needed, count * (2 if stage else 1), most)))
                    over = np.all(error[here] <= (wanted if stage else 0.0), axis=1)
                    following[here] = np.where(over, 0, np.minimum(needed, most))
            counts, stage = following, stage + 1
        return x, error, spent

    def _from_light(
        self, walker: Walker, light: np.ndarray, square: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The same of walks from b, one column after the other."""
        n, made, samples = len(light), walker.tables, len(light) * (self.samples or self.usual)
        x, error = np.zeros(light.shape), np.zeros(light.shape)
        for c, column in enumerate(light.T):
            made.append(made.device.upload(column))
            sums, share = walker.columns(samples, stream=c), np.abs(column, dtype=np.float64)
            missed = np.sqrt(3.0 * share.sum() * (share @ square))  # a walk weighs all of the light
            x[:, c], error[:, c] = sums.mean, np.hypot(sums.standard_error, missed / samples)
        return x, error, np.full(n, samples // n)

    def _result(
        self, one: Start, rest: np.ndarray, error: np.ndarray, pixels: np.ndarray, spent: np.ndarray, m: float
    ) -> Sampled:
        x = one.x[pixels] + one.r[pixels] + rest
        what = f"series of eq. 10, lengths of walks by m = {m:.3g}"
        if self.gather:  # errors of pixels are independent: their variances pass through the squares of R
            x = x + one.residual(x)
            known = np.all(np.isfinite(error))
            error = np.sqrt(np.asarray(squares(one.R) @ error**2)) if known else np.full_like(error, np.inf)
        met, advice = True, "try more samples=" + ("" if self.gather else ", or gather=True")
        if self.error is not None:
            within = np.all((error * one.channel.unit <= self.error).reshape(len(x), -1), axis=1)
            met, told = bool(within.all()), f"error={self.error:g} met"
            if not met:
                missed = f"{np.sum(~within)} of {len(x)} pixels missed error={self.error:g}"
                told = f"{missed} within {self.samples or _MOST} samples"
            what += f"; {told} ({spent.mean():.3g} samples a pixel, {spent.sum():.3g} in all)"
        if self.pixels is not None:
            return Sampled(x, error, np.nan, 1, one.products, False, what)
        return one.sampled(x, error, 1, what, advice, met)


def of_channel(channel: int, f: Callable[..., Result], *given: Any, **named: Any) -> Result:
    """f(...) of one channel of several; its refusals say of which."""
    try:
        return f(*given, **named)
    except (InputError, MemoryLimitError) as error:
        raise type(error)(f"in channel {channel}: {error}") from None


def check_whole(options: dict[str, Any]) -> None:
    """Refuse estimates of some pixels where whole pictures are needed."""
    if "pixels" in options:
        raise InputTypeError("pixels= gives some pixels alone; a picture needs all: leave it out")


def check_method(method: str, options: Iterable[str], those: Collection[str]) -> None:
    """Refuse options of `those` methods that sample, for one that does not."""
    for name in options:
        if name in ("samples", "seed") and method not in those:
            raise InputTypeError(
                f"unknown option {name!r}: method {method!r} does not sample; {' and '.join(those)} do"
            )


def check_seed(seed: Any) -> None:
    """Refuse a seed that does not fit into 64 bits."""
    checks.count("seed", seed, least=0, most=(1 << 64) - 1)
