# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl compress` and `ltcl invert`: a transport in few numbers, or its inverse."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ltcl import checks
from ltcl.cli import options, transports
from ltcl.cli.analyze import COLOURS
from ltcl.cli.command import Answer, Context, command, table
from ltcl.errors import InputError
from ltcl.store import save_inverse

_UNITS = {"": 1, "k": 1000, "m": 1000**2, "g": 1000**3, "ki": 1024, "mi": 1024**2, "gi": 1024**3}


def _bytes(text: str) -> int:
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*([kmg]?i?)b?\s*", text, re.IGNORECASE)
    count = int(float(match[1]) * _UNITS.get(match[2].lower(), 0)) if match else 0
    if count < 1:
        raise typer.BadParameter(f"{text!r} is no size; write bytes, or for instance 50MB or 1.5GiB")
    return count


_BUDGET = "Bytes that the numbers of R may take, such as 50MB."
_Norm = Annotated[Literal["pictures", "worst"], options.option("Whose error: of pictures, or any light.")]
_BASIS = "pixels or a wavelet (haar, db2, ...; compress: 'db2 rows', too); more than once: the best of them."


def _rtol(text: str) -> float | str:
    return text if text == "noise" else float(text)


_RTOL = "Relative error that solutions may have; compress: or noise, which keeps what stands out of it."


def _accuracy_options(
    rtol: Annotated[Any, options.option(_RTOL, parser=_rtol, metavar="FLOAT")] = 1e-2,
    basis: Annotated[list[str] | None, options.option(_BASIS)] = None,
) -> None:
    """How accurate the solutions are, and in which basis R is written."""


_GROUPS = (options.file_options, options.transport_options, _accuracy_options)


@command(*_GROUPS)
def compress(
    context: Context,
    file: options.Matrix,
    out: Annotated[Path, options.out("The compressed transport: .npz or .zarr.")],
    budget: Annotated[int | None, options.option(_BUDGET, parser=_bytes, metavar="SIZE")] = None,
    norm: _Norm = "pictures",
) -> Answer:
    """Write R in a basis where it is sparse; basis, threshold and precision are chosen by measurement."""
    from ltcl import store
    from ltcl.compression import compress

    T = transports.load_source(context, file, out)
    if T.is_compressed and T.error:
        error = f"with an error of {T.error:.2g}"
        raise InputError(f"{file}: is compressed already, {error}; compress what it came from")
    rtol, basis = context.options["rtol"], context.options["basis"] or None
    C = compress(T, rtol, budget, norm=norm, basis=basis, progress=partial(context.progress, total=1.0))
    store.save(out, C)
    transports.note_lost(file, out)
    facts: Any = C.compression
    data = transports.heading(context, file, T) | {"out": out, "bytes": facts.uncompressed}
    data |= {"bytes_compressed": C.nbytes, "bytes_on_disk": transports.on_disk(out)}
    data |= {"solution_error": C.error, "error_bound": C.error_bound, "compression": facts}
    before, after, disk = (checks.size(data[f"bytes{name}"]) for name in ("", "_compressed", "_on_disk"))
    columns = ("channel", "basis", "core", "numbers a row", "bytes", "error of R, 2-norm")
    rows = []
    for colour, channel in zip(COLOURS[T.channels], facts.channels, strict=True):
        core = f"{channel.format} 1 x {channel.width} {channel.precision}"
        rows.append((colour, channel.basis, core, channel.kept, checks.size(channel.nbytes), channel.error))
    within = f"solutions within {checks.upwards(C.error)}, {disk} on disk, in {facts.seconds:.3g} s"
    within += f", or {checks.upwards(C.error_bound)} for light that is no picture" * (norm == "pictures")
    return Answer(
        data, [table(columns, rows), f"\n{out}: {before} to {after} with the first bounce, {within}"]
    )


@command(*_GROUPS)
def invert(
    context: Context, file: options.Matrix, out: Annotated[Path, options.out("The inverse: .npz.")]
) -> Answer:
    """Find A = I - S^-1, one physical bounce, so that each further picture costs one product."""
    from ltcl.compression import INVERSE_NAMES, invert

    T = transports.load_source(context, file, out, inverse=True)
    rtol, basis = context.options["rtol"], context.options["basis"] or INVERSE_NAMES
    inverse = invert(T, rtol, basis=basis, progress=partial(context.progress, total=1.0))
    save_inverse(out, inverse)
    data = transports.heading(context, file, T)
    data |= {"out": out, "bytes": inverse.nbytes, "bytes_on_disk": out.stat().st_size}
    data |= {"errors": inverse.errors, "confidence": inverse.confidence}
    sizes = f"{checks.size(data['bytes'])}, {checks.size(data['bytes_on_disk'])} on disk"
    return Answer(data, [f"{out}: solutions within {checks.upwards(inverse.error)}, {sizes}"])
