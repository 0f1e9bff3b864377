# SPDX-License-Identifier: BSD-3-Clause
"""Exposures that see whole periods of a projector.

Most projectors show colours one after the other, or switch mirrors, within each picture. An exposure of n + f
periods, 0 < f < 1, catches a part of one period that depends on when it begins: up to f / (n + f) of white
light, three times that of a colour that is shown a third of the time. Exposures are kept where the nearest
whole number of periods is within 2 % of them, as it is of all long ones.
"""

from __future__ import annotations

from ltcl.acquisition.rig import LONGEST, SHORTEST
from ltcl.errors import InputError

_BROKEN = 0.02
_STEPS = (1, 2, 3, 4, 6, 8, 12, 16)  # about half a stop apart, then doubled on and on


def whole(seconds: float, period: float) -> bool:
    """Whether an exposure sees whole periods, but for 2 %.

    >>> whole(1 / 60, 1 / 60), whole(1 / 50, 1 / 60), whole(1 / 8, 1 / 60), whole(1.01, 1 / 60)
    (True, False, False, True)
    """
    count = seconds / period
    return round(count) >= 1 and abs(count - round(count)) <= _BROKEN * count


def exposures(
    offered: tuple[float, ...] | None,
    period: float | None,
    limits: tuple[float, float] = (SHORTEST, LONGEST),
) -> tuple[float, ...] | None:
    """Those of the camera's exposures that see whole periods; multiples of the period where it has any.

    Parameters
    ----------
    offered : tuple of float, or None
        The seconds of the camera, ascending; None: any within `limits`.
    period : float or None
        Of the projector, in seconds; None: its light is steady, and every exposure will do.
    limits : (float, float)
        The shortest and the longest exposure of a camera that has any between them.

    Raises
    ------
    InputError
        The camera has none.

    Examples
    --------
    >>> exposures((1 / 125, 1 / 60, 1 / 50, 1 / 30), 1 / 60)
    (0.016666666666666666, 0.03333333333333333)
    >>> [round(seconds, 4) for seconds in exposures(None, 1 / 60)][:4]
    [0.0167, 0.0333, 0.05, 0.0667]
    """
    if period is None:
        return offered
    if offered is None:
        offered = _multiples(period, limits)
    kept = tuple(seconds for seconds in offered if whole(seconds, period))
    if not kept:
        least, most = (offered[0], offered[-1]) if offered else limits
        raise InputError(
            f"the camera's exposures, {least:.4g} to {most:.4g} s, hold no multiple of the "
            f"projector's period, {period:.4g} s; period=None allows them where its light is steady"
        )
    return kept


def _multiples(period: float, limits: tuple[float, float]) -> tuple[float, ...]:
    most = int(limits[1] / period * (1 + 1e-9))
    counts = {step << k for step in _STEPS for k in range(most.bit_length()) if step << k <= most}
    return tuple(count * period for count in sorted(counts) if count * period >= limits[0])
