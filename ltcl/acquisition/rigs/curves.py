# SPDX-License-Identifier: BSD-3-Clause
"""Response curves by name, as a pair: light to code as a camera does, code to light as a projector does.

Light l and code c are in [0, 1]; every curve takes 0 to 0 and 1 to 1.

    linear      c = l
    gamma2.2    c = l^(1 / 2.2)
    srgb        IEC 61966-2-1, as in `ltcl.images.srgb`
    film        c = (1 + m^g) l^g / (l^g + m^g),  g = 1.2, m = 0.25

The last is a logistic in log l: the S of a characteristic curve after Hurter and Driffield (density over the
logarithm of exposure), with toe and shoulder, scaled to end at (1, 1).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ltcl import checks
from ltcl.errors import InputError, InputTypeError
from ltcl.images.srgb import from_srgb, to_srgb

Curve = Callable[[np.ndarray], np.ndarray]
_STEEPNESS, _MIDDLE = 1.2, 0.25
_TOP = 1.0 + _MIDDLE**_STEEPNESS


class _Pair(NamedTuple):
    encode: Curve  # light to code
    decode: Curve  # code to light


def _same(x: np.ndarray) -> np.ndarray:
    return x


def _film(light: np.ndarray) -> np.ndarray:
    power = light**_STEEPNESS
    return _TOP * power / (power + _MIDDLE**_STEEPNESS)


def _film_undone(code: np.ndarray) -> np.ndarray:
    return _MIDDLE * (code / (_TOP - code)) ** (1.0 / _STEEPNESS)


NAMED = {
    "linear": _Pair(_same, _same),
    "srgb": _Pair(to_srgb, from_srgb),
    "film": _Pair(_film, _film_undone),
    "gamma2.2": _Pair(lambda light: light ** (1 / 2.2), lambda code: code**2.2),
}


def camera(given: Any, channels: int) -> tuple[Curve, ...]:
    """The curve of each channel from light to code: a name, a function, or three of these.

    Raises
    ------
    InputError, InputTypeError
        An unknown name; a function that is not finite, falls, or leaves [0, 1] on [0, 1].

    Examples
    --------
    >>> float(camera("srgb", 1)[0](np.array(0.5)).round(3))
    0.735
    """
    return tuple(_curve("response", part, 0) for part in _each("response", given, channels))


def projector(given: Any, channels: int) -> tuple[Curve, ...]:
    """The curve of each channel from code to light; as `camera`.

    Examples
    --------
    >>> float(projector("srgb", 1)[0](np.array(0.5)).round(3))
    0.214
    """
    name = "projector_response"
    return tuple(_curve(name, part, 1) for part in _each(name, given, channels))


def called(given: Any) -> str | list[str]:
    """What a curve is called in records.

    >>> called("srgb"), called(["srgb", np.sqrt, "film"])
    ('srgb', ['srgb', 'sqrt', 'film'])
    """
    if isinstance(given, (list, tuple)):
        return [str(called(part)) for part in given]
    return given if isinstance(given, str) else getattr(given, "__name__", type(given).__name__)


def _each(name: str, given: Any, channels: int) -> list[Any]:
    if not isinstance(given, (list, tuple)):
        return [given] * channels
    if len(given) != channels:
        raise InputError(f"{name} has {len(given)} curves; it must be one curve, or {channels}")
    return list(given)


def _curve(name: str, given: Any, direction: int) -> Curve:
    if isinstance(given, str):
        return NAMED[checks.one_of(name, given, NAMED)][direction]
    curve: Curve = given
    if not callable(given):
        raise InputTypeError(f"{name} is {given!r}; it must be one of {', '.join(NAMED)}, or a function")
    x = np.linspace(0.0, 1.0, 1025)
    y = checks.finite(f"{name}(x)", checks.real(f"{name}(x)", given(x)))
    checks.shape(f"{name}(x)", y, x.shape)
    if y.min() < 0 or y.max() > 1 or np.any(np.diff(y) < 0):
        raise InputError(
            f"{name} falls or spans {y.min():g} to {y.max():g} on [0, 1]; it must rise within [0, 1]"
        )
    return curve
