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
from collections.abc import Iterable

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
_SETTLED = 8  # steps, after which second moments of weights grow alike at all pixels
_SHORTEST = 1 / 16  # below, terms that matter little are seen so rarely that nobody can tell their error
_UNMET = 3.0  # rule of three


class SecondMoments(Operator):
    """q Q: what a step makes of the second moments of weights.

    Parameters
    ----------
    R : CSR or Dense, (N, N)
    made : Tables
        Of R for the sampler in question, or with `columns` of R^T, over which the walks of the adjoint go.
    columns : bool
    """

    def __init__(self, R: CSR | Dense, made: Tables, columns: bool = False) -> None:
        super().__init__(R.device, R.shape)
        uniform = made.sampler == "uniform"
        self._entries, self._columns = mapped(R, np.square if uniform else np.abs), columns
        d = made.counts() if uniform else made.sums()
        self._d = R.device.upload(d[: R.shape[0]])

    def _product(self, x: Array, out: Array, scale: float, add: Array | None, transpose: bool) -> None:
        if transpose or add is not None:
            raise TypeError("SecondMoments is for power iteration only")
        self._entries._product(x, out, scale, None, self._columns)
        vectors.scale_rows(self._d, out, out)


def second_moment_radius(R: CSR | Dense, made: Tables, columns: bool = False) -> float:
    """q times the spectral radius of Q, by power iteration; kept with the tables. See `SecondMoments`.

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


def second_moments(R: CSR | Dense, made: Tables, columns: bool = False) -> Iterable[Operator]:
    """q Q, of `Links` that of each channel, for which R is not looked at. See `SecondMoments`."""
    return made.second_moments() if isinstance(made, Links) else [SecondMoments(R, made, columns)]


def growth_of_weights(R: CSR | Dense, made: Tables, columns: bool = False) -> np.ndarray:
    """(q Q)^k 1, k = 1 .. 8, of each channel, (channels, 8, N) float64; kept with the tables.

    The mean square of the weight that walks have after k steps, without what their lengths divide it by.

    >>> import ltcl
    >>> from ltcl.operators.alias import tables
    >>> R = Dense(ltcl.open_device(), [[0.0, 0.5], [-0.5, 0.0]])
    >>> growth_of_weights(R, tables(R))[0, :3, 0].tolist()
    [0.25, 0.0625, 0.015625]
    """
    if made.growth is None:
        made.growth = np.stack([_powers(Q) for Q in second_moments(R, made, columns)])
    return made.growth


def _powers(Q: Operator) -> np.ndarray:
    found, unit = np.ones((_SETTLED + 1, Q.shape[0])), 1.0
    for k in range(_SETTLED):  # float32 holds what is near 1
        found[k + 1] = Q.apply(Q.device.upload(found[k] / unit)).get() * unit
        unit = float(found[k + 1].max()) or 1.0
        if not math.isfinite(unit):
            found[k + 1 :] = math.inf
            break
    return found[1:]


def largest_square(growth: np.ndarray, scored: np.ndarray, worth: np.ndarray, samples: int) -> np.ndarray:
    """Of what `samples` walks have not met: the most that it may add to the sum of squares, by |light|^2.

    An event that n samples have not met has a chance of 3 / n at most, with 95 % confidence (the rule of
    three: Hanley and Lippman-Hand, 1983), and not more than that to be scored at the step in question. Its
    score is light times the worth of the step times the weight of the walk; of that the mean square is known:

        n E[score^2] / |light|^2 <= max over steps k of min(3, n p_k) worth_k^2 ((q Q)^k 1)_i

    Parameters
    ----------
    growth : (8, N)
        From `growth_of_weights`; of later steps all pixels grow alike, as they did at last.
    scored, worth : (L,)
        p_k and worth_k, of `Lengths.scores`.
    samples : int

    Returns
    -------
    (N,) float64

    Examples
    --------
    >>> largest_square(np.full((8, 1), 0.25), np.array([1.0, 0.5]), np.array([1.0, 2.0]), 100).tolist()
    [3.0]
    """
    with np.errstate(over="ignore", invalid="ignore"):
        times = np.minimum(_UNMET, samples * scored) * worth**2
        early, late = times[:_SETTLED, None], times[_SETTLED:]
        found = np.max(early * growth[: len(early)], axis=0)
        if late.size:
            later = np.arange(1, late.size + 1)
            ratio = float(growth[-1].max() / (growth[-2].max() or 1.0))
            found = np.maximum(found, growth[-1] * np.fmax.reduce(late * ratio**later, initial=0.0))
    return found


def chance_to_go_on(radius: float, albedo: float | None) -> float:
    """q = m / (1 - m) of eq. 24; where no albedo m is given sqrt(radius), at which rho(Q) = q.

    For equal row sums that is rho(R), hence the m of a closed scene (eq. 14).

    Parameters
    ----------
    radius : float
        From `second_moment_radius`.
    albedo : float, optional

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
                f"{_growth(radius)}, which must be below 1; use series='chebyshev' or method='chebyshev'"
            )
        return q
    m = checks.number("albedo", albedo, above=0.0)
    if m >= 0.5 or m / (1.0 - m) > _LONGEST:
        raise InputError(
            f"albedo is {m:.12g}; walks go on with chance m / (1 - m) (eq. 24), so they need m below 1/2, at "
            f"most {_LONGEST / (1.0 + _LONGEST):.6g}: beyond use series='chebyshev' or method='chebyshev'"
        )
    q = m / (1.0 - m)
    if not radius < q:
        least = f"below {radius / (1.0 + radius):.3g}" if radius < 1.0 else "whatever it is"
        raise InputError(
            f"albedo is {m:g}; over this R the variance of walks is infinite {least}: the second moments of "
            f"weights {_growth(radius / q)}; leave albedo out, or use series='chebyshev'"
        )
    return q


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
