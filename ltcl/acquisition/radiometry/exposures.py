# SPDX-License-Identifier: BSD-3-Clause
"""Which exposures to take: as few as reach a signal-to-noise ratio over the light that a few probes see.

Exposures t_k add up to SNR^2 = sum_k (L t_k)^2 / V(L t_k) at the radiance L, over those that do not saturate
there. The first is the longest that the brightest light allows; each further one is that which brings the
logarithm of SNR^2, cut off at what is wanted, furthest up on average over the light of the scene (greedy).
Light that no probe tells from noise is not asked for: a longer probe shows it.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.radiometry.merge import Radiance, merge
from ltcl.acquisition.radiometry.noise import NoiseModel
from ltcl.acquisition.radiometry.response import Response
from ltcl.errors import InputError

logger = logging.getLogger(__name__)

MOST = 8
_LIGHTS = 64  # radiances that stand for the scene
_DARKEST, _BRIGHTEST = 0.02, 0.999  # shares of its pixels
_STEP = 2.0 ** (1.0 / 3.0)  # a third of a stop
_SHORTEST, _LONGEST = 1e-4, 30.0
_BEYOND = 8.0  # times what saturates the shortest probe: what is expected where all are saturated
_CLEAR = 3.0  # standard deviations
_WORTH = 1e-3  # of log SNR^2 on average: what one more exposure must bring


def choose(
    probes: Sequence[Any],
    seconds: Any,
    response: Response | None = None,
    noise: NoiseModel | None = None,
    *,
    snr: float = 50.0,
    most: int = MOST,
    exposures: Sequence[float] | None = None,
    levels: int | None = None,
) -> tuple[float, ...]:
    """Exposures for a scene, ascending.

    Parameters
    ----------
    probes : sequence of (H, W) or (H, W, 3)
        One to three photographs, a few stops apart, of the scene as bright as it will be.
    seconds : (K,)
        Of each probe.
    response, noise, levels
        As in `merge`.
    snr : float
        Signal over noise to reach in a merged pixel, from the darkest 2 % of the lit pixels on. One exposure
        has at most the root of the camera's electrons, at its brightest.
    most : int
        Exposures at most, up to 8.
    exposures : sequence of float, optional
        Seconds that the camera has; None for thirds of stops from 1e-4 to 30 seconds.

    Returns
    -------
    tuple of float
        Where they cannot reach `snr`, or probes are saturated throughout, a warning is logged that says so.

    Raises
    ------
    InputError
        What `merge` refuses; no probe in which anything is lit.

    Examples
    --------
    >>> probe = np.geomspace(1e-3, 0.9, 400).reshape(20, 20)
    >>> choose([probe], [0.1], snr=25, exposures=[0.01, 0.1, 1.0, 10.0])
    (0.1, 1.0, 10.0)
    """
    noise = noise or NoiseModel()
    checks.number("snr", snr, above=0.0)
    checks.count("most", most, most=MOST)
    offered = _offered(exposures)
    seen = merge(probes, seconds, response, noise, levels=levels)
    lights = _lights(seen, noise, float(np.min(np.asarray(seconds, np.float64))))
    told = _told(lights, offered, noise)
    chosen = _greedy(told, snr**2, most)
    reached = np.sqrt(told[:, chosen].sum(axis=1))
    if reached.min() < snr:
        logger.warning(
            "%d exposures reach a signal-to-noise ratio of %.3g, not %.3g, in the worst of the light "
            "that was seen; average over frames, or add light",
            len(chosen),
            reached.min(),
            snr,
        )
    return tuple(float(t) for t in sorted(offered[chosen]))


def bracket(shortest: float, longest: float, count: int = 6) -> tuple[float, ...]:
    """Exposures for `calibrate`: `count` of them, ascending, whose ratios are not all powers of one number.

    Examples
    --------
    >>> [round(t, 3) for t in bracket(0.01, 0.32, 4)]
    [0.01, 0.026, 0.123, 0.32]
    """
    checks.number("shortest", shortest, above=0.0)
    checks.number("longest", longest, above=shortest)
    checks.count("count", count, least=2)
    # Steps in the golden ratio, which no period divides.
    steps = np.where(np.arange(count - 1) % 2, (1 + 5**0.5) / 2, 1.0)
    place = np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()
    return tuple(float(t) for t in shortest * (longest / shortest) ** place)


def _offered(exposures: Sequence[float] | None) -> np.ndarray:
    if exposures is None:
        return np.append(np.exp(np.arange(np.log(_SHORTEST), np.log(_LONGEST), np.log(_STEP))), _LONGEST)
    found = np.unique(checks.finite("exposures", checks.real("exposures", exposures).astype(np.float64)))
    if found.size == 0 or found[0] <= 0:
        raise InputError(f"exposures is {exposures!r}; it must be positive seconds, one at least")
    return found


def _lights(seen: Radiance, noise: NoiseModel, shortest: float) -> np.ndarray:
    """Radiances (64,) from the darkest to the brightest that the probes tell."""
    lit = seen.value[seen.valid & (seen.value > _CLEAR * np.sqrt(seen.variance))]
    saturated = (noise.saturation - noise.black) / shortest
    # Invalid is black or saturated; beside light that nearly saturates the shortest probe, the latter.
    unseen = np.mean(~seen.valid)
    near = lit.size and lit.max() > 0.5 * saturated
    if lit.size == 0:
        raise InputError("probes are black or saturated at every pixel; take one in which the scene is seen")
    if unseen > 1.0 - _BRIGHTEST and near:
        logger.warning(
            "%.1f %% of the pixels tell nothing, perhaps saturated in a probe of %g s; they are taken to be "
            "up to %g times as bright as that allows: a shorter probe would tell",
            100.0 * unseen,
            shortest,
            _BEYOND,
        )
        lit = np.append(lit, np.full(max(1, int(unseen * seen.valid.size)), _BEYOND * saturated))
    low, high = np.quantile(lit, [_DARKEST, _BRIGHTEST])
    return np.geomspace(low, max(high, low * 1.0001), _LIGHTS)


def _told(lights: np.ndarray, offered: np.ndarray, noise: NoiseModel) -> np.ndarray:
    """SNR^2 of each light (64) in each exposure."""
    x = lights[:, None] * offered
    variance = noise.variance(x)
    clear = x + noise.black + _CLEAR * np.sqrt(variance) < noise.saturation
    return np.where(clear, x**2 / variance, 0.0)


def _greedy(told: np.ndarray, wanted: float, most: int) -> list[int]:
    usable = np.flatnonzero(told[-1] > 0)
    chosen = [int(usable[-1]) if len(usable) else 0]
    while len(chosen) < most:
        total = told[:, chosen].sum(axis=1)
        if total.min() >= wanted:
            break
        after = np.minimum(total[:, None] + told, wanted)
        gain = np.log(after + 1e-3 * wanted).mean(axis=0)
        gain[chosen] = -np.inf
        best = int(gain.argmax())
        if gain[best] < np.log(np.minimum(total, wanted) + 1e-3 * wanted).mean() + _WORTH:
            break  # nothing that is left tells more
        chosen.append(best)
    return chosen
