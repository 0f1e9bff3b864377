# SPDX-License-Identifier: BSD-3-Clause
"""Monte Carlo (section 7 of the paper): every pixel of S^-1 b on its own, by random walks over the rows of R.

    l_d(i) = l_out(i) + sum over k >= 1 and paths of (-1)^k R_i i1 R_i1 i2 ... l_out(ik)    (eq. 23)

A walk samples one path, its entries in proportion to |R_ij| (eq. 25), its length by eq. 24. The forward dual
(eq. 22) is the same on I - A. A pixel costs the same whether others are asked for or not: it is for a few
pixels and for previews, not for a whole picture to 1 %, where any iteration is faster. All right-hand
sides share their walks: frames and colours of one S cost one walk a sample. The three S of a transport in
colour share them, too, where that leaves a finite variance (`ltcl.operators.links`); otherwise, and in the
adjoint form, each has walks of its own, and the reason is told.

The series needs rho(|R|) < 1, and a finite variance some more (`ltcl.theory.walks`); elsewhere it is refused.
``series="chebyshev"`` samples a polynomial of finite degree instead, which converges for every albedo; its
coefficients alternate and grow, and with them the noise, which the standard error tells.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ltcl import checks, theory
from ltcl.device import Array
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.operators.alias import SAMPLERS, Tables, tables_of_columns
from ltcl.operators.entrywise import rows_of_R, squares
from ltcl.operators.walks import ESTIMATORS, Lengths, Sums, Walker, geometric, whole
from ltcl.solvers import sampled
from ltcl.solvers.polynomials import chebyshev_bias, chebyshev_coefficients, chebyshev_degree
from ltcl.solvers.sampled import Channel, Estimate
from ltcl.solvers.stopping import System
from ltcl.theory.walks import chance_to_go_on, second_moment_radius

_MOST = 1 << 20  # samples of a pixel with a target error
_PILOT = 256  # samples that tell how many are needed
_PILOT_STREAM = 1
Measured = tuple[np.ndarray, np.ndarray]  # estimates and their standard errors


@dataclass(frozen=True)
class MonteCarlo:
    """Estimates with their standard errors.

    Parameters
    ----------
    samples : int, optional
        Of each pixel; 256 when not given. With `error` the most a pixel gets, 2^20 when not given. With
        `adjoint` the mean of all pixels.
    seed : int
        Below 2^64. The same seed gives the same bits on every device.
    pixels : (P,) integers, optional
        The pixels to estimate; x and its standard error are then (P,) or (P, k), in their order.
    error : float, optional
        Standard error wanted of every value of x, in its units. As many samples as it needs, by a pilot.
    estimator : str, optional
        "collision": walks score at every step. "endpoint": where they end (eq. 26, the paper's).
    sampler : str
        "alias" (eq. 25); "uniform", which the paper compares with; "cdf", for reference.
    albedo : float, optional
        m of eq. 24, in (0, 1/2); by default such that walks are as long as their variance asks for.
    adjoint : bool
        Walks from b instead of from each pixel, for whole pictures with few lights: the end-point estimator.
    gather : bool
        Final gather: one exact product at the end, b - R x.
    series : str
        "neumann" or "chebyshev", to `degree`; that which rtol asks for when not given.
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
        if self.albedo is not None:
            chance_to_go_on(0.0, self.albedo)
        if self.degree is not None:
            checks.count("degree", self.degree)
        self._refuse_together()

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
            first, lengths, reason = self._lengths(channels, made, sign)
        except (InputError, MemoryLimitError) as error:
            if len(channels) == 1:
                raise
            why = str(error).partition(";")[0]
        else:
            rest, error = self._walk(channels, made, lengths)
            found = zip(channels, sampled.each(rest, channels), sampled.each(error, channels), strict=True)
            return [self._estimate(one, first, mean, error, reason) for one, mean, error in found]
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
            _within_float32(x + first * r + rest), error, whole=self.pixels is None, reason=reason
        )
        return self._gathered(channel.system, found) if self.gather else found

    def _which(self, channel: Channel) -> np.ndarray:
        rows = channel.x.shape[0]
        return np.arange(rows) if self.pixels is None else _pixels(self.pixels, rows)

    def _lengths(self, channels: Sequence[Channel], made: Tables, sign: float) -> tuple[float, Lengths, str]:
        """c_0, the terms that walks estimate, and both in words."""
        if self.series == "chebyshev":
            lowest, largest = zip(*(theory.free_bounds(one.system.S) for one in channels), strict=True)
            bounds, rule = (min(lowest), max(largest)), channels[0].rule
            degree = max(1, chebyshev_degree(rule.rtol, bounds)) if self.degree is None else self.degree
            c = _within_float32(chebyshev_coefficients(degree, bounds) * sign ** np.arange(degree + 1))
            bias = chebyshev_bias(degree, bounds)
            reason = f"Chebyshev series of degree {degree}, which leaves {bias:.2g} of the residual"
            return float(c[0]), whole(c[1:]), reason
        R, _ = rows_of_R(channels[0].system.S, self.name)
        q = chance_to_go_on(second_moment_radius(R, made, self.adjoint), self.albedo)
        return 1.0, geometric(q, -sign), f"series of eq. 10, lengths of walks by m = {q / (1.0 + q):.3g}"

    def _walk(self, channels: Sequence[Channel], made: Tables, lengths: Lengths) -> Measured:
        """Estimates of the terms k >= 1 of channels side by side, and their standard errors."""
        watch, pixels = sampled.watch(channels), self._which(channels[0])
        host = sampled.side_by_side([one.r.get() for one in channels])
        if self.adjoint:
            return self._from_light(Walker(made, lengths, "endpoint", self.seed, watch=watch), host)
        walker = Walker(made, lengths, self.estimator or "collision", self.seed, watch=watch)
        r = made.device.upload(host)
        if self.error is None:
            return _measured(walker.rows(r, pixels, 0, self.samples or self.usual))
        pilot = walker.rows(r, pixels, 0, _PILOT, _PILOT_STREAM)
        # Samples of the pilot do not count: chosen by their own spread, they would be biased.
        unit = np.stack([one.unit for one in channels], axis=-1).ravel()
        wanted = _PILOT * (pilot.standard_error * unit / self.error) ** 2
        return _each(walker, r, pixels, _rounded_up(wanted.max(axis=1), self.samples or _MOST))

    def _from_light(self, walker: Walker, r: np.ndarray) -> Measured:
        mean, error = np.zeros(r.shape), np.zeros(r.shape)
        for c, column in enumerate(r.T):
            walker.tables.append(walker.tables.device.upload(column))
            mean[:, c], error[:, c] = _measured(walker.columns(0, self._count(len(r)), stream=c))
        return mean, error

    def _gathered(self, system: System, found: Estimate) -> Estimate:
        """Errors of the pixels are independent: their variances pass through the squares of R."""
        error, (R, _) = found.standard_error, rows_of_R(system.S, self.name)
        assert error is not None  # noqa: S101 - Monte Carlo always tells it
        x = sampled.gathered(system, found.x)
        return dataclasses.replace(found, x=x, standard_error=np.sqrt(np.asarray(squares(R) @ error**2)))

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


def _within_float32(values: np.ndarray) -> np.ndarray:
    """Coefficients or estimates of a polynomial of too high a degree are infinite, or NaN."""
    if not np.all(np.abs(values) <= np.finfo(np.float32).max):
        raise InputError(
            "the terms of this series are beyond float32; lower degree=, or use method='chebyshev'"
        )
    return values


def _pixels(pixels: Any, n: int) -> np.ndarray:
    array = np.asarray(pixels)
    if array.ndim != 1 or array.size == 0 or array.dtype.kind not in "iu":
        raise InputError(f"pixels has shape {array.shape} of {array.dtype}; it must be (P,) whole numbers")
    worst = int(array.min() if array.min() < 0 else array.max())
    if not 0 <= worst < n:
        raise InputError(f"pixels holds {worst}; they must be in 0..{n - 1}")
    return array.astype(np.int64)


def _rounded_up(wanted: np.ndarray, most: int) -> np.ndarray:
    """Powers of two, so that pixels of like need share a launch, within 2 .. most."""
    powers = 2.0 ** np.ceil(np.log2(np.clip(wanted, 2.0, most)))
    return np.minimum(powers, most).astype(np.int64)


def _each(walker: Walker, r: Array, pixels: np.ndarray, counts: np.ndarray) -> Measured:
    """Pixels with counts of samples of their own."""
    mean, error = np.zeros((2, len(pixels), r.columns))
    for count in np.unique(counts):
        here = counts == count
        mean[here], error[here] = _measured(walker.rows(r, pixels[here], 0, int(count)))
    return mean, error


def _measured(sums: Sums) -> Measured:
    return sums.mean, sums.standard_error
