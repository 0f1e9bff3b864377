# SPDX-License-Identifier: BSD-3-Clause
"""Shared part of `ltcl compensate` and `ltcl film`: the transport, projector and settings."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from ltcl.cli import loading, pictures
from ltcl.cli.command import Context
from ltcl.cli.options import file_option, option
from ltcl.cli.reports.pictures import PatternCodes
from ltcl.errors import InputError
from ltcl.tasks import compensation
from ltcl.transport.transport import Transport

PROJECTOR_PANEL = "Projector and target"
projector_option = partial(option, panel=PROJECTOR_PANEL)
projector_file = partial(file_option, panel=PROJECTOR_PANEL)


def parse_gain(text: str) -> float | str:
    """Parse a number, or auto."""
    if text == "auto":
        return text
    try:
        return float(text)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not a gain; write a number, or auto") from None


Gain = Annotated[
    str | None,
    projector_option(
        "Factor between the picture and what the scene will show; auto: the "
        "largest within reach. Default: 1; auto if T was measured.",
        parser=parse_gain,
        metavar="FACTOR",
    ),
]


def parse_film_gain(text: str) -> float | str:
    """Return a factor, "auto" or "follow"."""
    if text == "follow":
        return text
    try:
        return parse_gain(text)
    except typer.BadParameter:
        raise typer.BadParameter(
            f"{text!r} is not a gain; write a number, auto or follow"
        ) from None


FilmGain = Annotated[
    str | None,
    projector_option(
        "Factor between the film and what the scene will show; auto: the largest within reach of "
        "frames from all parts; follow: one that goes after the content, no faster than twofold in "
        "a second. Default: 1; auto if T was measured.",
        parser=parse_film_gain,
        metavar="FACTOR",
    ),
]


def target_options(
    gain: Gain = None,
    loss: Annotated[
        float | None,
        projector_option(
            "Relative error that the gain may cost with --gain auto. Default: the least possible."
        ),
    ] = None,
    low: Annotated[float, projector_option("Darkest light of the projector.")] = 0.0,
    high: Annotated[float, projector_option("Brightest light of the projector.")] = 1.0,
    clamp: Annotated[
        bool,
        projector_option(
            "Cut off light beyond that range, instead of finding the best pattern within it.",
            "--clamp",
        ),
    ] = False,
    background: Annotated[
        Path | None,
        projector_file(
            "Picture of the light without the projector. Default: as measured, else none."
        ),
    ] = None,
    calibration: Annotated[
        Path | None,
        projector_file("Store of 'ltcl acquire' from which TRANSPORT was made."),
    ] = None,
    weights: Annotated[
        Path | None,
        projector_file("Picture of the weight of the error at each pixel."),
    ] = None,
) -> None:
    """Options of the target and of the projector."""


@dataclass(kw_only=True)
class CompensationJob:
    """A transport, its measured projector, and the arguments of `compensate`."""

    T: Transport
    setup: Any
    settings: dict[str, Any]
    heading: dict[str, Any]
    notes: list[str | None] = field(default_factory=list)

    @property
    def pattern_codes(self) -> PatternCodes:
        """Encoding of a pattern's .png."""
        return "sRGB" if self.setup is None else "codes of the measured projector"


def prepare(context: Context, transport: Path) -> CompensationJob:
    """Load all that the options name, and check that it fits together."""
    asked = context.options
    setup = loading.load_setup(transport, asked["calibration"])
    T = loading.load(context, transport)
    if setup is None:
        setup = loading.setup_of_several(T)
    if setup is not None:
        _check_setup(context, setup, T)
    settings = loading.solver_settings(context, T, compensation.RTOL)
    settings["loss"] = asked["loss"]
    settings["clamp"] = asked["clamp"]
    settings["bounds"] = (asked["low"], asked["high"])
    settings["gain"] = resolve_gain(asked["gain"], setup)
    for name in ("weights", "background"):
        settings[name] = _read_camera_picture(context, asked[name], T)
    resolved = {"rtol": settings["rtol"], "gain": settings["gain"]}
    caveat = loading.compression_caveat("errors are", T, asked["exact"])
    notes = [caveat]
    if settings["weights"] is None and T.unlit.any():
        unlit = f"{T.unlit.sum()} camera pixels that the projector does not light"
        notes.append(f"{unlit} do not count in errors")
    if setup is not None:
        notes.append(
            "pattern .png holds the codes of the measured projector; 'ltcl show' shows it there"
        )
        if settings["background"] is None:
            # That of several projectors is in their T.
            settings["background"] = setup.ambient
            resolved["background"] = "measured"
            notes.append("the background is the ambient light that was measured")
    heading = loading.heading(context, transport, T, **resolved)
    return CompensationJob(T=T, setup=setup, settings=settings, heading=heading, notes=notes)


def resolve_gain(gain: float | str | None, setup: Any) -> float | str:
    """Return the gain, by default 1, or "auto" if the projector was measured."""
    if gain is None:
        return 1.0 if setup is None else "auto"
    return gain


def _check_setup(context: Context, setup: Any, T: Transport) -> None:
    """Refuse a projector with other pixels than T, and bounds beyond its measured range."""
    if (setup.grid, setup.channels) != (T.grid, T.channels):
        sizes = f"{setup.grid} and {setup.channels} channel(s)"
        path = context.options["calibration"]
        raise InputError(f"{path}: is of {sizes}; TRANSPORT has {T.grid} and {T.channels}")
    low = context.options["low"]
    high = context.options["high"]
    if not 0.0 <= low < high <= 1.0:
        problem = f"--low is {low:g} and --high is {high:g}"
        raise InputError(f"{problem}; a measured projector has 0 to 1")


def _read_camera_picture(context: Context, path: Path | None, T: Transport) -> Any:
    """Read a picture in the camera's pixels; None if there is none."""
    if path is None:
        return None
    return pictures.read(context, path, T.camera_grid, "the camera", upright=False)
