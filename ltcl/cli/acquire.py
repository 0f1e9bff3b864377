# SPDX-License-Identifier: BSD-3-Clause
"""Scans: `ltcl simulate` makes a folder for one; `ltcl acquire` plans, runs, reports."""

from __future__ import annotations

import dataclasses
import datetime
import json
import shlex
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from ltcl import checks, store
from ltcl.cli import options, pictures
from ltcl.cli.command import WAITING, Answer, Context, command, percent, table
from ltcl.cli.options import argument, option, pixels
from ltcl.device import open_device
from ltcl.errors import AcquisitionError, FileError, InputError, PhotographMissing, ScanRefused
from ltcl.store import StoreRecord, formats
from ltcl.tasks.report import versions
from ltcl.transport.verdict import verdict

_SCENES = ("dihedral", "trihedral", "box")


def _albedo(text: str) -> tuple[float, ...]:
    with suppress(ValueError):
        if len(albedo := tuple(map(float, text.split(",")))) in (1, 3):
            return albedo
    raise typer.BadParameter(f"{text!r} is no albedo; write one number, or red,green,blue")


_SCENE = "dihedral, trihedral, box; a transport file; or mitsuba: and one of these or an XML file of Mitsuba."
_AMBIENT = "Light of the room, where a lit white wall has 1. Default: 0.01; mitsuba has its own."
_Strategy = Literal["auto", "adaptive", "pixel", "block", "hadamard"]
_ALBEDO_HELP = "Of the walls: A or R,G,B. Default: 0.7."
_Curve = Literal["linear", "srgb", "gamma2.2", "film"]
_GRID_HELP = "Projector pixels: of mitsuba (24x32), or where a file lacks them."
_CAMERA_HELP = "Camera pixels, if other ones: Gray code then measures which is which."


def _rig_options(
    size: Annotated[
        int | None, option("Patches along a wall of a scene. Default: 16.", min=2)
    ] = None,
    grid: Annotated[tuple | None, pixels(_GRID_HELP)] = None,
    camera_grid: Annotated[tuple | None, pixels(_CAMERA_HELP)] = None,
    albedo: Annotated[Any, option(_ALBEDO_HELP, parser=_albedo, metavar="ALBEDO")] = None,
    response: Annotated[_Curve, option("Of the camera, light to code.")] = "srgb",
    projector_response: Annotated[_Curve, option("Of the projector, code to light.")] = "srgb",
    bits: Annotated[int, option("Of the photographs.", min=8, max=16)] = 12,
    ambient: Annotated[float | None, option(_AMBIENT, min=0.0)] = None,
    strategy: Annotated[_Strategy, option("How 'ltcl acquire' is to scan.")] = "auto",
    seed: Annotated[int, option("Of the noise.", min=0)] = 0,
) -> None:
    """Of the scene and the rig before it."""


@command(_rig_options)
def simulate(
    context: Context,
    scene: Annotated[str, argument("SCENE", _SCENE, parser=None)],
    out: options.Out,
) -> Answer:
    """Make a folder in which 'ltcl acquire' photographs SCENE, without a camera.

    Writes acquisition.toml, with what else it could say in comments, and truth.npz, the transport
    that is to be measured (not of mitsuba).
    """
    from ltcl.acquisition import Project

    if (out / "transport.zarr").exists():
        raise InputError(f"{out}: holds a transport.zarr that was acquired; choose another folder")
    if (out / "acquisition.toml").exists() and not (out / "simulate.json").exists():
        raise InputError(
            f"{out}: holds an acquisition.toml of somebody else; choose another folder"
        )
    asked = {name: value for name, value in context.options.items() if name != "out"}
    text = {"command": "simulate", "versions": versions(), "scene": scene, "options": asked}
    with pictures.fill(out, text) as folder:
        context.progress("scene")
        rig = _rig(folder, scene, asked)
        rig |= {name: asked[name] for name in ("response", "projector_response", "bits", "seed")}
        aligned = asked["camera_grid"] is None and not scene.endswith(".xml")
        settings = {"geometry": "aligned" if aligned else "graycode", "strategy": asked["strategy"]}
        tables = {
            name: "".join(
                f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in keys.items()
            )
            for name, keys in (("rig", rig), ("acquire", settings))
        }
        template = Path(__file__).with_name("acquisition.toml.in").read_text("utf-8")
        (folder / "acquisition.toml").write_text(template.format(**tables), "utf-8")
        with Project.open(folder).rig() as opened:  # refuses what cannot be photographed
            text |= {"projector_grid": opened.projector_grid, "channels": opened.channels}
    size = "{} x {} projector pixels".format(*text["projector_grid"])
    lines = [f"{out}: {scene}, {size}, {text['channels']} channel(s)"]
    lines += [f"what it takes: ltcl acquire plan {out}", f"to do it:      ltcl acquire run {out}"]
    return Answer({"folder": out, **text}, lines)


def _rig(folder: Path, scene: str, asked: dict[str, Any]) -> dict[str, Any]:
    """The table of a rig that Mitsuba renders, or of one around a transport, which goes into the folder."""
    from ltcl import scenes
    from ltcl.acquisition import camera_map

    source = scene.removeprefix("mitsuba:")
    is_rendered, is_named = source != scene, source in _SCENES
    refused = {"size": is_rendered or not is_named, "grid": is_named and not is_rendered}
    refused |= {"albedo": not is_named, "ambient": is_rendered}
    for name, is_refused in refused.items():
        if is_refused and asked[name] is not None:
            raise InputError(f"--{name} is {asked[name]}, but {scene} takes no --{name}")
    albedo = asked["albedo"] or (0.7,)
    rig: dict[str, Any] = (
        {} if asked["camera_grid"] is None else {"camera_grid": asked["camera_grid"]}
    )
    if is_rendered:
        rig |= {"kind": "mitsuba", "projector_grid": asked["grid"] or (24, 32)}
        rig |= {"scene": source if is_named else str(Path(source).resolve())}
        paint = {"channels": len(albedo), "albedo": albedo if albedo[1:] else albedo[0]}
        return rig | (paint if is_named else {})
    if is_named:
        walls, sides = (
            np.array([albedo]) if albedo[1:] else albedo[0],
            {"sides": 5} if scene == "box" else {},
        )
        built = getattr(scenes, scene)(asked["size"] or 16, albedo=walls, **sides)
        record: Any = StoreRecord(built.matrices(), grid=built.grid)
    elif not Path(scene).suffix and not Path(scene).exists():
        known = f"{', '.join(_SCENES)}, mitsuba:NAME or a transport file"
        raise InputError(f"SCENE is {scene!r}; it must be {known}")
    elif (record := formats.read(Path(scene))).grid is None and asked["grid"] is None:
        raise InputError(f"{scene}: does not contain its grid; give --grid HxW")
    elif isinstance(record, StoreRecord) and asked["grid"] is not None:
        record = dataclasses.replace(
            record, grid=checks.grid("--grid", asked["grid"], record.shape[1])
        )
    formats.write(folder / "truth.npz", record)
    rig |= {"kind": "virtual", "transport": "truth.npz"}
    rig |= {"ambient": 0.01 if asked["ambient"] is None else asked["ambient"]}
    if asked["camera_grid"]:  # a camera in the projector's place
        rig |= {"camera_map": "camera.npz"}
        (H, W), (h, w) = (
            asked["camera_grid"],
            checks.grid("grid", record.camera_grid or record.grid),
        )
        seen = camera_map(
            lambda u, v: ((u + 0.5) * w / W - 0.5, (v + 0.5) * h / H - 0.5), (H, W), (h, w)
        )
        formats.write(folder / "camera.npz", StoreRecord((seen,), grid=(h, w), camera_grid=(H, W)))
    return rig


_TAKE = (
    "Folder with the camera's own files: copied, in the order of their numbers, to what is missing."
)
_Take = Annotated[Path | None, options.file(_TAKE, metavar="FOLDER")]
_Overhead = Annotated[float, option("Seconds of each photograph beyond its exposure.", min=0.0)]

_HELP = """Photograph a scene under patterns, and make its transport of the photographs, in
DIR/transport.zarr. DIR has an acquisition.toml, which says what photographs, and how."""


def plan(context: Context, folder: options.Acquisition, overhead: _Overhead = 0.0) -> Answer:
    """What each strategy takes: photographs, time, disk; and how accurate it is.

    Noise and light are as measured once DIR/transport.zarr has its calibration, before that they
    are guessed. No camera is opened.
    """
    from ltcl.acquisition import Project
    from ltcl.acquisition.scanning.plan import choose, plans

    project = Project.open(folder)
    settings, facts = project.outlook()
    with project.naming("acquire"):
        strategies = plans(**facts, overhead=overhead)
    (best, why), is_measured, count = (
        choose(strategies),
        project.state != "new",
        facts["calibration"],
    )
    data = {"folder": folder, "rig": project.kind, "measured": is_measured}
    data |= {"asked_for": settings.strategy, "auto": best, "why": why}
    data |= {name: facts[name] for name in ("exposures", "noise", "light", "channels")}
    rows = []
    for name, each in strategies.items():
        counts = "{} x {}".format(*each.grid), each.patterns, each.photographs
        sizes = datetime.timedelta(seconds=round(each.seconds)), checks.size(each.disk)
        rows.append((name, *counts, *sizes, percent(each.error, 2)))
    columns = (
        "strategy",
        "pixels",
        "patterns",
        "photographs",
        "time",
        "disk at most",
        "error of T p",
    )
    source = "measured" if is_measured else "guessed; the calibration will measure them"
    advice = (
        "" if settings.strategy == "auto" else f"acquisition.toml asks for {settings.strategy}; "
    )
    lines = [
        f"{folder}: {project.kind} rig, {facts['channels']} channel(s)",
        f"exposures {', '.join(f'{t:.3g}' for t in facts['exposures'])} s, noise and light {source}\n",
        table(columns, rows),
        f"\nphotographs: all, {count} of them of the calibration; error of T p: by noise, relative",
        f"{advice}auto takes {best}: {why}",
    ]
    return Answer(data | {"plans": strategies}, lines)


def run(
    context: Context, folder: options.Acquisition, take: _Take = None, device: options.Device = None
) -> Answer:
    """Measure the set-up, then photograph all patterns; the transport comes to DIR/transport.zarr.

    Goes on from wherever the folder stands: after Ctrl-C or a power cut, with photographs that were
    missing, or with nothing but the transport left to be made.

    With a folder rig a person takes the photographs. Where they are missing, prints which pattern
    to show next, for how long to expose and the name to save it by, and ends with exit code 3.
    """
    from ltcl.acquisition import Project, acquire, finalize

    project = Project.open(folder)
    options.writable(project.store, project.store)
    opened = open_device(device)  # before the photographs, not after them
    if take is not None and project.kind != "folder":
        raise InputError(f"--take is given, but the rig of {folder} is {project.kind}, not folder")
    if take is not None and not take.is_dir():
        raise FileError(f"{take}: is no folder; --take needs the one with the camera's files")
    if project.kind == "live" and project.state != "new":
        with suppress(AcquisitionError):  # photographs are missing
            finalize(project.store)
        if project.state == "final":  # no camera or display has to be there
            return report(context, folder, device)
    settings = {"store": project.store, "device": opened, **project.settings}
    try:
        with project.rig() as rig:
            if take is not None:
                rig.take([each for each in take.glob("[!.]*") if each.is_file()])
            try:
                with project.naming("acquire"):
                    acquire(rig, progress=context.progress, **settings)
            except PhotographMissing as error:  # the normal way of a folder scan
                missing, shot, name = rig.missing(), error.shot._asdict(), shlex.quote(str(folder))
                data = {"folder": folder, "next": shot, "missing": missing, "exit_code": WAITING}
                lines = [
                    f"next: {error}",
                    f"{folder / 'shots.csv'} is the list; {len(missing)} are missing",
                ]
                lines.append(
                    f"on the projector: ltcl show {name}; then: ltcl acquire run {name} --take CARD"
                )
                return Answer(data, lines, WAITING)
    except (AcquisitionError, KeyboardInterrupt) as error:
        error.args = (f"{str(error) or 'interrupted'}; {_advice(project, error)}",)
        raise
    return report(context, folder, device)


def _advice(project: Any, error: BaseException) -> str:
    """What is kept of an acquisition that ends early, and how it goes on."""
    from ltcl.acquisition.session import calibration_photographs

    again = f"'ltcl acquire run {shlex.quote(str(project.folder))}' goes on"
    if isinstance(error, ScanRefused):
        return f"remove {project.store} to begin again"
    if project.kind == "folder" and not isinstance(error, KeyboardInterrupt):
        return f"remove wrong ones from {project.folder / 'photographs'}, to be asked for them again; {again}"
    if project.state == "begun":
        return f"what was photographed before is kept in {project.store}; {again}"
    if project.kind == "folder":
        return again
    return (
        f"{calibration_photographs(project.store)} photographs of the calibration are kept; {again}"
    )


def report(context: Context, folder: options.Acquisition, device: options.Device = None) -> Answer:
    """Coverage, saturation, noise and reciprocity of a finished acquisition.

    Of a virtual rig also the relative error of T p, for patterns p that were not scanned, after one
    scale for each channel: the unit of light of a camera is its own.
    """
    from ltcl.acquisition import Project, Report, Setup

    project, opened = Project.open(folder), open_device(device)
    if not project.store.exists():
        raise FileError(f"{project.store}: no such folder yet; 'ltcl acquire run' makes it")
    context.progress("entries and noise")
    facts = Report.of(project.store)
    data = {"folder": folder, "store": project.store, **json.loads(facts.to_json())}
    lines = [str(facts)]
    T = store.load(project.store, on_dark="mask", device=opened)
    data["verdict"] = judged = verdict(
        T, sum_deviation=facts.sum_deviation, saturation=facts.saturated
    )
    if project.kind == "virtual":
        context.progress("relative error of T p")
        with project.rig(aligned=True) as rig:
            data["error"] = errors = Setup.of(project.store).relative_error(rig, T)
        each = ", ".join(f"{error:.2%}" for error in errors)
        lines.append(f"relative error of T p, for patterns p that were not scanned: {each}")
    end = options.verdicts({str(project.store): judged})
    return Answer(data, [*lines, f"transport in {project.store}", *end])


app = typer.Typer(help=_HELP, no_args_is_help=True)
for _command in (plan, run, report):
    app.command()(command()(_command))
for _name in ("resume", "finalize"):  # of earlier versions
    app.command(_name, hidden=True)(command()(run))
