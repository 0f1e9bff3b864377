# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl denoise`: a measured transport with less noise."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

from ltcl.cli import options, transports
from ltcl.cli.analyze import COLOURS
from ltcl.cli.command import Answer, Context, command, table


@command(options.file_options, options.transport_options)
def denoise(
    context: Context,
    file: options.Matrix,
    out: Annotated[Path, options.out("The transport with less noise: .npz or .zarr.")],
) -> Answer:
    """Write TRANSPORT with less noise: reciprocal pairs averaged, wavelet coefficients shrunk."""
    from ltcl import store
    from ltcl.denoising import denoise

    T = transports.load_source(context, file, out)
    result = denoise(T, progress=partial(context.progress, total=1.0))
    store.save(out, result)
    transports.note_lost(file, out)
    noise = {"before": T.noise.floor.tolist(), "after": result.noise.floor.tolist()}
    data = transports.heading(context, file, T) | {"out": out, "noise": {"source": T.noise.source, **noise}}
    rows = list(zip(COLOURS[T.channels], *noise.values(), strict=True))
    lines = [table(("channel", "noise of an entry", "that left, in pictures"), rows), f"\n{out}"]
    return Answer(data, lines)
