# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl convert`: a transport file from any known format to any other; needs no device."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import typer

from ltcl import checks
from ltcl.cli import console, info, options, transports
from ltcl.cli.command import Answer, Context
from ltcl.errors import InputError
from ltcl.store import Record, formats

_In = Annotated[Path, options.argument("IN", options.FORMATS)]
_Out = Annotated[
    Path,
    options.argument("OUT", "The new file; its extension names the format.", callback=options.writable_file),
]


def convert(
    context: Context,
    source: _In,
    target: _Out,
    grid: options.Grid = None,
    camera_grid: options.CameraGrid = None,
    variable: options.Variable = None,
) -> Answer:
    """Write a transport in another format; OUT is replaced whole or not at all. Needs no device."""
    formats.find(target)  # refused before a long read
    context.progress(f"reading {source}")
    record = formats.read(source, variable=variable)
    with formats.about(source):
        grids = {"grid": (grid, record.shape[1]), "camera_grid": (camera_grid, record.shape[0])}
        asked = {name: checks.grid(name, size, pixels) for name, (size, pixels) in grids.items() if size}
        if isinstance(record, Record):
            record = dataclasses.replace(record, **asked)
        elif any(size != record.grid for size in asked.values()):  # which is part of what it is
            raise InputError(f"grid is {grid or camera_grid}; this transport is compressed on {record.grid}")
        facts = info.describe(target, record)  # refuses what could not be loaded again
    context.progress(f"writing {target}")
    formats.write(target, record)
    transports.note_lost(source, target)
    keeps_grid = target.suffix.lower() != ".npy" and record.grid is not None
    if not keeps_grid:
        text = "x".join(map(str, record.grid or "HW"))
        console.note(f"{target}: does not contain the grid; give --grid {text} wherever you use it")
    elif record.shape[0] != record.shape[1] and record.camera_grid is None:
        console.note(f"{target}: does not contain the camera's grid; give --camera-grid HxW, or to relight")
    text = f"{target}: {facts['stored']}, {checks.size(transports.on_disk(target))} on disk"
    return Answer({"source": source, **facts}, lambda: typer.echo(text))
