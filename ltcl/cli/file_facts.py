# SPDX-License-Identifier: BSD-3-Clause
"""Facts of a transport file that need no device: sizes, form of storage, first bounce, verdict."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.cli.reports.transports import FileFacts
from ltcl.errors import InputError
from ltcl.store import CompressedRecord, StoreRecord
from ltcl.store.record import CSR
from ltcl.transport import first_bounce
from ltcl.transport.noise import estimate
from ltcl.transport.transport import Transport
from ltcl.transport.verdict import Verdict, verdict

# Bytes of a transport beyond which only 'ltcl analyze' judges it.
MAX_JUDGED_BYTES = 1 << 28


def describe(
    file: Path, record: StoreRecord | CompressedRecord
) -> tuple[FileFacts, np.ndarray | None]:
    """Return facts of a transport, and F (channels, N); refuse what could not be loaded again."""
    if isinstance(record, CompressedRecord):
        return _describe_compressed(file, record)
    F = _first_bounce(record)
    matrices: list[Any] = list(record.matrices)
    stored = "sparse"
    if record.dense:
        stored = "dense"
    elif record.stored:
        stored = "row blocks"
    facts = FileFacts(
        file=file,
        shape=record.shape,
        grid=record.grid,
        camera_grid=record.camera_grid,
        mixing=_mixing(record),
        channels=_channels(len(matrices)),
        stored=stored,
        dtype=str(matrices[0].dtype),
        entries=sum(map(_count_entries, matrices)),
        nbytes=sum(map(_count_bytes, matrices)),
        first_bounce_from="diagonal" if record.first_bounce is None else "file",
        solution_error=0.0,
        first_bounce=_interval(F),
        dark_pixels=_count_dark(F),
    )
    return facts, F


def _describe_compressed(file: Path, record: CompressedRecord) -> tuple[FileFacts, np.ndarray]:
    """Describe a compressed transport without its operators, which need a device."""
    F = record.first_bounce
    kinds = ", ".join(record.kinds)
    facts = FileFacts(
        file=file,
        shape=record.shape,
        grid=record.grid,
        camera_grid=record.camera_grid,
        mixing=_mixing(record),
        channels=_channels(len(F)),
        stored=_stored_form(record),
        dtype=f"{kinds}; error {checks.upwards(record.error)}",
        entries=record.entries,
        nbytes=record.nbytes,
        first_bounce_from="file",
        solution_error=record.error,
        first_bounce=_interval(F),
        dark_pixels=_count_dark(F),
    )
    return facts, F


def _stored_form(record: CompressedRecord) -> Any:
    """Return "compressed" or "inverse"."""
    return record.format.split("-")[1]


def _channels(count: int) -> Any:
    return count


def _mixing(record: StoreRecord | CompressedRecord) -> Any:
    if record.mixing is None:
        return None
    return np.asarray(record.mixing).tolist()


def _count_entries(matrix: Any) -> int:
    if isinstance(matrix, np.ndarray):
        return int(np.count_nonzero(matrix))
    return int(matrix.nnz)


def _count_bytes(matrix: Any) -> int:
    if hasattr(matrix, "nbytes"):
        return int(matrix.nbytes)
    return sum(getattr(matrix, name).nbytes for name in CSR)


def _interval(F: np.ndarray | None) -> tuple[float, float] | None:
    if F is None:
        return None
    return float(F.min()), float(F.max())


def _count_dark(F: np.ndarray | None) -> int | None:
    if F is None:
        return None
    is_dark = (F <= 0).any(axis=0)
    return int(np.count_nonzero(is_dark))


def _first_bounce(record: StoreRecord) -> np.ndarray | None:
    """Check a whole record; return F (channels, N), 0 where dark, or None if T is not square."""
    _check_record(record)
    rows, columns = record.shape
    if rows != columns:
        if record.first_bounce is not None:
            raise InputError(
                f"first_bounce is given, but T is {record.shape}; only a square T has one"
            )
        return None
    matrices: list[Any] = list(record.matrices)
    F = record.first_bounce
    if F is None:
        F = np.stack([matrix.diagonal() for matrix in matrices])
    F = np.atleast_2d(checks.finite("first_bounce", F))

    def noise() -> Any:
        """Return the measured noise, or estimate it, which takes a while."""
        if record.noise is not None:
            return record.noise
        grid = record.grid or (1, columns)
        return estimate(matrices, grid, record.camera_grid or grid)

    rule = first_bounce.DarkRule(
        matrices=matrices,
        threshold=first_bounce.DARK_THRESHOLD,
        noise=noise,
        is_measured=record.noise is not None,
    )
    return np.where(rule.find_dark(F), 0.0, F)


def _check_record(record: StoreRecord) -> None:
    rows, columns = record.shape
    if record.grid is not None:
        checks.grid("grid", record.grid, columns)
    if record.camera_grid is not None:
        checks.grid("camera_grid", record.camera_grid, rows)
    if record.stored:
        # Blocks of a store are checked as they are read.
        return
    matrices: list[Any] = list(record.matrices)
    for matrix in matrices:
        checks.finite("T", matrix if record.dense else matrix.data)


def judge(record: StoreRecord | CompressedRecord, facts: FileFacts) -> Verdict:
    """Judge a transport as far as this is cheap; else tell which command can."""
    if isinstance(record, CompressedRecord):
        return Verdict(
            f"Unknown: stored as {facts.stored}: run 'ltcl analyze' on what it was made of."
        )
    is_square = record.shape[0] == record.shape[1]
    missing = ""
    if not record.grid:
        missing += " --grid HxW"
    if not is_square and not record.camera_grid:
        missing += " --camera-grid HxW"
    reason = ""
    if missing:
        reason = "the file does not contain the grid"
    elif facts.nbytes > MAX_JUDGED_BYTES:
        reason = "T takes more than 256 MiB"
    if reason:
        return Verdict(f"Unknown: {reason}: run 'ltcl analyze {facts.file}{missing}'.")
    arguments = {name: value for name, value in vars(record).items() if value is not None}
    matrices = arguments.pop("matrices")
    try:
        return verdict(Transport(matrices, **arguments))
    except InputError as error:
        # All pixels are dark.
        return Verdict(f"Not usable: {error}.", False, False)
