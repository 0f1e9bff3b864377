# SPDX-License-Identifier: BSD-3-Clause
"""Where random walks have a mean and a variance, and how long they should be.

The weight of a walk that goes on with chance q after each step has second moments that grow like powers of

    Q_ij = |R_i| |R_ij| / q      entries drawn in proportion (eq. 25)
    Q_ij = n_i R_ij^2 / q        one of n_i entries, all alike
    Q_ij = R_ij^2 / (p_ij q)     drawn by p, as walks are that channels share (`ltcl.operators.links`)

so that its variance is finite where the spectral radius of Q is below 1. Whenever it is, rho(|R|) < 1 too,
and the mean exists: by Cauchy and Schwarz rho(|R|)^2 <= q rho(Q).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from ltcl import checks
from ltcl.device import Array, vectors
from ltcl.errors import InputError
from ltcl.operators import CSR, Dense, Operator
from ltcl.operators.alias import Tables
from ltcl.operators.entrywise import mapped
from ltcl.operators.links import Links
from ltcl.theory.spectrum import spectral_radius

_LONGEST = 0.9999  # chance to go on; beyond, walks of many thousand steps would carry nothing
SETTLED = 8  # steps, after which second moments of weights grow alike at all pixels
_LARGEST = float(np.finfo(np.float32).max)
_SHORTEST = 1 / 16  # below, terms that matter little are seen so rarely that nobody can tell their error


class Moments(Operator):
    """q Q: what a step makes of the second moments of weights, or of those of a higher power.

    Parameters
    ----------
    R : CSR or Dense, (N, N)
    made : Tables
        Of R for the sampler in question, or with `columns` of R^T, over which the walks of the adjoint go.
    columns : bool
    power : int
        2, of second moments.
    """

    def __init__(self, R: CSR | Dense, made: Tables, columns: bool = False, power: int = 2) -> None:
        super().__init__(R.device, R.shape)
        uniform = made.sampler == "uniform"
        self._entries, self._columns = mapped(R, _power(power) if uniform else np.abs), columns
        d = (made.counts() if uniform else made.sums()).astype(np.float64) ** (power - 1)
        self._d = R.device.upload(np.minimum(d[: R.shape[0]], _LARGEST))

    def _product(self, x: Array, out: Array, scale: float, add: Array | None, transpose: bool) -> None:
        if transpose or add is not None:
            raise TypeError("Moments is for power iteration only")
        self._entries._product(x, out, scale, None, self._columns)
        vectors.scale_rows(self._d, out, out)


def _power(power: int) -> Callable[[np.ndarray], np.ndarray]:
    def raised(entries: np.ndarray) -> np.ndarray:
        with np.errstate(over="ignore"):
            return np.minimum(entries**power, np.float32(_LARGEST))

    return raised


def second_moment_radius(R: CSR | Dense, made: Tables, columns: bool = False) -> float:
    """q times the spectral radius of Q, by power iteration; kept with the tables. See `Moments`.

    Of `Links` the largest of all channels; R is not looked at.

    >>> import ltcl
    >>> from ltcl.operators.alias import tables
    >>> R = Dense(ltcl.open_device(), [[0.0, 0.5], [-0.5, 0.0]])
    >>> round(second_moment_radius(R, tables(R)), 6)
    0.25
    """
    if made.radius is None:
        made.radius = float(np.max([spectral_radius(Q).value for Q in second_moments(R, made, columns)]))
    return made.radius


def second_moments(R: CSR | Dense, made: Tables, columns: bool = False, power: int = 2) -> Iterable[Operator]:
    """q Q, of `Links` that of each channel, for which R is not looked at. See `Moments`."""
    return made.moments(power) if isinstance(made, Links) else [Moments(R, made, columns, power)]


def growth_of_weights(R: CSR | Dense, made: Tables, columns: bool = False, power: int = 2) -> np.ndarray:
    """(q Q)^k 1, k = 1 .. 8, of each channel, (channels, 8, N) float64.

    The mean square of the weight that walks have after k steps, without what their lengths divide it by; or
    the mean of its fourth `power`.

    >>> import ltcl
    >>> from ltcl.operators.alias import tables
    >>> R = Dense(ltcl.open_device(), [[0.0, 0.5], [-0.5, 0.0]])
    >>> growth_of_weights(R, tables(R))[0, :3, 0].tolist()
    [0.25, 0.0625, 0.015625]
    """
    return np.stack([_powers(Q) for Q in second_moments(R, made, columns, power)])


def _powers(Q: Operator) -> np.ndarray:
    found, unit = np.ones((SETTLED + 1, Q.shape[0])), 1.0
    for k in range(SETTLED):  # float32 holds what is near 1
        found[k + 1] = Q.apply(Q.device.upload(found[k] / unit)).get().astype(np.float64) * unit
        unit = float(found[k + 1].max()) or 1.0
        if not math.isfinite(unit):
            found[k + 1 :] = math.inf
            break
    return found[1:]


def chance_to_go_on(radius: float, albedo: float | None, others: Sequence[str] = ()) -> float:
    """q = m / (1 - m) of eq. 24; where no albedo m is given sqrt(radius), at which rho(Q) = q.

    For equal row sums that is rho(R), hence the m of a closed scene (eq. 14).

    Parameters
    ----------
    radius : float
        From `second_moment_radius`.
    albedo : float, optional
    others : names of options
        That the polynomial which is advised in its place excludes, as it does the albedo.

    Raises
    ------
    InputError
        m outside (0, 1/2), or an infinite variance.

    Examples
    --------
    >>> chance_to_go_on(0.25, None), round(chance_to_go_on(0.25, 0.3), 4)
    (0.5, 0.4286)
    """
    if albedo is None:
        q = max(math.sqrt(radius), _SHORTEST)
        if not q < _LONGEST:  # NaN neither, where moments overflow
            raise InputError(
                "walks over R have no finite variance: the second moments of their weights "
                f"{_growth(radius)}, which must be below 1; use {_polynomial(others)} or method='auto'"
            )
        return q
    m, instead = checks.number("albedo", albedo, above=0.0), _polynomial([*others, "albedo"])
    if m >= 0.5 or m / (1.0 - m) > _LONGEST:
        raise InputError(
            f"albedo is {m:.12g}; walks go on with chance m / (1 - m) (eq. 24), so they need m below 1/2, at "
            f"most {_LONGEST / (1.0 + _LONGEST):.6g}: beyond use {instead} or method='auto'"
        )
    q = m / (1.0 - m)
    if not radius < q:
        least = f"below {radius / (1.0 + radius):.3g}" if radius < 1.0 else "whatever it is"
        advice = "leave albedo out" if radius < _LONGEST**2 else f"use {instead} or method='auto'"
        raise InputError(
            f"albedo is {m:g}; over this R the variance of walks is infinite {least}: the second moments of "
            f"weights {_growth(radius / q)}; {advice}"
        )
    return q


def _polynomial(others: Sequence[str]) -> str:
    without = " and ".join(f"{name}=" for name in others)
    return "series='chebyshev'" + (f" without {without}" if without else "")


def _growth(radius: float) -> str:
    return f"grow by {radius:.3g} a step" if math.isfinite(radius) else "overflow float32 in one step"


def noise_of_terms(coefficients: np.ndarray, radius: float) -> float:
    """About the noise of one sample of sum c_k R^k b, k >= 1, all walks of one length, in units of b.

    The root of the sum of c_k^2 Q^k, as if what a walk meets at its steps were independent.

    >>> noise_of_terms(np.array([1.0, 3.0, 4.0]), 1.0)
    5.0
    """
    k = np.arange(1, len(coefficients))
    with np.errstate(over="ignore", invalid="ignore"):
        squares = np.asarray(coefficients[1:], np.float64) ** 2 * radius**k
        return float(np.sqrt(np.sum(squares)))
