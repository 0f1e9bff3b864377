# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl compensate`: the patterns under which a scene looks like given pictures, or like a film."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from ltcl import report
from ltcl.cli import compensate_frames, console, options, pictures, results, transports
from ltcl.cli.command import Answer, Context
from ltcl.cli.options import argument, file, option, writable_file
from ltcl.compensation import Compensation
from ltcl.errors import InputError
from ltcl.transport import Transport

_MANY = 0.01  # part of a picture out of reach from which advice is given
_SHEET = 12  # pictures on a contact sheet, at most


def _gain(text: str) -> float | str:
    try:
        return "auto" if text == "auto" else float(text)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is no gain; write a number, or auto") from None


_film = partial(option, rich_help_panel="Options of frames: a folder or a video")
_Pictures = Annotated[list[Path], argument("PICTURE...", "Pictures; or one folder or one video of frames.")]
_gain_help = (
    "Match FACTOR times the picture; auto: the largest within reach. Default: 1, auto of a measured T."
)
_Gain = Annotated[str | None, option(_gain_help, parser=_gain, metavar="FACTOR")]
_Loss = Annotated[float | None, option("Error that --gain auto may cost. Default: as little as possible.")]
_Calibration = Annotated[Path | None, file("The store of 'ltcl acquire' that TRANSPORT was made of.")]
_Weights = Annotated[Path | None, file("Picture of how much the error at each pixel counts.")]
_Low = Annotated[float, option("Darkest light of the projector.")]
_High = Annotated[float, option("Brightest light of the projector.")]
_Clamp = Annotated[bool, option("Clamp what exceeds that light, without making up for it.", "--clamp")]
_Background = Annotated[
    Path | None, file("Picture of the light that stays. Default: as measured, else none.")
]
_Batch = Annotated[int | None, _film("Frames solved at once; --resume needs the same. Default: 8.", min=1)]
_Resume = Annotated[bool, _film("Go on where the last run into DIR ended.", "--resume")]
_Frames = Annotated[int | None, _film("Only the first N frames.", min=1, metavar="N")]
_Video = Annotated[
    Path | None, file("Also a video of the patterns: .mkv, .avi or .mp4.", callback=writable_file)
]
_Fps = Annotated[float | None, _film("Frames a second of that video. Default: as the source, else 25.")]
_Format = Annotated[Literal["png", "exr"] | None, _film("png: 16 bits (default); exr: the light as it is.")]
_Appearance = Annotated[bool, _film("Write how the scene will look, too.", "--appearance")]


def compensate(
    context: Context,
    transport: options.Matrix,
    picture: _Pictures,
    out: options.Out,
    grid: options.Grid = None,
    camera_grid: options.CameraGrid = None,
    variable: options.Variable = None,
    method: options.Method = "auto",
    rtol: options.TaskRtol = None,
    inverse: options.Inverse = None,
    exact: options.Exact = None,
    samples: options.Samples = None,
    seed: options.Seed = None,
    first_bounce: options.FirstBounce = None,
    on_dark: options.OnDark = "auto",
    gain: _Gain = None,
    loss: _Loss = None,
    low: _Low = 0.0,
    high: _High = 1.0,
    clamp: _Clamp = False,
    background: _Background = None,
    calibration: _Calibration = None,
    weights: _Weights = None,
    resize: options.Resize = False,
    encoding: options.Encoding = "auto",
    device: options.Device = None,
    batch: _Batch = None,
    resume: _Resume = False,
    frames: _Frames = None,
    video: _Video = None,
    fps: _Fps = None,
    format: _Format = None,
    appearance: _Appearance = False,
) -> Answer:
    """Find the projector patterns that make a scene look like PICTURE.

    Writes for each picture the pattern, how the scene will look under it and what is out of the projector's
    reach, exactly as .exr and as .png; all in compensate.png, and compensate.json. The .png of a pattern has
    the codes for the projector, pixel for pixel: those of the measured response with a TRANSPORT of 'ltcl
    acquire', else sRGB. The others are for the eye, at one exposure, which compensate.json names.

    The ambient light of a TRANSPORT of 'ltcl acquire' is the background, and the gain is auto.

    Of a folder or a video of frames, writes the numbered patterns and frames.json batch by batch, with one
    gain for all; Ctrl-C keeps what is done, for --resume.
    """
    from ltcl.acquisition import Setup

    sampled = options.sampling(context.options)
    source = compensate_frames.source(picture, context.options)
    setup = Setup.of(calibration) if calibration else transports.setup_of(transport)
    T = transports.load(context, transport, "light")
    if setup is not None:
        _check_setup(setup, calibration, T, {"--low": low, "--high": high})
    settings = _settings(context, T, setup) | sampled
    measured = {"background": "measured"} if background is None and setup is not None else {}
    resolved = {name: settings[name] for name in ("rtol", "gain", *sampled)}
    text = transports.heading(context, transport, T, **resolved, **measured)
    text["pattern_png"] = "sRGB" if setup is None else "codes of the measured projector"
    notes = [transports.caveat("errors are", T, exact)]
    notes += ["pattern .png holds the codes of the measured projector: show it pixel for pixel"] * bool(setup)
    notes += ["the background is the ambient light that was measured"] * bool(measured)
    note = "\n".join(filter(None, notes))
    if source is not None:
        return compensate_frames.run(
            context, T, source, text, settings | {"codes": setup and setup.codes}, note
        )
    desired = pictures.Reader(T.camera_grid, "the camera", encoding, resize).read_all(picture)
    with results.fill(out, text) as folder:
        _write_all(
            context, T, folder, dict(zip(desired, picture, strict=True)), desired, text, settings, setup
        )
    return Answer({"folder": out, **text}, partial(_show, out, text["pictures"], note))


def _check_setup(setup: Any, calibration: Path | None, T: Transport, bounds: dict[str, float]) -> None:
    """Refuse the calibration of other pixels than those of T, and light beyond its black and white."""
    if (setup.grid, setup.channels) != (T.grid, T.channels):
        raise InputError(
            f"{calibration}: is of {setup.grid} pixels and {setup.channels} channel(s); TRANSPORT has "
            f"{T.grid} and {T.channels}"
        )
    for name, bound in bounds.items():
        if not 0.0 <= bound <= 1.0:
            limits = "from 0 to 1, the black and the white of the projector that 'ltcl acquire' measured"
            raise InputError(f"{name} is {bound:g}; it must be {limits}")


def _settings(context: Context, T: Transport, setup: Any) -> dict[str, Any]:
    """Arguments of `ltcl.compensate`, pictures and transports read from their files."""
    from ltcl.compensation import RTOL
    from ltcl.transport import default_rtol

    asked, judges = context.options, transports.load_judges(context, T)
    rtol, gain = asked["rtol"], asked["gain"]
    reader = pictures.Reader(T.camera_grid, "the camera", asked["encoding"], asked["resize"], upright=False)
    seen = {name: asked[name] and reader.read(asked[name]) for name in ("background", "weights")}
    if seen["background"] is None and setup is not None:
        seen["background"] = setup.ambient
    return {
        "rtol": default_rtol(RTOL, T, judges["exact"], judges["inverse"]) if rtol is None else rtol,
        "gain": gain if gain is not None else 1.0 if setup is None else "auto",
        "bounds": (asked["low"], asked["high"]),
        **{name: asked[name] for name in ("method", "loss", "clamp")},
        **seen,
        **judges,
    }


def _write_all(
    context: Context,
    T: Transport,
    folder: Path,
    files: dict[str, Path],
    desired: dict[str, np.ndarray],
    text: dict[str, Any],
    settings: dict[str, Any],
    setup: Any,
) -> None:
    """Compensate all pictures into `folder`; the report gets its entries."""
    from ltcl.compensation import compensate

    text["exposure"] = factor = pictures.exposure(*desired.values())
    text["pictures"], rows = [], []
    named = {name: context.options[name] for name in ("background", "weights")}
    for name in context.progress.each(list(files)):
        with pictures.naming({"desired": files[name], "gain": files[name], **named}):
            solves = options.solves(settings["method"], T.channels)
            callback = context.progress.solve(settings["rtol"], solves)
            found = compensate(T, desired[name], callback=callback, **settings)
        entry = {
            "file": str(files[name]),
            **{key: getattr(found, key) for key in ("gain", "clipped", "error", "transport_error", "gap")},
            "too_dark": float(np.mean(found.out_of_reach > 0)),
            "too_bright": float(np.mean(found.out_of_reach < 0)),
            "channels": report.solution(found.solution),
            "limited": report.solution(found.limited),
        }
        white = max(settings["bounds"][1], 0.0) or 1.0
        written, panels = _write(folder, name, desired[name], found, factor, white, setup)
        text["pictures"].append(entry | written)
        rows += [panels] if len(rows) < _SHEET else []
    pictures.contact_sheet(rows).save(folder / "compensate.png")


def _write(
    folder: Path, name: str, desired: np.ndarray, found: Compensation, factor: float, white: float, setup: Any
) -> tuple[dict[str, Any], list[Any]]:
    """Files of one picture, and its row of the contact sheet.

    Appearance / gain compares with the picture that was asked for, whatever the units of T.
    """
    scale, error = factor / found.gain, f"{100 * found.error:.2g} % relative error"
    seen, missing = pictures.shades(found.appearance, scale), found.out_of_reach
    shown = {
        "desired": (f"{name}, desired", pictures.shades(desired, factor)),
        "pattern": (f"{name}, pattern", pictures.shades(found.pattern, 1 / white)),
        "appearance": (f"{name}, as seen, {error}", seen),
        "out_of_reach": (
            "out of reach: orange too dark, blue too bright",
            pictures.mark(seen, missing * scale),
        ),
    }
    panels = {key: pictures.panel(codes, label) for key, (label, codes) in shown.items()}
    written = {"pattern": pictures.write_pattern(folder, f"{name}_pattern", found.pattern, white, setup)}
    for key in ("appearance", "out_of_reach"):
        written[key] = pictures.write(folder, f"{name}_{key}", getattr(found, key), panels[key])
    return written, list(panels.values())


def _show(out: Path, entries: list[dict[str, Any]], note: str) -> None:
    """Print what came out, and on stderr what would help."""
    rows = []
    for entry in entries:
        solves = entry["channels"] + [each for each in entry["limited"] if each not in entry["channels"]]
        methods = ", ".join(dict.fromkeys(solve["method"] for solve in solves))
        products = sum(solve["products"] for solve in solves)
        clipped, error = f"{100 * entry['clipped']:.1f} %", f"{100 * entry['error']:.2f} %"
        name, pattern = Path(entry["file"]).name, entry["pattern"]["png"]
        rows.append((name, methods, products, entry["gain"], clipped, error, pattern))
    console.table(("picture", "method", "products", "gain", "clipped", "error", "pattern"), rows)
    typer.echo(f"\npatterns, appearances and what is out of reach as .exr and .png in {out}")
    typer.echo(f"look at {out / 'compensate.png'}" + (f"\n{note}" if note else ""))
    for entry in entries:
        dark, bright = (
            f"{entry['file']}: {100 * entry[name]:.0f} % of it stays" for name in ("too_dark", "too_bright")
        )
        if entry["too_dark"] > _MANY:
            console.note(
                f"{dark} too dark for the projector's light; --gain auto finds the largest gain for it"
            )
        if entry["too_bright"] > _MANY:
            console.note(f"{bright} too bright, by bounces or the background; brighten its dark parts")
