# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl acquire`: plan, run and report of an acquisition, which is a folder with an acquisition.toml."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ltcl import checks, store
from ltcl import report as reports
from ltcl.cli import console, options, pictures, results
from ltcl.cli.command import WAITING, Answer, Context, command
from ltcl.device import open_device
from ltcl.errors import AcquisitionError, FileError, InputError, PhotographMissing, ScanRefused

if TYPE_CHECKING:
    from ltcl.acquisition import Project

_SETTINGS = ("block", "order", "threshold")  # of `ltcl.acquire`, which decide on a plan
_TAKE = "Folder with the camera's own files: copied, in the order of their numbers, to what is missing."
_PICTURES = "Also pictures: coverage, white, ambient light, first bounce."
_Overhead = Annotated[float, options.option("Seconds of each photograph beyond its exposure.", min=0.0)]
_Take = Annotated[Path | None, options.file(_TAKE, metavar="FOLDER")]
_Out = Annotated[Path | None, options.out(_PICTURES, options.writable_folder, "FOLDER")]


def plan(context: Context, folder: options.Acquisition, overhead: _Overhead = 0.0) -> Answer:
    """What each strategy takes: photographs, time, disk; and what it gives: signal over noise.

    Noise and light are as measured once DIR/transport.zarr has its calibration, before that they are guessed.
    No camera is opened.
    """
    from ltcl.acquisition import Project
    from ltcl.acquisition.calibrate import photographs
    from ltcl.acquisition.scanning import plan

    project = Project.open(folder)
    asked, facts = project.check(), _outlook(project)
    kind: dict[str, Any] = {"aligned": asked.geometry == "aligned", "by_hand": project.kind == "folder"}
    kind |= {"channels": facts["channels"], "frames": asked.frames}
    settings: dict[str, Any] = {name: getattr(asked, name) for name in _SETTINGS}
    settings["calibration"] = photographs(facts["grid"], **kind)
    with project.naming("acquire"):
        plans = plan.plans(**facts, **settings, overhead=overhead)
    chosen, why = plan.choose(plans)
    data = {"folder": folder, "rig": project.kind, "measured": project.state != "new"}
    data |= {"asked_for": asked.strategy, "auto": chosen, "why": why}
    data |= {name: facts[name] for name in ("exposures", "noise", "light", "channels")}
    data["plans"] = {name: dataclasses.asdict(each) for name, each in plans.items()}
    return Answer(data, partial(_show_plan, data))


def _outlook(project: Project) -> dict[str, Any]:
    """What decides on the plans: guessed before the calibration, then measured."""
    if project.state == "new":
        outlook = project.outlook()
        return {field.name: getattr(outlook, field.name) for field in dataclasses.fields(outlook)}
    from ltcl.acquisition import Calibration
    from ltcl.acquisition.scanning.plan import measured

    found = Calibration.of(project.store)
    facts = {"grid": found.resampling.grid, "channels": 1 if found.white.value.ndim == 2 else 3}
    return facts | {"exposures": found.exposures, "noise": found.noise, "light": measured(found)}


def _show_plan(data: dict[str, Any]) -> None:
    from ltcl.acquisition.scanning.plan import duration

    times = ", ".join(f"{t:.3g}" for t in data["exposures"])
    how = "measured" if data["measured"] else "guessed; the calibration will measure them"
    typer.echo(f"{data['folder']}: {data['rig']} rig, {data['channels']} channel(s)")
    typer.echo(f"exposures {times} s, noise and light {how}\n")
    rows = []
    for name, each in data["plans"].items():
        pixels, error = "{} x {}".format(*each["grid"]), console.percent(each["error"], 2)
        noise = f"{each['snr_direct']:.3g}", f"{each['snr_indirect']:.2g}"
        sizes = duration(each["seconds"]), checks.size(each["disk"])
        rows.append((name, pixels, each["patterns"], each["photographs"], *sizes, *noise, error, each["why"]))
    columns = ("strategy", "pixels", "patterns", "photographs", "time", "disk at most")
    console.table((*columns, "direct", "weak entry", "error of T p", "how"), rows)
    calibration = next(iter(data["plans"].values()))["calibration"]
    typer.echo(
        f"\nphotographs: all, {calibration} of them of the calibration; error of T p: by noise, relative"
    )
    typer.echo("direct, weak entry: signal over noise of entries on the diagonal, and off it")
    asked = "" if data["asked_for"] == "auto" else f"acquisition.toml asks for {data['asked_for']}; "
    typer.echo(f"{asked}auto takes {data['auto']}: {data['why']}")


def run(
    context: Context, folder: options.Acquisition, take: _Take = None, device: options.Device = None
) -> Answer:
    """Measure the set-up, then photograph all patterns; the transport comes to DIR/transport.zarr.

    Goes on from wherever the folder stands: after Ctrl-C or a power cut, with photographs that were missing,
    or with nothing but the transport left to be made.

    With a folder rig a person takes the photographs. Where they are missing, prints which pattern to show
    next, for how long to expose and the name to save it by, and ends with exit code 3.
    """
    from ltcl.acquisition import Project, acquire

    project = Project.open(folder)
    options.writable_folder(project.store)
    opened = open_device(device)  # before the photographs, not after them
    if take is not None:
        _take(project, take)
    settings = {"store": project.store, "device": opened, **project.settings}
    if project.state == "final" and project.kind == "live":  # no camera or display is opened
        return _report(context, project, opened)
    try:
        with _advising(project), project.rig() as rig:
            try:
                with project.naming("acquire"):
                    acquire(rig, progress=context.progress, **settings)
            except PhotographMissing as error:
                return _next(project, rig, error)
    except ScanRefused:
        raise
    except AcquisitionError:  # such as a camera that is not there, which may not be needed any more
        if not _finalize(project):
            raise
    return _report(context, project, opened)


def _finalize(project: Project) -> bool:
    """Make the transport of what has been photographed; False where photographs are missing."""
    from ltcl.acquisition import finalize

    try:
        if project.state != "new":
            finalize(project.store)
    except AcquisitionError:
        return False
    return project.state == "final"


@contextmanager
def _advising(project: Project) -> Iterator[None]:
    """Say with what ends an acquisition early how it goes on."""
    try:
        yield
    except ScanRefused as error:
        error.args = (f"{error}; remove {project.store} to begin again",)
        raise
    except AcquisitionError as error:
        error.args = (f"{error}; {_left(project)}",)
        raise
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"interrupted; {_left(project)}") from None


def _left(project: Project) -> str:
    """What an acquisition that ended early has left, and how it goes on."""
    command = f"'ltcl acquire run {project.folder}'"
    if project.state == "begun":
        return f"what was photographed before is kept in {project.store}; {command} goes on"
    if project.kind == "folder":
        return (
            f"take photographs that are wrong again, in {project.folder}/photographs; then {command} goes on"
        )
    return f"{project.kept} photographs of the calibration are kept; {command} goes on"


def _next(project: Project, rig: Any, error: PhotographMissing) -> Answer:
    """What a person has to do now: not an error, but the normal way of a folder scan."""
    missing, folder = rig.missing(), project.folder
    data = {"folder": folder, "next": error.shot._asdict(), "missing": missing, "exit_code": WAITING}

    def show() -> None:
        typer.echo(f"next: {error}")
        typer.echo(f"{len(missing)} photograph(s) are missing; {folder}/shots.csv lists them")
        typer.echo(f"'ltcl show {folder}' shows their patterns; then: ltcl acquire run {folder}")

    return Answer(data, show, WAITING)


def _take(project: Project, source: Path) -> None:
    """Copy the camera's own files to the photographs that are missing."""
    if project.kind != "folder":
        raise InputError(f"--take is given, but the rig of {project.folder} is {project.kind}, not folder")
    if not source.is_dir():
        raise FileError(f"{source}: is no folder; --take needs the one with the camera's files")
    with project.rig() as rig:
        rig.take([path for path in source.iterdir() if path.is_file() and not path.name.startswith(".")])


def report(
    context: Context, folder: options.Acquisition, out: _Out = None, device: options.Device = None
) -> Answer:
    """Coverage, saturation, noise and reciprocity of a finished acquisition.

    Of a virtual rig also the relative error of T p, for patterns p that were not scanned, after one scale for
    each channel: the unit of light of a camera is its own.
    """
    from ltcl.acquisition import Project

    return _report(context, Project.open(folder), open_device(device), out)


def _report(context: Context, project: Project, device: Any, out: Path | None = None) -> Answer:
    """What came of it, with pictures into `out` where that is given."""
    from ltcl.acquisition import Report, Setup

    context.progress("entries and noise")
    found = Report.of(project.store)
    data = {"folder": project.folder, "store": project.store, **json.loads(found.to_json())}
    lines, setup = [str(found)], Setup.of(project.store)
    if project.kind == "virtual":
        context.progress("relative error of T p")
        T = store.load(project.store, on_dark="mask", device=device)
        with project.aligned().rig() as rig:
            data["error"] = errors = setup.relative_error(rig, T)
        each = ", ".join(f"{error:.2%}" for error in errors)
        lines.append(f"relative error of T p, for patterns p that were not scanned: {each}")
    lines.append(f"transport in {project.store}" + ("" if out is None else f", pictures in {out}"))
    if out is not None:
        _draw(project, setup, out, {"command": "acquire_report", "versions": reports.versions(), **data})
    return Answer(data, lambda: typer.echo("\n".join(lines)))


def _draw(project: Project, setup: Any, out: Path, text: dict[str, Any]) -> None:
    """Light at one exposure; coverage is a number of camera pixels."""
    import numpy as np

    from ltcl.store import BlockStore

    F = np.moveaxis(np.asarray(BlockStore.open(project.store).extra("first_bounce")), 0, -1)
    F = F.reshape(*setup.grid, *(3,) * (F.shape[-1] == 3))
    text["exposure"] = factor = pictures.exposure(setup.white)
    coverage = setup.calibration.resampling.coverage
    drawn = {"white": (setup.white, factor), "ambient": (setup.ambient, factor), "first_bounce": (F, factor)}
    drawn["coverage"] = (coverage, pictures.exposure(coverage))
    with results.fill(out, text) as folder:
        for name, (picture, scale) in drawn.items():
            panel = pictures.panel(pictures.shades(picture, scale), name)
            pictures.write(folder, name, picture, panel)


app = typer.Typer(
    help="Photograph a scene under patterns, and make its transport of the photographs.\n\n"
    "DIR is a folder with an acquisition.toml, which says what photographs, and how; 'ltcl simulate' makes "
    "one. The transport comes to DIR/transport.zarr.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
)
for _function in (plan, run, report):
    app.command()(command(_function))
for _name in ("resume", "finalize"):  # of earlier versions
    app.command(_name, hidden=True)(command(run))
