# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl acquire plan`: what every strategy takes and gives, before the first photograph."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ltcl import checks
from ltcl.cli import console, options

if TYPE_CHECKING:
    from ltcl.acquisition import Project
    from ltcl.acquisition.scanning.plan import Plan

_SETTINGS = ("block", "order", "threshold")  # of `ltcl.acquire`, which decide how many photographs there are
_Overhead = Annotated[
    float,
    typer.Option(min=0.0, metavar="SECONDS", help="What each photograph takes beside its exposure."),
]


def run(folder: options.Acquisition, overhead: _Overhead = 0.0, json: options.Json = False) -> None:
    """Tell what each strategy takes: photographs, time, disk; and what it gives: signal over noise.

    With noise and light as they were measured once DIR/transport.zarr has its calibration, before that as
    they are guessed. No camera is opened.
    """
    from ltcl.acquisition import Project
    from ltcl.acquisition.scanning import plan

    project = Project.open(folder)
    wanted = project.check()
    known = _measured(project) if project.state != "new" else _guessed(project)
    settings = {name: getattr(wanted, name) for name in _SETTINGS}
    with project.naming("acquire"):
        plans = plan.plans(**known, **settings, overhead=overhead)
    chosen, why = plan.choose(plans)
    told = {"measured": project.state != "new", "asked_for": wanted.strategy, "auto": chosen, "why": why}
    if json:
        found = {name: dataclasses.asdict(one) for name, one in plans.items()}
        shown = {name: known[name] for name in ("exposures", "noise", "light", "channels")}
        console.answer({"folder": folder, "rig": project.kind, **told, **shown, "plans": found})
    else:
        _show(project, known, plans, told)


def _guessed(project: Project) -> dict[str, Any]:
    seen = project.outlook()
    return {field.name: getattr(seen, field.name) for field in dataclasses.fields(seen)}


def _measured(project: Project) -> dict[str, Any]:
    from ltcl.acquisition import Calibration
    from ltcl.acquisition.scanning.plan import measured

    told = Calibration.of(project.store)
    channels = 1 if told.white.value.ndim == 2 else 3
    facts = {"grid": told.resampling.grid, "channels": channels, "exposures": told.exposures}
    return {**facts, "noise": told.noise, "light": measured(told)}


def _show(project: Project, known: dict[str, Any], plans: dict[str, Plan], told: dict[str, Any]) -> None:
    from ltcl.acquisition.scanning.plan import duration

    times = ", ".join(f"{t:.3g}" for t in known["exposures"])
    how = "as measured" if told["measured"] else "guessed; the calibration will measure them"
    typer.echo(f"{project.folder}: {project.kind} rig, {known['channels']} channel(s)")
    typer.echo(f"exposures {times} s, noise and light {how}\n")
    console.table(
        (
            "strategy",
            "pixels",
            "patterns",
            "photographs",
            "time",
            "disk at most",
            "direct",
            "weak entry",
            "T p off",
            "how",
        ),
        [
            (
                name,
                f"{one.grid[0]} x {one.grid[1]}",
                one.patterns,
                one.photographs,
                duration(one.seconds),
                checks.size(one.disk),
                f"{one.snr_direct:.3g}",
                f"{one.snr_indirect:.2g}",
                f"{100 * one.error:.2g} %",
                one.why,
            )
            for name, one in plans.items()
        ],
    )
    more = 200 if known["channels"] == 3 else 100
    typer.echo(
        "\ndirect, weak entry: signal over noise; T p off: a picture, by noise; before these come about "
        f"{more} photographs of calibration, and those of the geometry"
    )
    if told["asked_for"] == "auto":
        typer.echo(f"auto takes {told['auto']}: {told['why']}")
    else:
        typer.echo(
            f"{project.path} asks for {told['asked_for']}; auto would take {told['auto']}: {told['why']}"
        )
