# SPDX-License-Identifier: BSD-3-Clause
"""Checks of the arguments of `compensate`, before anything is uploaded."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Operator
from ltcl.solvers import METHODS, Inverse, SolveSettings
from ltcl.solvers.solve import OPTIONS
from ltcl.tasks.compensation.problem import (
    Columns,
    CompensationProblem,
    Limits,
    channel_systems,
    stack_channels,
)
from ltcl.tasks.requirements import check_exact, check_inverse, default_rtol
from ltcl.transport import frames as layout
from ltcl.transport.transport import Transport, check_transport

# Tolerance of the solves if none is given.
RTOL = 1e-2
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


@dataclass(frozen=True, kw_only=True, eq=False)
class CompensationRequest:
    """The checked inputs of `compensate`.

    Attributes
    ----------
    T, reference : Transport
        The transport that solves, and the one that judges.
    problem : CompensationProblem
    shape : PictureLayout
        Frames and colours of `desired`.
    gain, loss : float, optional
        No gain means "auto".
    is_exact_gain_allowed : bool
        True if gain="auto" takes the largest gain without an error, if there is one.
    first_bounce : (channels, N) float64
        Empty if T has no S.
    transport_error : float
        ``.error`` of the reference.
    inverse : Inverse, optional
    method, options : str, dict
        Arguments of `ltcl.solve`.
    exact : sequence of Operator
        The systems that judge the solves of each channel, if T does not judge them itself.
    clamp : bool
    """

    T: Transport
    reference: Transport
    problem: CompensationProblem
    shape: layout.PictureLayout
    gain: float | None
    loss: float | None
    is_exact_gain_allowed: bool
    first_bounce: np.ndarray
    transport_error: float
    inverse: Inverse | None
    method: str
    options: dict[str, Any]
    exact: Sequence[Operator]
    clamp: bool


def check_inputs(
    T: Transport,
    desired: Any,
    *,
    bounds: tuple[float, float],
    background: Any,
    gain: float | str,
    loss: float | None,
    weights: Any,
    method: str,
    rtol: float | None,
    exact: Transport | None,
    inverse: Inverse | None,
    clamp: bool,
    options: dict[str, Any],
) -> CompensationRequest:
    """Refuse bad inputs before anything is uploaded, and set up the problem."""
    check_transport(T, square=False)
    bounds = checks.interval("bounds", bounds)
    checked_gain = check_gain(gain, loss)
    system_count = 1 if T.couples else T.channels
    masked = stack_channels([T.masked] * T.channels, system_count)[0]
    ceilings = None
    if T.ceilings is not None:
        ceilings = stack_channels([T.ceilings] * T.channels, system_count)[0]
    limits = Limits.in_float32(bounds, masked, ceilings)
    columns, shape = layout.unpack("desired", desired, T.camera_grid, T.channels)
    dark = check_background(background, T, shape, columns)
    if T.background is not None:
        dark = [light + black for light, black in zip(dark, T.background, strict=True)]
    channel_weights, weight_unit = check_weights(weights, T, shape, columns)
    settings = check_solves(
        T,
        method=method,
        rtol=rtol,
        exact=exact,
        inverse=inverse,
        clamp=clamp,
        options=options,
    )
    reference = T
    judging_systems: Sequence[Operator] = ()
    if exact is not None:
        reference = exact
        judging_systems = exact.systems
    if channel_weights is not None:
        channel_weights = stack_channels(channel_weights, system_count)
    problem = CompensationProblem(
        systems=channel_systems(reference),
        desired=stack_channels(columns, system_count),
        background=stack_channels(dark, system_count),
        weights=channel_weights,
        weight_unit=weight_unit,
        limits=limits,
        settings=dataclasses.replace(settings, atol=settings.atol / weight_unit),
    )
    first_bounce = np.zeros((T.channels, 0))
    if T.is_square:
        first_bounce = np.atleast_2d(T.first_bounce)
    return CompensationRequest(
        T=T,
        reference=reference,
        problem=problem,
        shape=shape,
        gain=checked_gain,
        loss=loss,
        is_exact_gain_allowed=weights is None and loss is None,
        first_bounce=first_bounce,
        transport_error=reference.error,
        inverse=inverse,
        method=method,
        options=options,
        exact=judging_systems,
        clamp=clamp,
    )


def check_solves(
    T: Transport,
    *,
    method: str = "auto",
    rtol: float | None = None,
    exact: Transport | None = None,
    inverse: Inverse | None = None,
    clamp: bool = False,
    options: dict[str, Any],
) -> SolveSettings:
    """Refuse what no picture could be solved with; the settings of the solves."""
    if inverse is not None:
        other_method = None if method == "auto" else method
        check_inverse(T, inverse, rtol, exact=exact, method=other_method)
    if rtol is None:
        rtol = RTOL
        if T.is_compressed or inverse is not None:
            rtol = default_rtol(RTOL, T, exact, inverse)
    settings = check_settings(T, method, rtol, options)
    if checks.flag("clamp", clamp) and not T.is_square and T.scene is T:
        raise InputError(
            "clamp is True, but this T has no S; its light is found within the bounds only"
        )
    if exact is not None:
        check_exact(T, exact)
    return settings


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
    background: Any, T: Transport, shape: layout.PictureLayout, desired: Columns
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
    weights: Any, T: Transport, shape: layout.PictureLayout, desired: Columns
) -> tuple[Columns | None, float]:
    """The weights of every channel, None if all are alike, and their unit.

    The unit is a power of 2 that keeps their squares inside float64.
    """
    if weights is None and not T.unlit.any():
        return None, 1.0
    if weights is None:
        is_lit = ~T.unlit[:, None]
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


def check_settings(
    T: Transport, method: str, rtol: float, options: dict[str, Any]
) -> SolveSettings:
    """The settings of a solve within the bounds; a T without S has no other solve."""
    checks.one_of("method", method, METHODS)
    if not T.is_square and method != "auto":
        raise InputError(
            f"method is {method!r}, but this T has no S for it to solve; it must be 'auto'"
        )
    _check_option_names(T, method, options)
    shared = {}
    for name in SOLVE_OPTIONS:
        if options.get(name) is not None:
            shared[name] = options[name]
    return SolveSettings(rtol=rtol, **shared)


def _check_option_names(T: Transport, method: str, options: dict[str, Any]) -> None:
    known: list[str] = [*SOLVE_OPTIONS]
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


def _check_frames(
    name: str, value: Any, T: Transport, shape: layout.PictureLayout, desired: Columns
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


def _frames_and_colours(shape: layout.PictureLayout, channels: int) -> tuple[int, int]:
    """Frames, and colours that stand side by side in the columns of one channel."""
    colours = 3 if shape.colour and channels == 1 else 1
    return shape.frame_count, colours
