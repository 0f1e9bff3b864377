# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl analyze`: spectrum, cost of each method, and checks of the measurement."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ltcl import checks
from ltcl.cli import loading, options, panels
from ltcl.cli.command import Answer, Context, command
from ltcl.cli.options import check_writable_file, file_option, option
from ltcl.cli.reports.transports import AnalyzedFile
from ltcl.cli.tables import COLOURS, interval_text, percent, table, verdict_lines
from ltcl.errors import InputError
from ltcl.tasks import analysis

PLOT_FORMATS = (".png", ".svg", ".pdf")


def _check_plot(path: Path | None) -> Path | None:
    if path is not None:
        if path.suffix.lower() not in PLOT_FORMATS:
            raise typer.BadParameter(f"{path} must be a .png, .svg or .pdf")
        checks.load_extra("matplotlib", "plots", "--plot")
    return check_writable_file(path)


@command(*options.READ_OPTIONS)
def analyze(
    context: Context,
    files: options.TransportFiles,
    rtol: Annotated[float, option("Relative residual at which a solve ends.")] = 1e-2,
    show_dark: options.ShowDark = None,
    plot: Annotated[
        Path | None,
        file_option(
            "Plot of the bounds on rho(R) and of the forecast: .png, .svg or .pdf.",
            callback=_check_plot,
        ),
    ] = None,
) -> Answer:
    """Show the spectrum of R, the cost of each method, and whether T is physically possible."""
    analyses = {}
    entries = []
    spectra = []
    forecasts = []
    first_bounces = {}
    verdicts = {}
    for file in context.progress.each(files):
        T = loading.load(context, file)
        if T.is_square:
            first_bounces[file.name] = (T.first_bounce, T.grid)
        context.progress("analyzing")
        facts = analysis.analyze(T, rtol=rtol)
        analyses[file.name] = facts
        verdicts[str(file)] = facts.verdict
        entry = AnalyzedFile(file=file, device=T.device.name, **facts.to_dict())
        entries.append(entry)
        colours = COLOURS[T.channels]
        # A T without S has no channels to analyze.
        for colour, channel in zip(colours, facts.channels, strict=False):
            label = {"file": str(file), "channel": colour}
            spectra.append({**label, **_spectrum(channel)})
            forecasts.append({**label, **channel.products})
    if plot is not None:
        if not spectra:
            raise InputError("--plot is given, but no FILE has an S whose spectrum could be drawn")
        from ltcl import plots

        plots.save(plots.analysis(analyses), plot)
    panels.write_first_bounces(show_dark, first_bounces)
    lines = []
    if spectra:
        lines = [
            "Spectrum of R, bounds on that of S, and checks of the measurement",
            _table(spectra),
            "  negative light: in one bounce between parts of the picture; should be 0",
            "  light passed on: share of each pixel's light, by one bounce; "
            "must be at least 0 and below 1",
            f"\nProducts with S to a relative residual of {rtol:g}, two more by sweeps; "
            "-: no forecast",
            _table(forecasts),
        ]
    return Answer(entries, [*lines, *verdict_lines(verdicts)])


def _spectrum(channel: Any) -> dict[str, Any]:
    """Return a row of the first table, by columns."""
    energy = channel.energy
    first_bounce = channel.first_bounce
    return {
        "rho(R)": channel.spectral_radius,
        "certificate": channel.spectral_radius_certificate,
        "rho(R) within": interval_text(*channel.spectral_radius_bounds),
        "albedo": channel.albedo,
        "S within": interval_text(*channel.bounds),
        "first bounce": interval_text(first_bounce[0], first_bounce[-1]),
        "reciprocity defect": channel.reciprocity_defect,
        "negative light": percent(channel.negative_bounce),
        "light passed on": interval_text(energy.bounce_lowest, energy.bounce_highest),
    }


def _table(rows: list[dict[str, Any]]) -> str:
    return table([*rows[0]], [row.values() for row in rows])
