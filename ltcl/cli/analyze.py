# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl analyze`: how strong the interreflection is, and what each method will cost."""

from __future__ import annotations

from typing import Any

import typer

from ltcl.cli import console, options, transports

_COLOURS = {1: ("grey",), 3: ("red", "green", "blue")}


def run(
    files: options.Matrices,
    rtol: options.Rtol = 1e-2,
    grid: options.Grid = None,
    first_bounce: options.FirstBounce = None,
    on_dark: options.OnDark = "raise",
    device: options.Device = None,
    json: options.Json = False,
) -> None:
    """Norms and spectral radius of R, and the products each method needs to reach the tolerance."""
    from ltcl.analysis import analyze

    found = []
    with console.Steps(len(files)) as steps:
        for file in files:
            steps.item(str(file))
            T = transports.load(file, device, grid=grid, first_bounce=first_bounce, on_dark=on_dark)
            found.append({"file": str(file), "device": T.device.name, **analyze(T, rtol=rtol).to_dict()})
    if json:
        console.answer(found)
        return
    methods = tuple(found[0]["channels"][0]["products"])
    columns = ("file", "channel", "rho(R)", "albedo", "norm 1", "norm inf", "first bounce", *methods)
    console.table(columns, [row for entry in found for row in _rows(entry, methods)])
    typer.echo(f"\n{', '.join(methods)}: products with S to a relative residual of {rtol:g}")


def _rows(entry: dict[str, Any], methods: tuple[str, ...]) -> list[tuple]:
    return [
        (
            entry["file"],
            colour,
            channel["spectral_radius"],
            channel["albedo"],
            channel["norm_one"],
            channel["norm_inf"],
            "{:.4g} .. {:.4g}".format(channel["first_bounce"][0], channel["first_bounce"][-1]),
            *(
                "diverges" if channel["products"][name] is None else channel["products"][name]
                for name in methods
            ),
        )
        for colour, channel in zip(_COLOURS[len(entry["channels"])], entry["channels"], strict=True)
    ]
