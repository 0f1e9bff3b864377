# SPDX-License-Identifier: BSD-3-Clause
"""`ExportedScan`: what a scan tells of its projector, for files: the map, and the calibration.

A scan of one projector keeps its map. One of several projectors is on squares of camera pixels, and
the map to the projector's own pixels, m, stands beside it, as it was when it was scanned. After an
update the store has the squares s(p) whose light camera pixels p see now. With squares of n pixels
that light came to the camera pixel n (s + 1/2) - 1/2 then, so that the map is now

    m(n (s(p) + 1/2) - 1/2)
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ltcl.acquisition import Calibration, Correspondence, Project
from ltcl.acquisition.calibration import stored_map
from ltcl.acquisition.captures.map_file import read_map
from ltcl.acquisition.geometry import Resampling
from ltcl.acquisition.projectors.combined import facts_path, has_facts, read_facts
from ltcl.acquisition.projectors.warp import is_of_squares
from ltcl.acquisition.radiance import planes
from ltcl.acquisition.several import scanned_stores
from ltcl.errors import FileError, InputError
from ltcl.files import as_path
from ltcl.store import BlockStore

# Files of `ltcl acquire`, `ltcl acquire import` and `ltcl simulate` in a folder.
STORE = "transport.zarr"
PROJECT = "acquisition.toml"
MAP = "map.npz"


@dataclass(frozen=True, kw_only=True, eq=False)
class ExportedScan:
    """The parts of a scan that are exported.

    Attributes
    ----------
    path : Path
        The store, or the folder of imported photographs.
    name : str
        Name of the projector in files.
    mapping : Correspondence
        From the camera's pixels to those of the projector.
    resampling : Resampling
        By that map.
    calibration : Calibration or None
        None of imported photographs.
    """

    path: Path
    name: str
    mapping: Correspondence
    resampling: Resampling
    calibration: Calibration | None

    @property
    def store(self) -> Path | None:
        """The file of the transport; None if photographs were imported."""
        return None if self.calibration is None else self.path


def read_scans(paths: Sequence[str | os.PathLike[str]]) -> list[ExportedScan]:
    """Read scans of one camera, one for each projector.

    A scan is the store or the folder of `ltcl acquire run`, or the folder of `ltcl acquire import`;
    the folder of several projectors has one for each.

    FileError for other files; InputError if the cameras have different pixels, or a scan is given
    twice.
    """
    places: list[Path] = []
    for path in paths:
        places += _places(as_path(path, "path"))
    _check_once(places)
    scans: list[ExportedScan] = []
    for number, place in enumerate(places, 1):
        name = _name(place, number, [scan.name for scan in scans])
        scans.append(_read_scan(place, name))
    camera = scans[0].mapping.camera_grid
    for scan in scans:
        if scan.mapping.camera_grid != camera:
            raise InputError(
                f"{scan.path}: has a camera of {scan.mapping.camera_grid} pixels; it must be "
                f"{camera}, that of the first scan"
            )
    return scans


def _places(path: Path) -> list[Path]:
    """The stores of a folder of scans, or what was named."""
    if not (path / PROJECT).exists() or (path / MAP).is_file():
        return [path]
    if Project.open_all(path)[0].name:
        return scanned_stores(path)
    return [path / STORE]


def _check_once(places: Sequence[Path]) -> None:
    """Refuse a scan that is given twice, whose projector would take half of its own light."""
    known: set[Path] = set()
    for place in places:
        resolved = place.resolve()
        if resolved in known:
            raise InputError(f"SCAN {place} is given twice; each projector must be given once")
        known.add(resolved)


def _name(place: Path, number: int, taken: Sequence[str]) -> str:
    """The projector's name in its project, where it has one that is not taken."""
    if not has_facts(place):
        return f"projector_{number}"
    name = read_facts(place).name
    unused = name
    while unused in taken:
        unused = f"{name}_{number}"
        number += 1
    return unused


def _read_scan(path: Path, name: str) -> ExportedScan:
    if (path / MAP).is_file():
        mapping = read_map(path / MAP)
        return ExportedScan(
            path=path,
            name=name,
            mapping=mapping,
            resampling=Resampling.of(mapping),
            calibration=None,
        )
    if not path.is_dir():
        raise FileError(
            f"{path}: is no store of 'ltcl acquire run' and no folder of 'ltcl acquire import'; "
            "a scan must be one of them"
        )
    opened = BlockStore.open(path)
    calibration = Calibration.of(opened)
    mapping = stored_map(opened)
    resampling = calibration.resampling
    if has_facts(path):
        mapping = _own_map(path, mapping)
        resampling = Resampling.of(mapping).ascertained_by(planes(calibration.white, "value"))
    elif is_of_squares(mapping):
        raise FileError(
            f"{path}: has squares of camera pixels, as scans of several projectors; "
            f"{facts_path(path).name} and the map that it names, which tell the projector's own "
            "pixels, must stand beside it"
        )
    return ExportedScan(
        path=path, name=name, mapping=mapping, resampling=resampling, calibration=calibration
    )


def _own_map(path: Path, squares: Correspondence) -> Correspondence:
    """The map to the own pixels of one of several projectors, whose store has `squares`."""
    facts = read_facts(path)
    known = facts.view().mapping
    if known.camera_grid != squares.camera_grid:
        raise FileError(
            f"{facts_path(path)}: names a map of {known.camera_grid} camera pixels; the scan has "
            f"{squares.camera_grid}"
        )
    if is_of_squares(squares):
        return known
    column = (facts.side * (squares.x + 0.5) - 0.5).astype(np.float32)
    row = (facts.side * (squares.y + 0.5) - 0.5).astype(np.float32)
    x = cv2.remap(known.x, column, row, cv2.INTER_LINEAR, borderValue=np.nan)
    y = cv2.remap(known.y, column, row, cv2.INTER_LINEAR, borderValue=np.nan)
    is_known = squares.valid & np.isfinite(x) & np.isfinite(y)
    return Correspondence(x, y, is_known, known.grid)
