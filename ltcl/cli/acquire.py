# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl acquire`: plan, run and report of a folder with an acquisition.toml; `ltcl show`: its patterns."""

from __future__ import annotations

import dataclasses
import datetime
import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ltcl import checks, store
from ltcl.cli import options, transports
from ltcl.cli.command import WAITING, Answer, Context, command, percent, table
from ltcl.cli.options import option
from ltcl.device import open_device
from ltcl.errors import AcquisitionError, FileError, InputError, PhotographMissing, ScanRefused
from ltcl.verdict import verdict

if TYPE_CHECKING:
    from ltcl.acquisition import Project

_TAKE = "Folder with the camera's own files: copied, in the order of their numbers, to what is missing."
_Overhead = Annotated[float, option("Seconds of each photograph beyond its exposure.", min=0.0)]
_ARRIVAL = "Next pattern when its photograph is in the folder of the acquisition."

app = typer.Typer(
    help="Photograph a scene under patterns, and make its transport of the photographs, in "
    "DIR/transport.zarr. DIR has an acquisition.toml, which says what photographs, and how.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
)


@app.command()
@command()
def plan(context: Context, folder: options.Acquisition, overhead: _Overhead = 0.0) -> Answer:
    """What each strategy takes: photographs, time, disk; and how accurate it is.

    Noise and light are as measured once DIR/transport.zarr has its calibration, before that they are guessed.
    No camera is opened.
    """
    from ltcl.acquisition import Project
    from ltcl.acquisition.calibrate import photographs
    from ltcl.acquisition.scanning.plan import choose, plans

    project = Project.open(folder)
    settings, facts = project.outlook()
    facts = facts if project.state == "new" else _measured(project)
    kind: dict[str, Any] = {"aligned": settings.geometry == "aligned", "by_hand": project.kind == "folder"}
    count = photographs(facts["grid"], channels=facts["channels"], frames=settings.frames, **kind)
    asked: dict[str, Any] = {name: getattr(settings, name) for name in ("block", "order", "threshold")}
    with project.naming("acquire"):
        strategies = plans(**facts, **asked, overhead=overhead, calibration=count)
    best, why = choose(strategies)
    data = {"folder": folder, "rig": project.kind, "measured": project.state != "new"}
    data |= {"asked_for": settings.strategy, "auto": best, "why": why}
    data |= {name: facts[name] for name in ("exposures", "noise", "light", "channels")}
    data["plans"] = {name: dataclasses.asdict(each) for name, each in strategies.items()}
    rows = []
    for name, each in strategies.items():
        counts = "{} x {}".format(*each.grid), each.patterns, each.photographs
        sizes = datetime.timedelta(seconds=round(each.seconds)), checks.size(each.disk)
        rows.append((name, *counts, *sizes, percent(each.error, 2)))
    columns = ("strategy", "pixels", "patterns", "photographs", "time", "disk at most", "error of T p")
    times = ", ".join(f"{t:.3g}" for t in facts["exposures"])
    source = "measured" if data["measured"] else "guessed; the calibration will measure them"
    advice = "" if settings.strategy == "auto" else f"acquisition.toml asks for {settings.strategy}; "
    lines = [
        f"{folder}: {project.kind} rig, {facts['channels']} channel(s)",
        f"exposures {times} s, noise and light {source}\n",
        table(columns, rows),
        f"\nphotographs: all, {count} of them of the calibration; error of T p: by noise, relative",
        f"{advice}auto takes {best}: {why}",
    ]
    return Answer(data, lines)


def _measured(project: Project) -> dict[str, Any]:
    """What decides on the plans, by the calibration."""
    from ltcl.acquisition import Calibration
    from ltcl.acquisition.scanning.plan import measured

    calibration = Calibration.of(project.store)
    channels = 1 if calibration.white.value.ndim == 2 else 3
    facts = {"grid": calibration.resampling.grid, "channels": channels, "light": measured(calibration)}
    return facts | {"exposures": calibration.exposures, "noise": calibration.noise}


@app.command("finalize", hidden=True)
@app.command("resume", hidden=True)  # of earlier versions
@app.command()
@command()
def run(
    context: Context,
    folder: options.Acquisition,
    take: Annotated[Path | None, options.file(_TAKE, metavar="FOLDER")] = None,
    device: options.Device = None,
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
    if take is not None and project.kind != "folder":
        raise InputError(f"--take is given, but the rig of {folder} is {project.kind}, not folder")
    if take is not None and not take.is_dir():
        raise FileError(f"{take}: is no folder; --take needs the one with the camera's files")
    if _is_complete(project):
        return _report(context, project, opened)
    settings = {"store": project.store, "device": opened, **project.settings}
    with _advising(project), project.rig() as rig:
        if take is not None:
            rig.take([path for path in take.iterdir() if path.is_file() and not path.name.startswith(".")])
        try:
            with project.naming("acquire"):
                acquire(rig, progress=context.progress, **settings)
        except PhotographMissing as error:  # the normal way of a folder scan
            missing, shot = rig.missing(), error.shot._asdict()
            data = {"folder": folder, "next": shot, "missing": missing, "exit_code": WAITING}
            lines = [
                f"next: {error}",
                f"{len(missing)} photograph(s) are missing; {folder}/shots.csv lists them",
                f"'ltcl show {folder}' shows their patterns; then: ltcl acquire run {folder}",
            ]
            return Answer(data, lines, WAITING)
    return _report(context, project, opened)


def _is_complete(project: Project) -> bool:
    """Whether a live rig has taken all photographs: then no camera or display has to be there."""
    from ltcl.acquisition import finalize

    with suppress(AcquisitionError):
        if project.kind == "live" and project.state != "new":
            finalize(project.store)
            return True
    return False


@contextmanager
def _advising(project: Project) -> Iterator[None]:
    """Add to what ends an acquisition early what is kept, and how it goes on."""
    from ltcl.acquisition.session import calibration_photographs

    try:
        yield
    except (AcquisitionError, KeyboardInterrupt) as error:
        again = f"'ltcl acquire run {project.folder}' goes on"
        if isinstance(error, ScanRefused):
            advice = f"remove {project.store} to begin again"
        elif project.state == "begun":
            advice = f"what was photographed before is kept in {project.store}; {again}"
        elif project.kind == "folder" and isinstance(error, KeyboardInterrupt):
            advice = again
        elif project.kind == "folder":
            advice = f"take wrong photographs in {project.folder}/photographs again; then {again}"
        else:
            count = calibration_photographs(project.store)
            advice = f"{count} photographs of the calibration are kept; {again}"
        error.args = (f"{str(error) or 'interrupted'}; {advice}",)
        raise


@app.command()
@command()
def report(context: Context, folder: options.Acquisition, device: options.Device = None) -> Answer:
    """Coverage, saturation, noise and reciprocity of a finished acquisition.

    Of a virtual rig also the relative error of T p, for patterns p that were not scanned, after one scale for
    each channel: the unit of light of a camera is its own.
    """
    from ltcl.acquisition import Project

    return _report(context, Project.open(folder), open_device(device))


def _report(context: Context, project: Project, device: Any) -> Answer:
    from ltcl.acquisition import Report, Setup

    context.progress("entries and noise")
    facts = Report.of(project.store)
    data = {"folder": project.folder, "store": project.store, **json.loads(facts.to_json())}
    lines = [str(facts)]
    T = store.load(project.store, on_dark="mask", device=device)
    data["verdict"] = judged = verdict(T, sum_deviation=facts.sum_deviation, saturation=facts.saturated)
    if project.kind == "virtual":
        context.progress("relative error of T p")
        with project.rig(aligned=True) as rig:
            data["error"] = errors = Setup.of(project.store).relative_error(rig, T)
        each = ", ".join(f"{error:.2%}" for error in errors)
        lines.append(f"relative error of T p, for patterns p that were not scanned: {each}")
    end = transports.verdicts({str(project.store): judged})
    return Answer(data, [*lines, f"transport in {project.store}", *end])


@command()
def show(
    context: Context,
    folder: Annotated[Path, options.argument("FOLDER", "Pictures, or an acquisition with its patterns.")],
    display: Annotated[int, option("Number of the display, from 0.", metavar="N", min=0)] = 1,
    every: Annotated[float | None, option("Next picture after so many seconds.", metavar="SECONDS")] = None,
    arrival: Annotated[bool, option(_ARRIVAL, "--arrival")] = False,
) -> Answer:
    """Show patterns full screen, next by key, timer or photograph; Escape ends it. Needs extra projector."""
    if every is not None and arrival:
        raise InputError(f"--every is {every:g}, but --arrival is given; one of them decides what comes next")
    from ltcl.acquisition import rigs

    def progress(shot: Any, done: int, total: int) -> None:
        context.progress(f"photograph {shot.number}: {shot.seconds:g} s, {shot.save_as}", done, total)

    advance = "arrival" if arrival else every or "key"
    count = rigs.show(folder, display=display, advance=advance, progress=progress)
    return Answer({"folder": folder, "shown": count}, [f"{count} pattern(s) were shown"])
