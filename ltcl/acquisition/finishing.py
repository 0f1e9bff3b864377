# SPDX-License-Identifier: BSD-3-Clause
"""`finalize`: the transport of a store whose photographs are all taken, without the rig that took them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from ltcl.acquisition import run
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.run import Progress
from ltcl.acquisition.settings import Settings
from ltcl.errors import AcquisitionError, FileError
from ltcl.files import as_path
from ltcl.store import BlockStore


def finalize(store: str | os.PathLike[str], progress: Progress | None = None) -> None:
    """Make the transport from the photographs in a store; nothing happens where that was done before.

    Parameters
    ----------
    store : path
        Of `ltcl.acquire`.
    progress : function of two ints, optional
        As in `ltcl.acquire`.

    Raises
    ------
    FileError
        There is no such store, it is damaged, or was not made by `ltcl.acquire`.
    AcquisitionError
        Photographs are missing; how many batches of patterns, where that is known.

    Examples
    --------
    >>> import tempfile, ltcl
    >>> from ltcl.acquisition import VirtualRig
    >>> rig, store = VirtualRig(np.eye(64) / 2, (8, 8), bits=12), f"{tempfile.mkdtemp()}/T.zarr"
    >>> T = ltcl.acquire(rig, geometry="aligned", strategy="pixel", store=store)
    >>> finalize(store)
    """
    path = as_path(store)
    found = BlockStore.open(path, "a")
    if "strategy" not in found.attributes:
        state = (
            "holds no whole calibration" if "acquisition" in found.provenance else "is not of ltcl.acquire"
        )
        raise FileError(f"{path}: {state}; nothing can be made of it")
    if found.final:
        return
    missing = {batch for _, batch in found.missing("columns")}
    every = found.layout.blocks("columns")
    if missing and found.attributes["strategy"] != "adaptive":  # which has room for more than it asks for
        raise AcquisitionError(f"{path}: {len(missing)} of {every} batches of patterns are not photographed")
    made = found.attributes["settings"]
    times = made["exposures"]
    wanted = Settings(**made | {"exposures": None if times is None else tuple(times)})
    told = Calibration.of(found)
    absent: Any = _Absent(path, told.resampling.grid, found.layout.channels)
    run.scan(run.resumed(found, Shots(absent), wanted), progress or (lambda done, total: None))


class _Absent:
    """In the place of the rig that took the photographs."""

    def __init__(self, path: Path, grid: tuple[int, int], channels: int) -> None:
        self.projector_grid, self.channels, self._path = grid, channels, path

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        """An adaptive scan does not know how many more it will ask for."""
        raise AcquisitionError(f"{self._path}: the next batch of patterns is not photographed")
