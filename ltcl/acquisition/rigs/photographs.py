# SPDX-License-Identifier: BSD-3-Clause
"""A camera's files: codes as the camera gave them, and what EXIF says of the exposure.

PNG, TIFF, JPEG, BMP and EXR hold codes, which are taken as they stand. Camera RAW is developed by rawpy
(LibRaw) without what depends on the picture or bends it: linear, no automatic brightness, no white balance,
no conversion of colours, no rotation, bilinear demosaicing. The sensor's black level stays (subtracting it
would clip noise); 65535 is the sensor's white level.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ltcl import checks, images
from ltcl.acquisition.rigs import exif, extras
from ltcl.acquisition.rigs.exif import Taken
from ltcl.errors import FileError
from ltcl.files import input_file

RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")
SUFFIXES = (*images.BITS, *RAW)
"""Extensions of photographs."""


class Photograph(NamedTuple):
    """Codes (H, W) or (H, W, 3), uint8, uint16 or float32, and what the camera noted."""

    codes: np.ndarray
    taken: Taken


def read(path: Path) -> Photograph:
    """Read a photograph whatever its kind.

    Raises
    ------
    FileError, MemoryLimitError
        Missing, empty, damaged, or no photograph; the file is named.
    AcquisitionError
        It is camera RAW, and rawpy is not installed.
    """
    input_file(path)
    if path.suffix.lower() in RAW:
        return _developed(path)
    codes = images.read_codes(path)
    if codes.dtype.kind == "f":
        with np.errstate(over="ignore"):
            codes = codes.astype(np.float32)
    try:
        return Photograph(codes, exif.read(path))
    except FileError as error:
        raise FileError(f"{path}: {error}") from error


def _developed(path: Path) -> Photograph:
    instead = ", or save the photographs as 16-bit TIFF"
    rawpy = extras.load("rawpy", "camera", f"{path}: camera RAW", instead)
    try:
        with rawpy.imread(str(path)) as raw:
            _check_fits(raw.sizes)
            return Photograph(_linear(rawpy, raw), _noted(raw.other))
    except (rawpy.LibRawError, rawpy.NotSupportedError, ValueError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise FileError(f"{path}: is no readable camera RAW file: {reason}") from error


def _check_fits(sizes: Any) -> None:
    # LibRaw holds the raw values, four colours while it works, and the result.
    checks.fits_host("developing the RAW file", sizes.raw_height * sizes.raw_width * (2 + 8 + 6))


def _linear(rawpy: Any, raw: Any) -> np.ndarray:
    return raw.postprocess(
        gamma=(1, 1),
        no_auto_bright=True,
        adjust_maximum_thr=0.0,  # else full scale follows the brightest pixel of each photograph
        user_wb=[1.0, 1.0, 1.0, 1.0],
        output_color=rawpy.ColorSpace.raw,
        output_bps=16,
        user_flip=0,
        user_black=0,
        user_cblack=[0, 0, 0, 0],
        demosaic_algorithm=rawpy.DemosaicAlgorithm.LINEAR,
    )


def _noted(other: Any) -> Taken:
    time = other.timestamp
    return Taken(exif.positive(other.shutter_speed), None if time is None else time.replace(tzinfo=None))
