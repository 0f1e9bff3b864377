# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl analyze`: how strong the interreflection is, and what each method will cost."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ltcl.analysis import ChannelAnalysis
from ltcl.cli import options, pictures, transports
from ltcl.cli.command import Answer, Context, command, percent, table

COLOURS = {1: ("grey",), 3: ("red", "green", "blue")}


def _plot(path: Path | None) -> Path | None:
    if path is not None and path.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise typer.BadParameter(f"{path} must be a .png, .svg or .pdf")
    return options.writable_file(path)


_PLOT = "Draw bounds on rho(R) and the forecast: .png, .svg or .pdf."


@command(options.file_options, options.transport_options)
def analyze(
    context: Context,
    files: options.Matrices,
    rtol: Annotated[float, options.option("Relative residual at which a solve ends.")] = 1e-2,
    show_dark: options.ShowDark = None,
    plot: Annotated[Path | None, options.file(_PLOT, callback=_plot)] = None,
) -> Answer:
    """Spectrum of R, products each method needs to the tolerance, and whether T is physically possible."""
    from ltcl.analysis import analyze

    analyses, entries, spectra, forecasts, lights, verdicts = {}, [], [], [], {}, {}
    for file in context.progress.each(files):
        T = transports.load(context, file)
        lights[file.name] = T.first_bounce, T.grid
        context.progress("analyzing")
        analyses[file.name] = analysis = analyze(T, rtol=rtol)
        verdicts[str(file)] = analysis.verdict
        entries.append({"file": str(file), "device": T.device.name, **analysis.to_dict()})
        for colour, channel in zip(COLOURS[T.channels], analysis.channels, strict=True):
            label = {"file": str(file), "channel": colour}
            spectra.append(label | _spectrum(channel))
            forecasts.append(label | channel.products)
    if plot is not None:
        from ltcl import plots

        plots.save(plots.analysis(analyses), plot)
    if show_dark is not None:
        pictures.write_first_bounces(show_dark, lights)
    lines = [
        "Spectrum of R, bounds on that of S, and checks of the measurement",
        table([*spectra[0]], [row.values() for row in spectra]),
        "  negative light: in one bounce between parts of the picture; should be 0",
        "  light passed on: share of each pixel's light, by one bounce; must be at least 0 and below 1",
        f"\nProducts with S to a relative residual of {rtol:g}, two more by sweeps; -: no forecast",
        table([*forecasts[0]], [row.values() for row in forecasts]),
        *transports.verdicts(verdicts),
    ]
    return Answer(entries, lines)


def _spectrum(channel: ChannelAnalysis) -> dict[str, Any]:
    energy, first = channel.energy, channel.first_bounce
    return {
        "rho(R)": channel.spectral_radius,
        "certificate": channel.spectral_radius_certificate,
        "rho(R) within": _interval(*channel.spectral_radius_bounds),
        "albedo": channel.albedo,
        "S within": _interval(*channel.bounds),
        "first bounce": _interval(first[0], first[-1]),
        "reciprocity defect": channel.reciprocity_defect,
        "negative light": percent(channel.negative_bounce),
        "light passed on": _interval(energy.bounce_lowest, energy.bounce_highest),
    }


def _interval(lower: float, upper: float) -> str:
    return f"{lower:.4g} .. {upper:.4g}"
