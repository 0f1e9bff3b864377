# SPDX-License-Identifier: BSD-3-Clause
"""`finalize`: the transport of a store whose photographs are all taken, without the rig that took them."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from ltcl.acquisition import task
from ltcl.acquisition.calibrate import Progress
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.settings import Settings
from ltcl.errors import AcquisitionError, FileError
from ltcl.store import BlockStore


def finalize(store: str | os.PathLike[str], progress: Progress | None = None) -> None:
    """Make the transport from the photographs in a store; nothing happens where that was done before.

    `progress` is that of `ltcl.acquire`. FileError for a store that is missing, damaged or not made by
    `ltcl.acquire`; AcquisitionError where photographs are missing.

    Examples
    --------
    >>> import tempfile, ltcl
    >>> from ltcl.acquisition import VirtualRig
    >>> rig, store = VirtualRig(np.eye(64) / 2, (8, 8), bits=12), f"{tempfile.mkdtemp()}/T.zarr"
    >>> T = ltcl.acquire(rig, geometry="aligned", strategy="pixel", store=store)
    >>> finalize(store)
    """
    scan = BlockStore.open(store, "a")
    if "strategy" not in scan.attributes:
        state = "holds no whole calibration" if "acquisition" in scan.provenance else "is not of ltcl.acquire"
        raise FileError(f"{scan.path}: {state}; a transport cannot be made of it")
    if scan.final:
        return
    missing = {batch for _, batch in scan.missing("columns")}
    if missing and scan.attributes["strategy"] != "adaptive":  # which has room for more than it asks for
        batches = f"{len(missing)} of {scan.layout.blocks('columns')} batches of patterns"
        raise AcquisitionError(f"{scan.path}: {batches} are not photographed")
    settings = scan.attributes["settings"]
    times = settings["exposures"] and tuple(settings["exposures"])
    rig: Any = _NoRig(Calibration.of(scan).resampling.grid, scan.layout.channels)
    try:
        task.scan(scan, Shots(rig), Settings(**settings | {"exposures": times}), progress or _silent)
    except AcquisitionError as error:
        raise AcquisitionError(f"{scan.path}: {error}") from error


def _silent(step: str, done: int, total: int) -> None:
    """No progress."""


class _NoRig:
    """In place of the rig that took the photographs: an adaptive scan may ask for more of them."""

    def __init__(self, grid: tuple[int, int], channels: int) -> None:
        self.projector_grid, self.channels = grid, channels

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        """Refused."""
        raise AcquisitionError("the next batch of patterns is not photographed")
