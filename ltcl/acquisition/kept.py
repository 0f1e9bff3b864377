# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of a calibration that has not ended, kept in a folder next to the store that is to be.

A calibration is committed as a whole, and what decides its next photograph are those before. So a run that
was stopped is run again from its start, with the photographs that are there, until it asks for a new one.
They are known by what was asked for: codes, seconds, and how often the same was asked for before.
"""

from __future__ import annotations

import contextlib
import json
import logging
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ltcl.acquisition.fingerprint import shot_key
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.settings import check_same_rig
from ltcl.errors import AcquisitionError, FileError
from ltcl.files import sweep
from ltcl.store.array_log import ArrayLog, locked

logger = logging.getLogger(__name__)
_RIG = "rig"  # the file that tells whose photographs they are


def place(store: Path) -> Path:
    """Where the photographs of a calibration for `store` are.

    >>> place(Path("T.zarr")).name
    'T.zarr.calibration'
    """
    return store.with_name(f"{store.name}.calibration")


def count(store: Path) -> int:
    """How many there are."""
    return sum(name.startswith("shot_") for name in ArrayLog(place(store)).names)


def busy(store: Path) -> bool:
    """Whether another process is at work on them."""
    if not place(store).is_dir():
        return False
    try:
        with locked(place(store), wait=False):
            return False
    except FileError:
        return True


def forget(store: Path) -> None:
    """Remove what a run that was killed after its calibration has left."""
    if _RIG in ArrayLog(place(store)).names:
        shutil.rmtree(place(store), ignore_errors=True)


@contextlib.contextmanager
def keeping(store: Path, shots: Shots) -> Iterator[None]:
    """Keep what is photographed in the block until it ends well, or use what is kept already.

    Whatever else ends the block, they stay; a rig with `keeps_photographs` does that itself.

    Raises
    ------
    InputError
        Those that are there are of another rig.
    FileError
        They cannot be written; another process is at work on them.
    """
    if getattr(shots.rig, "keeps_photographs", False):
        yield
        return
    log = ArrayLog(place(store))
    if not log.names:
        if log.path.exists() and any(log.path.iterdir()):
            raise FileError(f"{log.path}: is there, and was not made by ltcl; it will not be replaced")
        log.put(_RIG, json=np.array(json.dumps(shots.describe()["rig"], default=str)))
    with locked(log.path, wait=False):
        sweep(log.path)
        check_same_rig(json.loads(str(log.get(_RIG)["json"])), shots, log.path)
        if count(store):
            logger.info("calibration: %d photographs of an earlier run are used again", count(store))
        shots.keeper = CalibrationCache(log, shots)
        try:
            yield
        except AcquisitionError:
            if not shots.asking:  # the rig gave them all, and they cannot be used
                logger.warning("%s keeps the photographs; remove it to take them anew", log.path)
            raise
        finally:
            shots.keeper = None
    forget(store)


class CalibrationCache:
    """Photographs in a log, by what was asked for."""

    def __init__(self, log: ArrayLog, shots: Shots) -> None:
        self._log, self._recall = log, getattr(shots.rig, "recall", None)
        self._asked: Counter[str] = Counter()

    def find(self, codes: np.ndarray, seconds: float) -> np.ndarray | None:
        """The next photograph of `codes` for `seconds`, as the rig gave it; its rig is told."""
        try:
            image = self._log.get(self._name(codes, seconds))["image"]
        except (FileError, KeyError):  # not there, or damaged: it is taken again
            return None
        if self._recall is not None:
            self._recall(codes, seconds, image)
        self._asked[shot_key(codes, seconds)] += 1
        return image

    def add(self, codes: np.ndarray, seconds: float, image: Any) -> None:
        """Commit what `find` did not find."""
        self._log.put(self._name(codes, seconds), image=image)
        self._asked[shot_key(codes, seconds)] += 1

    def _name(self, codes: np.ndarray, seconds: float) -> str:
        shot = shot_key(codes, seconds)
        return f"shot_{shot}_{self._asked[shot]}"
