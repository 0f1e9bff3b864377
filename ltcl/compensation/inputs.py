# SPDX-License-Identifier: BSD-3-Clause
"""What `compensate` is given, checked before anything is uploaded; pictures as one (M, k) array a channel."""

from __future__ import annotations

import dataclasses
import logging
from typing import Any

import numpy as np

from ltcl import checks, layout
from ltcl.errors import InputError, InputTypeError
from ltcl.solvers import sampled
from ltcl.solvers.methods import KINDS, METHODS, SAMPLED
from ltcl.transport import Transport

logger = logging.getLogger(__name__)

Columns = list[np.ndarray]
_OWN = ("bounds", "background", "gain", "loss", "weights", "exact", "inverse", "clamp", "method", "rtol")
_OPTIONS = ("atol", "maxiter", "callback", "throw")  # of `ltcl.solve`, that a solve within bounds has, too

_LEAST_LOSS = 1e-6


def bounds(value: Any) -> tuple[float, float]:
    """(low, high), finite and in this order."""
    try:
        low, high = value
    except (TypeError, ValueError):
        raise InputError(f"bounds is {_shown(value)}; it must be (low, high)") from None
    for place, bound in enumerate((low, high)):
        if np.ndim(bound):
            raise InputError(
                f"bounds[{place}] is {_shown(bound)}; it must be one number, the same for all pixels"
            )
    low = checks.number("bounds[0]", low)
    return low, checks.number("bounds[1]", high, above=low)


def gain(value: Any, loss: Any) -> float | None:
    """The gain, None where it is to be found; a loss is checked, too."""
    if isinstance(value, str) and value == "auto":
        if loss is not None and checks.number("loss", loss, above=0.0, below=1.0) < _LEAST_LOSS:
            raise InputError(
                f"loss is {loss!r}, which float32 cannot tell from none; it must be at least {_LEAST_LOSS:g}"
            )
        return None
    try:
        found = None if np.ndim(value) else checks.number("gain", value, above=0.0)
    except InputError:
        found = None
    if found is None:
        raise InputError(f"gain is {_shown(value)}; it must be 'auto' or a finite number above 0")
    if loss is not None:
        raise InputError(f"loss is {loss!r}, but gain is {value!r}; a loss is of use with gain='auto' only")
    return found


def clamp(value: Any, T: Transport) -> None:
    """Refuse what is no yes or no, and light that nothing but a solve within the bounds finds."""
    if not isinstance(value, bool):
        raise InputTypeError(f"clamp is {_shown(value)}; it must be True or False")
    if value and not T.is_square:
        raise InputError("clamp is True, but this T has no S; its light is found within the bounds only")


def desired(value: Any, T: Transport) -> tuple[Columns, layout.Layout]:
    """Of every channel; a warning where it looks like a picture that was not decoded."""
    array = checks.real("desired", value)
    if array.dtype.kind in "iu" and array.size and array.max() > 1:
        logger.warning(
            "desired holds %s, up to %d; it is taken as linear radiance in the units of T: "
            "use ltcl.images.read, or divide",
            array.dtype,
            array.max(),
        )
    return layout.unpack("desired", array, T.camera_grid, T.channels)


def background(value: Any, T: Transport, shape: layout.Layout, like: Columns) -> Columns:
    """Of every channel: none, one number, one for all frames, or one per frame."""
    if value is None:
        return [np.zeros_like(part) for part in like]
    if np.ndim(value) == 0:
        level = checks.number("background", value)
        return [np.full(part.shape, level) for part in like]
    return _alike("background", value, T, shape, like)


def weights(value: Any, T: Transport, shape: layout.Layout, like: Columns) -> Columns | None:
    """Of every channel; None where all pixels count alike."""
    if value is None:
        if not T.masked.any():
            return None
        return [np.broadcast_to(~T.masked[:, None], part.shape).astype(np.float64) for part in like]
    counts = _alike("weights", value, T, shape, like)
    least, most = (pick(part.min() if pick is min else part.max() for part in counts) for pick in (min, max))
    if least < 0.0 or most == 0.0:
        raise InputError(f"weights range from {least:.3g} to {most:.3g}; they must be at least 0, not all 0")
    return counts


def rules(T: Transport, method: str, rtol: Any, options: dict[str, Any]) -> dict[str, Any]:
    """Options of a solve within the bounds; of a T without S, those are all that there are."""
    sampled.check_whole(options)
    if not T.is_square and method != "auto":
        raise InputError(f"method is {method!r}, but this T has no S for it to solve; it must be 'auto'")
    checks.one_of("method", method, METHODS)
    known = list(_OPTIONS)
    if T.is_square:
        kind = KINDS.get(method)
        known += ["x0", *(field.name for field in (dataclasses.fields(kind) if kind else ()))]
    sampled.check_method(method, options, SAMPLED)
    for name in options:
        if name not in known:
            raise InputTypeError(f"unknown option {name!r}; compensate has {', '.join([*_OWN, *known])}")
    rtol = checks.number("rtol", rtol, least=0.0, below=1.0)
    atol = checks.number("atol", options.get("atol", 0.0), least=0.0)
    if rtol == 0.0 and atol == 0.0:
        raise InputError("rtol and atol are both 0; one of them must be positive")
    found = {"rtol": rtol, "atol": atol, "callback": options.get("callback")}
    if options.get("maxiter") is not None:
        found["maxiter"] = checks.count("maxiter", options["maxiter"])
    return found


def _shown(value: Any) -> str:
    """What was given, in one line; of arrays the shape."""
    if isinstance(value, (tuple, list)) and any(np.ndim(part) for part in value):
        return f"a {type(value).__name__} of {len(value)} arrays"
    return f"an array of shape {np.shape(value)}" if isinstance(value, np.ndarray) else repr(value)


def _alike(name: str, value: Any, T: Transport, shape: layout.Layout, like: Columns) -> Columns:
    """Columns of a picture that has as many frames and colours as `like`, which has `shape`, or one."""
    columns, own = layout.unpack(name, value, T.camera_grid, T.channels)
    # (M, frames, colours): one frame or one grey serves all.
    have, want = (
        (len(like[0]), part.frames or 1, 3 if part.colour and T.channels == 1 else 1) for part in (own, shape)
    )
    try:
        return [np.broadcast_to(c.reshape(have), want).reshape(c.shape[0], -1) for c in columns]
    except ValueError:
        raise InputError(
            f"{name} has {have[1]} frame(s) of {have[2]} colour(s), desired {want[1]} of {want[2]}; "
            f"{name} must have as many, or one"
        ) from None
