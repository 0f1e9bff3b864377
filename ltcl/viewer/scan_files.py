# SPDX-License-Identifier: BSD-3-Clause
"""Files of an acquisition as they come: photographs by hand, of the calibration, or batches.

A rig that a person works by hand has all photographs in the folder. For other rigs those of the
calibration are there until it has ended; then come batches of the scan, columns of T or pictures of
an adaptive scan, in units of light.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import images
from ltcl.acquisition.rig import to_unit
from ltcl.acquisition.rigs.photographs import read_photograph
from ltcl.acquisition.rigs.shooting_list import Shot
from ltcl.acquisition.session import calibration_folder
from ltcl.store import ArrayLog, BlockStore

BATCH_PREFIX = "columns_0."
SMALLEST_LIGHT = 1e-30


@dataclass(frozen=True, kw_only=True)
class ScanFile:
    """A photograph, or a batch of a scan; one taken by hand has a `shot`."""

    path: Path
    # When the file was written.
    time: float
    number: int
    shot: Shot | None = None


@dataclass(frozen=True)
class StoredCamera:
    """The camera of photographs in a store, as far as they tell."""

    channels: int
    bits: int | None


def photographs_by_hand(rig: Any) -> Iterator[ScanFile]:
    """Yield the photographs of a folder rig by their numbers."""
    # It looks for the files.
    rig.missing()
    for shot in rig.shots:
        name = rig.file_name(shot.number)
        if name:
            path = rig.folder / "photographs" / name
            yield ScanFile(path=path, time=path.stat().st_mtime, number=shot.number, shot=shot)


def photographs_of_calibration(store: Path) -> Iterator[ScanFile]:
    """Yield the photographs of a calibration in the order in which they were taken."""
    paths = _sorted_by_time(calibration_folder(store).glob("shot_*.npz"))
    for number, (written, path) in enumerate(paths, 1):
        yield ScanFile(path=path, time=written, number=number)


def batches(store: BlockStore) -> Iterator[ScanFile]:
    """Yield the batches of a scan in the order in which they were written."""
    paths = _sorted_by_time((store.path / "log").glob(f"{BATCH_PREFIX}*.npz"))
    for written, path in paths:
        number = int(path.stem.removeprefix(BATCH_PREFIX))
        yield ScanFile(path=path, time=written, number=number)


def _sorted_by_time(paths: Iterator[Path]) -> list[tuple[float, Path]]:
    return sorted((path.stat().st_mtime, path) for path in paths)


class PhotographReader:
    """Reads photographs in [0, 1] of full scale; all must be of one shape and type."""

    def __init__(self, bits: int | None) -> None:
        self._bits = bits
        self._format: Any = None

    def read(self, name: str, file: ScanFile, rig: Any) -> np.ndarray:
        """Read a photograph taken by hand or of a calibration; AcquisitionError as in `acquire`."""
        if file.shot is None:
            image = ArrayLog(file.path.parent).get(file.path.stem)["image"]
            channels = 1 if image.ndim == 2 else 3
            camera: Any = StoredCamera(channels, self._bits)
        else:
            camera = rig
            image = read_photograph(name, file.path, camera.channels, file.shot.seconds)
        codes = to_unit(name, image, camera, self._format)
        self._format = (image.shape, image.dtype)
        return codes


def read_batch(store: BlockStore, number: int) -> np.ndarray:
    """Read the light of a batch as a picture in sRGB, the brightest pixel at 1."""
    light = store.block(0, number).matrix.sum(axis=0)
    grid = store.layout.camera_grid
    if grid is None:
        grid = store.layout.grid
    light = np.reshape(light, grid)
    return images.to_srgb(light / max(light.max(), SMALLEST_LIGHT))
