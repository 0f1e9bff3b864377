# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of a memory card come in the order in which they were taken, or are refused."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ltcl.acquisition import FolderRig
from ltcl.errors import InputError

# Name, EXIF time (whole seconds, or with a fraction; None for none), and date of the file.
CardFile = tuple[str, float | None, float]


def write_card(folder: Path, files: list[CardFile]) -> list[Path]:
    """Files of one grey each, which rises in the order of the list."""
    paths = []
    for k, (name, time, date) in enumerate(files):
        path = folder / name
        exif = Image.Exif()
        if time is not None:
            exif.get_ifd(0x8769)[0x9003] = f"2024:05:01 12:00:{int(time):02d}"
            if time % 1:
                exif.get_ifd(0x8769)[0x9291] = f"{round(100 * (time % 1)):02d}"
        image = Image.fromarray(np.full((4, 4), 10 * k, np.uint8))
        image.save(path, exif=exif, quality=100)
        os.utime(path, (date, date))
        paths.append(path)
    return paths


def rig_for(folder: Path, count: int) -> FolderRig:
    rig = FolderRig(folder, (1, 1))
    rig.prepare([([[1.0]], 1.0 + k) for k in range(count)])
    return rig


def greys(rig: FolderRig, count: int) -> list[int]:
    photographs = [rig.photograph([[1.0]], 1.0 + k) for k in range(count)]
    return [int(np.round(photograph.mean())) for photograph in photographs]


KNOWN: dict[str, list[CardFile]] = {
    "numbers alone": [("IMG_9.png", None, 9), ("IMG_10.png", None, 8), ("IMG_100.png", None, 7)],
    "times agree": [("a_3.jpg", 3, 0), ("a_4.jpg", 3, 0), ("a_5.jpg", 5, 0)],
    "the counter began again": [
        ("DSC_9998.jpg", 1, 0),
        ("DSC_9999.jpg", 2, 0),
        ("DSC_0001.jpg", 2, 0),
        ("DSC_0002.jpg", 3, 0),
    ],
    "within a second": [
        ("IMG_9999.jpg", 7.25, 0),
        ("IMG_0001.jpg", 7.5, 0),
        ("IMG_0002.jpg", 7.75, 0),
    ],
    "dates of files": [
        ("_MG_9999.png", None, 1e9),
        ("_MG_0001.png", None, 1e9 + 2),
        ("_MG_0002.png", None, 1e9 + 4),
    ],
    "dates, all in one second": [("P9999.jpg", 4, 1e9), ("P0001.jpg", 4, 1e9 + 2)],
    "the counter was reset": [
        ("IMG_0412.jpg", 1, 0),
        ("IMG_0413.jpg", 2, 0),
        ("IMG_0001.jpg", 3, 0),
    ],
    "names without numbers": [("c.jpg", 1, 0), ("a.jpg", 2, 0), ("b.jpg", 3, 0)],
    "copied dates": [("IMG_7.png", None, 3), ("IMG_8.png", None, 1), ("IMG_9.png", None, 2)],
}
UNKNOWN: dict[str, list[CardFile]] = {
    "no times": [("IMG_9999.png", None, 5), ("IMG_0001.png", None, 5)],
    "dates of a copy": [("IMG_9999.png", None, 6), ("IMG_0001.png", None, 5)],
    "times contradict": [
        ("a1.jpg", 2, 0),
        ("a2.jpg", 1, 0),
        ("a3.jpg", 2, 0),
        ("a4.jpg", 1, 0),
    ],
}


@pytest.mark.parametrize("files", KNOWN.values(), ids=KNOWN)
@pytest.mark.parametrize("seed", [0, 1])
def test_photographs_come_in_the_order_of_capture(
    tmp_path: Path, files: list[CardFile], seed: int
) -> None:
    card = tmp_path / "card"
    card.mkdir()
    paths = write_card(card, files)
    rig = rig_for(tmp_path / "scan", len(files))
    rig.take(np.random.default_rng(seed).permutation(np.array(paths)))
    assert greys(rig, len(files)) == [10 * k for k in range(len(files))]


@pytest.mark.parametrize("files", UNKNOWN.values(), ids=UNKNOWN)
def test_an_unknown_order_is_refused(tmp_path: Path, files: list[CardFile]) -> None:
    card = tmp_path / "card"
    card.mkdir()
    paths = write_card(card, files)
    rig = rig_for(tmp_path / "scan", len(files))
    with pytest.raises(InputError, match=paths[0].name):
        rig.take(paths)
    assert len(rig.missing()) == len(files)


def test_files_of_an_earlier_round_are_left_out(tmp_path: Path) -> None:
    """The card keeps what was copied, and the counter begins again in the second round."""
    card = tmp_path / "card"
    card.mkdir()
    files: list[CardFile] = [
        (f"IMG_{number:04d}.jpg", k, 0) for k, number in enumerate((9998, 9999, 1))
    ]
    paths = write_card(card, files)
    rig = rig_for(tmp_path / "scan", 2)
    rig.take(paths[:2])
    rig.prepare([([[1.0]], 3.0), ([[1.0]], 4.0)])
    twin = card / "IMG_0002.jpg"
    shutil.copyfile(paths[0], twin)  # EXIF of the first: taken at the same time
    with pytest.raises(InputError, match="files holds 1 new"):
        rig.take(paths)
    assert greys(rig, 2) == [0, 10]
