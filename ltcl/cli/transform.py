# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl compress`, `denoise` and `invert`: other transports made of one."""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ltcl import checks, store
from ltcl.cli import loading, options
from ltcl.cli.command import Answer, Context, command
from ltcl.cli.options import option, out_option
from ltcl.cli.reports.transports import CompressReport, DenoiseReport, InvertReport, NoiseReport
from ltcl.cli.tables import COLOURS, table
from ltcl.errors import InputError
from ltcl.operators.wavelets import EXAMPLES
from ltcl.store import formats
from ltcl.tasks import compression, denoising
from ltcl.transport.transport import Transport

BYTES_OF_UNIT = {
    "": 1,
    "k": 1000,
    "m": 1000**2,
    "g": 1000**3,
    "ki": 1024,
    "mi": 1024**2,
    "gi": 1024**3,
}
COMPRESS_COLUMNS = ("channel", "basis", "core", "numbers a row", "bytes", "error of R, 2-norm")
DENOISE_COLUMNS = ("channel", "noise of an entry", "remaining noise, in pictures")


def _parse_bytes(text: str) -> int:
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*([kmg]?i?)b?\s*", text, re.IGNORECASE)
    if match is not None:
        unit = BYTES_OF_UNIT.get(match[2].lower(), 0)
        count = int(float(match[1]) * unit)
        if count > 0:
            return count
    advice = "write bytes, or for instance 50MB or 1.5GiB"
    raise typer.BadParameter(f"{text!r} is not a size; {advice}")


def _parse_rtol(text: str) -> float | str:
    return text if text == "noise" else float(text)


def _accuracy_options(
    rtol: Annotated[
        Any,
        option(
            "Relative error that solutions may have; compress also takes noise, "
            "which keeps all that stands out of the noise.",
            parser=_parse_rtol,
            metavar="FLOAT",
        ),
    ] = 1e-2,
    basis: Annotated[
        list[str] | None,
        option(
            f"Basis of R: pixels or a wavelet ({EXAMPLES}, ...; compress also takes "
            "'db2 rows'); the best one if given more than once."
        ),
    ] = None,
) -> None:
    """Options of the accuracy of solutions and of the basis of R."""


@command(*options.READ_OPTIONS, _accuracy_options)
def compress(
    context: Context,
    file: options.TransportFile,
    out: Annotated[Path, out_option("The compressed transport: .npz or .zarr.")],
    budget: Annotated[
        int | None,
        option(
            "Limit of the bytes for the numbers of R, such as 50MB.",
            parser=_parse_bytes,
            metavar="SIZE",
        ),
    ] = None,
    norm: Annotated[
        Literal["pictures", "worst"],
        option("Light that the error bound covers: pictures, or any light (worst)."),
    ] = "pictures",
) -> Answer:
    """Write R in a basis where it is sparse.

    Basis, threshold and precision are chosen by measurement.
    """
    _check_out(context, out)
    T = loading.load(context, file)
    if T.is_compressed and T.error:
        problem = f"{file}: is compressed already, to {T.error:.2g}"
        raise InputError(f"{problem}; compress the original transport")
    C = compression.compress(
        T,
        rtol=context.options["rtol"],
        basis=context.options["basis"] or None,
        budget=budget,
        norm=norm,
        progress=partial(context.progress, total=1.0),
    )
    _save(file, out, C)
    facts: Any = C.compression
    report = CompressReport(
        **loading.heading(context, file, T),
        out=out,
        bytes=facts.uncompressed,
        bytes_compressed=C.nbytes,
        bytes_on_disk=loading.bytes_on_disk(out),
        solution_error=C.error,
        error_bound=C.error_bound,
        compression=facts,
    )
    return Answer(report, [_compression_table(facts), _compression_line(report)])


def _compression_table(facts: Any) -> str:
    rows = []
    colours = COLOURS[len(facts.channels)]
    for colour, channel in zip(colours, facts.channels, strict=True):
        core = f"{channel.format} 1 x {channel.width} {channel.precision}"
        size = checks.size(channel.nbytes)
        row = [colour, channel.basis, core, channel.kept, size, channel.error]
        rows.append(row)
    return table(COMPRESS_COLUMNS, rows)


def _compression_line(report: CompressReport) -> str:
    before = checks.size(report.bytes)
    after = checks.size(report.bytes_compressed)
    disk = checks.size(report.bytes_on_disk)
    facts = report.compression
    error = checks.upwards(report.solution_error)
    line = (
        f"\n{report.out}: {before} to {after} with the first bounce, "
        f"solutions within {error}, {disk} on disk, in {facts.seconds:.3g} s"
    )
    if facts.norm == "pictures":
        error = checks.upwards(report.error_bound)
        line += f", or {error} for light that is no picture"
    return line


@command(*options.READ_OPTIONS)
def denoise(
    context: Context,
    file: options.TransportFile,
    out: Annotated[Path, out_option("The transport with less noise: .npz or .zarr.")],
) -> Answer:
    """Write TRANSPORT with less noise: average reciprocal pairs, shrink wavelet coefficients."""
    _check_out(context, out)
    T = loading.load(context, file)
    result = denoising.denoise(T, progress=partial(context.progress, total=1.0))
    _save(file, out, result)
    noise = NoiseReport(
        source=T.noise.source,
        before=T.noise.floor.tolist(),
        after=result.noise.floor.tolist(),
    )
    report = DenoiseReport(**loading.heading(context, file, T), out=out, noise=noise)
    rows = zip(COLOURS[T.channels], noise.before, noise.after, strict=True)
    return Answer(report, [table(DENOISE_COLUMNS, rows), f"\n{out}"])


@command(*options.READ_OPTIONS, _accuracy_options)
def invert(
    context: Context,
    file: options.TransportFile,
    out: Annotated[Path, out_option("The inverse: .npz.")],
) -> Answer:
    """Find A = I - S^-1, one physical bounce, so that each further picture costs one product."""
    formats.find(out, inverse=True)
    T = loading.load(context, file)
    inverse = compression.invert(
        T,
        rtol=context.options["rtol"],
        basis=context.options["basis"] or compression.INVERSE_NAMES,
        progress=partial(context.progress, total=1.0),
    )
    store.save_inverse(out, inverse)
    report = InvertReport(
        **loading.heading(context, file, T),
        out=out,
        bytes=inverse.nbytes,
        bytes_on_disk=out.stat().st_size,
        errors=list(inverse.errors),
        confidence=inverse.confidence,
    )
    error = checks.upwards(inverse.error)
    memory = checks.size(report.bytes)
    disk = checks.size(report.bytes_on_disk)
    line = f"{out}: solutions within {error}, {memory}, {disk} on disk"
    return Answer(report, [line])


def _check_out(context: Context, out: Path) -> None:
    """Refuse a format that cannot hold all of a transport."""
    formats.find(out)
    if out.suffix.lower() not in (".npz", ".zarr"):
        raise InputError(f"--out is {out}; what {context.name} makes must be a .npz or a .zarr")


def _save(source: Path, out: Path, T: Transport) -> None:
    store.save(out, T)
    loading.note_lost_setup(source, out)
