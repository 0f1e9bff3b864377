# SPDX-License-Identifier: BSD-3-Clause
"""Monte Carlo (section 7 of the paper): every pixel of S^-1 b on its own, by random walks over the rows of R.

    l_d(i) = l_out(i) + sum over k >= 1 and paths of (-1)^k R_i i1 R_i1 i2 ... l_out(ik)    (eq. 23)

A walk samples one path, its entries in proportion to |R_ij| (eq. 25), its length by eq. 24. The forward dual
(eq. 22) is the same on I - A. A pixel costs the same whether others are asked for or not: it is for a few
pixels and for previews, not for a whole picture to 1 %, where any iteration is faster. All right-hand
sides share their walks: frames and colours of one S cost one walk a sample. The three S of a transport in
colour share them, too, where that leaves a finite variance (`ltcl.operators.links`), and of a polynomial
little noise; otherwise, and in the adjoint form, each has walks of its own, and the reason is told.

The series needs rho(|R|) < 1, and a finite variance some more (`ltcl.theory.walks`); elsewhere it is refused.
``series="chebyshev"`` samples a polynomial of finite degree instead, which converges for every albedo; its
coefficients alternate and grow, and with them the noise, which `reason` foretells.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ltcl import checks, theory
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators.alias import SAMPLERS, Tables, tables, tables_of_columns
from ltcl.operators.entrywise import rows_of_R
from ltcl.operators.walks import ESTIMATORS, Lengths, Sums, Walker, geometric
from ltcl.solvers import noise, sampled
from ltcl.solvers.noise import Noise
from ltcl.solvers.sampled import Channel, Estimate
from ltcl.solvers.sampled_polynomial import HIGHEST, USUAL, sampled_terms
from ltcl.solvers.stopping import System
from ltcl.solvers.target_error import MOST, Measured, Staged, sample_to
from ltcl.theory.walks import chance_to_go_on, second_moment_radius

_FEW = 0.1  # of the pixels lit: then walks from the light find more of it


@dataclass(frozen=True)
class MonteCarlo:
    """Estimates with their standard errors.

    Parameters
    ----------
    samples : int, optional
        Of each pixel; 256 when not given. With `error` the most of a pixel in its last stage, 2^20 when not
        given; the stages before take up to as many together. With `adjoint` the mean of all pixels.
    seed : int
        Below 2^64. The same seed gives the same bits on every device.
    pixels : (P,) integers, optional
        The pixels to estimate; x and its standard error are then (P,) or (P, k), in their order.
    error : float, optional
        Standard error wanted of every value of x, absolute, in its units; with `gather` of those before. As
        many samples as it needs, see `ltcl.solvers.target_error`. How many pixels missed it is in `reason`.
    estimator : str, optional
        "collision": walks score at every step. "endpoint": where they end (eq. 26, the paper's).
    sampler : str
        "alias" (eq. 25); "uniform", which the paper compares with; "cdf", for reference. Alias tables leave
        out what is drawn less than once in about 2^19 times the entries of its row, and round the rest as
        finely: a bias beside the standard error, which "cdf" hardly has. It may show beyond 2^20 samples.
    albedo : float, optional
        m of eq. 24, in (0, 1/2); by default such that walks are as long as their variance asks for.
    adjoint : bool
        Walks from b instead of from each pixel, for whole pictures with few lights: the end-point estimator
        and alias tables, without `pixels` and `error`.
    gather : bool
        Final gather: one exact product at the end, b - R x.
    series : str
        "neumann" or "chebyshev", to `degree`; that which rtol asks for when not given.
    """

    name: ClassVar[str] = "monte_carlo"
    usual: ClassVar[int] = USUAL
    samples: int | None = None
    seed: int = 0
    pixels: Any = None
    error: float | None = None
    estimator: str | None = None
    sampler: str = "alias"
    albedo: float | None = None
    adjoint: bool = False
    gather: bool = False
    series: str = "neumann"
    degree: int | None = None

    def __post_init__(self) -> None:
        if self.samples is not None:
            sampled.check_samples(self.samples)
        sampled.check_seed(self.seed)
        if self.error is not None:
            checks.number("error", self.error, above=0.0)
        if self.estimator is not None:
            checks.one_of("estimator", self.estimator, ESTIMATORS)
        checks.one_of("sampler", self.sampler, SAMPLERS)
        checks.one_of("series", self.series, ("neumann", "chebyshev"))
        checks.flag("adjoint", self.adjoint)
        checks.flag("gather", self.gather)
        if self.albedo is not None:
            chance_to_go_on(0.0, self.albedo, self._only_neumann)
        if self.degree is not None:
            checks.count("degree", self.degree, most=HIGHEST)
        self._refuse_together()

    @property
    def _only_neumann(self) -> list[str]:
        """Options given that the polynomial excludes, beside the albedo."""
        given = {"adjoint": self.adjoint, "estimator": self.estimator == "endpoint"}
        return [name for name, there in given.items() if there]

    def check(self, n: int) -> None:
        """Refuse what does not fit S, (n, n)."""
        if self.pixels is not None:
            _pixels(self.pixels, n)
        if self.adjoint and self._count(n) >= 1 << 32:
            most = ((1 << 32) - 1) // n
            raise InputError(f"samples is {self.samples}; of {n} pixels adjoint=True takes at most {most}")

    def estimate(self, channels: Sequence[Channel]) -> list[Estimate]:
        """The start plus the estimate of S^-1 r, r its residual; channels share walks where they can."""
        if self.adjoint and len(channels) > 1:
            return sampled.each_alone(self, channels, "those from b are of one channel")
        try:
            made, sign = self._tables(channels)
            first, lengths, reason, bias = self._lengths(channels, made, sign)
        except (InputError, MemoryLimitError) as error:
            if len(channels) == 1:
                raise
            why = sampled.cause(error)
        else:
            rest = self._walk(channels, made, lengths)
            parts = (sampled.each(values, channels) for values in (rest.mean, rest.standard_error))
            found = [
                self._estimate(one, first, mean, error, reason)
                for one, mean, error in zip(channels, *parts, strict=True)
            ]
            return self._told(found, rest, channels, bias)
        return sampled.each_alone(self, channels, why)

    def _tables(self, channels: Sequence[Channel]) -> tuple[Tables, float]:
        """What walks go over, and the sign in S = I + sign R."""
        if not self.adjoint:
            return sampled.tables_of(channels, self)
        R, sign = rows_of_R(channels[0].system.S, self.name)
        return tables_of_columns(R), sign

    def _estimate(
        self, channel: Channel, first: float, rest: np.ndarray, error: np.ndarray, reason: str
    ) -> Estimate:
        """Of one channel, by the coefficient of its residual and the walks."""
        pixels = self._which(channel)
        x, r = (array.get()[pixels].astype(np.float64) for array in (channel.x, channel.r))
        found = Estimate(
            sampled.within_float32(x + first * r + rest), error, whole=self.pixels is None, reason=reason
        )
        return self._gathered(channel.system, found) if self.gather else found

    def _which(self, channel: Channel) -> np.ndarray:
        rows = channel.x.shape[0]
        return np.arange(rows) if self.pixels is None else _pixels(self.pixels, rows)

    def _lengths(
        self, channels: Sequence[Channel], made: Tables, sign: float
    ) -> tuple[float, Lengths, str, float]:
        """c_0, the terms that walks estimate, both in words, and what others may add to x, by the light."""
        Rs = [rows_of_R(one.system.S, self.name)[0] for one in channels]
        moments = second_moment_radius(Rs[0], made, self.adjoint)
        if self.series == "chebyshev":
            lowest, largest = zip(*(theory.free_bounds(one.system.S) for one in channels), strict=True)
            wanted = self.degree, self.samples, self.error is None
            return sampled_terms((min(lowest), max(largest)), sign, channels[0].rule.rtol, moments, *wanted)
        own = self.sampler == "uniform" and len(Rs) == 1  # of walks that are shared each is tried next
        if own and moments >= 1.0 > second_moment_radius(Rs[0], tables(Rs[0])):
            raise InputError(
                "walks by sampler='uniform' have no finite variance over this R: the second moments of their "
                f"weights grow by {moments:.3g} a step, which must be below 1; use sampler='alias'"
            )
        q = chance_to_go_on(moments, self.albedo, self._only_neumann)
        return 1.0, geometric(q, -sign), f"series of eq. 10, lengths of walks by m = {q / (1.0 + q):.3g}", 0.0

    def _walk(self, channels: Sequence[Channel], made: Tables, lengths: Lengths) -> Staged:
        """Estimates of the terms k >= 1 of channels side by side, and their standard errors."""
        pixels, light = self._which(channels[0]), [one.r.get() for one in channels]
        estimator = "endpoint" if self.adjoint else self.estimator or "collision"
        lit = [(rows_of_R(c.system.S, self.name)[0], r) for c, r in zip(channels, light, strict=True)]
        measured = Noise(lit, made, lengths, estimator, self.adjoint).errors
        walker = Walker(made, lengths, estimator, self.seed, watch=sampled.watch(channels))
        host = sampled.side_by_side(light)
        if self.adjoint:
            return self._from_light(walker, host, measured)
        r = made.device.upload(host)
        if self.error is not None:
            unit = np.stack([one.unit for one in channels], axis=-1).ravel()
            with np.errstate(over="ignore"):
                wanted = np.minimum(self.error / unit, np.finfo(np.float64).max)
            return sample_to(walker, r, pixels, wanted, self.samples or MOST, measured)
        sums = walker.rows(r, pixels, 0, self.samples or self.usual)
        return Staged.fixed(sums, measured(sums, pixels))

    def _from_light(self, walker: Walker, r: np.ndarray, measured: Measured) -> Staged:
        total, squares = np.zeros(r.shape), np.zeros(r.shape)
        for c, column in enumerate(r.T):
            walker.tables.append(walker.tables.device.upload(column))
            sums = walker.columns(0, self._count(len(r)), stream=c)
            total[:, c], squares[:, c] = sums.total, sums.squares
        sums = Sums(self._count(len(r)), total, squares)
        return Staged.fixed(sums, measured(sums, np.arange(len(r))))

    def _told(
        self, found: list[Estimate], rest: Staged, channels: Sequence[Channel], bias: float
    ) -> list[Estimate]:
        """Whether the error is as small as wanted, what was spent on it, and what to try next."""
        gather = "" if self.gather or self.pixels is not None else ", or gather=True"
        if self.error is None:
            return [dataclasses.replace(one, advice=f"try more samples={gather}") for one in found]
        met = rest.met | self.gather
        for one, channel in zip(found, channels, strict=True):
            assert one.standard_error is not None  # noqa: S101 - Monte Carlo always tells it
            within = one.standard_error * channel.unit <= self.error
            met = met & within.reshape(len(within), -1).all(axis=1)
        off = bias * max(float(np.max(_mean_square(one) ** 0.5 * one.unit)) for one in channels)
        instead = "" if met.all() else self._instead(channels)
        biased = off > self.error
        by = "the noise alone, with " if biased else ""
        what = rest.told(met, self.error, self.samples or MOST, instead, by)
        if biased:
            met, what = met & False, f"{what}; {self._more_terms(off)}"
        advice = f"try a smaller error={gather}" if self.pixels is None else ""
        return [
            dataclasses.replace(one, reason=f"{one.reason}; {what}", met=bool(met.all()), advice=advice)
            for one in found
        ]

    def _gathered(self, system: System, found: Estimate) -> Estimate:
        """Errors of the pixels are independent: their variances pass through the squares of R."""
        error, (R, _) = found.standard_error, rows_of_R(system.S, self.name)
        assert error is not None  # noqa: S101 - Monte Carlo always tells it
        x = sampled.gathered(system, found.x)
        return dataclasses.replace(found, x=x, standard_error=noise.gathered(R, error))

    def _instead(self, channels: Sequence[Channel]) -> str:
        """What to try where the error was missed."""
        lit = np.mean(sampled.side_by_side([one.r.get() for one in channels]).any(axis=1))
        if lit <= _FEW and self.pixels is None and (self.series, self.sampler) == ("neumann", "alias"):
            return "adjoint=True suits few lights"
        return "allow a larger error=" if self.samples is None else "allow more samples="

    def _more_terms(self, off: float) -> str:
        more = "lower rtol=" if self.degree is None else "raise degree="
        return f"the series may be off by up to {off:.2g} in the root mean square over pixels: {more}"

    def _count(self, n: int) -> int:
        return n * (self.samples or self.usual)

    def _refuse_together(self) -> None:
        """Options that exclude each other."""
        if self.gather and self.pixels is not None:
            raise InputTypeError("gather=True needs x at every pixel; leave pixels= out")
        if self.series == "chebyshev" and (self.adjoint or self.estimator == "endpoint"):
            raise InputTypeError("series='chebyshev' scores at every step; leave adjoint= and estimator= out")
        if self.series == "chebyshev" and self.albedo is not None:
            raise InputTypeError("series='chebyshev' has walks of one length; leave albedo= out")
        if self.series == "neumann" and self.degree is not None:
            raise InputTypeError("degree= is for series='chebyshev'; give albedo= for other walks")
        if not self.adjoint:
            return
        if self.pixels is not None or self.error is not None:
            raise InputTypeError("adjoint=True estimates whole pictures; leave pixels= and error= out")
        if self.estimator == "collision" or self.sampler != "alias":
            raise InputTypeError("adjoint=True has estimator='endpoint' and sampler='alias'; leave them out")


def _mean_square(channel: Channel) -> np.ndarray:
    """Of each column of the light."""
    return np.mean(channel.r.get().astype(np.float64) ** 2, axis=0)


def _pixels(pixels: Any, n: int) -> np.ndarray:
    array = checks.real("pixels", pixels)
    if array.size == 0:
        raise InputError("pixels is empty; it must hold at least one, or be left out for all")
    if array.ndim != 1 or array.dtype.kind not in "iu":
        raise InputError(f"pixels has shape {array.shape} of {array.dtype}; it must be (P,) whole numbers")
    worst = int(array.min() if array.min() < 0 else array.max())
    if not 0 <= worst < n:
        raise InputError(f"pixels holds {worst}; they must be in 0..{n - 1}")
    return array.astype(np.int64)
