# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl info` and `analyze` describe transports; `compress`, `denoise`, `invert`, `convert` make others."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from ltcl import checks, store
from ltcl.cli import options, pictures
from ltcl.cli.command import FAILED, Answer, Context, command, fail, note, percent, table
from ltcl.cli.options import option
from ltcl.errors import InputError, LtclError
from ltcl.store import BlockStore, CompressedRecord, StoreRecord, formats
from ltcl.store.guards import about
from ltcl.store.record import CSR
from ltcl.tasks import analysis, compression, denoising
from ltcl.transport import first_bounce
from ltcl.transport.noise import estimate
from ltcl.transport.transport import Transport
from ltcl.transport.verdict import Verdict, verdict

_COLOURS = {1: ("grey",), 3: ("red", "green", "blue")}
_UNITS = {"": 1, "k": 1000, "m": 1000**2, "g": 1000**3, "ki": 1024, "mi": 1024**2, "gi": 1024**3}
_interval = "{:.4g} .. {:.4g}".format


@command()
def info(
    context: Context,
    files: options.Matrices,
    variable: options.Variable = None,
    show_dark: options.ShowDark = None,
) -> Answer:
    """Size, channels, grid, entries and first bounce of transport files and of inverses. Needs no device.

    All bytes of a .zarr are compared with their checksums. A bad file does not keep the others from
    being shown; the exit code is then 1. Transports of more than 256 MiB are judged by 'ltcl
    analyze' only.
    """
    entries, rows, lights, verdicts = [], [], {}, {}
    for file in context.progress.each(files):
        context.progress("reading")
        try:
            record = formats.read(file, variable=variable)
            with about(file):
                if file.is_dir():
                    BlockStore.open(file).verify()
                facts, F = _describe(file, record)
            lights |= {} if F is None else {file.name: (F, record.grid or (1, record.shape[1]))}
            verdicts[str(file)] = judged = _verdict(record, facts)
            entries.append(facts | {"verdict": judged})
            sizes = (facts[name] for name in ("shape", "grid", "camera_grid"))
            shape, grid, camera_grid = (
                "{} x {}".format(*size) if size else "unknown" for size in sizes
            )
            if facts["camera_grid"] in (None, facts["grid"]) and len({*facts["shape"]}) == 1:
                camera_grid = "the same"
            stored, size = f"{facts['stored']} {facts['dtype']}", checks.size(facts["nbytes"])
            light = (
                facts["first_bounce"] and _interval(*facts["first_bounce"]),
                facts["dark_pixels"],
            )
            counts = facts["channels"], grid, camera_grid, stored, facts["entries"], size
            rows.append((file, shape, *counts, *light))
        except LtclError as error:
            entries.append({"file": str(file), **fail(error)})
    pictures.write_first_bounces(show_dark, lights)
    columns = ("file", "shape", "channels", "grid", "camera grid", "stored", "entries", "memory")
    lines = [table((*columns, "first bounce", "dark pixels"), rows)] if rows else []
    return Answer(
        entries, lines + options.verdicts(verdicts), FAILED if len(rows) < len(files) else 0
    )


def _describe(
    file: Path, record: StoreRecord | CompressedRecord
) -> tuple[dict[str, Any], np.ndarray | None]:
    """Facts about a transport in plain types, and F; refuses what could not be loaded again."""
    sizes = {name: getattr(record, name) for name in ("shape", "grid", "camera_grid", "mixing")}
    facts: dict[str, Any] = {"file": str(file), **sizes}
    if isinstance(record, CompressedRecord):  # whose operators are not made: that takes a device
        F, kinds, error = record.first_bounce, ", ".join(record.kinds), record.error
        facts |= {"channels": len(F), "entries": record.entries, "solution_error": error}
        facts |= {"dtype": f"{kinds}; error {checks.upwards(error)}", "nbytes": record.nbytes}
        facts |= {"first_bounce_from": "file", "stored": record.format.split("-")[1]}
    else:
        F, T = _first_bounce(record), list[Any](record.matrices)
        kind = "dense" if record.dense else "row blocks" if record.stored else "sparse"
        facts |= {"channels": len(T), "stored": kind, "dtype": str(T[0].dtype)}
        facts["entries"] = sum(np.count_nonzero(M) if record.dense else M.nnz for M in T)
        facts["nbytes"] = sum(
            getattr(M, "nbytes", 0) or sum(getattr(M, a).nbytes for a in CSR) for M in T
        )
        source = "diagonal" if record.first_bounce is None else "file"
        facts |= {"first_bounce_from": source, "solution_error": 0.0}
    facts["first_bounce"] = None if F is None else (float(F.min()), float(F.max()))
    facts["dark_pixels"] = None if F is None else int(np.count_nonzero((F <= 0).any(axis=0)))
    return facts, F


def _first_bounce(record: StoreRecord) -> np.ndarray | None:
    """F (channels, N), 0 where dark, which a rectangular T has not, after all of a record is checked."""
    (rows, columns), F, matrices = record.shape, record.first_bounce, list[Any](record.matrices)
    for name, pixels in (("grid", columns), ("camera_grid", rows)):
        checks.grid(name, getattr(record, name) or (1, pixels), pixels)
    for T in () if record.stored else matrices:  # blocks of a store have been checked
        checks.finite("T", T if record.dense else T.data)
    if rows != columns and F is not None:
        raise InputError(f"first_bounce is given, but T is {record.shape}; only a square T has one")
    if rows != columns:
        return None
    F = np.stack([T.diagonal() for T in matrices]) if F is None else F
    F, grid = np.atleast_2d(checks.finite("first_bounce", F)), record.grid or (1, columns)
    noise = lambda: record.noise or estimate(matrices, grid, record.camera_grid or grid)  # noqa: E731
    rule = first_bounce.DarkRule(
        matrices=matrices,
        threshold=first_bounce.DARK_THRESHOLD,
        noise=noise,
        is_measured=record.noise is not None,
    )
    return np.where(rule.find_dark(F), 0.0, F)


def _verdict(record: StoreRecord | CompressedRecord, facts: dict[str, Any]) -> Verdict:
    if isinstance(record, CompressedRecord):
        return Verdict(
            f"Unknown: stored as {facts['stored']}: run 'ltcl analyze' on what it was made of."
        )
    square, missing = record.shape[0] == record.shape[1], "" if record.grid else " --grid HxW"
    missing += "" if square or record.camera_grid else " --camera-grid HxW"
    if missing or (square and facts["nbytes"] > 1 << 28):
        why = "the file does not contain the grid" if missing else "T takes more than 256 MiB"
        tool = f"analyze {facts['file']}" if square else f"convert {facts['file']} OUT.npz"
        return Verdict(f"Unknown: {why}: run 'ltcl {tool}{missing}'.")
    known = {name: value for name, value in vars(record).items() if value is not None}
    try:
        return verdict(Transport(known.pop("matrices"), **known))
    except InputError as error:  # dark all over
        return Verdict(f"Good for nothing: {error}.", False, False)


def _plot(path: Path | None) -> Path | None:
    if path is not None and path.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise typer.BadParameter(f"{path} must be a .png, .svg or .pdf")
    return options.writable_file(path)


_PLOT = "Draw bounds on rho(R) and the forecast: .png, .svg or .pdf."


@command(*options.TRANSPORT)
def analyze(
    context: Context,
    files: options.Matrices,
    rtol: Annotated[float, option("Relative residual at which a solve ends.")] = 1e-2,
    show_dark: options.ShowDark = None,
    plot: Annotated[Path | None, options.file(_PLOT, callback=_plot)] = None,
) -> Answer:
    """Spectrum of R, products each method needs to the tolerance, and whether T is physically possible."""
    analyses, entries, spectra, forecasts, lights, verdicts = {}, [], [], [], {}, {}
    for file in context.progress.each(files):
        T = options.load(context, file)
        lights[file.name] = T.first_bounce, T.grid
        context.progress("analyzing")
        analyses[file.name] = facts = analysis.analyze(T, rtol=rtol)
        verdicts[str(file)] = facts.verdict
        entries.append({"file": str(file), "device": T.device.name, **facts.to_dict()})
        for colour, channel in zip(_COLOURS[T.channels], facts.channels, strict=True):
            label = {"file": str(file), "channel": colour}
            forecasts.append(label | channel.products)
            spectrum = {
                "rho(R)": channel.spectral_radius,
                "certificate": channel.spectral_radius_certificate,
                "rho(R) within": _interval(*channel.spectral_radius_bounds),
                "albedo": channel.albedo,
                "S within": _interval(*channel.bounds),
                "first bounce": _interval(channel.first_bounce[0], channel.first_bounce[-1]),
                "reciprocity defect": channel.reciprocity_defect,
                "negative light": percent(channel.negative_bounce),
                "light passed on": _interval(
                    channel.energy.bounce_lowest, channel.energy.bounce_highest
                ),
            }
            spectra.append(label | spectrum)
    if plot is not None:
        from ltcl import plots

        plots.save(plots.analysis(analyses), plot)
    pictures.write_first_bounces(show_dark, lights)
    lines = [
        "Spectrum of R, bounds on that of S, and checks of the measurement",
        table([*spectra[0]], [row.values() for row in spectra]),
        "  negative light: in one bounce between parts of the picture; should be 0",
        "  light passed on: share of each pixel's light, by one bounce; must be at least 0 and below 1",
        f"\nProducts with S to a relative residual of {rtol:g}, two more by sweeps; -: no forecast",
        table([*forecasts[0]], [row.values() for row in forecasts]),
        *options.verdicts(verdicts),
    ]
    return Answer(entries, lines)


def _bytes(text: str) -> int:
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*([kmg]?i?)b?\s*", text, re.IGNORECASE)
    count = int(float(match[1]) * _UNITS.get(match[2].lower(), 0)) if match else 0
    if count < 1:
        raise typer.BadParameter(
            f"{text!r} is no size; write bytes, or for instance 50MB or 1.5GiB"
        )
    return count


_BUDGET = "Bytes that the numbers of R may take, such as 50MB."
_BASIS = "pixels or a wavelet (haar, db2, ...; compress: 'db2 rows', too); more than once: the best of them."
_HELP = (
    "Relative error that solutions may have; compress: or noise, which keeps what stands out of it."
)
_RTOL = option(_HELP, parser=lambda text: text if text == "noise" else float(text), metavar="FLOAT")


def _accuracy_options(
    rtol: Annotated[Any, _RTOL] = 1e-2,
    basis: Annotated[list[str] | None, option(_BASIS)] = None,
) -> None:
    """How accurate the solutions are, and in which basis R is written."""


@command(*options.TRANSPORT, _accuracy_options)
def compress(
    context: Context,
    file: options.Matrix,
    out: Annotated[Path, options.out("The compressed transport: .npz or .zarr.")],
    budget: Annotated[int | None, option(_BUDGET, parser=_bytes, metavar="SIZE")] = None,
    norm: Annotated[
        Literal["pictures", "worst"], option("Whose error: of pictures, or any.")
    ] = "pictures",
) -> Answer:
    """Write R in a basis where it is sparse; basis, threshold and precision are chosen by measurement."""
    asked = {"rtol": context.options["rtol"], "basis": context.options["basis"] or None}
    make = partial(compression.compress, budget=budget, norm=norm, **asked)
    _, C, data = _transform(context, file, out, make)
    facts: Any = C.compression
    data |= {
        "bytes": facts.uncompressed,
        "bytes_compressed": C.nbytes,
        "bytes_on_disk": options.on_disk(out),
    }
    data |= {"solution_error": C.error, "error_bound": C.error_bound, "compression": facts}
    before, after, disk = (
        checks.size(data[f"bytes{name}"]) for name in ("", "_compressed", "_on_disk")
    )
    columns = ("channel", "basis", "core", "numbers a row", "bytes", "error of R, 2-norm")
    rows = []
    for colour, channel in zip(_COLOURS[C.channels], facts.channels, strict=True):
        core = f"{channel.format} 1 x {channel.width} {channel.precision}"
        rows.append(
            (colour, channel.basis, core, channel.kept, checks.size(channel.nbytes), channel.error)
        )
    more = f"solutions within {checks.upwards(C.error)}, {disk} on disk, in {facts.seconds:.3g} s"
    more += f", or {checks.upwards(C.error_bound)} for light that is no picture" * (
        norm == "pictures"
    )
    return Answer(
        data, [table(columns, rows), f"\n{out}: {before} to {after} with the first bounce, {more}"]
    )


@command(*options.TRANSPORT)
def denoise(
    context: Context,
    file: options.Matrix,
    out: Annotated[Path, options.out("The transport with less noise: .npz or .zarr.")],
) -> Answer:
    """Write TRANSPORT with less noise: reciprocal pairs averaged, wavelet coefficients shrunk."""
    T, result, data = _transform(context, file, out, denoising.denoise)
    noise = {"before": T.noise.floor.tolist(), "after": result.noise.floor.tolist()}
    data["noise"] = {"source": T.noise.source, **noise}
    rows = zip(_COLOURS[T.channels], *noise.values(), strict=True)
    return Answer(
        data, [table(("channel", "noise of an entry", "that left, in pictures"), rows), f"\n{out}"]
    )


@command(*options.TRANSPORT, _accuracy_options)
def invert(
    context: Context, file: options.Matrix, out: Annotated[Path, options.out("The inverse: .npz.")]
) -> Answer:
    """Find A = I - S^-1, one physical bounce, so that each further picture costs one product."""
    basis = context.options["basis"] or compression.INVERSE_NAMES
    make = partial(compression.invert, rtol=context.options["rtol"], basis=basis)
    _, inverse, data = _transform(context, file, out, make, is_inverse=True)
    data |= {"bytes": inverse.nbytes, "bytes_on_disk": out.stat().st_size}
    data |= {"errors": inverse.errors, "confidence": inverse.confidence}
    sizes = f"{checks.size(data['bytes'])}, {checks.size(data['bytes_on_disk'])} on disk"
    return Answer(data, [f"{out}: solutions within {checks.upwards(inverse.error)}, {sizes}"])


def _transform(
    context: Context, file: Path, out: Path, make: Callable[..., Any], is_inverse: bool = False
) -> tuple[Transport, Any, dict[str, Any]]:
    """T, what is made of it and written to `out`, and the beginning of the report."""
    formats.find(out, inverse=is_inverse)
    if not is_inverse and out.suffix.lower() not in (".npz", ".zarr"):
        raise InputError(f"--out is {out}; what {context.name} makes must be a .npz or a .zarr")
    T = options.load(context, file)
    if context.name == "compress" and T.is_compressed and T.error:
        raise InputError(
            f"{file}: is compressed already, to {T.error:.2g}; compress what it came from"
        )
    result = make(T, progress=partial(context.progress, total=1.0))
    (store.save_inverse if is_inverse else store.save)(out, result)
    if not is_inverse:
        options.note_lost(file, out)
    return T, result, options.heading(context, file, T) | {"out": out}


@command(options.file_options)
def convert(
    context: Context,
    source: Annotated[Path, options.argument("IN", options.FORMATS)],
    target: Annotated[
        Path, options.argument("OUT", "The new file.", callback=options.writable_file)
    ],
) -> Answer:
    """Write a transport in another format; OUT is replaced whole or not at all. Needs no device."""
    formats.find(target)  # refused before a long read
    context.progress(f"reading {source}")
    record = formats.read(source, variable=context.options["variable"])
    with about(source):
        sizes = {name: size for name in ("grid", "camera_grid") if (size := context.options[name])}
        if isinstance(record, StoreRecord):
            record = dataclasses.replace(record, **sizes)
        elif any(size != record.grid for size in sizes.values()):
            (h, w), size = record.grid, next(iter(sizes.values()))
            raise InputError(f"grid is {size}; this transport is compressed on {h} x {w}")
        facts, _ = _describe(target, record)  # refuses what could not be loaded again
    context.progress(f"writing {target}")
    formats.write(target, record)
    options.note_lost(source, target)
    if target.suffix.lower() == ".npy" or record.grid is None:
        text = "x".join(map(str, record.grid or "HW"))
        note(f"{target}: does not contain the grid; give --grid {text} wherever you use it")
    elif record.shape[0] != record.shape[1] and record.camera_grid is None:
        note(f"{target}: does not contain the camera's grid; give --camera-grid HxW, or to relight")
    size = checks.size(options.on_disk(target))
    return Answer({"source": source, **facts}, [f"{target}: {facts['stored']}, {size} on disk"])
