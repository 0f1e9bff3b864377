# SPDX-License-Identifier: BSD-3-Clause
"""Monte Carlo (section 7 of the paper): every pixel of S^-1 b on its own, by random walks over the rows of R.

    l_d(i) = l_out(i) + sum over k >= 1 and paths of (-1)^k R_i i1 R_i1 i2 ... l_out(ik)    (eq. 23)

A walk samples one path, its entries in proportion to |R_ij| (eq. 25), its length by eq. 24. The forward dual
(eq. 22) is the same on I - A. It is for a few pixels and for previews: for a whole picture to 1 % any
iteration is faster. Right-hand sides share their walks, and so do the three S of a transport in colour, where
that leaves a finite variance; else, and from b, each has walks of its own, and says why. An infinite variance
(`ltcl.theory.walks`) is refused.

The standard error has two parts, of n samples of a pixel with spread s:

    s^2 / n + 3 (W_i max |b|)^2 / n^2

Samples tell nothing of a light that none of them has met, but then its chance is at most about 3 / n (rule
of three: Hanley and Lippman-Hand, 1983), and its share of the variance at most the second term; W_i is the
root mean square weight of a walk after its first step. Weights do not grow after it where no row of R is
heavier than the chance to go on (`theory.walks.chance_to_go_on`). It does not cover rows with sums above 3/4
and above the others that walks seldom meet.

The hybrid samples the products of Jacobi (eq. 20):

    l^(k+1)_i = l_out(i) - |R_i| mean of sign(R_ij) l^(k)_j over a few columns j, drawn by eq. 25

Each iteration draws fresh columns, `samples` loads a pixel in place of a row, so that later ones damp its
noise as they damp light. That of the last product remains, and no standard error is known; final gather makes
that product exactly. It converges in the mean where rho(R) < 1, as Jacobi does, with bounded noise from
enough samples on (`ltcl.theory.walks`); fewer are refused.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import numpy as np

from ltcl import checks, theory
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators import Operator, walks
from ltcl.operators.walks import Lengths, Tables, Walker
from ltcl.solvers.result import Solution, Status
from ltcl.theory.walks import LONGEST, chance_to_go_on, enough_samples, has_variance, weights

Result = TypeVar("Result")
Callback = Callable[[int, float], object]
Watch = Callable[[], object]  # called after each step
Estimate = tuple[np.ndarray, np.ndarray, np.ndarray]  # means, standard errors, samples of each pixel

_MOST = 1 << 20  # samples of a stage
_FIRST = 512  # of the first
_SPARE = 1.2  # times the samples that a stage seems to need, so that few pixels need one more
_ADVICE = "try more samples=, or gather=True"


class Channel:
    """S x = b to be sampled, b (N,) or (N, k), S = I + sign R, from a start x with residual r.

    Errors are asked for in the caller's units; those of b and x are `unit` of them, one or one a column.
    """

    def __init__(
        self,
        method: str,
        S: Operator,
        b: np.ndarray,
        x0: np.ndarray | None = None,
        rtol: float = 1e-2,
        unit: np.ndarray | float = 1.0,
        maxiter: int = 1000,
    ) -> None:
        self.method, self.S, self.b, self.rtol, self.unit, self.maxiter = method, S, b, rtol, unit, maxiter
        self.R, self.sign = walks.rows_of_R(S, method)
        self.products, self._right = 0, S.device.upload(b)
        self.r = self._right.get()
        self.x = np.zeros(b.shape)
        if x0 is not None:
            self.x = x0.astype(np.float32).astype(np.float64)
            self.r = self.residual(self.x)

    def residual(self, x: np.ndarray) -> np.ndarray:
        """b - S x, by one product."""
        self.products += 1
        return self.S.apply(self.S.device.upload(x), scale=-1.0, add=self._right).get()

    def picture(
        self, x: np.ndarray, error: np.ndarray | None, count: int, reason: str, advice: str, met: bool = True
    ) -> Solution:
        """Of a whole picture x; converged where its true residual is within rtol and errors were `met`."""
        if not np.all(np.abs(x) <= np.finfo(np.float32).max):
            raise InputError("what was sampled has grown beyond float32; rescale, or use method='chebyshev'")
        norms = np.linalg.norm(self.b.astype(np.float64), axis=0)
        residual = np.linalg.norm(self.residual(x).astype(np.float64), axis=0)
        relative = float(np.max(residual / np.where(norms > 0.0, norms, 1.0)))
        converged = met and relative <= self.rtol
        return Solution(
            x,
            Status.CONVERGED if converged else Status.SAMPLED,
            count,
            self.products,
            (1.0, relative),
            seconds=0.0,
            method=self.method,
            reason=reason if converged else f"{reason}; {advice}",
            lowest=relative,  # of x, be it worse than the start
            standard_error=error,
        )


Channels = Sequence[Channel]


@dataclass(frozen=True)
class Sampler:
    """What the methods that draw random numbers share, and options of both; see `ltcl.solve`.

    `_refusal` says why tables give no estimate, empty where they do; `_estimate` is of one channel, or of
    three that share their samples, where S is I + sign times what walks go over.
    """

    name: ClassVar[str]
    usual: ClassVar[int]
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
            hear(next(steps), max(one.residuals[-1] for one in estimates))
        return estimates

    def _together(self, channels: Channels, watch: Watch) -> list[Solution]:
        if len(channels) == 1:
            return self._alone(channels[0], watch)
        why = "those from b are of one channel"
        try:
            if not self.adjoint:
                made = walks.linked([one.R for one in channels], [one.sign for one in channels])
                why = self._refusal(channels, made)
                if not why:
                    return self._estimate(channels, made, 1.0, watch)
        except MemoryLimitError as error:
            why = str(error)
        each = [of_channel(c, self._alone, one, watch)[0] for c, one in enumerate(channels)]
        return [dataclasses.replace(s, reason=f"{s.reason}; channels share no walks: {why}") for s in each]

    def _alone(self, channel: Channel, watch: Watch) -> list[Solution]:
        made = (walks.tables_of_columns if self.adjoint else walks.tables)(channel.R)
        refusal = self._refusal([channel], made)
        if refusal:
            raise InputError(f"{refusal}; use method='auto'")
        return self._estimate([channel], made, channel.sign, watch)

    def _refusal(self, channels: Channels, made: Tables) -> str:
        raise NotImplementedError

    def _estimate(self, channels: Channels, made: Tables, sign: float, watch: Watch) -> list[Solution]:
        raise NotImplementedError


@dataclass(frozen=True)
class MonteCarlo(Sampler):
    """Estimates with their standard errors.

    An `error` takes as many samples as it needs, in stages. Each draws fresh samples, as many as the stage
    before asks for, at most `samples`, 2^20 when not given, and only the last stage of a pixel counts:
    samples chosen by their own spread would be biased. Alias tables round chances to 2^-19 or so, and sums
    are float32: biases that may show beyond 2^20.
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
            raise InputTypeError("adjoint=True estimates whole pictures; leave pixels= and error= out")

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

    def _refusal(self, channels: Channels, made: Tables) -> str:
        step = weights(channels[0].R, made)
        radius, q = step.radius, chance_to_go_on(step, self.albedo)
        if has_variance(radius, q):
            return ""
        lengths = "" if self.albedo is None else f" with albedo={self.albedo:g}"
        return (
            f"walks over R{lengths} have no finite variance: the second moments of their weights grow by "
            f"{radius:.3g} a step, which must be below {min(q, 1.0):.3g}"
        )

    def _estimate(self, channels: Channels, made: Tables, sign: float, watch: Watch) -> list[Solution]:
        n, count, columns = len(channels[0].r), len(channels), channels[0].r.shape[1:]
        step = weights(channels[0].R, made)
        q = chance_to_go_on(step, self.albedo)
        lengths = Lengths.geometric(q, -sign, from_b=self.adjoint)
        walker = Walker(made, lengths, self.seed, watch)
        light = np.stack([one.r for one in channels], axis=-1).reshape(n, -1)  # (N, columns * channels)
        pixels = np.arange(n) if self.pixels is None else np.asarray(self.pixels, np.int64)
        score = lengths.scores()[0][0]  # what weights are multiplied by after the first step
        square = step.mean_square.T * score**2  # (N, channels)
        if self.adjoint:
            x, error, spent = self._from_light(walker, light, square[:, 0])
        else:
            scores = np.sqrt(square[pixels][:, np.arange(light.shape[1]) % count])
            unmet = 3.0**0.5 * scores * np.abs(light).max(axis=0)
            units = np.stack([np.broadcast_to(one.unit, columns) for one in channels], axis=-1)
            x, error, spent = self._in_stages(walker, light, pixels, unmet, units.ravel())
        x, error = (np.moveaxis(a.reshape(len(pixels), *columns, count), -1, 0) for a in (x, error))
        reason = f"series of eq. 10, lengths of walks by m = {q / (1.0 + q):.3g}"
        reason += f" ({spent.mean():.3g} samples a pixel, {spent.sum():.3g} in all)"
        return [self._result(one, x[c], error[c], pixels, reason) for c, one in enumerate(channels)]

    def _in_stages(
        self, walker: Walker, light: np.ndarray, pixels: np.ndarray, unmet: np.ndarray, units: np.ndarray
    ) -> Estimate:
        """Means, standard errors and samples of all stages; of n samples `unmet` / n is part of the errors.

        Without an error to meet there is one stage. Else the first is never the last, and each that follows
        has the samples that squared errors of a / n + b / n^2 ask for, rounded up to powers of two.
        """
        r, target = walker.tables.device.upload(light), (self.error or np.inf) / units
        most = self.samples or (self.usual if self.error is None else _MOST)
        x, spread, active = np.zeros(unmet.shape), np.zeros(unmet.shape), np.arange(len(pixels))
        last = np.full(len(pixels), most if self.error is None else min(_FIRST, most))  # samples of a stage
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
                a, b = last[active, None] * (spread[active] / target) ** 2, (unmet[active] / target) ** 2
                needed = _SPARE / 2 * np.max(a + np.sqrt(a**2 + 4.0 * b), axis=1)
            needed = np.clip(needed, last[active] * (2 if stage else 1), most)
            last[active] = np.minimum(2.0 ** np.ceil(np.log2(needed)), most)
        raise AssertionError

    def _from_light(self, walker: Walker, light: np.ndarray, square: np.ndarray) -> Estimate:
        """The same of walks from b, one column after the other."""
        n, made, samples = len(light), walker.tables, len(light) * (self.samples or self.usual)
        x, error = np.zeros(light.shape), np.zeros(light.shape)
        for c, column in enumerate(light.T):
            made.append(made.device.upload(column))
            sums, share = walker.columns(samples, stream=c), np.abs(column, dtype=np.float64)
            unmet = np.sqrt(3.0 * share.sum() * (share @ square))  # a walk weighs all of the light
            x[:, c], error[:, c] = sums.mean, np.hypot(sums.standard_error, unmet / samples)
        return x, error, np.full(n, samples // n)

    def _result(
        self, one: Channel, rest: np.ndarray, error: np.ndarray, pixels: np.ndarray, reason: str
    ) -> Solution:
        x = one.x[pixels] + one.r[pixels] + rest
        if self.gather:  # errors of pixels are independent: their variances pass through the squares of R
            x, known = x + one.residual(x), np.all(np.isfinite(error))
            error = np.sqrt(np.asarray(walks.squares(one.R) @ error**2)) if known else error + np.inf
        missed = 0
        if self.error is not None:
            missed = np.sum(~np.all((error * one.unit <= self.error).reshape(len(x), -1), axis=1))
            most = f" within {self.samples or _MOST} samples"
            outcome = f"{missed} of {len(x)} pixels missed error={self.error:g}{most}"
            reason += f"; {outcome}" if missed else f"; error={self.error:g} was reached"
        if self.pixels is not None:
            facts = Status.SAMPLED, 1, one.products, (np.nan,), 0.0, self.name, reason, np.inf
            return Solution(x, *facts, standard_error=error)
        return one.picture(x, error, 1, reason, _ADVICE, not missed)


@dataclass(frozen=True)
class Hybrid(Sampler):
    """Jacobi with sampled products, as many as Jacobi takes to rtol."""

    name: ClassVar[str] = "hybrid"
    usual: ClassVar[int] = 32

    def _refusal(self, channels: Channels, made: Tables) -> str:
        rho = _largest_radius(channels)
        if not rho < 1.0:
            return f"the spectral radius of R is {rho:.3g}; for method='hybrid', Jacobi, it must be below 1"
        if weights(channels[0].R, made).radius < 1.0:  # then any number of samples will do
            return ""
        samples, enough = self.samples or self.usual, enough_samples([one.R for one in channels], made)
        if samples >= enough:
            return ""
        return f"samples is {samples}; the noise of products by this R may grow below samples={enough:g}"

    def _estimate(self, channels: Channels, made: Tables, sign: float, watch: Watch) -> list[Solution]:
        rho, rtol = _largest_radius(channels), min(one.rtol for one in channels)
        required = math.ceil(math.log(min(max(rtol, 1e-6), 1.0)) / math.log(rho)) if rho > 0.0 else 1
        count, samples = min(max(1, required), channels[0].maxiter), self.samples or self.usual
        walker = Walker(made, Lengths(np.array([-sign])), self.seed, watch)
        r = np.stack([one.r.astype(np.float64) for one in channels], axis=-1)
        l = start = r.reshape(len(r), -1)  # (N, columns * channels)
        for k in range(count):
            l = start + walker.rows(made.device.upload(l), np.arange(len(l)), samples, stream=k).mean
        reason, advice = f"Jacobi, {samples} columns of each row drawn in each of {count} iterations", _ADVICE
        if count < required:
            advice = f"stopped at {count} of the {required} iterations that rtol asks for: raise maxiter="
        estimates = []
        for one, rest in zip(channels, np.moveaxis(l.reshape(r.shape), -1, 0), strict=True):
            x = one.x + rest
            x = x + one.residual(x) if self.gather else x
            estimates.append(one.picture(x, None, count, reason, advice))
        return estimates


def _largest_radius(channels: Channels) -> float:
    """Of the spectra of R, kept with each."""
    Rs = [one.R for one in channels]
    return max(walks.kept(R, "spectral radius", lambda R=R: theory.spectral_radius(R).value) for R in Rs)


def of_channel(channel: int, f: Callable[..., Result], *arguments: Any, **options: Any) -> Result:
    """f(...) of one channel of several; its refusals say of which."""
    try:
        return f(*arguments, **options)
    except (InputError, MemoryLimitError) as error:
        raise type(error)(f"in channel {channel}: {error}") from None


def check_whole(options: dict[str, Any]) -> None:
    """Refuse estimates of some pixels where whole pictures are needed."""
    if "pixels" in options:
        raise InputTypeError("pixels= gives some pixels alone; a picture needs all: leave it out")
