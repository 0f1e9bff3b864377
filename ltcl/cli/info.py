# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl info`: what transport files hold; needs no device."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.cli import console, options
from ltcl.cli.command import FAILED, Answer, Context
from ltcl.errors import InputError, LtclError
from ltcl.store import BlockStore, Parts, Record, formats, inverses


def info(context: Context, files: options.Matrices, variable: options.Variable = None) -> Answer:
    """Size, channels, grid, entries and first bounce of transport files and of inverses. Needs no device.

    All bytes of a .zarr are compared with their checksums. A bad file does not keep the others from being
    shown; the exit code is then 1.
    """
    entries = []
    for file in context.progress.each(files):
        context.progress("reading")
        try:
            entries.append(_facts(file, variable))
        except (LtclError, MemoryError) as error:
            entries.append({"file": str(file), "error": str(error) or f"{file}: the host has no memory left"})
            console.error(entries[-1]["error"])
    rows = [_row(entry) for entry in entries if "error" not in entry]
    columns = ("file", "shape", "channels", "grid", "camera grid", "stored", "entries", "memory")
    columns = (*columns, "first bounce", "dark pixels")
    return Answer(
        entries, lambda: rows and console.table(columns, rows), FAILED if len(rows) < len(files) else 0
    )


def _facts(file: Path, variable: str | None) -> dict[str, Any]:
    if inverses.is_inverse(file):
        return {**describe(file, inverses.read(file)), "stored": "inverse"}
    record = formats.read(file, variable=variable)
    with formats.about(file):
        if file.is_dir():
            BlockStore.open(file).verify()
        return describe(file, record)


def describe(file: Path, record: Record | Parts) -> dict[str, Any]:
    """Facts about a transport in plain types; refuses what could not be loaded again."""
    facts = _of_record(record) if isinstance(record, Record) else _of_parts(record)
    F = facts.pop("F")  # (channels, N); a rectangular T has none
    return {
        "file": str(file),
        **{name: getattr(record, name) for name in ("shape", "grid", "camera_grid", "mixing")},
        **facts,
        "first_bounce": None if F is None else (float(F.min()), float(F.max())),
        "dark_pixels": None if F is None else int(np.count_nonzero((F <= 0).any(axis=0))),
    }


def _of_parts(parts: Parts) -> dict[str, Any]:
    """A compressed one, whose operators are not made: that takes a device."""
    return {
        "F": parts.first_bounce,
        "channels": len(parts.first_bounce),
        "stored": "compressed",
        "dtype": f"{', '.join(parts.kinds)}; error {checks.upwards(parts.error)}",
        "entries": parts.entries,
        "nbytes": parts.nbytes,
        "first_bounce_from": "file",
        "solution_error": parts.error if math.isfinite(parts.error) else None,
    }


def _of_record(record: Record) -> dict[str, Any]:
    rows, columns = record.shape
    for name, pixels in (("grid", columns), ("camera_grid", rows)):
        if getattr(record, name) is not None:
            checks.grid(name, getattr(record, name), pixels)
    F = record.first_bounce
    if F is not None and rows != columns:
        raise InputError(f"first_bounce is given, but T is {record.shape}; only a square T has one")
    if F is None and rows == columns:
        F = np.stack([T.diagonal() for T in record.matrices])
    matrices: Any = record.matrices
    values = [np.empty(0) if record.stored else T if record.dense else T.data for T in matrices]
    for name, array in [("first_bounce", F), *(("T", array) for array in values)]:
        if array is not None:
            checks.finite(name, array)  # of a store, blocks have been checked
    parts = [[T] if record.dense or record.stored else [T.data, T.indices, T.indptr] for T in matrices]
    return {
        "F": None if F is None else np.atleast_2d(F),
        "channels": len(matrices),
        "stored": "dense" if record.dense else "row blocks" if record.stored else "sparse",
        "dtype": str(matrices[0].dtype),
        "entries": sum(np.count_nonzero(T) if record.dense else T.nnz for T in matrices),
        "nbytes": sum(part.nbytes for T in parts for part in T),
        "first_bounce_from": "diagonal" if record.first_bounce is None else "file",
        "solution_error": 0.0,
    }


def _row(entry: dict[str, Any]) -> tuple:
    """Of the table; a camera has its grid where it is not that of the projector."""
    shape, grid, camera = (entry[name] for name in ("shape", "grid", "camera_grid"))
    same = camera in (None, grid) and shape[0] == shape[1]
    sizes = ("unknown" if size is None else "{} x {}".format(*size) for size in (grid, camera))
    projector, camera = sizes
    return (
        entry["file"],
        "{} x {}".format(*shape),
        entry["channels"],
        projector,
        "the same" if same else camera,
        f"{entry['stored']} {entry['dtype']}",
        entry["entries"],
        checks.size(entry["nbytes"]),
        entry["first_bounce"] and "{:.4g} .. {:.4g}".format(*entry["first_bounce"]),
        entry["dark_pixels"],
    )
