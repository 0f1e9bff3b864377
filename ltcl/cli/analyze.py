# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl analyze`: how strong the interreflection is, and what each method will cost."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ltcl.cli import console, options, transports

_CERTIFICATES = {
    "none": "no forecast",
    "free bounds": "from row sums, at no extra products",
    "collatz-wielandt": "from certified bounds on rho(R)",
    "power iteration": "from an estimate of rho(R)",
    "trial sweeps": "from sweeps that were tried",
    "ritz values": "from an estimate of the spectrum of S",
}
_COLOURS = {1: ("grey",), 3: ("red", "green", "blue")}
_Plot = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE", help="Draw bounds on rho(R) and the forecast: .png, .svg, .pdf.", show_default=False
    ),
]


def run(
    files: options.Matrices,
    rtol: options.Rtol = 1e-2,
    plot: _Plot = None,
    grid: options.Grid = None,
    first_bounce: options.FirstBounce = None,
    on_dark: options.OnDark = "auto",
    device: options.Device = None,
    json: options.Json = False,
) -> None:
    """Spectrum of R, products each method needs to the tolerance, and whether T is physically possible."""
    from ltcl.analysis import analyze

    analyses, found = {}, []
    with console.Steps(len(files)) as steps:
        for file in files:
            steps.item(str(file))
            T = transports.load(file, device, grid=grid, first_bounce=first_bounce, on_dark=on_dark)
            analyses[str(file)] = analyze(T, rtol=rtol)
            found.append({"file": str(file), "device": T.device.name, **analyses[str(file)].to_dict()})
    if plot is not None:
        _draw(plot, analyses)
    if json:
        console.answer(found)
    else:
        _show(found, rtol)


def _draw(path: Path, analyses: dict[str, Any]) -> None:
    from ltcl import plots

    plots.save(plots.analysis({Path(file).name: one for file, one in analyses.items()}), path)


def _show(found: list[dict[str, Any]], rtol: float) -> None:
    methods = tuple(found[0]["channels"][0]["products"])
    typer.echo("Spectrum of R, and bounds on that of S")
    columns = (
        "file",
        "channel",
        "rho(R)",
        "between",
        "certificate",
        "albedo",
        "norm 1",
        "norm inf",
        "S between",
    )
    console.table((*columns, "first bounce"), _rows(found, _spectrum))
    typer.echo(
        f"\nProducts with S to a relative residual of {rtol:g}; a sweep costs about one product, and a"
    )
    typer.echo("solve by sweeps two more; -: no forecast")
    console.table(("file", "channel", *methods), _rows(found, _forecast))
    for name in methods:
        certificates = {channel["certificates"][name] for entry in found for channel in entry["channels"]}
        typer.echo(f"  {name}: {', '.join(str(_CERTIFICATES.get(one, one)) for one in sorted(certificates))}")
    orders = tuple(f"n = {terms['n']}" for terms in found[0]["channels"][0]["series"])
    typer.echo("\nBound on the error of the series with powers 0 to n: inverse (eq. 16), forward (eq. 15)")
    console.table(("file", "channel", *orders), _rows(found, _series))
    typer.echo(
        "  powers 1 to n of R cancel bounces 2 to n and leave bounce n + 1 with the sign (-1)^n (eq. 13)"
    )
    typer.echo("\nChecks of the measurement")
    columns = (
        "reciprocity defect",
        "negative light",
        "share passed on",
        "albedo from columns",
        "entries below 0",
        "light of these",
    )
    console.table(("file", "channel", *columns), _rows(found, _checks))
    typer.echo("  negative light: in one bounce between parts of the picture; should be 0")
    typer.echo("  share passed on: of the light of each pixel by one bounce; must be at least 0 and below 1")
    typer.echo(
        "  albedo from columns: of a closed room whose R has the largest column sum; a guess of the scene's"
    )


def _rows(found: list[dict[str, Any]], cells: Any) -> list[tuple]:
    return [
        (entry["file"], colour, *cells(channel))
        for entry in found
        for colour, channel in zip(_COLOURS[len(entry["channels"])], entry["channels"], strict=True)
    ]


def _spectrum(channel: dict[str, Any]) -> tuple:
    return (
        channel["spectral_radius"],
        _between(*channel["spectral_radius_bounds"]),
        channel["spectral_radius_certificate"],
        channel["albedo"],
        channel["norm_one"],
        channel["norm_inf"],
        _between(*channel["bounds"]),
        _between(channel["first_bounce"][0], channel["first_bounce"][-1]),
    )


def _forecast(channel: dict[str, Any]) -> tuple:
    return tuple(
        _count(products, channel["certificates"][name]) for name, products in channel["products"].items()
    )


def _count(products: float | None, certificate: str) -> Any:
    """JSON has None for both: what has a certificate but no number diverges."""
    if products is None:
        return None if certificate.startswith("none") else "diverges"
    return f"{products:g} sweeps" if "sweeps" in certificate else products


def _series(channel: dict[str, Any]) -> tuple:
    return tuple(f"{_bound(terms['inverse'])}, {_bound(terms['forward'])}" for terms in channel["series"])


def _bound(value: float | None) -> str:
    """Eq. 16 has none from an albedo of 1/2 on."""
    return "no bound" if value is None else f"{value:.2g}"


def _checks(channel: dict[str, Any]) -> tuple:
    energy = channel["energy"]
    return (
        channel["reciprocity_defect"],
        _percent(channel["negative_bounce"]),
        _between(energy["bounce_lowest"], energy["bounce_highest"]),
        energy["albedo_from_columns"],
        _percent(energy["negative_entries"]),
        _percent(energy["negative_light"]),
    )


def _between(lower: float | None, upper: float | None) -> str:
    return " .. ".join("-" if value is None else f"{value:.4g}" for value in (lower, upper))


def _percent(share: float | None) -> str | None:
    return None if share is None else f"{100 * share:.3g} %"
