# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of a calibration that has not ended, kept beside the store that is to be.

A calibration is committed as a whole, and what decides its next photograph are those before. So a run that
was stopped is run again from its start, with the photographs that are there, until it asks for a new one.
They are known by what was asked for: codes, seconds, and how often the same was asked for before.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ltcl.acquisition import unchanged
from ltcl.acquisition.rig import Shots
from ltcl.errors import AcquisitionError
from ltcl.store.blocks import aside, shelf
from ltcl.store.blocks.shelf import Shelf

logger = logging.getLogger(__name__)


def place(store: Path) -> Path:
    """Where the photographs of a calibration for `store` are.

    >>> place(Path("T.zarr")).name
    'T.zarr.calibration'
    """
    return store.with_name(f"{store.name}.calibration")


def count(store: Path) -> int:
    """How many there are."""
    folder = place(store)
    return len(aside.versions(folder, "extra")) if (folder / "extra").is_dir() else 0


def busy(store: Path) -> bool:
    """Whether another process is at work on them."""
    folder = place(store) / "extra"
    if not folder.is_dir():
        return False
    lock = aside.try_lock(folder)
    if lock is not None and lock >= 0:
        os.close(lock)
    return lock is None


def forget(store: Path) -> None:
    """Take away what a run that was killed behind its calibration has left."""
    shelf.remove(place(store))


@contextlib.contextmanager
def keeping(store: Path, shots: Shots) -> Iterator[None]:
    """Keep what is photographed in the block until it ends well, or find what is kept already.

    They go as well where it ends in an AcquisitionError that is not the rig's: then they show something that
    cannot be used, and would show it again. A rig with `keeps_photographs` does that itself.

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
    with Shelf(place(store), {"rig": shots.describe()["rig"]}) as kept:
        unchanged.refuse_other_rig(kept.about.get("rig"), shots, kept.path)
        if kept.names:
            logger.info("calibration: %d photographs of an earlier run are used again", len(kept.names))
        shots.keeper = Keeper(kept, shots)
        try:
            yield
        except AcquisitionError:
            if not shots.asking:
                kept.remove()
            raise
        finally:
            shots.keeper = None
        kept.remove()


class Keeper:
    """Photographs on a shelf: the one that is asked for, or the place for it."""

    def __init__(self, kept: Shelf, shots: Shots) -> None:
        self._kept, self._recall = kept, getattr(shots.rig, "recall", None)
        self._asked: Counter[str] = Counter()

    def find(self, codes: np.ndarray, seconds: float) -> np.ndarray | None:
        """The next photograph of `codes` for `seconds`, as the rig gave it; its rig is told."""
        image = self._kept.get(self._name(codes, seconds))
        if image is not None:
            if self._recall is not None:
                self._recall(codes, seconds, image)
            self._asked[_shot(codes, seconds)] += 1
        return image

    def add(self, codes: np.ndarray, seconds: float, image: np.ndarray) -> None:
        """Commit what `find` did not find."""
        self._kept.put(self._name(codes, seconds), image)
        self._asked[_shot(codes, seconds)] += 1

    def _name(self, codes: np.ndarray, seconds: float) -> str:
        shot = _shot(codes, seconds)
        return f"shot_{shot}_{self._asked[shot]}"


def _shot(codes: np.ndarray, seconds: float) -> str:
    told = repr(codes.shape).encode() + codes.tobytes() + struct.pack("<d", seconds)
    return hashlib.blake2b(told, digest_size=16).hexdigest()
