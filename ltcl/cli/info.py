# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl info`: contents of transport files, without a device."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.cli import file_facts, options, panels
from ltcl.cli.command import Answer, Context, command
from ltcl.cli.failure import FAILED, fail
from ltcl.cli.reports.parts import VerdictReport
from ltcl.cli.reports.transports import BadFile, FileFacts, GoodFile
from ltcl.cli.tables import interval_text, size_text, table, verdict_lines
from ltcl.errors import LtclError
from ltcl.store import BlockStore, formats
from ltcl.store.guards import about
from ltcl.transport.verdict import Verdict

COLUMNS = (
    "file",
    "shape",
    "channels",
    "grid",
    "camera grid",
    "stored",
    "entries",
    "memory",
    "first bounce",
    "dark pixels",
)


@command()
def info(
    context: Context,
    files: options.TransportFiles,
    variable: options.Variable = None,
    show_dark: options.ShowDark = None,
) -> Answer:
    """Show size, channels, grid, entries and first bounce of transport files and inverses.

    Needs no device. All bytes of a .zarr are compared with their checksums. Good files are shown
    also if others are bad; the exit code is then 1. Transports of more than 256 MiB are judged by
    'ltcl analyze' only.
    """
    entries: list[GoodFile | BadFile] = []
    rows = []
    first_bounces = {}
    verdicts = {}
    for file in context.progress.each(files):
        context.progress("reading")
        try:
            facts, F, verdict = _read_facts(file, variable)
        except LtclError as error:
            failure = fail(error)
            entries.append(BadFile(file=file, **failure.document()))
            continue
        if F is not None:
            _, pixels = facts.shape
            grid = (1, pixels) if facts.grid is None else facts.grid
            first_bounces[file.name] = (F, grid)
        verdicts[str(file)] = verdict
        entries.append(GoodFile(**vars(facts), verdict=VerdictReport.from_verdict(verdict)))
        rows.append(_table_row(facts))
    panels.write_first_bounces(show_dark, first_bounces)
    lines = verdict_lines(verdicts)
    if rows:
        lines.insert(0, table(COLUMNS, rows))
    code = FAILED if len(rows) < len(files) else 0
    return Answer(entries, lines, code)


def _read_facts(file: Path, variable: str | None) -> tuple[FileFacts, np.ndarray | None, Verdict]:
    record = formats.read(file, variable=variable)
    with about(file):
        if file.is_dir():
            BlockStore.open(file).verify()
        facts, F = file_facts.describe(file, record)
    return facts, F, file_facts.judge(record, facts)


def _table_row(facts: FileFacts) -> list[Any]:
    first_bounce = None
    if facts.first_bounce is not None:
        first_bounce = interval_text(*facts.first_bounce)
    camera_grid = size_text(facts.camera_grid)
    rows, columns = facts.shape
    if rows == columns and facts.camera_grid in (None, facts.grid):
        camera_grid = "the same"
    return [
        facts.file,
        size_text(facts.shape),
        facts.channels,
        size_text(facts.grid),
        camera_grid,
        f"{facts.stored} {facts.dtype}",
        facts.entries,
        checks.size(facts.nbytes),
        first_bounce,
        facts.dark_pixels,
    ]
