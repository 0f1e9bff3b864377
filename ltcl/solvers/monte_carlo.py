# SPDX-License-Identifier: BSD-3-Clause
"""Monte Carlo (section 7 of the paper): every pixel of S^-1 b on its own, by random walks over the rows of R.

    l_d(i) = l_out(i) + sum over k >= 1 and paths of (-1)^k R_i i1 R_i1 i2 ... l_out(ik)    (eq. 23)

A walk samples one path, its entries in proportion to |R_ij| (eq. 25), its length by eq. 24. The forward dual
(eq. 22) is the same on I - A. A pixel costs the same whether others are asked for or not: it is for a few
pixels and for previews, not for a whole picture to 1 %, where any iteration is faster. All right-hand
sides share their walks: frames and colours of one S cost one walk a sample. The three S of a transport in
colour have tables and walks of their own.

The series needs rho(|R|) < 1, and a finite variance some more (`ltcl.theory.walks`); elsewhere it is refused.
``series="chebyshev"`` samples a polynomial of finite degree instead, which converges for every albedo; its
coefficients alternate and grow, and with them the noise, which `reason` foretells.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ltcl import checks, theory
from ltcl.device import Array
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import CSR, Dense
from ltcl.operators.alias import SAMPLERS, tables, tables_of_columns
from ltcl.operators.entrywise import rows_of_R
from ltcl.operators.walks import ESTIMATORS, Lengths, Sums, Walker, geometric, whole
from ltcl.solvers import noise, sampled
from ltcl.solvers.noise import Noise
from ltcl.solvers.polynomials import bias_in_words, chebyshev_coefficients, chebyshev_degree
from ltcl.solvers.sampled import Estimate
from ltcl.solvers.stopping import Rule, System
from ltcl.solvers.target_error import MOST, Measured, Staged, sample_to
from ltcl.theory.walks import chance_to_go_on, noise_of_terms, second_moment_radius

_HIGHEST = 10_000  # degree: walks are as long
_LOUDEST = 2.0**63  # noise of a sample whose square float32 still holds
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
        "alias" (eq. 25); "uniform", which the paper compares with; "cdf", for reference.
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
        checks.flag("adjoint", self.adjoint)
        checks.flag("gather", self.gather)
        if self.albedo is not None:
            chance_to_go_on(0.0, self.albedo)
        if self.degree is not None:
            checks.count("degree", self.degree, most=_HIGHEST)
        self._refuse_together()

    def check(self, n: int) -> None:
        """Refuse what does not fit S, (n, n)."""
        if self.pixels is not None:
            _pixels(self.pixels, n)
        if self.adjoint and self._count(n) >= 1 << 32:
            most = ((1 << 32) - 1) // n
            raise InputError(f"samples is {self.samples}; of {n} pixels adjoint=True takes at most {most}")

    def estimate(self, system: System, x: np.ndarray, r: Array, rule: Rule, unit: np.ndarray) -> Estimate:
        """`x` plus the estimate of S^-1 r, where r is the residual of x."""
        R, sign = rows_of_R(system.S, self.name)
        first, lengths, reason = self._lengths(system, R, sign, rule)
        pixels = np.arange(len(x)) if self.pixels is None else _pixels(self.pixels, len(x))
        rest = self._walk(R, lengths, r, pixels, unit, rule)
        x = sampled.within_float32(x[pixels] + first * r.get()[pixels].astype(np.float64) + rest.mean)
        found = Estimate(x, rest.standard_error, whole=self.pixels is None, reason=reason)
        found = _gather(system, R, found) if self.gather else found
        return self._told(found, rest, r, unit)

    def _lengths(self, system: System, R: CSR | Dense, sign: float, rule: Rule) -> tuple[float, Lengths, str]:
        """c_0, the terms that walks estimate, and both in words."""
        made = tables_of_columns(R) if self.adjoint else tables(R, self.sampler)
        moments = second_moment_radius(R, made, self.adjoint)
        if self.series == "chebyshev":
            return self._polynomial(theory.free_bounds(system.S), sign, rule.rtol, moments)
        if self.sampler == "uniform" and moments >= 1.0 > second_moment_radius(R, tables(R)):
            raise InputError(
                "walks by sampler='uniform' have no finite variance over this R: the second moments of their "
                f"weights grow by {moments:.3g} a step, which must be below 1; use sampler='alias'"
            )
        q = chance_to_go_on(moments, self.albedo)
        return 1.0, geometric(q, -sign), f"series of eq. 10, lengths of walks by m = {q / (1.0 + q):.3g}"

    def _polynomial(
        self, bounds: tuple[float, float], sign: float, rtol: float, moments: float
    ) -> tuple[float, Lengths, str]:
        """That of Chebyshev, to the degree given, or to that of rtol where noise leaves anything of it."""
        degree = max(1, chebyshev_degree(rtol, bounds)) if self.degree is None else self.degree
        if degree > _HIGHEST:
            raise InputError(
                f"rtol is {rtol:g}, which takes a degree of {degree}; degree= must be at most {_HIGHEST}"
            )
        c = chebyshev_coefficients(degree, bounds) * sign ** np.arange(degree + 1)
        most = self.samples or (self.usual if self.error is None else MOST)
        noise = noise_of_terms(c, moments) / math.sqrt(most)
        if self.degree is None and not noise < 1.0:
            instead = "or use series='neumann'" if moments < 1.0 else "or use method='chebyshev'"
            raise InputError(
                f"samples is {most}; of the polynomial of degree {degree} that rtol={rtol:g} asks for they "
                f"leave noise of about {noise:.2g} times b: give a lower degree=, more samples=, {instead}"
            )
        if not noise * math.sqrt(most) <= _LOUDEST:
            raise InputError(
                f"degree is {degree}; its terms over this R are beyond float32: lower degree=, or use "
                "method='chebyshev'"
            )
        reason = f"Chebyshev series of degree {degree}, which leaves {bias_in_words(degree, bounds)}"
        noisy = f"and noise of about {noise:.2g} times b with {most} samples"
        return float(c[0]), whole(c[1:]), f"{reason}, {noisy}"

    def _walk(
        self, R: CSR | Dense, lengths: Lengths, r: Array, pixels: np.ndarray, unit: np.ndarray, rule: Rule
    ) -> Staged:
        """Estimates of the terms k >= 1, and their standard errors."""
        made = tables_of_columns(R) if self.adjoint else tables(R, self.sampler)
        estimator = "endpoint" if self.adjoint else self.estimator or "collision"
        measured = Noise(R, made, lengths, r, only_dark=estimator == "endpoint").errors
        walker = Walker(made, lengths, estimator, self.seed, watch=sampled.watch(rule))
        if self.adjoint:
            return self._from_light(walker, r, measured)
        if self.error is not None:
            return sample_to(walker, r, pixels, self.error / unit, self.samples or MOST, measured)
        sums = walker.rows(r, pixels, 0, self.samples or self.usual)
        return Staged.fixed(sums, measured(sums, pixels))

    def _from_light(self, walker: Walker, r: Array, measured: Measured) -> Staged:
        host = r.get()
        total, squares = np.zeros((2, len(host), r.columns))
        for c, column in enumerate(host.reshape(len(host), -1).T):
            walker.tables.append(r.device.upload(column))
            sums = walker.columns(0, self._count(len(host)), stream=c)
            total[:, c], squares[:, c] = sums.total, sums.squares
        sums = Sums(self._count(len(host)), total.reshape(host.shape), squares.reshape(host.shape))
        return Staged.fixed(sums, measured(sums, np.arange(len(host))))

    def _told(self, found: Estimate, rest: Staged, r: Array, unit: np.ndarray) -> Estimate:
        """Whether the error is as small as wanted, what was spent on it, and what to try next."""
        gather = "" if self.gather or self.pixels is not None else ", or gather=True"
        if self.error is None:
            return dataclasses.replace(found, advice=f"try more samples={gather}")
        assert found.standard_error is not None  # noqa: S101 - Monte Carlo always tells it
        within = found.standard_error * unit <= self.error
        met = within.reshape(len(within), -1).all(axis=1) & (rest.met | self.gather)
        what = rest.told(met, self.error, self.samples or MOST, "" if met.all() else self._instead(r))
        advice = f"try a smaller error={gather}" if self.pixels is None else ""
        reason = f"{found.reason}; {what}"
        return dataclasses.replace(found, reason=reason, met=bool(met.all()), advice=advice)

    def _instead(self, r: Array) -> str:
        """What to try where the error was missed."""
        lit = np.mean(r.get().reshape(r.shape[0], -1).any(axis=1))
        if lit <= _FEW and self.pixels is None and (self.series, self.sampler) == ("neumann", "alias"):
            return "adjoint=True suits few lights"
        return "allow a larger error=" if self.samples is None else "allow more samples="

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


def _gather(system: System, R: CSR | Dense, found: Estimate) -> Estimate:
    assert found.standard_error is not None  # noqa: S101 - Monte Carlo always tells it
    x, error = sampled.gathered(system, found.x), noise.gathered(R, found.standard_error)
    return dataclasses.replace(found, x=x, standard_error=error)
