# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl invert`: S^-1 = I - A of a transport, once; other commands take it with ``--inverse``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ltcl import checks
from ltcl.cli import console, options, transports

_Out = Annotated[
    Path,
    typer.Option("--out", "-o", metavar="FILE", help="The inverse: .npz.", show_default=False),
]
_Basis = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME",
        help="pixels, or a wavelet (haar, db2, db4, ...); may be given more than once. Default: the best of "
        "db2, haar, db4 and pixels.",
        show_default=False,
    ),
]


def run(
    file: options.Matrix,
    out: _Out,
    rtol: options.SolutionRtol = 1e-2,
    basis: _Basis = None,
    grid: options.Grid = None,
    first_bounce: options.FirstBounce = None,
    on_dark: options.OnDark = "auto",
    device: options.Device = None,
    json: options.Json = False,
) -> None:
    """Find A = I - S^-1, one physical bounce, so that each further picture costs one product."""
    from ltcl.compression import INVERSE_NAMES, invert
    from ltcl.store import inverses

    inverses.check_name(out)  # refused before a long computation
    transports.refuse_same(out, file)
    T = transports.load(file, device, grid=grid, first_bounce=first_bounce, on_dark=on_dark)
    with console.Steps(1) as steps:
        steps.item(str(file))
        inverse = invert(T, rtol, basis=basis or INVERSE_NAMES, progress=steps.at)
    inverses.save_inverse(out, inverse)
    text = {
        **transports.heading("invert", file, T, rtol=rtol, basis=basis),
        "out": out,
        "bytes": inverse.nbytes,
        "bytes_on_disk": out.stat().st_size,
        "errors": inverse.errors,
        "confidence": inverse.confidence,
    }
    if json:
        console.answer(text)
    else:
        size, disk = checks.size(inverse.nbytes), checks.size(out.stat().st_size)
        typer.echo(f"{out}: solutions within {checks.upwards(inverse.error)}, {size}, {disk} on disk")
