# SPDX-License-Identifier: BSD-3-Clause
"""Files as cameras write them: JPEG, PNG and TIFF with EXIF, a small DNG; a shooting list."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.TiffImagePlugin import IFDRational, ImageFileDirectory_v2


def shooting_list(folder: Path) -> list[dict[str, str]]:
    with (folder / "shots.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def write(path: Path, codes: np.ndarray, seconds: float | None = None) -> None:
    """Save uint8 codes, with EXIF where `seconds` are known."""
    exif = Image.Exif()
    exif[271] = "ltcl"  # Pillow saves none without a main tag
    if seconds is not None:
        exif.get_ifd(0x8769)[33434] = IFDRational(round(seconds * 10**6), 10**6)
        exif[0x8769] = (
            0  # its place, which Pillow fills in; without it a TIFF would lack the inner tags
        )
    Image.fromarray(codes).save(path, exif=exif, quality=100, subsampling=0)


def write_dng(path: Path, raw: np.ndarray, seconds: float, **sides: int) -> None:
    """Save raw values (h, w) of 12 bits under a red-green-green-blue filter as DNG 1.4."""
    h, w = raw.shape
    tags = {
        256: sides.get("w", w),
        257: sides.get("h", h),
        258: 16,
        259: 1,  # no compression
        262: sides.get("photometric", 32803),  # a colour filter array
        273: 0,  # Pillow adds the length of the directory
        274: 6,  # held upright: must not turn the pixels
        279: 2 * h * w,
        33421: (2, 2),
        33422: bytes([0, 1, 1, 2]),
        33434: IFDRational(round(seconds * 1e6), 10**6),
        50706: bytes([1, 4, 0, 0]),
        50708: "ltcl test",
        50714: 256,
        50717: 4095,
        # White balance, must not be applied.
        50728: (
            IFDRational(1, 2),
            IFDRational(1),
            IFDRational(1, 3),
        ),
    }
    directory = ImageFileDirectory_v2()
    for tag, value in tags.items():
        directory[tag] = value
    with path.open("wb") as file:
        directory.save(file)
        file.write(raw.astype("<u2").tobytes())
