# SPDX-License-Identifier: BSD-3-Clause
"""Pictures and a transport: `ltcl compensate`, also of a film, `ltcl separate` and `ltcl relight`."""

from __future__ import annotations

import glob
import inspect
import json
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import numpy as np
import typer

from ltcl import checks
from ltcl.batch.cluster import connect
from ltcl.cli import options, pictures
from ltcl.cli.command import Answer, Context, Progress, UsageError, command, note, percent, table
from ltcl.cli.options import argument, file, option, writable_file
from ltcl.errors import BatchError, InputError, LtclError
from ltcl.files import fill_folder
from ltcl.store.formats import FORMATS
from ltcl.tasks import compensation, relighting, report, separation
from ltcl.transport.transport import Transport

_MANY = 0.01  # part of a picture or pattern out of reach from which advice is given
_RESULTS = ("gain", "clipped", "error", "transport_error", "gap")
# times as bright: what is that much darker is shown a second time on a contact sheet, amplified
_DIM = 4
_REASONS = {
    "dark": "; where the pattern is at 1 a lower --gain helps, or --gain auto",
    "bright": ", by bounces or the background; brighten its dark parts",
}


def parse_gain(text: str) -> float | str:
    """A number, or auto."""
    try:
        return "auto" if text == "auto" else float(text)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is no gain; write a number, or auto") from None


GAIN = "Match FACTOR times the picture; auto: the largest within reach. Default: 1, auto of a measured T."
_BACKGROUND = "Picture of the light that stays. Default: as measured, else none."
_VIDEO = "Also a video of the patterns: .mkv or .avi, lossless; or .mp4, which changes their codes."
_FPS = "Frames a second of that video. Default: as the source, else 25."
_FORMAT = "png: 16 bits (default); exr: the light as it is."
_CLUSTER = (
    "Of frames and scenes. local: processes here, one for each GPU; or a Dask scheduler's ADDRESS."
)
_SCENES = "In the place of TRANSPORT: many, as 'scans/*.zarr'. DIR gets a folder each."
_MPI = "Share each solve: 'mpiexec -n 2 ltcl compensate ... --mpi'."
_PICTURES = argument("PICTURE...", "Pictures; or one folder or one video of frames.")
_FILM: dict[str, Any] = {"rich_help_panel": "Options of frames: a folder or a video"}
_FRAMES = ("batch", "resume", "frames", "video", "fps", "format", "appearance")


def _work_options(
    batch: Annotated[
        int | None, option("Frames solved at once. Default: 8.", min=1, **_FILM)
    ] = None,
    resume: Annotated[
        bool, option("Go on where the last run into DIR ended.", "--resume", **_FILM)
    ] = False,
    frames: Annotated[
        int | None, option("Only the first N frames.", metavar="N", min=1, **_FILM)
    ] = None,
    video: Annotated[Path | None, file(_VIDEO, callback=writable_file, **_FILM)] = None,
    fps: Annotated[float | None, option(_FPS, **_FILM)] = None,
    format: Annotated[Literal["png", "exr"] | None, option(_FORMAT, **_FILM)] = None,
    appearance: Annotated[
        bool, option("Also how the scene will look.", "--appearance", **_FILM)
    ] = False,
    mpi: Annotated[bool, option(_MPI, "--mpi")] = False,
    cluster: Annotated[str | None, option(_CLUSTER, metavar="local|ADDRESS")] = None,
    workers: Annotated[
        int | None, option("Processes of --cluster local.", metavar="N", min=1)
    ] = None,
    transports: Annotated[str | None, option(_SCENES, metavar="PATTERN")] = None,
) -> None:
    """Of many frames, as of `ltcl.batch.compensate_frames`, or scenes, and what shares the work."""


@command(*options.TASK, _work_options)
def compensate(
    context: Context,
    transport: options.Matrix,
    out: options.Out,
    picture: Annotated[list[Path] | None, _PICTURES] = None,
    gain: Annotated[str | None, option(GAIN, parser=parse_gain, metavar="FACTOR")] = None,
    loss: Annotated[
        float | None, option("Error that --gain auto may cost. Default: the least.")
    ] = None,
    low: Annotated[float, option("Darkest light of the projector.")] = 0.0,
    high: Annotated[float, option("Brightest light of the projector.")] = 1.0,
    clamp: Annotated[
        bool, option("Clamp what exceeds that, without making up for it.", "--clamp")
    ] = False,
    background: Annotated[Path | None, file(_BACKGROUND)] = None,
    calibration: Annotated[
        Path | None, file("The store of 'ltcl acquire' behind TRANSPORT.")
    ] = None,
    weights: Annotated[
        Path | None, file("Picture of how much the error at each pixel counts.")
    ] = None,
) -> Answer:
    """Find the projector patterns that make a scene look like PICTURE.

    Writes for each picture the pattern, how the scene will look under it and what is out of the
    projector's reach, exactly as .exr and as .png; all in compensate.png, and compensate.json. The
    .png of a pattern has the codes for the projector, pixel for pixel: those of the measured
    response with a TRANSPORT of 'ltcl acquire', else sRGB. The others are for the eye, at one
    exposure, which compensate.json names. Standard deviations by the noise of TRANSPORT, where that
    is known, are NAME_pattern_std and NAME_appearance_std.

    The ambient light of a TRANSPORT of 'ltcl acquire' is the background, and the gain is auto.

    Of a folder or a video of frames, writes the numbered patterns and frames.json batch by batch,
    with one gain for all; Ctrl-C keeps what is done, for --resume. With --cluster workers solve,
    and do --transports; docs/guide/cluster.md shows how.
    """
    asked, paths = context.options, picture or []
    has_scenes = asked["transports"] is not None
    paths = [transport, *paths] if has_scenes else paths
    if not paths:
        raise UsageError("Missing argument 'PICTURE...'.")
    film = _film(paths, asked)
    if has_scenes:
        return _compensate_scenes(context, paths, out)
    setup, T = options.setup(transport, calibration), options.load(context, transport)
    if setup is not None and (setup.grid, setup.channels) != (T.grid, T.channels):
        sizes = (
            f"{setup.grid} and {setup.channels} channel(s); TRANSPORT has {T.grid} and {T.channels}"
        )
        raise InputError(f"{calibration}: is of {sizes}")
    if setup is not None and not 0.0 <= low < high <= 1.0:
        raise InputError(
            f"--low is {low:g} and --high is {high:g}; a measured projector has 0 to 1"
        )
    settings = options.solving(context, T, compensation.RTOL)
    settings |= {"loss": loss, "clamp": clamp, "bounds": (low, high)}
    settings["gain"] = gain if gain is not None else 1.0 if setup is None else "auto"
    for name, path in (("weights", weights), ("background", background)):
        settings[name] = path and pictures.read(
            context, path, T.camera_grid, "the camera", upright=False
        )
    text = options.heading(context, transport, T, rtol=settings["rtol"], gain=settings["gain"])
    text["pattern_png"] = "sRGB" if setup is None else "codes of the measured projector"
    notes = [options.caveat("errors are", T, asked["exact"])]
    notes += ["masked pixels do not count in errors"] * bool(weights is None and T.masked.any())
    if setup is not None:
        notes.append(
            "pattern .png holds the codes of the measured projector; 'ltcl show' shows it there"
        )
    if setup is not None and background is None:
        settings["background"], text["options"]["background"] = setup.ambient, "measured"
        notes.append("the background is the ambient light that was measured")
    if film is None:
        lines = _compensate_pictures(context, T, paths, out, text, settings, setup)
    else:
        lines = _compensate_frames(
            context, T, film, out, text, settings | {"codes": setup and setup.codes}
        )
    return Answer({"folder": out, **text}, [*lines, *notes])


def _film(paths: list[Path], asked: dict[str, Any]) -> Path | None:
    """The folder or video, which must be the only input; None where there are pictures."""
    from ltcl.images.frames import is_frames

    films, scenes = [path for path in paths if is_frames(path)], asked["transports"] is not None
    if asked["mpi"] and (scenes or asked["cluster"] is not None):
        raise InputError(
            f"--mpi is given, and --{'transports' if scenes else 'cluster'}; give one of them"
        )
    if scenes and paths[0].suffix.lower() in FORMATS:
        raise InputError(
            f"{paths[0]}: is a transport, and --transports is given, too; give one of them"
        )
    if films and len(paths) > 1:
        raise InputError(
            f"{films[0]}: holds frames and must be alone; there are {len(paths) - 1} more"
        )
    refused = (
        ("mpi", "transports") if films else _FRAMES if scenes else (*_FRAMES, "cluster", "workers")
    )
    why = (
        "holds frames; it is for pictures"
        if films
        else "is a picture; it is for a folder or a video"
    )
    for name in refused:
        if asked[name] not in (None, False):
            raise InputError(f"--{name} is given, but {paths[0]} {why}")
    return films[0] if films else None


def _compensate_pictures(
    context: Context,
    T: Transport,
    paths: list[Path],
    out: Path,
    text: Any,
    settings: Any,
    setup: Any,
) -> list[Any]:
    """Patterns of all pictures into a folder with their contact sheet; the lines of the answer."""
    desired = pictures.read_all(context, paths, T.camera_grid, "the camera")
    text["exposure"] = factor = pictures.exposure(*desired.values())
    text["pictures"], sheet, rows = [], [], []
    high, noisy = max(settings["bounds"][1], 0.0) or 1.0, options.shows_noise(T, settings)
    with pictures.fill(out, text) as folder:
        for name, path in zip(context.progress.each(list(desired)), paths, strict=True):
            try:
                result = compensation.compensate(T, desired[name], **settings)
            except LtclError as error:
                error.args = (f"{error} (compensating {path})",)
                raise
            written, panels = _write(
                folder / name, desired[name], result, factor, high, setup, noisy
            )
            sheet.append(panels)
            facts = {key: getattr(result, key) for key in _RESULTS}
            lack = result.out_of_reach
            facts |= {"too_dark": float(np.mean(lack > 0)), "too_bright": float(np.mean(lack < 0))}
            facts["channels"], facts["limited"] = map(
                report.solution, (result.solution, result.limited)
            )
            text["pictures"].append({"file": str(path), **facts, **written})
            solved = facts["channels"] + [
                each for each in facts["limited"] if each not in facts["channels"]
            ]
            methods = ", ".join(dict.fromkeys(each["method"] for each in solved))
            counts = methods, sum(each["products"] for each in solved), facts["gain"]
            shares = percent(facts["clipped"]), percent(facts["error"])
            rows.append((path.name, *counts, *shares, f"{name}_pattern.png"))
            for what, reason in _REASONS.items():
                if (share := facts[f"too_{what}"]) > _MANY:
                    note(f"{path}: {100 * share:.0f} % of it stays too {what}{reason}")
        pictures.contact_sheet(sheet[:12]).save(folder / "compensate.png")
    columns = ("picture", "method", "products", "gain", "clipped", "error", "pattern")
    where = f"\npatterns, appearances and what is out of reach as .exr and .png in {out}"
    return [table(columns, rows), where, f"look at {out / 'compensate.png'}"]


def _write(
    stem: Path,
    desired: np.ndarray,
    result: Any,
    factor: float,
    high: float,
    setup: Any,
    noisy: bool,
) -> tuple[dict[str, Any], list[Any]]:
    """Files of one picture, and its row of the contact sheet."""
    from ltcl import images

    folder, name, pattern = stem.parent, stem.name, result.pattern
    units = {
        "pattern": 1 / high,
        "appearance": factor / result.gain,
    }  # to compare with what was asked for
    seen = pictures.shades(result.appearance, units["appearance"])
    missing = pictures.mark(seen, result.out_of_reach * units["appearance"])
    panels = [
        pictures.panel(desired, f"{name}, desired", factor),
        pictures.panel(pattern, f"{name}, pattern", units["pattern"]),
        pictures.panel(seen, f"{name}, as predicted, error {100 * result.error:.2g} %"),
        pictures.panel(missing, "out of reach: orange too dark, blue too bright"),
    ]
    images.write(folder / f"{name}_pattern.exr", pattern)
    codes, encoding = (
        (pattern / high, "srgb") if setup is None else (setup.codes(pattern), "linear")
    )
    images.write(folder / f"{name}_pattern.png", codes, encoding=encoding)
    written: dict[str, Any] = {
        "pattern": {suffix: f"{name}_pattern.{suffix}" for suffix in ("exr", "png")}
    }
    for key, shown in zip(("appearance", "out_of_reach"), panels[2:], strict=True):
        written[key] = pictures.write(folder, f"{name}_{key}", getattr(result, key), shown)
    for key, unit in units.items() if noisy else ():
        std = getattr(result.std, key)
        written[key]["std"], shown = pictures.deviation(folder, f"{name}_{key}", std, unit)
        panels.append(shown)
    return written, panels


def _compensate_frames(
    context: Context, T: Transport, film: Path, out: Path, text: Any, settings: Any
) -> list[Any]:
    """Patterns of all frames of a folder or a video into a folder; the lines of the answer."""
    from ltcl.batch import compensate_frames

    asked = {name: context.options[name] for name in (*_FRAMES, "resize", "encoding")} | settings
    arguments = {
        name: value for name, value in asked.items() if value is not None and name != "callback"
    }
    try:
        with _cluster(context) as client:
            result = compensate_frames(
                T, film, out, progress=context.progress, client=client, **arguments
            )
    except KeyboardInterrupt:
        count = f"{context.progress.tasks[0].completed:.0f} frame(s) are done and stay in {out}"
        raise KeyboardInterrupt(f"interrupted; {count}; --resume goes on from there") from None
    worst, most, records = result.worst, result.most_clipped, result.records
    names = "video gain solved seconds frames_per_second transport_error worst most_clipped"
    text |= {
        "source": film,
        **{name: getattr(result, name) for name in names.split()},
        "frames": records,
    }
    if most.clipped > _MANY:
        count = sum(record.clipped > _MANY for record in records)
        frame = (
            f"frame {most.number} ({most.name}) most; a lower --gain helps where patterns are at 1"
        )
        note(f"{count} frame(s) ask for light beyond the projector's, {frame}")
    pace = f"{result.frames_per_second:.1f}" if result.solved else None
    columns = ("frames", "of this run", "a second", "gain", "worst error", "most clipped")
    error, clipped = percent(worst.error), percent(most.clipped)
    frames = f"{error} in frame {worst.number}", f"{clipped} in frame {most.number}"
    row = (len(records), result.solved, pace, result.gain, *frames)
    also = "" if result.video is None else f", as a video in {result.video}"
    return [table(columns, [row]), f"\npatterns and frames.json in {out}{also}"]


def _cluster(context: Context) -> AbstractContextManager[Any]:
    """The client that was asked for, or None."""
    cluster, workers, device = (context.options[name] for name in ("cluster", "workers", "device"))
    if cluster is None and workers is not None:
        raise InputError(
            f"--workers is {workers}, but there is no --cluster; it is for --cluster local"
        )
    return nullcontext() if cluster is None else connect(cluster, workers, device)


def _compensate_scenes(context: Context, paths: list[Path], out: Path) -> Answer:
    """The pictures on each of many scenes, one task each; those that failed are named at the end."""
    from ltcl.batch import map as of_each

    pattern = context.options["transports"]
    scenes = sorted(map(Path, glob.glob(pattern)))
    if not scenes:
        raise InputError(f"--transports is {pattern}, and there is no such file or folder")
    if len({scene.stem for scene in scenes}) < len(scenes):
        raise InputError(
            f"--transports is {pattern}: it must mean files or folders of different names"
        )
    if {out.resolve(), *((out / each.stem).resolve() for each in scenes)} & {
        *map(Path.resolve, scenes)
    }:
        raise InputError(f"--out is {out}, where transports are; it must be another place")
    asked = context.options | dict.fromkeys(("transports", "cluster", "workers"))
    asked |= (
        {} if context.options["cluster"] is None else {"device": None}
    )  # workers have their own
    own = {
        name: asked.get(name)
        for name in [*inspect.signature(inspect.unwrap(compensate)).parameters][1:]
    }

    def files_of(scene: Path) -> dict[str, bytes]:
        with TemporaryDirectory() as folder, Progress(quiet=True) as progress:
            place, call = Path(folder) / "scene", Context("compensate", asked, progress)
            inspect.unwrap(compensate)(
                call, **own | {"transport": scene, "picture": paths, "out": place}
            )
            return {file.name: file.read_bytes() for file in place.iterdir()}

    reports, rows, failed = [], [], None
    with _cluster(context) as client:
        try:
            results = of_each(files_of, scenes, client=client, progress=context.progress)
        except BatchError as error:
            results, failed = error.results, error
    for scene, files in zip(scenes, results, strict=True):
        if not isinstance(files, LtclError):
            with fill_folder(out / scene.stem) as folder:
                for name, content in files.items():
                    (folder / name).write_bytes(content)
            reports.append({"folder": out / scene.stem, **json.loads(files["compensate.json"])})
            shown = reports[-1]["pictures"]
            rows.append(
                (scene.stem, shown[0]["gain"], percent(max(each["error"] for each in shown)))
            )
    if failed is not None:
        raise failed
    lines = [table(("scene", "gain", "worst error"), rows), f"\na folder for each in {out}"]
    return Answer({"folder": out, "scenes": reports}, lines)


@command(*options.TASK)
def separate(
    context: Context,
    transport: options.Matrix,
    picture: options.Pictures,
    out: options.Out,
    bounces: Annotated[int, option("Indirect bounces to separate.", min=0)] = 4,
) -> Answer:
    """Split PICTURE, taken of the scene under projector light, into direct light and bounces.

    Writes direct, indirect, bounce_1, bounce_2, ... and the rest exactly as .exr (measured ones may
    be a little negative), and for the eye as .png, all at one exposure, which separate.json names;
    and separate.png with all of them. Several pictures get a folder each. Standard deviations by
    the noise of TRANSPORT, where that is known, are direct_std, bounce_1_std, ... and in
    separate.png.
    """
    T = options.load(context, transport)
    settings = options.solving(context, T, separation.RTOL, bounces + 1)
    photographs = pictures.read_all(context, picture, T.camera_grid, "the camera", upright=False)
    noisy, factor = options.shows_noise(T, settings), pictures.exposure(*photographs.values())
    text = options.heading(context, transport, T, rtol=settings["rtol"])
    text["exposure"], text["pictures"], sheet, rows, errors = factor, [], [], [], []
    with pictures.fill(out, text) as folder:
        for name, path in zip(context.progress.each(list(photographs)), picture, strict=True):
            result = separation.separate(T, photographs[name], bounces, **settings)
            numbered = {f"bounce_{k}": bounce for k, bounce in enumerate(result.bounces, 1)}
            light = {
                "direct": result.direct,
                "indirect": result.indirect,
                **numbered,
                "rest": result.rest,
            }
            solved = dict(
                zip(["direct", *numbered], map(report.solution, result.solutions), strict=True)
            )
            std = (
                dict(zip(solved, [result.std.direct, *result.std.bounces], strict=True))
                if noisy
                else {}
            )
            panels, deviations, parts = [pictures.panel(photographs[name], name, factor)], [], []
            whole = float(photographs[name].mean(dtype=np.float64))
            for part, picture_of in light.items():
                panels.append(pictures.panel(picture_of, part, factor))
                place = f"{name}/{part}" if len(photographs) > 1 else part
                mean, solves = float(picture_of.mean(dtype=np.float64)), solved.get(part, [])
                facts: Any = {"part": part, **pictures.write(folder, place, picture_of, panels[-1])}
                facts |= {
                    "lowest": float(picture_of.min()),
                    "share": mean / whole if whole else None,
                }
                facts["channels"] = solves
                if part in std:
                    facts["std"], shown = pictures.deviation(folder, place, std[part], factor)
                    deviations.append(shown)
                parts.append(facts)
                residual = max(
                    (each["residual"] for each in solves if each["error"] is None), default=None
                )
                errors += [each["error"] for each in solves if each["error"] is not None]
                products = sum(each["products"] for each in solves) or None
                rows.append((path.name, part, percent(facts["share"], 4), products, residual))
            entry = {"file": str(path), "transport_error": result.transport_error, "parts": parts}
            text["pictures"].append(entry)
            brighter = (pictures.amplified(light[part], part, factor) for part in light)
            dim = [panel for times, panel in brighter if times >= _DIM]
            sheet += [panels[:3], panels[3:], dim, deviations]
        pictures.contact_sheet([row for row in sheet if row]).save(folder / "separate.png")
    lines: list[Any] = [table(("picture", "part", "share of light", "products", "residual"), rows)]
    lines.append(f"\neach part as .exr and .png in {out}; look at {out / 'separate.png'}")
    if errors:
        worst = 100 * float(checks.upwards(max(errors)))
        lines.append(f"the relative error of each part by the inverse is at most {worst:.2g} %")
    lines.append(options.caveat("all of this is", T, context.options["exact"]))
    return Answer({"folder": out, **text}, lines)


@command(options.file_options, options.picture_options)
def relight(
    context: Context,
    transport: options.Matrix,
    pattern: Annotated[list[Path], argument("PATTERN...", "Pictures of patterns.")],
    out: options.Out,
    on_dark: options.OnDark = "mask",
    device: options.Device = None,
) -> Answer:
    """Show what the camera will see when PATTERN is projected.

    With a TRANSPORT of 'ltcl acquire' a PATTERN of integers, as .png, holds the codes for its
    projector, and the result is what the pattern adds to the ambient light.

    Writes pictures exactly as .exr, and for the eye as .png at one exposure, which relight.json
    names.
    """
    T = options.load(context, transport, dark_note=False)
    patterns = pictures.read_all(
        context, pattern, T.grid, "the projector", options.setup(transport)
    )
    light = {name: relighting.relight(T, each) for name, each in patterns.items()}
    factor, text = pictures.exposure(*light.values()), options.heading(context, transport, T)
    text["exposure"], text["pictures"], rows = factor, [], []
    with pictures.fill(out, text) as folder:
        for (name, picture), path in zip(light.items(), pattern, strict=True):
            panel = pictures.panel(picture, f"{path.name}, relit", factor)
            entry = {"file": str(path), "brightest": float(picture.max())}
            entry |= pictures.write(folder, f"{name}_relit", picture, panel)
            text["pictures"].append(entry)
            rows.append((path.name, entry["brightest"], entry["exr"]))
    lines = [table(("pattern", "brightest in picture", "picture"), rows)]
    lines += [f"\npictures as .exr and .png in {out}", options.caveat("they are", T)]
    return Answer({"folder": out, **text}, lines)
