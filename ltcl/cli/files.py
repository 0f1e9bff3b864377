# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl info` and `ltcl convert`: transport files described and in another format."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from ltcl import checks, first_bounce
from ltcl.cli import options, pictures, transports
from ltcl.cli.command import FAILED, Answer, Context, command, note, print_error, table
from ltcl.errors import InputError, LtclError
from ltcl.noise import estimate
from ltcl.store import BlockStore, Parts, Record, formats
from ltcl.store.record import about
from ltcl.transport import Transport
from ltcl.verdict import Verdict, verdict

_JUDGED = 1 << 28  # bytes of a transport at most


@command()
def info(
    context: Context,
    files: options.Matrices,
    variable: options.Variable = None,
    show_dark: options.ShowDark = None,
) -> Answer:
    """Size, channels, grid, entries and first bounce of transport files and of inverses. Needs no device.

    All bytes of a .zarr are compared with their checksums. A bad file does not keep the others from being
    shown; the exit code is then 1. Transports of more than 256 MiB are judged by 'ltcl analyze' only.
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
            rows.append(_row(facts))
        except LtclError as error:
            entries.append({"file": str(file), **print_error(error)})
    if show_dark is not None and lights:
        pictures.write_first_bounces(show_dark, lights)
    columns = ("file", "shape", "channels", "grid", "camera grid", "stored", "entries", "memory")
    lines = [table((*columns, "first bounce", "dark pixels"), rows)] if rows else []
    return Answer(entries, lines + transports.verdicts(verdicts), FAILED if len(rows) < len(files) else 0)


@command(options.file_options)
def convert(
    context: Context,
    source: Annotated[Path, options.argument("IN", options.FORMATS)],
    target: Annotated[Path, options.argument("OUT", "The new file.", callback=options.writable_file)],
) -> Answer:
    """Write a transport in another format; OUT is replaced whole or not at all. Needs no device."""
    formats.find(target)  # refused before a long read
    context.progress(f"reading {source}")
    record = formats.read(source, variable=context.options["variable"])
    with about(source):
        pixels = {"grid": record.shape[1], "camera_grid": record.shape[0]}
        sizes = {name: context.options[name] for name in pixels if context.options[name]}
        sizes = {name: checks.grid(name, size, pixels[name]) for name, size in sizes.items()}
        if isinstance(record, Record):
            record = dataclasses.replace(record, **sizes)
        elif any(size != record.grid for size in sizes.values()):
            (h, w), size = record.grid, next(iter(sizes.values()))
            raise InputError(f"grid is {size}; this transport is compressed on {h} x {w}")
        facts, _ = _describe(target, record)  # refuses what could not be loaded again
    context.progress(f"writing {target}")
    formats.write(target, record)
    transports.note_lost(source, target)
    if target.suffix.lower() == ".npy" or record.grid is None:
        text = "x".join(map(str, record.grid or "HW"))
        note(f"{target}: does not contain the grid; give --grid {text} wherever you use it")
    elif record.shape[0] != record.shape[1] and record.camera_grid is None:
        note(f"{target}: does not contain the camera's grid; give --camera-grid HxW, or to relight")
    size = checks.size(transports.on_disk(target))
    return Answer({"source": source, **facts}, [f"{target}: {facts['stored']}, {size} on disk"])


def _describe(file: Path, record: Record | Parts) -> tuple[dict[str, Any], np.ndarray | None]:
    """Facts about a transport in plain types, and F; refuses what could not be loaded again."""
    if isinstance(record, Parts):  # whose operators are not made: that takes a device
        F, kinds, error = record.first_bounce, ", ".join(record.kinds), record.error
        facts: dict[str, Any] = {"channels": len(F), "entries": record.entries, "solution_error": error}
        facts |= {"dtype": f"{kinds}; error {checks.upwards(error)}", "nbytes": record.nbytes}
        facts |= {"first_bounce_from": "file", "stored": record.format.split("-")[1]}
    else:
        F, facts = _describe_record(record)
    facts = {
        "file": str(file),
        **{name: getattr(record, name) for name in ("shape", "grid", "camera_grid", "mixing")},
        **facts,
        "first_bounce": None if F is None else (float(F.min()), float(F.max())),
        "dark_pixels": None if F is None else int(np.count_nonzero((F <= 0).any(axis=0))),
    }
    return facts, F


def _describe_record(record: Record) -> tuple[np.ndarray | None, dict[str, Any]]:
    """F (channels, N), 0 where dark, which a rectangular T has not, and facts about the matrices."""
    (rows, columns), F, matrices = record.shape, record.first_bounce, list[Any](record.matrices)
    for name, pixels in (("grid", columns), ("camera_grid", rows)):
        if getattr(record, name) is not None:
            checks.grid(name, getattr(record, name), pixels)
    if F is not None and rows != columns:
        raise InputError(f"first_bounce is given, but T is {record.shape}; only a square T has one")
    if F is None and rows == columns:
        F = np.stack([T.diagonal() for T in matrices])
    for T in () if record.stored else matrices:  # blocks of a store have been checked
        checks.finite("T", T if record.dense else T.data)
    layouts = [[T] if record.dense or record.stored else [T.data, T.indices, T.indptr] for T in matrices]
    if F is not None:
        F, grid = np.atleast_2d(checks.finite("first_bounce", F)), record.grid or (1, columns)
        noise = lambda: record.noise or estimate(matrices, grid, record.camera_grid or grid)  # noqa: E731
        known, share = record.noise is not None, first_bounce.DARK
        F = np.where(first_bounce.dark(matrices, share, noise, known, F), 0.0, F)
    return F, {
        "channels": len(matrices),
        "stored": "dense" if record.dense else "row blocks" if record.stored else "sparse",
        "dtype": str(matrices[0].dtype),
        "entries": sum(np.count_nonzero(T) if record.dense else T.nnz for T in matrices),
        "nbytes": sum(array.nbytes for arrays in layouts for array in arrays),
        "first_bounce_from": "diagonal" if record.first_bounce is None else "file",
        "solution_error": 0.0,
    }


def _verdict(record: Record | Parts, facts: dict[str, Any]) -> Verdict:
    if isinstance(record, Parts):
        return Verdict(f"Unknown: stored as {facts['stored']}: run 'ltcl analyze' on what it was made of.")
    square, missing = record.shape[0] == record.shape[1], "" if record.grid else " --grid HxW"
    missing += "" if square or record.camera_grid else " --camera-grid HxW"
    if missing or (square and facts["nbytes"] > _JUDGED):
        why = "the file does not contain the grid" if missing else "T takes more than 256 MiB"
        tool = f"analyze {facts['file']}" if square else f"convert {facts['file']} OUT.npz"
        return Verdict(f"Unknown: {why}: run 'ltcl {tool}{missing}'.")
    names = ("grid", "first_bounce", "camera_grid", "mixing", "noise")
    settings = {n: value for n in names if (value := getattr(record, n)) is not None}
    try:
        return verdict(Transport(record.matrices, **settings))
    except InputError as error:  # dark all over
        return Verdict(f"Good for nothing: {error}.", False, False)


def _row(entry: dict[str, Any]) -> tuple:
    """Of the table; a camera has its grid where it is not that of the projector."""
    sizes = {}
    for name in ("shape", "grid", "camera_grid"):
        sizes[name] = "{} x {}".format(*entry[name]) if entry[name] else "unknown"
    if entry["camera_grid"] in (None, entry["grid"]) and entry["shape"][0] == entry["shape"][1]:
        sizes["camera_grid"] = "the same"
    first = entry["first_bounce"] and "{:.4g} .. {:.4g}".format(*entry["first_bounce"])
    stored, size = f"{entry['stored']} {entry['dtype']}", checks.size(entry["nbytes"])
    facts = (sizes["shape"], entry["channels"], sizes["grid"], sizes["camera_grid"], stored)
    return (entry["file"], *facts, entry["entries"], size, first, entry["dark_pixels"])
