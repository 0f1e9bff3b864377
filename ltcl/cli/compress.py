# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl compress`: a transport in few numbers, at a known cost to its solutions."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from ltcl import checks, report
from ltcl.cli import console, options, transports
from ltcl.cli.command import Answer, Context
from ltcl.errors import InputError
from ltcl.store import formats

_COLOURS = {1: ("grey",), 3: ("red", "green", "blue")}
_UNITS = {"": 1, "k": 1000, "m": 1000**2, "g": 1000**3, "ki": 1024, "mi": 1024**2, "gi": 1024**3}


def _bytes(text: str) -> int:
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*([kmg]?i?)b?\s*", text, re.IGNORECASE)
    count = int(float(match[1]) * _UNITS.get(match[2].lower(), 0)) if match else 0
    if count < 1:
        raise typer.BadParameter(f"{text!r} is no size; write bytes, or for instance 50MB or 1.5GiB")
    return count


_Out = Annotated[Path, options.out("The compressed transport: .npz or .zarr.")]
_Budget = Annotated[
    int | None,
    options.option("Bytes that the numbers of R may take, such as 50MB.", parser=_bytes, metavar="SIZE"),
]


def compress(
    context: Context,
    file: options.Matrix,
    out: _Out,
    rtol: options.SolutionRtol = 1e-2,
    budget: _Budget = None,
    basis: options.Basis = None,
    grid: options.Grid = None,
    variable: options.Variable = None,
    first_bounce: options.FirstBounce = None,
    on_dark: options.OnDark = "auto",
    device: options.Device = None,
) -> Answer:
    """Write R in a basis where it is sparse; basis, threshold and precision are chosen by measurement."""
    from ltcl import store
    from ltcl.compression import compress

    formats.find(out)  # refused before a long computation
    if out.suffix.lower() not in (".npz", ".zarr"):
        raise InputError(f"--out is {out}; a compressed transport must be a .npz or a .zarr")
    transports.refuse_same(out, file)
    T = transports.load(context, file)
    if T.is_compressed and T.error:
        error = f"with an error of {T.error:.2g}"
        raise InputError(f"{file}: is compressed already, {error}; compress what it came from")
    C = compress(T, rtol, budget, basis=basis or None, progress=context.progress.share)
    store.save(out, C)
    transports.note_lost(file, out)
    data = transports.heading(context, file, T)
    data |= {"out": out, "bytes": C.compression.uncompressed, "bytes_compressed": C.nbytes}
    data |= {
        "bytes_on_disk": transports.on_disk(out),
        "solution_error": C.error,
        "compression": C.compression,
    }
    return Answer(data, partial(_show, report.plain(data)))


def _show(data: dict[str, Any]) -> None:
    """The bases that were tried, and what was chosen, by channel."""
    found = data["compression"]
    channels = list(zip(_COLOURS[len(found["channels"])], found["channels"], strict=True))
    typer.echo(f"Tried on {'x'.join(map(str, found['window']))} pixels, errors in the 2-norm of R")
    columns = ("channel", "basis", "core", "numbers a row", "bytes", "error")
    rows = [
        (colour, *_cells(trial), trial["left"] or ("chosen" if trial["basis"] == channel["basis"] else None))
        for colour, channel in channels
        for trial in channel["trials"]
    ]
    console.table((*columns, "chosen, or why not"), rows)
    sizes = [checks.size(data[name]) for name in ("bytes", "bytes_compressed", "bytes_on_disk")]
    within = checks.upwards(data["solution_error"])
    text = "{} to {} with the first bounce, solutions within {}, {} on disk".format(
        *sizes[:2], within, sizes[2]
    )
    typer.echo(f"\n{data['out']}: {text}, in {found['seconds']:.3g} s")


def _cells(facts: dict[str, Any]) -> tuple:
    width = f" 1 x {facts['width']}" if facts["format"] == "tiles" else ""
    core = f"{facts['format']}{width} {facts['precision']}"
    return facts["basis"], core, f"{facts['kept']:.1f}", checks.size(facts["nbytes"]), facts["error"]
