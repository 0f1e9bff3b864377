# SPDX-License-Identifier: BSD-3-Clause
"""Facts of a transport file that need no device: sizes, form of storage, first bounce, verdict."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.cli.reports.transports import FileFacts
from ltcl.errors import InputError
from ltcl.store import CombinedRecord, CompressedRecord, StoreRecord
from ltcl.store.record import CSR
from ltcl.transport import first_bounce
from ltcl.transport.noise import estimate
from ltcl.transport.transport import Transport
from ltcl.transport.verdict import Verdict, verdict

# Bytes of a transport beyond which only 'ltcl analyze' judges it.
MAX_JUDGED_BYTES = 1 << 28


def describe(
    file: Path, record: StoreRecord | CompressedRecord | CombinedRecord
) -> tuple[FileFacts, np.ndarray | None]:
    """Return facts of a transport, and F (channels, N); refuse what could not be loaded again."""
    if isinstance(record, CompressedRecord):
        return _describe_compressed(file, record)
    if isinstance(record, CombinedRecord):
        return _describe_combined(file, record), None
    F = _first_bounce(record)
    matrices: list[Any] = list(record.matrices)
    stored = "sparse"
    if record.dense:
        stored = "dense"
    elif record.stored:
        stored = "row blocks"
    facts = _facts(
        file,
        record,
        F,
        channels=len(matrices),
        stored=stored,
        dtype=str(matrices[0].dtype),
        entries=sum(map(_count_entries, matrices)),
        nbytes=sum(map(_count_bytes, matrices)),
        first_bounce_from="diagonal" if record.first_bounce is None else "file",
        solution_error=0.0,
    )
    return facts, F


def _describe_compressed(file: Path, record: CompressedRecord) -> tuple[FileFacts, np.ndarray]:
    """Describe a compressed transport without its operators, which need a device."""
    F = record.first_bounce
    kinds = ", ".join(record.kinds)
    facts = _facts(
        file,
        record,
        F,
        channels=len(F),
        # "compressed" or "inverse".
        stored=record.format.split("-")[1],
        dtype=f"{kinds}; error {checks.upwards(record.error)}",
        entries=record.entries,
        nbytes=record.nbytes,
        first_bounce_from="file",
        solution_error=record.error,
    )
    return facts, F


def _describe_combined(file: Path, record: CombinedRecord) -> FileFacts:
    """Describe several projectors: the sizes of all their matrices together."""
    matrices: list[Any] = []
    for member in record.members:
        _check_record(member)
        matrices.extend(member.matrices)
    return _facts(
        file,
        record,
        None,
        channels=len(record.members[0].matrices),
        stored="combined",
        dtype=str(matrices[0].dtype),
        entries=sum(map(_count_entries, matrices)),
        nbytes=sum(map(_count_bytes, matrices)),
        first_bounce_from="diagonal",
        solution_error=0.0,
    )


def _facts(
    file: Path,
    record: StoreRecord | CompressedRecord | CombinedRecord,
    F: np.ndarray | None,
    **facts_of_form: Any,
) -> FileFacts:
    """Add what all forms of storage share."""
    mixing = record.mixing
    first_bounce = None
    dark_pixels = None
    if F is not None:
        first_bounce = (float(F.min()), float(F.max()))
        dark_pixels = int(np.count_nonzero((F <= 0).any(axis=0)))
    return FileFacts(
        file=file,
        shape=record.shape,
        grid=record.grid,
        camera_grid=record.camera_grid,
        mixing=None if mixing is None else np.asarray(mixing).tolist(),
        first_bounce=first_bounce,
        dark_pixels=dark_pixels,
        **facts_of_form,
    )


def _count_entries(matrix: Any) -> int:
    if isinstance(matrix, np.ndarray):
        return int(np.count_nonzero(matrix))
    return int(matrix.nnz)


def _count_bytes(matrix: Any) -> int:
    if hasattr(matrix, "nbytes"):
        return int(matrix.nbytes)
    return sum(getattr(matrix, name).nbytes for name in CSR)


def _first_bounce(record: StoreRecord) -> np.ndarray | None:
    """Check a whole record; return F (channels, N), 0 where dark, or None if T is not square."""
    _check_record(record)
    rows, columns = record.shape
    if rows != columns:
        if record.first_bounce is not None:
            problem = f"first_bounce is given, but T is {record.shape}"
            raise InputError(f"{problem}; only a square T has one")
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
        entries = matrix if record.dense else matrix.data
        checks.finite("T", entries)


def judge(record: StoreRecord | CompressedRecord | CombinedRecord, facts: FileFacts) -> Verdict:
    """Judge a transport as far as this is cheap; else tell which command can."""
    if isinstance(record, CombinedRecord):
        count = len(record.members)
        return Verdict(f"Unknown: {count} projectors: run 'ltcl analyze {facts.file}'.")
    if isinstance(record, CompressedRecord):
        advice = "run 'ltcl analyze' on what it was made of"
        return Verdict(f"Unknown: stored as {facts.stored}: {advice}.")
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
    arguments = vars(record).items()
    arguments = {name: value for name, value in arguments if value is not None}
    matrices = arguments.pop("matrices")
    try:
        return verdict(Transport(matrices, **arguments))
    except InputError as error:
        # All pixels are dark.
        return Verdict(f"Not usable: {error}.", False, False)
