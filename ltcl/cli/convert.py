# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl convert`: a transport file from any known format to any other; needs no device."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import typer

from ltcl import checks
from ltcl.cli import console, info, options, transports
from ltcl.errors import InputError
from ltcl.store import Parts, Record, formats

_IN = Annotated[Path, typer.Argument(metavar="IN", help=options.FORMATS)]
_OUT = Annotated[Path, typer.Argument(metavar="OUT", help="The new file; its extension names the format.")]


def run(
    source: _IN,
    target: _OUT,
    grid: options.Grid = None,
    camera_grid: options.CameraGrid = None,
    json: options.Json = False,
) -> None:
    """Write a transport in another format; OUT is replaced whole or not at all. Needs no device."""
    formats.find(target)  # refused before a long read
    record = formats.read(source)
    with formats.about(source):
        rows, columns = record.shape
        record = _with_grids(record, grid, camera_grid)
        facts = info.describe(target, record)  # refuses what could not be loaded again
    formats.write(target, record)
    transports.note_lost(source, target)
    if record.grid is None:
        console.note(f"{target}: does not tell the grid; give --grid HxW here, or wherever you use it")
    elif rows != columns and record.camera_grid is None:
        console.note(f"{target}: does not tell the camera's grid; give --camera-grid HxW here, or to relight")
    if record.grid is not None and target.suffix.lower() == ".npy":
        grid_text = "x".join(map(str, record.grid))
        console.note(f"{target}: .npy does not keep the grid; give --grid {grid_text} wherever you use it")
    if json:
        console.answer({"source": source, **facts})
    else:
        typer.echo(f"{target}: {facts['stored']}, {checks.size(transports.on_disk(target))} on disk")


def _with_grids(record: Record | Parts, grid: Any, camera_grid: Any) -> Record | Parts:
    """The record with the grids that were given; that of a compressed one is part of what it is."""
    rows, columns = record.shape
    if isinstance(record, Parts):
        for name, given in (("grid", grid), ("camera_grid", camera_grid)):
            if given is not None and checks.grid(name, given, columns) != record.grid:
                raise InputError(f"{name} is {given}; this transport is compressed on its own, {record.grid}")
        return record
    if grid is not None:
        record = dataclasses.replace(record, grid=checks.grid("grid", grid, columns))
    if camera_grid is not None:
        record = dataclasses.replace(record, camera_grid=checks.grid("camera_grid", camera_grid, rows))
    return record
