# SPDX-License-Identifier: BSD-3-Clause
"""Whether an inverse serves for a transport: what tasks ask before they take it in place of solves."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError, InputTypeError
from ltcl.solvers.inverse import Inverse
from ltcl.transport import Transport, refuse_other, require

_ROUNDING = 1e-5  # of float32, in the light that tells whether an inverse is that of a transport
_FITS: weakref.WeakKeyDictionary[Inverse, weakref.ref[Transport]] = weakref.WeakKeyDictionary()


def require_inverse(T: Transport, inverse: Any, rtol: float | None, **others: Any) -> Inverse:
    """`inverse`, if it can serve for T at `rtol`; `others` are arguments that it takes the place of.

    Raises
    ------
    InputError, InputTypeError
        No inverse, one of another transport, an `rtol` below its error, or one of the others is given.
    """
    if not isinstance(inverse, Inverse):
        raise InputTypeError(f"inverse is a {type(inverse).__name__}; it must be what ltcl.invert(T) gives")
    for name, value in others.items():
        if value is not None:
            raise InputError(f"{name} is given, but inverse takes the place of all solves; leave one out")
    require(T)
    inverse.refuse_beyond(rtol)
    known = _FITS.get(inverse)
    if known is None or known() is not T:
        _refuse_other(T, inverse)
        _FITS[inverse] = weakref.ref(T)
    return inverse


def _refuse_other(T: Transport, inverse: Inverse) -> None:
    """Refuse a transport that this is not the inverse of: told by one random light."""
    refuse_other("inverse", inverse, T, "make it with ltcl.invert(T)")
    missed, allowed = _miss(T, inverse)
    if not missed <= allowed:
        raise InputError(
            f"inverse is not that of T: a random light comes back off by {missed:.2g}, which may be "
            f"{checks.upwards(allowed)} at most; make it with ltcl.invert(T)"
        )


def _miss(T: Transport, inverse: Inverse) -> tuple[float, float]:
    """By how much X S v misses v, relatively and in the worst channel, and what it may be."""
    v = np.random.default_rng(0).standard_normal(T.shape[1]).astype(np.float32)
    misses = [np.linalg.norm(X @ (S @ v) - v) for X, S in zip(inverse.systems, T.systems, strict=True)]
    off = T.error * (1.0 + inverse.error)
    return float(max(misses) / np.linalg.norm(v)), inverse.error + off + _ROUNDING
