# SPDX-License-Identifier: BSD-3-Clause
"""Checks of the arguments of `compensate`, before anything is uploaded."""

from __future__ import annotations

import dataclasses
import logging
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError, InputTypeError
from ltcl.solvers.solve import METHODS, OPTIONS
from ltcl.tasks.compensation.problem import Columns, CompensationProblem, StoppingRules
from ltcl.transport import frames as layout
from ltcl.transport.transport import Transport

logger = logging.getLogger(__name__)

# Arguments of `compensate` itself.
ARGUMENTS = (
    "bounds",
    "background",
    "gain",
    "loss",
    "weights",
    "exact",
    "inverse",
    "clamp",
    "method",
    "rtol",
)
# Options of `ltcl.solve` that a solve within bounds has, too.
SOLVE_OPTIONS = ("atol", "maxiter", "callback", "throw")
# The least relative error that float32 resolves.
MIN_LOSS = 1e-6
# Brightest pixels: from 1e-38 on float32 has all digits, and some devices have any.
MIN_BRIGHTNESS = 1e-30
MAX_BRIGHTNESS = 1e38
# Times the brightest pixel that was reached: beyond, desired is hardly in the units of T.
UNITS_RATIO = 4.0


def check_gain(gain: Any, loss: Any) -> float | None:
    """The gain as a number, None for "auto"; a loss is checked, too."""
    if not isinstance(gain, str):
        number = checks.number("gain", gain, above=0.0)
        if loss is not None:
            raise InputError(
                f"loss is {loss!r}, but gain is {gain!r}; a loss belongs to gain='auto' only"
            )
        return number
    if gain != "auto":
        raise InputError(f"gain is {gain!r}; it must be 'auto' or a finite number above 0")
    if loss is not None:
        checks.number("loss", loss, least=MIN_LOSS, below=1.0)
    return None


def check_background(
    background: Any, T: Transport, shape: layout.Layout, desired: Columns
) -> Columns:
    """The background of every channel, like `desired`: none, one number, one or all frames."""
    if background is None:
        level = np.float32(0)
    elif np.ndim(background) == 0:
        level = checks.number("background", background)
    else:
        return _check_frames("background", background, T, shape, desired)
    return [np.broadcast_to(level, d.shape) for d in desired]


def check_weights(
    weights: Any, T: Transport, shape: layout.Layout, desired: Columns
) -> tuple[Columns | None, float]:
    """The weights of every channel, None if all are alike, and their unit.

    The unit is a power of 2 that keeps their squares inside float64.
    """
    if weights is None and not T.masked.any():
        return None, 1.0
    if weights is None:
        is_lit = ~T.masked[:, None]
        return [np.broadcast_to(is_lit, d.shape).astype(np.float64) for d in desired], 1.0
    weights = checks.real("weights", weights).astype(np.float64, copy=False)
    channels = _check_frames("weights", weights, T, shape, desired)
    smallest = min(float(w.min()) for w in channels)
    largest = max(float(w.max()) for w in channels)
    if smallest < 0.0 or largest == 0.0:
        raise InputError(
            f"weights range from {smallest:.3g} to {largest:.3g}; "
            "they must be at least 0, not all 0"
        )
    _, exponent = np.frexp(largest)
    unit = float(np.ldexp(1.0, int(exponent) - 1))
    return [w / unit for w in channels], unit


def check_rules(
    T: Transport, method: str, rtol: float, options: dict[str, Any], weight_unit: float
) -> StoppingRules:
    """The rules of a solve within the bounds; a T without S has no other solve."""
    checks.one_of("method", method, METHODS)
    if not T.is_square and method != "auto":
        raise InputError(
            f"method is {method!r}, but this T has no S for it to solve; it must be 'auto'"
        )
    _check_option_names(T, method, options)
    rtol = checks.number("rtol", rtol, least=0.0, below=1.0)
    atol = checks.number("atol", options.get("atol", 0.0), least=0.0)
    if rtol == 0.0 and atol == 0.0:
        condition = " where atol is 0" if "atol" in options else ""
        raise InputError(f"rtol is 0; it must be above 0 and below 1{condition}")
    rules = StoppingRules(
        rtol=rtol,
        atol=atol / weight_unit,
        callback=options.get("callback"),
    )
    if options.get("maxiter") is not None:
        maxiter = checks.count("maxiter", options["maxiter"])
        rules = dataclasses.replace(rules, maxiter=maxiter)
    return rules


def _check_option_names(T: Transport, method: str, options: dict[str, Any]) -> None:
    known = list(SOLVE_OPTIONS)
    if T.is_square:
        known.append("x0")
    known.extend(OPTIONS.get(method, ()))
    for name in options:
        # Some pixels alone are no pattern.
        if name in known and name != "pixels":
            continue
        owners = [repr(owner) for owner, names in OPTIONS.items() if name in names]
        problem = f"unknown option {name!r}"
        if owners and name != "pixels":
            problem = f"{name} is an option of method={' and '.join(owners)}"
        allowed = ", ".join([*ARGUMENTS, *known])
        raise InputTypeError(f"{problem}; compensate with method {method!r} has {allowed}")


def check_range(problem: CompensationProblem, gain: float) -> None:
    """Refuse pictures that float32 does not resolve, or does not hold."""
    brightest_light = max(abs(problem.limits.low), abs(problem.limits.high))
    largest_scale = max(float(scale.max()) for _, scale in problem.systems)
    brightest_desired = max(max(float(d.max()), -float(d.min())) for d in problem.desired)
    light = f"light of {brightest_light:.3g}, as bounds allow it, makes"
    pictures = {
        "T reaches": largest_scale,
        "desired reaches": gain * brightest_desired,
        light: brightest_light * largest_scale,
    }
    for subject, brightest in pictures.items():
        if 0.0 < brightest < MIN_BRIGHTNESS or brightest > MAX_BRIGHTNESS:
            raise InputError(
                f"{subject} {brightest:.3g}; it must be from {MIN_BRIGHTNESS:g} to "
                f"{MAX_BRIGHTNESS:g}: scale T, desired or bounds"
            )


def warn_of_units(target: Columns, appearance: Columns) -> None:
    """Log a warning if the brightest pixel of the target is far beyond that of the appearance."""
    highest = max(float(c.max()) for c in target)
    reached = max(float(c.max()) for c in appearance)
    if highest > UNITS_RATIO * reached:
        logger.warning(
            "desired reaches %.3g, the scene %.3g at most; %s",
            highest,
            reached,
            layout.UNITS % 255,
        )


def _check_frames(
    name: str, value: Any, T: Transport, shape: layout.Layout, desired: Columns
) -> Columns:
    """Columns of a picture with as many frames and colours as `desired`, or one of these."""
    columns, value_shape = layout.unpack(name, value, T.camera_grid, T.channels)
    pixels = len(desired[0])
    counts = _frames_and_colours(value_shape, T.channels)
    expected = _frames_and_colours(shape, T.channels)
    for count, expected_count in zip(counts, expected, strict=True):
        if count not in (1, expected_count):
            raise InputError(
                f"{name} has {counts[0]} frame(s) of {counts[1]} colour(s), desired {expected[0]} "
                f"of {expected[1]}; {name} must have as many, or one"
            )
    repeated = []
    for column in columns:
        frames = np.broadcast_to(column.reshape(pixels, *counts), (pixels, *expected))
        repeated.append(frames.reshape(pixels, -1))
    return repeated


def _frames_and_colours(shape: layout.Layout, channels: int) -> tuple[int, int]:
    """Frames, and colours that stand side by side in the columns of one channel."""
    frames = 1 if shape.frames is None else shape.frames
    colours = 3 if shape.colour and channels == 1 else 1
    return frames, colours
