# SPDX-License-Identifier: BSD-3-Clause
"""A person takes the photographs of a scan, in rounds, and makes mistakes; `acquire` with a `FolderRig`."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ltcl.acquisition import FolderRig, VirtualRig, acquire
from ltcl.errors import AcquisitionError, LtclError, PhotographMissing
from ltcl.store import BlockStore

from .rigs import camera_files
from .scanning.helpers import corner, off, rig
from .stopping import LINE
from .test_bad_input import refused

GIVEN: dict[str, Any] = {
    "geometry": "aligned",
    "strategy": "pixel",
    "frames": 2,
    "response": LINE,
    "exposures": [0.5, 8.0],
}


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A folder with all that a person photographed for a scan, and T."""
    root = tmp_path_factory.mktemp("session")
    lit = rig(4, response="linear", bits=8)
    for _ in range(30):
        try:
            T = acquire(FolderRig(root / "photos", (4, 8), 1), **GIVEN, store=root / "T.zarr")
        except PhotographMissing:
            _photograph(lit, root / "photos")
        else:
            return root / "photos", T.matrices[0].tocsr().toarray()
    raise AssertionError("the list of photographs has no end")


def _photograph(lit: VirtualRig, folder: Path) -> None:
    """What is on the list and not there yet: 8 bits, with EXIF, a photograph a second."""
    noon = datetime(2026, 3, 1, 12)
    for row in (folder / "shots.csv").read_text().splitlines()[1:]:
        number, pattern, seconds, save = row.split(",")
        target = folder / f"{save}.png"
        if not target.exists():
            codes = np.asarray(cv2.imread(str(folder / pattern), cv2.IMREAD_UNCHANGED), np.float32) / 255
            taken = (noon + timedelta(seconds=int(number))).strftime("%Y:%m:%d %H:%M:%S")
            camera_files.write(target, lit.photograph(codes, float(seconds)), float(seconds), taken)


def test_all_is_photographed_once(session: tuple[Path, np.ndarray]) -> None:
    """Patterns out, photographs in; no number is left over, and T is what was in view."""
    folder, T = session
    assert FolderRig(folder, (4, 8), 1).missing() == ()
    assert off(T.astype(np.float64), corner(4), (4, 8)) < 0.05


def test_what_is_mixed_up_in_a_later_session_is_named_by_its_file(
    session: tuple[Path, np.ndarray], tmp_path: Path
) -> None:
    """Without times in the files; the calibration was committed in the session before."""
    folder, store = shutil.copytree(session[0], tmp_path / "photos"), tmp_path / "T.zarr"

    def acquired(progress: Any = None) -> None:
        acquire(FolderRig(folder, (4, 8), 1), **GIVEN, store=store, progress=progress)

    def stop(step: str, done: int, total: int) -> None:
        if step == "scan":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        acquired(stop)
    last = len(list((folder / "photographs").iterdir()))  # of the pattern of blocks
    photo = {k: folder / f"photographs/photo_{last - k:06d}.png" for k in range(1, 7)}
    swapped(photo[6], photo[4])  # of two patterns, for the same seconds
    with pytest.raises(
        AcquisitionError, match=rf"({last - 6}|{last - 5}) \(photo_.*({last - 4}|{last - 3}) \(photo_"
    ):
        acquired()
    swapped(photo[5], photo[3])
    with pytest.raises(AcquisitionError, match=rf"{last - 6} to {last - 5} .* {last - 4} to {last - 3}"):
        acquired()


def smaller(path: Path, other: Path) -> None:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    path.unlink()
    cv2.imwrite(str(path), np.asarray(image)[:2])


def swapped(path: Path, other: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(other.read_bytes())
    other.write_bytes(content)


def torn(path: Path, other: Path) -> None:
    path.write_bytes(path.read_bytes()[:40])


def linked_out(path: Path, other: Path) -> None:
    outside = path.parents[2] / "outside.png"
    path.rename(outside)
    path.symlink_to(outside)


def twice(path: Path, other: Path) -> None:
    shutil.copy(path, path.with_suffix(".tif"))


@pytest.mark.parametrize(
    ("spoil", "text"),
    [
        (smaller, r"photograph {n} \(photo_{n:06}\.png\) is uint8 \(2, 8\); it must be uint8 \(4, 8\)"),
        (swapped, r"photograph {n} .*was exposed for"),
        (torn, r"photograph {n} \(photo_{n:06}\.png\) cannot be used: "),
        (linked_out, r"photograph {n} cannot be used: .*leads out of the folder"),
        (twice, r"photograph {n} is there as photo_{n:06}\.png and photo_{n:06}\.tif; keep one"),
        (lambda path, other: path.unlink(), r"photograph {n} is missing: project patterns/pattern_"),
        (lambda path, other: path.write_bytes(b""), r"photograph {n} .*empty"),
    ],
)
def test_a_folder_with_a_bad_photograph(
    session: tuple[Path, np.ndarray], tmp_path: Path, spoil: Callable[[Path, Path], None], text: str
) -> None:
    """In the second batch of the scan. It is named; put right, the scan goes on where it was."""
    folder, whole = session
    copy = Path(shutil.copytree(folder, tmp_path / "photos"))
    photographs = copy / "photographs"
    number = len(list(photographs.iterdir())) - 10
    path = photographs / f"photo_{number:06}.png"
    spoil(path, photographs / f"photo_{number + 3:06}.png")
    store = tmp_path / "T.zarr"
    refused(AcquisitionError, text.format(n=number), FolderRig(copy, (4, 8), 1), **GIVEN, store=store)
    committed = BlockStore.open(store).written
    assert committed
    shutil.rmtree(photographs)
    shutil.copytree(folder / "photographs", photographs)
    T = acquire(FolderRig(copy, (4, 8), 1), **GIVEN, store=store)
    np.testing.assert_array_equal(T.matrices[0].tocsr().toarray(), whole)


def test_a_folder_that_leads_elsewhere(session: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    copy, outside = Path(shutil.copytree(session[0], tmp_path / "photos")), tmp_path / "outside"
    (copy / "photographs").rename(outside)
    (copy / "photographs").symlink_to("../outside")
    refused(LtclError, "leads out of the folder", FolderRig(copy, (4, 8), 1), **GIVEN)
