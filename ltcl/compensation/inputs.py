# SPDX-License-Identifier: BSD-3-Clause
"""What `compensate` is given, checked before anything is uploaded; pictures as one (M, k) array a channel."""

from __future__ import annotations

from typing import Any

import numpy as np

from ltcl import checks, layout
from ltcl.errors import InputError, InputTypeError
from ltcl.solvers import sampled
from ltcl.transport import Transport

Columns = list[np.ndarray]
_OPTIONS = ("atol", "maxiter", "callback", "throw")  # of `ltcl.solve`, that a solve within bounds has, too


def bounds(value: Any) -> tuple[float, float]:
    """(low, high), finite and in this order."""
    try:
        low, high = value
    except (TypeError, ValueError):
        raise InputError(f"bounds is {value!r}; it must be (low, high)") from None
    low = checks.number("bounds[0]", low)
    return low, checks.number("bounds[1]", high, above=low)


def gain(value: Any, loss: Any) -> float | None:
    """The gain, None where it is to be found; a loss is checked, too."""
    if isinstance(value, str):
        if value != "auto":
            raise InputError(f"gain is {value!r}; it must be 'auto' or a finite number above 0")
        if loss is not None:
            checks.number("loss", loss, above=0.0, below=1.0)
        return None
    if loss is not None:
        raise InputError(f"loss is {loss!r}, but gain is {value!r}; a loss is of use with gain='auto' only")
    return checks.number("gain", value, above=0.0)


def background(value: Any, T: Transport, shape: layout.Layout, like: Columns) -> Columns:
    """Of every channel: none, one for all frames, or one per frame."""
    if value is None:
        return [np.zeros_like(part) for part in like]
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
    if not T.is_square:
        if method != "auto":
            raise InputError(f"method is {method!r}, but this T has no S for it to solve; it must be 'auto'")
        for name in options:
            if name not in _OPTIONS:
                raise InputTypeError(
                    f"unknown option {name!r}; for a T without S there are {', '.join(_OPTIONS)}"
                )
    rtol = checks.number("rtol", rtol, least=0.0, below=1.0)
    atol = checks.number("atol", options.get("atol", 0.0), least=0.0)
    if rtol == 0.0 and atol == 0.0:
        raise InputError("rtol and atol are both 0; one of them must be positive")
    found = {"rtol": rtol, "atol": atol, "callback": options.get("callback")}
    if options.get("maxiter") is not None:
        found["maxiter"] = checks.count("maxiter", options["maxiter"])
    return found


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
