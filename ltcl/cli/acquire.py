# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl acquire`: a scan planned, run and reported."""

from __future__ import annotations

import dataclasses
import datetime
import json
import shlex
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from ltcl import checks, store
from ltcl.cli import options
from ltcl.cli.aim import aim
from ltcl.cli.command import Answer, Context, command
from ltcl.cli.failure import WAITING
from ltcl.cli.fit import fit
from ltcl.cli.importing import import_photographs
from ltcl.cli.options import file_option, option
from ltcl.cli.projectors import copy_from_card, report_several, run_several
from ltcl.cli.reports.acquisition import (
    NextPhotograph,
    PhotographMissing,
    PlanReport,
    PlansReport,
    RigKind,
    ScanReport,
    ScansReport,
    StrategyPlan,
    UpdateReport,
)
from ltcl.cli.reports.parts import Channels, VerdictReport
from ltcl.cli.tables import percent, size_text, table, verdict_lines
from ltcl.device import open_device
from ltcl.errors import AcquisitionError, FileError, InputError, ScanRefused
from ltcl.errors import PhotographMissing as MissingError
from ltcl.transport.verdict import verdict

PLAN_COLUMNS = (
    "strategy",
    "pixels",
    "patterns",
    "calibration",
    "photographs",
    "time",
    "disk at most",
    "error of T p",
)
Overhead = Annotated[
    float, option("Seconds that each photograph takes beyond its exposure.", min=0.0)
]
Card = Annotated[
    Path | None,
    file_option(
        "Folder with the camera's own files; they are copied, in the order in which they were "
        "taken, in place of the missing photographs.",
        metavar="FOLDER",
    ),
]
app = typer.Typer(
    help=(
        "Photograph a scene under patterns, and make its transport of the "
        "photographs, in DIR/transport.zarr. DIR has an acquisition.toml, which "
        "describes the rig and the scan."
    ),
    no_args_is_help=True,
)


@app.command()
@command()
def plan(context: Context, folder: options.Acquisition, overhead: Overhead = 0.0) -> Answer:
    """Show photographs, time, disk and accuracy of each strategy.

    Noise and light are as measured once DIR/transport.zarr has its calibration; before that they
    are guessed. No camera is opened.
    """
    from ltcl.acquisition import Project

    projects = Project.open_all(folder)
    reports = [_plan(project, overhead) for project in projects]
    lines = []
    for project, report in zip(projects, reports, strict=True):
        lines += [*_heading(project), *_plan_lines(report)]
    if len(projects) == 1:
        return Answer(reports[0], lines)
    by_name = {}
    for project, report in zip(projects, reports, strict=True):
        by_name[project.name] = report
        lines += _map_lines(project)
    return Answer(PlansReport(folder=folder, projectors=by_name), lines)


def _heading(project: Any) -> list[str]:
    """The name of one of several projectors."""
    return [f"[{project.name}]"] if project.name else []


def _map_lines(project: Any) -> list[str]:
    """Lines that say what the map of one of several projectors takes."""
    from ltcl.acquisition.projectors.view import expected_photographs

    if project.view() is not None:
        return [f"{project.name}: its map is there"]
    with project.rig(closed=True) as rig:
        count = expected_photographs(rig.projector_grid)
    return [f"{project.name}: its map takes about {count} photographs of Gray code before that"]


def _plan(project: Any, overhead: float) -> PlanReport:
    """The plan of one projector."""
    from ltcl.acquisition.scanning import sketch
    from ltcl.acquisition.scanning.pace import seconds_per_megapixel
    from ltcl.acquisition.scanning.plan import choose, plans

    settings, facts = project.outlook()
    with project.naming("acquire"):
        pace = seconds_per_megapixel(facts["channels"])
        strategies = plans(**facts, overhead=overhead, pace=pace)
    best, why = choose(strategies)
    is_measured = project.state != "new"
    # Before that exposures are guessed for scans that take several; a sketch takes one.
    exposures = len(facts["exposures"]) if is_measured else 1
    first = strategies["sketch"].photographs
    report = PlanReport(
        folder=project.folder,
        rig=_rig_kind(project),
        measured=is_measured,
        asked_for=settings.strategy,
        auto=best,
        why=why,
        exposures=facts["exposures"],
        noise=facts["noise"],
        light=facts["light"],
        channels=facts["channels"],
        megapixels=facts["megapixels"],
        pace=pace,
        rounds=len(sketch.round_sizes(settings.photographs, settings.rtol, first, exposures)),
        photographs_of_round=sketch.photographs_of_round(exposures),
        plans={},
    )
    for name, strategy in strategies.items():
        report.plans[name] = StrategyPlan.from_attributes(strategy)
    return report


def _rig_kind(project: Any) -> RigKind:
    return project.kind


def _plan_lines(report: PlanReport) -> list[str]:
    rows = []
    for name, strategy in report.plans.items():
        row = [name, size_text(strategy.grid), strategy.patterns]
        row += [
            strategy.calibration,
            strategy.photographs,
            datetime.timedelta(seconds=round(strategy.seconds)),
        ]
        row += [checks.size(strategy.disk), percent(strategy.error, 2)]
        rows.append(row)
    exposures = ", ".join(f"{seconds:.3g}" for seconds in report.exposures)
    source = "measured"
    if not report.measured:
        source = "guessed; the calibration will measure them"
    advice = f"auto takes {report.auto}: {report.why}"
    if report.asked_for != "auto":
        advice = f"acquisition.toml asks for {report.asked_for}; {advice}"
    lines = [
        f"{report.folder}: {report.rig} rig, {report.channels} channel(s)",
        f"exposures {exposures} s, noise and light {source}\n",
        table(PLAN_COLUMNS, rows),
        "\nphotographs: all, with those of the calibration; error of T p: forecast, relative",
        _computing_line(report),
    ]
    if report.rounds:
        lines.append(
            f"a sketch goes on for up to {report.rounds} rounds, of at most "
            f"{report.photographs_of_round} photographs each, as asked for by rtol or photographs"
        )
    return [*lines, advice]


def _computing_line(report: PlanReport) -> str:
    """The time that the computer works besides, by the pace that was measured."""
    if report.megapixels is None:
        return (
            "time: exposures and overhead; computing adds about "
            f"{report.pace:.2g} s for each photograph and megapixel of the camera"
        )
    strategy = report.auto if report.asked_for == "auto" else report.asked_for
    seconds = report.plans[strategy].computing or 0.0
    return (
        f"time: exposures and overhead; computing adds about {max(seconds / 60, 0.1):.1f} minutes "
        f"for {strategy}, with {report.megapixels:.3g} megapixels"
    )


@app.command()
@command()
def run(
    context: Context,
    folder: options.Acquisition,
    take: Card = None,
    device: options.DeviceName = None,
) -> Answer:
    """Measure the set-up, then photograph all patterns; the transport comes to DIR/transport.zarr.

    Several projectors, with [[projector]] in acquisition.toml, are scanned one by one, into
    DIR/NAME.zarr, while the others show black; in between it is checked that the camera did not
    move.

    A run that was stopped continues: after Ctrl-C or a power cut, with photographs that were
    missing, or with nothing but the transport left to be made.

    With a folder rig a person takes the photographs. If some are missing, prints which pattern to
    show next, for how long to expose and the name to save it by, and ends with exit code 3.
    """
    from ltcl.acquisition import Project, acquire

    project, *others = Project.open_all(folder)
    options.check_writable_folder(project.store)
    # The device is opened before the photographs, not after them.
    opened = open_device(device)
    if others:
        return _run_several(context, [project, *others], take, opened)
    _check_card(project, take)
    if _has_all_photographs(project):
        # No camera or display has to be there.
        return _report(context, folder, device)
    try:
        with project.rig() as rig:
            if take is not None:
                copy_from_card(rig, take, project)
            try:
                with project.naming("acquire"):
                    acquire(
                        rig,
                        progress=context.progress,
                        store=project.store,
                        device=opened,
                        **project.settings,
                    )
            except MissingError as error:
                # A scan by hand goes on with the next photograph.
                again = f"ltcl acquire run {shlex.quote(str(folder))}"
                return _ask_for_photograph(folder, error, rig.missing(), again)
    except (AcquisitionError, KeyboardInterrupt) as error:
        problem = str(error) or "interrupted"
        error.args = (f"{problem}; {_advice(project, error)}",)
        raise
    return _report(context, folder, device)


def _run_several(context: Context, projects: Any, take: Path | None, device: Any) -> Answer:
    """Scan several projectors one by one."""
    folder = projects[0].folder
    for project in projects:
        _check_card(project, take)
    again = f"ltcl acquire run {shlex.quote(str(folder))}"
    try:
        waiting = run_several(context, projects, take, device)
    except (AcquisitionError, KeyboardInterrupt) as error:
        problem = str(error) or "interrupted"
        error.args = (f"{problem}; what was done before is kept; '{again}' goes on",)
        raise
    if waiting is None:
        return report_several(folder, projects)
    step, error, missing = waiting
    answer = _ask_for_photograph(step.folder, error, missing, again)
    others = [project.name for project in projects if project.name != step.project.name]
    hint = f"shown by {step.project.name}; black: {', '.join(others)}"
    return dataclasses.replace(answer, lines=[*answer.lines, hint])


def _check_card(project: Any, take: Path | None) -> None:
    if take is None:
        return
    if project.kind != "folder":
        rig = f"the rig of {project.folder} is {project.kind}"
        raise InputError(f"--take is given, but {rig}, not folder")
    if not take.is_dir():
        advice = "--take needs the one with the camera's files"
        raise FileError(f"{take}: is not a folder; {advice}")


def _has_all_photographs(project: Any) -> bool:
    """Finish a live scan without its rig, if all its photographs are taken."""
    from ltcl.acquisition import finalize

    if project.kind != "live" or project.state == "new":
        return False
    with suppress(AcquisitionError):
        # It is raised if photographs are missing.
        finalize(project.store)
    return project.state == "final"


def _ask_for_photograph(
    folder: Path, error: MissingError, missing: list[int], again: str
) -> Answer:
    """Tell which photograph a person has to take next, and how it goes on."""
    name = shlex.quote(str(folder))
    verb = "is" if len(missing) == 1 else "are"
    report = PhotographMissing(
        folder=folder,
        next=NextPhotograph(**error.shot._asdict()),
        missing=missing,
    )
    lines = [
        f"next: {error}",
        f"{folder / 'shots.csv'} is the list; {len(missing)} {verb} missing",
        f"on the projector: ltcl show {name}; then: {again} --take CARD",
    ]
    return Answer(report, lines, WAITING)


def _advice(project: Any, error: BaseException) -> str:
    """Tell what is kept of an acquisition that ends early, and how it continues."""
    from ltcl.acquisition.session import calibration_photographs

    again = f"'ltcl acquire run {shlex.quote(str(project.folder))}' goes on"
    if isinstance(error, ScanRefused):
        return f"remove {project.store} to begin again"
    if project.kind == "folder" and not isinstance(error, KeyboardInterrupt):
        photographs = project.folder / "photographs"
        return f"remove wrong ones from {photographs} to take them again; {again}"
    if project.state == "begun":
        return f"what was photographed before is kept in {project.store}; {again}"
    if project.kind == "folder":
        return again
    count = calibration_photographs(project.store)
    return f"{count} photographs of the calibration are kept; {again}"


@app.command()
@command()
def update(
    context: Context,
    folder: options.Acquisition,
    to: Annotated[
        Path | None,
        file_option(
            "Folder of the new transport, which must not exist. Default: DIR/updated.zarr, or "
            "DIR/NAME.updated.zarr.",
            "--store",
            metavar="STORE",
        ),
    ] = None,
    photographs: Annotated[
        int | None,
        option(
            "Photographs at most. Default: 60; 12 measure nothing again, each round takes 16 more.",
            metavar="N",
            min=12,
        ),
    ] = None,
    projector: options.ProjectorName = None,
    take: Card = None,
    device: options.DeviceName = None,
) -> Answer:
    """Carry DIR/transport.zarr over to where projector and lamp stand now, by 12 photographs.

    For a projector that was bumped by up to an eighth of its picture, or a lamp that has aged,
    while the camera and the scene stay. Three photographs judge the new transport; if it does not
    hold, what fails is measured again, by 16 photographs more in each round. If it does not hold
    after that, a new scan is needed, and where. DIR/transport.zarr stays as it is.

    With a folder rig a person takes the photographs: patterns come to STORE.photographs, first 12,
    then those of each round, and the command ends with exit code 3 as long as photographs are
    missing.
    """
    from ltcl import acquisition
    from ltcl.acquisition.several import keep_facts

    project = acquisition.Project.open(folder, projector)
    default = f"{projector}.updated.zarr" if projector else "updated.zarr"
    target = folder / default if to is None else to
    opened = open_device(device)
    _check_card(project, take)
    settings = {} if photographs is None else {"photographs": photographs}
    by_hand = target.with_name(f"{target.name}.photographs")
    if project.name and not target.exists():
        keep_facts(project, target)
    with project.rig(photographs=by_hand) as rig:
        if take is not None:
            copy_from_card(rig, take, project)
        try:
            with project.naming("acquire"):
                result = acquisition.update(
                    rig,
                    project.store,
                    store=target,
                    progress=context.progress,
                    device=opened,
                    **settings,
                )
        except MissingError as error:
            again = f"ltcl acquire update {shlex.quote(str(folder))}"
            if to is not None:
                again += f" --store {shlex.quote(str(to))}"
            if photographs is not None:
                again += f" --photographs {photographs}"
            if projector is not None:
                again += f" --projector {projector}"
            return _ask_for_photograph(by_hand, error, rig.missing(), again)
    report = UpdateReport(
        folder=folder,
        store=target,
        scan=project.store,
        grid=result.transport.grid,
        channels=_channels(result),
        photographs=result.photographs,
        shift=result.shift,
        largest=result.movement.largest,
        gain=result.gain.tolist(),
        masked=result.masked,
        measured_again=result.measured_again,
        error=result.error,
        bound=result.bound,
        previous_error=result.previous_error,
        holds=result.holds,
        failing=float(result.failing.mean()),
        judgement=result.judgement,
    )
    lines = [str(result), f"transport in {target}"]
    if project.name and result.holds:
        lines.append(_combine_again(folder, project, target))
    return Answer(report, lines)


def _combine_again(folder: Path, updated: Any, target: Path) -> str:
    """The command that makes one transport of a projector that was updated and the others."""
    from ltcl import acquisition

    stores = []
    for project in acquisition.Project.open_all(folder):
        store = target if project.name == updated.name else project.store
        stores.append(shlex.quote(str(store)))
    out = shlex.quote(str(folder / "combined.npz"))
    return f"next: ltcl combine {' '.join(stores)} --out {out}"


def _channels(result: Any) -> Channels:
    return result.transport.channels


app.command("aim")(aim)
app.command("fit")(fit)
app.command("import")(import_photographs)


@app.command("report")
@command()
def report(
    context: Context, folder: options.Acquisition, device: options.DeviceName = None
) -> Answer:
    """Show coverage, saturation, noise and reciprocity of a finished acquisition.

    A virtual rig also gets the relative error of T p, for patterns p that were not scanned, after
    one scale for each channel, as the unit of light of a camera is its own.
    """
    return _report(context, folder, device)


def _report(context: Context, folder: Path, device: str | None) -> Answer:
    from ltcl.acquisition import Project

    projects = Project.open_all(folder)
    opened = open_device(device)
    lines = []
    by_name = {}
    for project in projects:
        report, own_lines = _scan_report(context, project, opened)
        by_name[project.name] = report
        lines += [*_heading(project), *own_lines]
    if len(projects) == 1:
        return Answer(by_name[""], lines)
    lines.append("what they are good for together: 'ltcl combine', then 'ltcl analyze'")
    return Answer(ScansReport(folder=folder, projectors=by_name), lines)


def _scan_report(context: Context, project: Any, device: Any) -> tuple[ScanReport, list[str]]:
    """The report of one scan, and its lines."""
    from ltcl.acquisition import Report, Setup

    if not project.store.exists():
        advice = "'ltcl acquire run' makes it"
        raise FileError(f"{project.store}: no such folder yet; {advice}")
    context.progress("entries and noise")
    facts = Report.of(project.store)
    T = store.load(project.store, on_dark="mask", device=device)
    judgement = verdict(
        T,
        sum_deviation=facts.sum_deviation,
        saturation=facts.saturated,
        left_out=facts.left_out,
    )
    scan = ScanReport(
        folder=project.folder,
        store=project.store,
        **json.loads(facts.to_json()),
        verdict=VerdictReport.from_verdict(judgement),
    )
    lines = [str(facts)]
    if project.kind == "virtual":
        context.progress("relative error of T p")
        with project.rig(aligned=True) as rig:
            scan.error = list(Setup.of(project.store).relative_error(rig, T))
        errors = ", ".join(f"{error:.2%}" for error in scan.error)
        lines.append(f"relative error of T p, for p that were not scanned: {errors}")
    lines.append(f"transport in {project.store}")
    if not project.name:
        # One of several projectors lights a part of the scene.
        lines += verdict_lines({str(project.store): judgement})
    return scan, lines
