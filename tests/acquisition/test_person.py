# SPDX-License-Identifier: BSD-3-Clause
"""A person takes the photographs of a scan, in rounds, and makes mistakes; `acquire` with a `FolderRig`."""

from __future__ import annotations

import csv
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl import images
from ltcl.acquisition import FolderRig, VirtualRig, acquire
from ltcl.acquisition.radiometry import Response
from ltcl.errors import AcquisitionError, PhotographMissing
from ltcl.store import BlockStore

from .rigs import camera_files

GRID = (4, 8)
SETTINGS: dict[str, Any] = {
    "geometry": "aligned",
    "strategy": "pixel",
    "frames": 2,
    "response": Response(np.array([[-0.004 / 0.996, 1.0]])),  # of a camera with an offset of 0.4 %
    "exposures": [0.5, 8.0],
}


def scan(folder: Path, store: Path, **options: Any) -> np.ndarray:
    """T, (N, N) float64."""
    T = acquire(FolderRig(folder, GRID), **SETTINGS, store=store, **options)
    return T.matrices[0].tocsr().toarray().astype(np.float64)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A folder with all that a person photographed for a scan, and the T that came of it."""
    root = tmp_path_factory.mktemp("session")
    truth = ltcl.scenes.dihedral(4, albedo=0.6).transport().matrices[0]
    lit = VirtualRig(truth, GRID, ambient=0.01, response="linear")
    for _ in range(30):
        try:
            T = scan(root / "photos", root / "T.zarr")
        except PhotographMissing:
            photograph(lit, root / "photos")
        else:
            unit = np.sum(truth @ np.ones(32)) / np.sum(T)
            assert np.linalg.norm(unit * T - truth) < 0.05 * np.linalg.norm(truth)
            assert FolderRig(root / "photos", GRID).missing() == ()  # no number is left over
            return root / "photos", T
    raise AssertionError("the list of photographs has no end")


def photograph(lit: VirtualRig, folder: Path) -> None:
    """What is on the list and not there yet: 8 bits, with EXIF."""
    with (folder / "shots.csv").open(encoding="utf-8", newline="") as file:
        for shot in csv.DictReader(file):
            path, seconds = folder / f"{shot['save as']}.png", float(shot["seconds"])
            if not path.exists():
                codes = images.read_codes(folder / shot["project"]) / np.float32(255)
                camera_files.write(path, lit.photograph(codes, seconds), seconds)


def stop(step: str, done: int, total: int) -> None:
    if step == "scan":
        raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("swaps", "text"),
    [
        ([], r"photograph {0} is missing .*project patterns/pattern_"),
        ([(0, 3)], r"photograph {0} \(photo_{0:06}\.png\) was exposed for"),
        ([(0, 2)], r"({0}|{1}) \(photo_.*({2}|{3}) \(photo_"),  # of two patterns, for the same seconds
        ([(0, 2), (1, 3)], r"{0} .* {1} .* {2} .* {3} "),  # two patterns
    ],
)
def test_a_bad_photograph_is_named_by_its_file(
    session: tuple[Path, np.ndarray], tmp_path: Path, swaps: list[tuple[int, int]], text: str
) -> None:
    """The calibration was committed in an earlier session. Put right, the scan goes on where it was."""
    folder, store = Path(shutil.copytree(session[0], tmp_path / "photos")), tmp_path / "T.zarr"
    with pytest.raises(KeyboardInterrupt):
        scan(folder, store, progress=stop)
    first = len(list((folder / "photographs").iterdir())) - 6  # before the pattern of blocks
    paths = [folder / f"photographs/photo_{first + k:06}.png" for k in range(4)]
    for a, b in swaps:
        content = paths[a].read_bytes()
        shutil.copy(paths[b], paths[a])
        paths[b].write_bytes(content)
    if not swaps:
        paths[0].unlink()
    with pytest.raises(AcquisitionError, match=text.format(*range(first, first + 4))) as error:
        scan(folder, store)
    assert "\n" not in str(error.value)
    assert BlockStore.open(store).written
    shutil.copytree(session[0] / "photographs", folder / "photographs", dirs_exist_ok=True)
    np.testing.assert_array_equal(scan(folder, store), session[1])
