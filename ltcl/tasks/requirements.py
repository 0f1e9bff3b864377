# SPDX-License-Identifier: BSD-3-Clause
"""Requirements of several tasks: `inverse` and `exact` of the same T, tolerance, progress."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError, InputTypeError
from ltcl.solvers import Inverse
from ltcl.transport.transport import Transport, check_transport

# Relative difference of first bounces that float32 does not resolve.
FIRST_BOUNCE_RTOL = 1e-6
# Rounding of float32 in the products that show whether an inverse belongs to a transport.
INVERSE_ROUNDING = 1e-5


def check_same_scene(name: str, other: Any, T: Transport, advice: str) -> None:
    """Refuse an object made from a transport with other pixels, colours or first bounce than T."""
    for attribute in ("grid", "channels"):
        value = getattr(other, attribute)
        expected = getattr(T, attribute)
        if value != expected:
            raise InputError(f"{name} has {attribute} {value}; it must be that of T, {expected}")
    if not np.allclose(other.first_bounce, T.first_bounce, rtol=FIRST_BOUNCE_RTOL, atol=0.0):
        raise InputError(f"{name} has another first bounce than T; {advice}")
    if not np.array_equal(_mixing_matrix(T), _mixing_matrix(other)):
        raise InputError(f"{name} mixes colours in another way than T; {advice}")


def _mixing_matrix(T: Any) -> np.ndarray:
    if T.mixing is None:
        return np.eye(3)
    return T.mixing


def check_inverse(T: Transport, inverse: Any, rtol: float | None, **replaced: Any) -> None:
    """Refuse an `inverse` of another T or with an error above `rtol`.

    The options `replaced` belong to the solves that the inverse takes the place of: they must be
    None.
    """
    if not isinstance(inverse, Inverse):
        kind = type(inverse).__name__
        raise InputTypeError(f"inverse is a {kind}; it must be what ltcl.invert(T) gives")
    for name, value in replaced.items():
        if value is not None:
            raise InputError(
                f"{name} is given, but inverse takes the place of all solves; leave one out"
            )
    inverse.refuse_beyond(rtol)
    # That of several projectors is the inverse of the scene that they have in common.
    T = T.scene
    if inverse in T.checked_inverses:
        return
    check_same_scene("inverse", inverse, T, "make it with ltcl.invert(T)")
    deviation = _roundtrip_deviation(T, inverse)
    allowed = inverse.error + T.error * (1.0 + inverse.error) + INVERSE_ROUNDING
    # Written so that NaN is refused, too.
    if not deviation <= allowed:
        raise InputError(
            f"inverse is not that of T: a random light deviates by {deviation:.2g} after S and "
            f"inverse, which may be {checks.upwards(allowed)} at most; make it with ltcl.invert(T)"
        )
    T.checked_inverses.add(inverse)


def _roundtrip_deviation(T: Transport, inverse: Inverse) -> float:
    """||X S v - v|| / ||v|| of a random light v, for the worst channel."""
    v = np.random.default_rng(0).standard_normal(T.shape[1]).astype(np.float32)
    deviations = []
    for X, S in zip(inverse.systems, T.systems, strict=True):
        deviations.append(np.linalg.norm(X @ (S @ v) - v))
    return float(max(deviations) / np.linalg.norm(v))


def default_rtol(
    minimum: float, T: Transport, exact: Any = None, inverse: Inverse | None = None
) -> float:
    """Default tolerance of a task: `minimum`, or the error of T or of the inverse if larger."""
    error = 0.0
    if inverse is not None:
        error = inverse.error
    elif exact is None:
        error = T.error
    if error >= 1.0:
        # The solve refuses such a T or inverse, with the reason.
        return minimum
    return max(minimum, error)


def check_exact(T: Transport, exact: Any) -> None:
    """Refuse an `exact` that is not the uncompressed transport of T."""
    check_transport(T)
    check_transport(exact, name="exact")
    check_same_scene("exact", exact, T, "it must be that of T, or T made from exact")


def check_progress(
    progress: Callable[[str, float], object] | None,
) -> Callable[[str, float], object]:
    """`progress`, or a function that does nothing if it is None."""
    if progress is None:
        return _ignore_progress
    if not callable(progress):
        raise InputTypeError(f"progress is {progress!r}; it must be callable(text, share), or None")
    return progress


def _ignore_progress(text: str, share: float) -> None:
    """Report to nobody."""


def error_note(error: float) -> str:
    """Suffix of a printed result: the error of its T, empty if T is exact."""
    if not error:
        return ""
    return f" with a T that itself is off by {checks.upwards(error)}"
