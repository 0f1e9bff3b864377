# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl acquire report`: what came of an acquisition; of a simulated one, how far it is from the truth."""

from __future__ import annotations

import json as jsonlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ltcl import report, store
from ltcl.cli import console, options, pictures, results
from ltcl.device import open_device
from ltcl.errors import FileError

if TYPE_CHECKING:
    from ltcl.acquisition import Project

_Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        "-o",
        parser=options.folder,
        metavar="FOLDER",
        help="Also pictures there: coverage, white, ambient light, first bounce.",
        show_default=False,
    ),
]


def run(
    folder: options.Acquisition, out: _Out = None, device: options.Device = None, json: options.Json = False
) -> None:
    """Tell what came of it: coverage, saturation, noise, reciprocity.

    Of a virtual rig also how far T p is from the truth, for patterns p that were not scanned, after one scale
    for each channel: the unit of light of a camera is its own.
    """
    from ltcl.acquisition import Project

    project = Project.open(folder)
    if project.state == "new":
        raise FileError(f"{project.store}: is not begun; {project.next} photographs it")
    tell(project, open_device(device), json, out)


def tell(project: Project, device: Any, json: bool, out: Path | None = None) -> None:
    """Print the report of what is finished, with pictures into `out` where that is given."""
    from ltcl.acquisition import Report

    with console.Steps(2) as steps:
        steps.item("entries and noise")
        found = Report.of(project.store)
        steps.item("how far it is from the truth")
        off = _off(project, device) if project.kind == "virtual" else None
    told = {"folder": project.folder, "store": project.store, **jsonlib.loads(found.to_json())}
    if off is not None:
        told["off"] = off
    if out is not None:
        _draw(project, out, {"command": "acquire_report", "versions": report.versions(), **told})
    if json:
        console.answer(told)
        return
    typer.echo(str(found))
    if off is not None:
        parts = ", ".join(f"{part:.2%}" for part in off)
        typer.echo(f"T p is off by {parts} from the truth, for patterns p that were not scanned")
    typer.echo(f"transport in {project.store}" + ("" if out is None else f", pictures in {out}"))


def _off(project: Project, device: Any) -> tuple[float, ...]:
    """Relative error of T p in each channel, after one scale."""
    from ltcl.acquisition import Setup, held

    T = store.load(project.store, on_dark="mask", device=device)
    with project.aligned().rig() as rig:
        return held.off(rig, T, Setup.of(project.store))


def _draw(project: Project, out: Path, text: dict[str, Any]) -> None:
    import numpy as np

    from ltcl.acquisition import Setup
    from ltcl.store import BlockStore

    setup = Setup.of(project.store)
    F = np.asarray(BlockStore.open(project.store).extra("first_bounce"))
    bounce = F[0].reshape(setup.grid) if len(F) == 1 else np.moveaxis(F, 0, -1).reshape(*setup.grid, 3)
    found = {"coverage": setup.calibration.resampling.coverage, "white": setup.white}
    found |= {"ambient": setup.ambient, "first_bounce": bounce}
    with results.fill(out, text) as folder:
        text["pictures"] = {
            name: pictures.write(folder, name, picture, pictures.brightness(picture))
            for name, picture in found.items()
        }
