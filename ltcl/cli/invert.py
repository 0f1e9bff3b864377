# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl invert`: S^-1 = I - A of a transport, once; other commands take it with ``--inverse``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ltcl import checks
from ltcl.cli import options, transports
from ltcl.cli.command import Answer, Context


def invert(
    context: Context,
    file: options.Matrix,
    out: Annotated[Path, options.out("The inverse: .npz.")],
    rtol: options.SolutionRtol = 1e-2,
    basis: options.Basis = None,
    grid: options.Grid = None,
    variable: options.Variable = None,
    first_bounce: options.FirstBounce = None,
    on_dark: options.OnDark = "auto",
    device: options.Device = None,
) -> Answer:
    """Find A = I - S^-1, one physical bounce, so that each further picture costs one product."""
    from ltcl.compression import INVERSE_NAMES, invert
    from ltcl.store import inverses

    inverses.check_name(out)  # refused before a long computation
    transports.refuse_same(out, file)
    T = transports.load(context, file)
    inverse = invert(T, rtol, basis=basis or INVERSE_NAMES, progress=context.progress.share)
    inverses.save_inverse(out, inverse)
    data = transports.heading(context, file, T)
    data |= {"out": out, "bytes": inverse.nbytes, "bytes_on_disk": out.stat().st_size}
    data |= {"errors": inverse.errors, "confidence": inverse.confidence}
    error, sizes = (
        checks.upwards(inverse.error),
        (checks.size(data[key]) for key in ("bytes", "bytes_on_disk")),
    )
    text = "{}: solutions within {}, {}, {} on disk".format(out, error, *sizes)
    return Answer(data, lambda: typer.echo(text))
