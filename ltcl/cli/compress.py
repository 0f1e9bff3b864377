# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl compress`: a transport in few numbers, at a known cost to its solutions."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import typer

from ltcl import checks, report
from ltcl.cli import console, options, transports
from ltcl.errors import InputError
from ltcl.store import formats

_COLOURS = {1: ("grey",), 3: ("red", "green", "blue")}
_UNITS = {"": 1, "k": 1000, "m": 1000**2, "g": 1000**3, "ki": 1024, "mi": 1024**2, "gi": 1024**3}


def _bytes(text: str) -> int:
    found = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*([kmg]?i?)b?\s*", text, re.IGNORECASE)
    count = int(float(found[1]) * _UNITS.get(found[2].lower(), 0)) if found else 0
    if count < 1:
        raise typer.BadParameter(f"{text!r} is no size; write bytes, or for instance 50MB or 1.5GiB")
    return count


_Out = Annotated[
    Path,
    typer.Option(
        "--out", "-o", metavar="FILE", help="The compressed transport: .npz or .zarr.", show_default=False
    ),
]
_Budget = Annotated[
    int | None,
    typer.Option(
        parser=_bytes,
        metavar="SIZE",
        help="Bytes that the numbers of R may take, such as 50MB.",
        show_default=False,
    ),
]
_Basis = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME",
        help="pixels, a wavelet (haar, db2, db4, ...), or its rows alone ('db2 rows'); may be given more "
        "than once. Default: the best of db2, haar, db4 and pixels.",
        show_default=False,
    ),
]


def run(
    file: options.Matrix,
    out: _Out,
    rtol: options.SolutionRtol = 1e-2,
    budget: _Budget = None,
    basis: _Basis = None,
    grid: options.Grid = None,
    first_bounce: options.FirstBounce = None,
    on_dark: options.OnDark = "auto",
    device: options.Device = None,
    json: options.Json = False,
) -> None:
    """Write R in a basis where it is sparse; basis, threshold and precision are chosen by measurement."""
    from ltcl import store
    from ltcl.compression import compress

    formats.find(out)  # refused before a long computation
    if out.suffix.lower() not in (".npz", ".zarr"):
        raise InputError(f"--out is {out}; a compressed transport must be a .npz or a .zarr")
    transports.refuse_same(out, file)
    T = transports.load(file, device, grid=grid, first_bounce=first_bounce, on_dark=on_dark)
    if T.is_compressed and T.error:
        error = f"with an error of {T.error:.2g}"
        raise InputError(f"{file}: is compressed already, {error}; compress what it came from")
    with console.Steps(1) as steps:
        steps.item(str(file))
        C = compress(T, rtol, budget, basis=basis or None, progress=steps.at)
    store.save(out, C)
    text = {
        **transports.heading("compress", file, T, rtol=rtol, budget=budget, basis=basis),
        "out": out,
        "bytes": C.compression.uncompressed,
        "bytes_compressed": C.nbytes,
        "bytes_on_disk": transports.on_disk(out),
        "solution_error": C.error,
        "compression": C.compression,
    }
    transports.note_lost(file, out)
    if json:
        console.answer(text)
    else:
        _show(report.plain(text))


def _show(text: dict[str, Any]) -> None:
    made = text["compression"]
    colours = _COLOURS[len(made["channels"])]
    pairs = list(zip(colours, made["channels"], strict=True))
    window = "x".join(map(str, made["window"]))
    typer.echo(f"Tried on {window} pixels, errors in the 2-norm of R")
    console.table(
        ("channel", "basis", "core", "kept a row", "bytes", "error", "launches", "taken, or left because"),
        [
            (colour, *_trial(trial, channel["basis"]))
            for colour, channel in pairs
            for trial in channel["trials"]
        ],
    )
    typer.echo("  the basis that needs the fewest bytes is taken")
    typer.echo("\nTaken, on all pixels")
    console.table(
        (
            "channel",
            "basis",
            "core",
            "kept a row",
            "bytes",
            "dropped",
            "rounded",
            "error",
            "norm of S^-1",
            "solution",
        ),
        [(colour, *_taken(channel)) for colour, channel in pairs],
    )
    typer.echo(
        "  dropped: Frobenius norm of the numbers left out; rounded: that of the rounding of the others"
    )
    typer.echo("  error: 2-norm of both together, at most; solution: error times norm of S^-1, relative to x")
    within = checks.upwards(text["solution_error"])
    before, after = (checks.size(text[name]) for name in ("bytes", "bytes_compressed"))
    more = ", which is more" if text["bytes_compressed"] >= text["bytes"] else ""
    typer.echo(
        f"\n{text['out']}: {before} to {after}{more} with the first bounce, solutions within {within}, "
        f"{checks.size(text['bytes_on_disk'])} on disk, in {made['seconds']:.3g} s"
    )


def _trial(trial: dict[str, Any], taken: str) -> tuple:
    return (
        trial["basis"],
        _core(trial),
        f"{trial['kept']:.1f}",
        checks.size(trial["nbytes"]),
        trial["error"],
        trial["launches"],
        trial["left"] or ("taken" if trial["basis"] == taken else None),
    )


def _taken(channel: dict[str, Any]) -> tuple:
    return (
        channel["basis"],
        _core(channel),
        f"{channel['kept']:.1f}",
        checks.size(channel["nbytes"]),
        channel["dropped"],
        channel["quantisation"],
        channel["error"],
        channel["inverse_norm"],
        channel["solution_error"],
    )


def _core(stored: dict[str, Any]) -> str:
    width = f" 1 x {stored['width']}" if stored["format"] == "tiles" else ""
    return f"{stored['format']}{width} {stored['precision']}"
