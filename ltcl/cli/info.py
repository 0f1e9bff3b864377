# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl info`: what transport files hold; needs no device."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
import typer

from ltcl import checks
from ltcl.cli import console, options
from ltcl.errors import InputError, LtclError
from ltcl.store import BlockStore, Parts, Record, formats, inverses


def run(files: options.Matrices, json: options.Json = False) -> None:
    """Tell what transport files hold: size, channels, grid, entries, first bounce. Needs no device.

    Of inverses, too; all bytes of a .zarr are compared with their checksums. A bad file does not keep the
    others from being told; the exit code is then 1.
    """
    found, errors = [], []
    with console.Steps(len(files)) as steps:
        for file in files:
            steps.item(str(file))
            try:
                found.append(_facts(file))
            except (LtclError, MemoryError) as error:
                errors.append(str(error) or f"{file}: the host has no memory left")
                found.append({"file": str(file), "error": errors[-1]})
    if json:
        console.answer(found)
    elif len(errors) < len(found):
        _show([entry for entry in found if "error" not in entry])
    for message in errors:
        console.error(message)
    if errors:
        raise typer.Exit(1)


def _facts(file: Path) -> dict[str, Any]:
    if inverses.is_inverse(file):
        return {**_of_parts(file, inverses.read(file)), "stored": "inverse"}
    record = formats.read(file)
    with formats.about(file):
        if file.is_dir():
            BlockStore.open(file).verify()
        return describe(file, record)


def _show(found: list[dict[str, Any]]) -> None:
    console.table(
        (
            "file",
            "shape",
            "channels",
            "grid",
            "camera grid",
            "stored",
            "entries",
            "memory",
            "first bounce",
            "dark pixels",
        ),
        [
            (
                entry["file"],
                _times(entry["shape"]),
                entry["channels"],
                _times(entry["grid"]) or "not told",
                _camera(entry),
                f"{entry['stored']} {entry['dtype']}",
                entry["entries"],
                checks.size(entry["nbytes"]),
                _range(entry["first_bounce"]),
                entry["dark_pixels"],
            )
            for entry in found
        ],
    )


def describe(file: Path, record: Record | Parts) -> dict[str, Any]:
    """Facts about a transport file, in plain types; refuses what could not be loaded.

    Of a compressed one the operators are not made: that takes a device.
    """
    if isinstance(record, Parts):
        return _of_parts(file, record)
    if not record.stored:  # a store's blocks have been checked
        for T in record.matrices:
            checks.finite("T", _values(T))
    _check_extras(record)
    F = _first_bounce(record)
    return {
        "file": str(file),
        "shape": record.shape,
        "channels": len(record.matrices),
        "grid": record.grid,
        "camera_grid": record.camera_grid,
        "stored": "dense" if record.dense else "row blocks" if record.stored else "sparse",
        "dtype": str(record.matrices[0].dtype),
        "entries": sum(map(_entries, record.matrices)),
        "nbytes": sum(_nbytes(T) for T in record.matrices),
        "first_bounce": None if F is None else (float(F.min()), float(F.max())),
        "first_bounce_from": "diagonal" if record.first_bounce is None else "file",
        "mixing": record.mixing,
        "dark_pixels": None if F is None else int(np.count_nonzero((F <= 0).any(axis=0))),
        "solution_error": 0.0,
    }


def _of_parts(file: Path, parts: Parts) -> dict[str, Any]:
    F = parts.first_bounce
    return {
        "file": str(file),
        "shape": parts.shape,
        "channels": len(F),
        "grid": parts.grid,
        "camera_grid": parts.camera_grid,
        "stored": "compressed",
        "dtype": f"{', '.join(parts.kinds)}; error {checks.upwards(parts.error)}",
        "entries": parts.entries,
        "nbytes": parts.nbytes,
        "first_bounce": (float(F.min()), float(F.max())),
        "first_bounce_from": "file",
        "mixing": parts.mixing,
        "dark_pixels": int(np.count_nonzero((F <= 0).any(axis=0))),
        "solution_error": parts.error if math.isfinite(parts.error) else None,
    }


def _check_extras(record: Record) -> None:
    rows, columns = record.shape
    for name, pixels in (("grid", columns), ("camera_grid", rows)):
        if getattr(record, name) is not None:
            checks.grid(name, getattr(record, name), pixels)
    if record.first_bounce is not None:
        checks.finite("first_bounce", record.first_bounce)
        if rows != columns:
            raise InputError(f"first_bounce is given, but T is {record.shape}; only a square T has one")


def _values(T: Any) -> np.ndarray:
    return T if isinstance(T, np.ndarray) else T.data


def _entries(T: Any) -> int:
    return int(np.count_nonzero(T)) if isinstance(T, np.ndarray) else T.nnz


def _nbytes(T: Any) -> int:
    if isinstance(T, scipy.sparse.csr_array):
        return T.data.nbytes + T.indices.nbytes + T.indptr.nbytes
    return T.nbytes


def _first_bounce(record: Record) -> np.ndarray | None:
    """F, (channels, N): what the file says, else the diagonal; None where T is rectangular."""
    if record.shape[0] != record.shape[1]:
        return None
    if record.first_bounce is not None:
        return np.atleast_2d(record.first_bounce)
    return np.stack([T.diagonal() for T in record.matrices])


def _times(shape: Any) -> str:
    return "" if shape is None else f"{shape[0]} x {shape[1]}"


def _camera(entry: dict[str, Any]) -> str:
    """The grid of a camera, where it is not that of the projector."""
    rows, columns = entry["shape"]
    given = entry["camera_grid"]
    if given is None or tuple(given) == tuple(entry["grid"] or ()):
        return "the same" if rows == columns else "not told"
    return _times(given)


def _range(limits: Any) -> str | None:
    return None if limits is None else f"{limits[0]:.4g} .. {limits[1]:.4g}"
