# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl convert`: a transport in another file format, without a device."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

from ltcl import checks
from ltcl.cli import file_facts, loading, options
from ltcl.cli.command import Answer, Context, command, note
from ltcl.cli.options import argument, check_writable_file
from ltcl.cli.reports.transports import ConvertReport
from ltcl.errors import InputError
from ltcl.store import CombinedRecord, CompressedRecord, StoreRecord, formats
from ltcl.store.guards import about


@command(options.file_options)
def convert(
    context: Context,
    source: Annotated[Path, argument("IN", options.FORMATS)],
    target: Annotated[Path, argument("OUT", "The new file.", callback=check_writable_file)],
) -> Answer:
    """Write a transport in another format; OUT is replaced whole or not at all. Needs no device."""
    # An unknown format is refused before a long read.
    formats.find(target)
    context.progress(f"reading {source}")
    record = formats.read(source, variable=context.options["variable"])
    with about(source):
        record = _set_grids(context, record)
        # It refuses what could not be loaded again.
        facts, _ = file_facts.describe(target, record)
    context.progress(f"writing {target}")
    formats.write(target, record)
    loading.note_lost_setup(source, target)
    _note_lost_grids(target, record)
    size = checks.size(loading.bytes_on_disk(target))
    report = ConvertReport(source=source, **vars(facts))
    return Answer(report, [f"{target}: {facts.stored}, {size} on disk"])


def _set_grids(
    context: Context, record: StoreRecord | CompressedRecord | CombinedRecord
) -> StoreRecord | CompressedRecord | CombinedRecord:
    """Set the grids of the options; a compressed transport cannot have another one."""
    sizes = {}
    for name in ("grid", "camera_grid"):
        if context.options[name] is not None:
            sizes[name] = context.options[name]
    if isinstance(record, StoreRecord):
        return dataclasses.replace(record, **sizes)
    if any(size != record.grid for size in sizes.values()):
        size = next(iter(sizes.values()))
        grid = "{} x {}".format(*record.grid)
        raise InputError(f"grid is {size}; this transport is compressed on {grid}")
    return record


def _note_lost_grids(target: Path, record: StoreRecord | CompressedRecord | CombinedRecord) -> None:
    rows, columns = record.shape
    if target.suffix.lower() == ".npy" or record.grid is None:
        grid = "HxW"
        if record.grid is not None:
            grid = "{}x{}".format(*record.grid)
        advice = f"give --grid {grid} wherever you use it"
        note(f"{target}: does not contain the grid; {advice}")
    elif rows != columns and record.camera_grid is None:
        advice = "give --camera-grid HxW, or to relight"
        note(f"{target}: does not contain the camera's grid; {advice}")
