# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl compensate`: the patterns under which a scene looks like given pictures, or like a film."""

from __future__ import annotations

import dataclasses
import inspect
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from ltcl import report
from ltcl.cli import options, pictures, transports
from ltcl.cli.command import Answer, Context, command, note, percent, table
from ltcl.cli.options import argument, file, option, writable_file
from ltcl.compensation import Compensation
from ltcl.errors import InputError, LtclError
from ltcl.transport import Transport

_MANY = 0.01  # part of a picture or pattern out of reach from which advice is given
_RESULTS = ("gain", "clipped", "error", "transport_error", "gap")
_SHEET = 12  # pictures on a contact sheet, at most


def _gain(text: str) -> float | str:
    try:
        return "auto" if text == "auto" else float(text)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is no gain; write a number, or auto") from None


_GAIN = "Match FACTOR times the picture; auto: the largest within reach. Default: 1, auto of a measured T."
_LOSS = "Error that --gain auto may cost. Default: as little as possible."
_CLAMP = "Clamp what exceeds that light, without making up for it."
_BACKGROUND = "Picture of the light that stays. Default: as measured, else none."
_VIDEO = "Also a video of the patterns: .mkv or .avi, lossless; or .mp4, which changes their codes."
_FPS = "Frames a second of that video. Default: as the source, else 25."
_FORMAT = "png: 16 bits (default); exr: the light as it is."
_FILM: dict[str, Any] = {"rich_help_panel": "Options of frames: a folder or a video"}
_MORE: dict[str, Any] = {"min": 1, **_FILM}


def _film_options(
    batch: Annotated[int | None, option("Frames solved at once. Default: 8.", **_MORE)] = None,
    resume: Annotated[bool, option("Go on where the last run into DIR ended.", "--resume", **_FILM)] = False,
    frames: Annotated[int | None, option("Only the first N frames.", metavar="N", **_MORE)] = None,
    video: Annotated[Path | None, file(_VIDEO, callback=writable_file, **_FILM)] = None,
    fps: Annotated[float | None, option(_FPS, **_FILM)] = None,
    format: Annotated[Literal["png", "exr"] | None, option(_FORMAT, **_FILM)] = None,
    appearance: Annotated[bool, option("Also how the scene will look.", "--appearance", **_FILM)] = False,
) -> None:
    """Of `ltcl.batch.compensate_frames`."""


_FRAMES = tuple(inspect.signature(_film_options).parameters)


@command(
    options.file_options,
    options.transport_options,
    options.solve_options,
    options.picture_options,
    _film_options,
)
def compensate(
    context: Context,
    transport: options.Matrix,
    picture: Annotated[list[Path], argument("PICTURE...", "Pictures; or one folder or one video of frames.")],
    out: options.Out,
    gain: Annotated[str | None, option(_GAIN, parser=_gain, metavar="FACTOR")] = None,
    loss: Annotated[float | None, option(_LOSS)] = None,
    low: Annotated[float, option("Darkest light of the projector.")] = 0.0,
    high: Annotated[float, option("Brightest light of the projector.")] = 1.0,
    clamp: Annotated[bool, option(_CLAMP, "--clamp")] = False,
    background: Annotated[Path | None, file(_BACKGROUND)] = None,
    calibration: Annotated[Path | None, file("The store of 'ltcl acquire' behind TRANSPORT.")] = None,
    weights: Annotated[Path | None, file("Picture of how much the error at each pixel counts.")] = None,
) -> Answer:
    """Find the projector patterns that make a scene look like PICTURE.

    Writes for each picture the pattern, how the scene will look under it and what is out of the projector's
    reach, exactly as .exr and as .png; all in compensate.png, and compensate.json. The .png of a pattern has
    the codes for the projector, pixel for pixel: those of the measured response with a TRANSPORT of 'ltcl
    acquire', else sRGB. The others are for the eye, at one exposure, which compensate.json names. Standard
    deviations by the noise of TRANSPORT, where that is known, are NAME_pattern_std and NAME_appearance_std.

    The ambient light of a TRANSPORT of 'ltcl acquire' is the background, and the gain is auto.

    Of a folder or a video of frames, writes the numbered patterns and frames.json batch by batch, with one
    gain for all; Ctrl-C keeps what is done, for --resume.
    """
    from ltcl.acquisition import Setup
    from ltcl.compensation import RTOL

    film = _film(picture, context.options)
    measured = calibration or (transport if transports.is_measured(transport) else None)
    setup = Setup.of(measured) if measured else None
    T = transports.load(context, transport)
    if setup is not None and (setup.grid, setup.channels) != (T.grid, T.channels):
        sizes = f"{setup.grid} and {setup.channels} channel(s); TRANSPORT has {T.grid} and {T.channels}"
        raise InputError(f"{calibration}: is of {sizes}")
    if setup is not None and not 0.0 <= low < high <= 1.0:
        limits = "from 0 to 1, the black and the white of the projector that 'ltcl acquire' measured"
        raise InputError(f"--low is {low:g} and --high is {high:g}; they must be {limits}")

    def read(file: Path) -> np.ndarray:
        return pictures.read(context, file, T.camera_grid, "the camera", upright=False)

    settings = transports.solving(context, T, RTOL) | {"loss": loss, "clamp": clamp, "bounds": (low, high)}
    settings["gain"] = gain if gain is not None else 1.0 if setup is None else "auto"
    settings |= {"weights": weights and read(weights), "background": background and read(background)}
    resolved = {"rtol": settings["rtol"], "gain": settings["gain"]}
    notes = [transports.caveat("errors are", T, context.options["exact"])]
    notes += ["masked pixels do not count in errors"] * bool(weights is None and T.masked.any())
    if setup is not None:
        notes.append("pattern .png holds the codes of the measured projector: show it pixel for pixel")
    if setup is not None and background is None:
        settings["background"], resolved["background"] = setup.ambient, "measured"
        notes.append("the background is the ambient light that was measured")
    text = transports.heading(context, transport, T, **resolved)
    text["pattern_png"] = "sRGB" if setup is None else "codes of the measured projector"
    if film is None:
        lines = _compensate_pictures(context, T, picture, out, text, settings, setup)
    else:
        lines = _compensate_frames(context, T, film, out, text, settings | {"codes": setup and setup.codes})
    return Answer({"folder": out, **text}, [*lines, *notes])


def _film(paths: list[Path], asked: dict[str, Any]) -> Path | None:
    """The folder or video, which must be the only input; None where there are pictures."""
    from ltcl.images.frames import is_frames

    films = [path for path in paths if is_frames(path)]
    if films and len(paths) > 1:
        text = f"holds frames, and there are {len(paths) - 1} more inputs; it must be the only one"
        raise InputError(f"{films[0]}: {text}")
    for name in _FRAMES:
        if not films and asked[name] not in (None, False):
            raise InputError(f"--{name} is given, but {paths[0]} is a picture; it is for a folder or a video")
    return films[0] if films else None


def _compensate_pictures(
    context: Context, T: Transport, paths: list[Path], out: Path, text: Any, settings: Any, setup: Any
) -> list[Any]:
    """Patterns of all pictures into a folder with their contact sheet; the lines of the answer."""
    from ltcl.compensation import compensate

    desired = pictures.read_all(context, paths, T.camera_grid, "the camera")
    files = dict(zip(desired, paths, strict=True))
    text["exposure"] = factor = pictures.exposure(*desired.values())
    text["pictures"], sheet, rows = [], [], []
    with pictures.fill(out, text) as folder:
        for name in context.progress.each(list(desired)):
            try:
                callback = transports.callback(context, T, settings)
                result = compensate(T, desired[name], callback=callback, **settings)
            except LtclError as error:
                error.args = (f"{error} (compensating {files[name]})",)
                raise
            white, noisy = max(settings["bounds"][1], 0.0) or 1.0, transports.shows_noise(T, settings)
            written, panels = _write(folder / name, desired[name], result, factor, white, setup, noisy)
            sheet.append(panels)
            facts = {key: getattr(result, key) for key in _RESULTS}
            lack, solves = result.out_of_reach, {"channels": result.solution, "limited": result.limited}
            facts |= {"too_dark": float(np.mean(lack > 0)), "too_bright": float(np.mean(lack < 0))}
            facts |= {key: report.solution(each) for key, each in solves.items()}
            text["pictures"].append({"file": str(files[name]), **facts, **written})
            rows.append(_row(files[name], facts, f"{name}_pattern.png"))
        pictures.contact_sheet(sheet[:_SHEET]).save(folder / "compensate.png")
    columns = ("picture", "method", "products", "gain", "clipped", "error", "pattern")
    where = f"\npatterns, appearances and what is out of reach as .exr and .png in {out}"
    return [table(columns, rows), where, f"look at {out / 'compensate.png'}"]


def _write(
    place: Path,
    desired: np.ndarray,
    result: Compensation,
    factor: float,
    white: float,
    setup: Any,
    noisy: bool,
) -> tuple[dict[str, Any], list[Any]]:
    """Files of one picture, and its row of the contact sheet.

    Appearance / gain compares with the picture that was asked for, whatever the units of T. The .png of the
    pattern has a pixel for each of the projector: codes of the measured one, else sRGB.
    """
    from ltcl import images

    folder, name, scale = place.parent, place.name, factor / result.gain
    seen, pattern = pictures.shades(result.appearance, scale), result.pattern
    missing = pictures.mark(seen, result.out_of_reach * scale)
    panels = {
        "desired": pictures.panel(pictures.shades(desired, factor), f"{name}, desired"),
        "pattern": pictures.panel(pictures.shades(pattern, 1 / white), f"{name}, pattern"),
        "appearance": pictures.panel(seen, f"{name}, as predicted, error {100 * result.error:.2g} %"),
        "out_of_reach": pictures.panel(missing, "out of reach: orange too dark, blue too bright"),
    }
    images.write(folder / f"{name}_pattern.exr", pattern)
    codes, encoding = (pattern / white, "srgb") if setup is None else (setup.codes(pattern), "linear")
    images.write(folder / f"{name}_pattern.png", codes, encoding=encoding)
    written: dict[str, Any] = {"pattern": {suffix: f"{name}_pattern.{suffix}" for suffix in ("exr", "png")}}
    for key in ("appearance", "out_of_reach"):
        written[key] = pictures.write(folder, f"{name}_{key}", getattr(result, key), panels[key])
    for key, unit in {"pattern": 1 / white, "appearance": scale}.items() if noisy else ():
        deviation = pictures.deviation(folder, f"{name}_{key}", getattr(result.std, key), unit)
        written[key]["std"], panels[f"{key}_std"] = deviation
    return written, list(panels.values())


def _row(file: Path, facts: dict[str, Any], pattern: str) -> tuple:
    """Of the table; notes say what would help."""
    solves = facts["channels"] + [each for each in facts["limited"] if each not in facts["channels"]]
    methods = ", ".join(dict.fromkeys(solve["method"] for solve in solves))
    products = sum(solve["products"] for solve in solves)
    reasons = {"dark": "; where the pattern is at 1 a lower --gain helps, or --gain auto"}
    reasons["bright"] = ", by bounces or the background; brighten its dark parts"
    for name, reason in reasons.items():
        if (share := facts[f"too_{name}"]) > _MANY:
            note(f"{file}: {100 * share:.0f} % of it stays too {name}{reason}")
    shares = percent(facts["clipped"]), percent(facts["error"])
    return (file.name, methods, products, facts["gain"], *shares, pattern)


def _compensate_frames(
    context: Context, T: Transport, film: Path, out: Path, text: Any, settings: Any
) -> list[Any]:
    """Patterns of all frames of a folder or a video into a folder; the lines of the answer."""
    from ltcl.batch import compensate_frames

    asked = {name: context.options[name] for name in (*_FRAMES, "resize", "encoding")} | settings
    arguments = {name: value for name, value in asked.items() if value is not None}
    try:
        result = compensate_frames(T, film, out, progress=context.progress, **arguments)
    except KeyboardInterrupt:
        count = f"{context.progress.done:.0f} frame(s) are done and stay in {out}"
        raise KeyboardInterrupt(f"interrupted; {count}; --resume goes on from there") from None
    worst, most, records = result.worst, result.most_clipped, result.records
    names = ("video", "gain", "solved", "seconds", "frames_per_second", "transport_error")
    text |= {"source": film, **{name: getattr(result, name) for name in names}, "worst": worst}
    text |= {"most_clipped": most, "frames": [dataclasses.asdict(record) for record in records]}
    if most.clipped > _MANY:
        count = sum(record.clipped > _MANY for record in records)
        frame = f"frame {most.number} ({most.name}) most; a lower --gain helps where patterns are at 1"
        note(f"{count} frame(s) ask for light beyond the projector's, {frame}")
    pace = f"{result.frames_per_second:.1f}" if result.solved else None
    columns = ("frames", "of this run", "a second", "gain", "worst error", "most clipped")
    error, clipped = percent(worst.error), percent(most.clipped)
    frames = f"{error} in frame {worst.number}", f"{clipped} in frame {most.number}"
    row = (len(records), result.solved, pace, result.gain, *frames)
    also = "" if result.video is None else f", as a video in {result.video}"
    return [table(columns, [row]), f"\npatterns and frames.json in {out}{also}"]
