# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl info`: what transport files hold; needs no device."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.cli import console, options
from ltcl.store import Record, formats


def run(files: options.Matrices, json: options.Json = False) -> None:
    """Tell what transport files hold: size, channels, grid, entries, first bounce. Needs no device."""
    found = []
    with console.Steps(len(files)) as steps:
        for file in files:
            steps.item(str(file))
            record = formats.read(file)
            with formats.about(file):
                found.append(describe(file, record))
    if json:
        console.answer(found)
        return
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
                _times(entry["camera_grid"]) or "the same",
                f"{entry['stored']} {entry['dtype']}",
                entry["entries"],
                checks.size(entry["nbytes"]),
                _range(entry["first_bounce"]),
                entry["dark_pixels"],
            )
            for entry in found
        ],
    )


def describe(file: Path, record: Record) -> dict[str, Any]:
    """Facts about a transport file, in plain types."""
    parts = [_values(T) for T in record.matrices]
    for values in parts:
        checks.finite("T", values)
    F = _first_bounce(record)
    return {
        "file": str(file),
        "shape": record.shape,
        "channels": len(record.matrices),
        "grid": record.grid,
        "camera_grid": record.camera_grid,
        "stored": "dense" if record.dense else "sparse",
        "dtype": str(record.matrices[0].dtype),
        "entries": sum(int(np.count_nonzero(values)) if record.dense else values.size for values in parts),
        "nbytes": sum(_nbytes(T) for T in record.matrices),
        "first_bounce": None if F is None else (float(F.min()), float(F.max())),
        "first_bounce_from": "diagonal" if record.first_bounce is None else "file",
        "dark_pixels": None if F is None else int(np.count_nonzero((F <= 0).any(axis=0))),
    }


def _values(T: Any) -> np.ndarray:
    return T if isinstance(T, np.ndarray) else T.data


def _nbytes(T: Any) -> int:
    return T.nbytes if isinstance(T, np.ndarray) else T.data.nbytes + T.indices.nbytes + T.indptr.nbytes


def _first_bounce(record: Record) -> np.ndarray | None:
    """F, (channels, N): what the file says, else the diagonal; None where T is rectangular."""
    if record.shape[0] != record.shape[1]:
        return None
    if record.first_bounce is not None:
        return np.atleast_2d(record.first_bounce)
    return np.stack([T.diagonal() for T in record.matrices])


def _times(shape: Any) -> str:
    return "" if shape is None else f"{shape[0]} x {shape[1]}"


def _range(limits: Any) -> str | None:
    return None if limits is None else f"{limits[0]:.4g} .. {limits[1]:.4g}"
