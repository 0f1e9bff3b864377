# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl analyze`: how strong the interreflection is, and what each method will cost."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from ltcl.cli import console, options, transports
from ltcl.cli.command import Answer, Context

_COLOURS = {1: ("grey",), 3: ("red", "green", "blue")}


def _plot(path: Path | None) -> Path | None:
    if path is not None and path.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise typer.BadParameter(f"{path} must be a .png, .svg or .pdf")
    return options.writable_file(path)


_Plot = Annotated[
    Path | None, options.file("Draw bounds on rho(R) and the forecast: .png, .svg or .pdf.", callback=_plot)
]


def analyze(
    context: Context,
    files: options.Matrices,
    rtol: options.Rtol = 1e-2,
    plot: _Plot = None,
    grid: options.Grid = None,
    variable: options.Variable = None,
    first_bounce: options.FirstBounce = None,
    on_dark: options.OnDark = "auto",
    device: options.Device = None,
) -> Answer:
    """Spectrum of R, products each method needs to the tolerance, and whether T is physically possible."""
    from ltcl.analysis import analyze

    analyses, entries = {}, []
    for file in context.progress.each(files):
        T = transports.load(context, file)
        context.progress("analyzing")
        analyses[file.name] = analyze(T, rtol=rtol)
        entries.append({"file": str(file), "device": T.device.name, **analyses[file.name].to_dict()})
    if plot is not None:
        from ltcl import plots

        plots.save(plots.analysis(analyses), plot)
    return Answer(entries, partial(_show, entries, rtol))


def _show(entries: list[dict[str, Any]], rtol: float) -> None:
    """Two tables; each row is a colour channel of a file."""
    channels = [
        ((entry["file"], colour), channel)
        for entry in entries
        for colour, channel in zip(_COLOURS[len(entry["channels"])], entry["channels"], strict=True)
    ]
    names, first = ("file", "channel"), channels[0][1]
    typer.echo("Spectrum of R, bounds on that of S, and checks of the measurement")
    columns = ("rho(R)", "certificate", "rho(R) within", "albedo", "S within", "first bounce")
    checks = ("reciprocity defect", "negative light", "light passed on")
    console.table((*names, *columns, *checks), [(*name, *_spectrum(channel)) for name, channel in channels])
    typer.echo("  negative light: in one bounce between parts of the picture; should be 0")
    typer.echo(
        "  light passed on: share of each pixel's light, by one bounce; must be at least 0 and below 1"
    )
    typer.echo(f"\nProducts with S to a relative residual of {rtol:g}, two more by sweeps; -: no forecast")
    console.table((*names, *first["products"]), [(*name, *_products(channel)) for name, channel in channels])


def _spectrum(channel: dict[str, Any]) -> tuple:
    energy, first = channel["energy"], channel["first_bounce"]
    return (
        channel["spectral_radius"],
        channel["spectral_radius_certificate"],
        _interval(*channel["spectral_radius_bounds"]),
        channel["albedo"],
        _interval(*channel["bounds"]),
        _interval(first[0], first[-1]),
        channel["reciprocity_defect"],
        console.percent(channel["negative_bounce"]),
        _interval(energy["bounce_lowest"], energy["bounce_highest"]),
    )


def _products(channel: dict[str, Any]) -> list[Any]:
    """JSON has None for both: what has a certificate but no number diverges."""
    pairs = ((products, channel["certificates"][name]) for name, products in channel["products"].items())
    return [
        None
        if number is None and certificate.startswith("none")
        else "diverges"
        if number is None
        else number
        for number, certificate in pairs
    ]


def _interval(lower: float | None, upper: float | None) -> str:
    return " .. ".join("-" if value is None else f"{value:.4g}" for value in (lower, upper))
