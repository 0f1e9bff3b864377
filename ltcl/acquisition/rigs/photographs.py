# SPDX-License-Identifier: BSD-3-Clause
"""A camera's files: codes as the camera stored them, and the exposure in their EXIF.

PNG, TIFF, JPEG, BMP and EXR hold codes, which are not changed. Camera RAW is developed by rawpy (LibRaw)
without what depends on the picture or bends it: linear, no automatic brightness, no white balance, no
conversion of colours, no rotation, bilinear demosaicing. The sensor's black level stays (subtracting it would
clip noise); 65535 is the sensor's white level.
"""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ltcl import checks, images
from ltcl.acquisition.rig import load_extra
from ltcl.errors import AcquisitionError, FileError, MemoryLimitError
from ltcl.files import input_file

RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")
SUFFIXES = (*images.BITS, *RAW)
"""Extensions of photographs."""
_FORMATS = {".jpg": "JPEG", ".jpeg": "JPEG", ".png": "PNG", ".tif": "TIFF", ".tiff": "TIFF"}
_EXIF, _EXPOSURE = 34665, 33434  # tags of EXIF 2.32
_ROUNDING = 0.05  # EXIF holds nominal values, 1/30 s for 1/32 s; neighbouring thirds of a stop differ by 26 %


def photograph(name: str, path: Path, channels: int, seconds: float | None) -> np.ndarray:
    """The codes of a file for a rig of so many channels, exposed for `seconds` as far as its EXIF says.

    One channel of a colour photograph is the green one: a sensor has the most pixels of it, and a mean of
    channels with different response curves would follow none. AcquisitionError begins with `name`.
    """
    try:
        codes, exposed = read(path)
    except (FileError, MemoryLimitError) as error:
        raise AcquisitionError(f"{name} cannot be used: {error}") from error
    if exposed is not None and seconds is not None and abs(exposed / seconds - 1.0) > _ROUNDING:
        raise AcquisitionError(f"{name} was exposed for {exposed:.4g} s by its EXIF, not {seconds:.4g} s")
    if codes.ndim == 2 and channels == 3:
        raise AcquisitionError(f"{name} is grey; a rig of three channels needs RGB")
    return np.ascontiguousarray(codes[..., 1]) if codes.ndim == 3 and channels == 1 else codes


def read(path: Path) -> tuple[np.ndarray, float | None]:
    """Codes (H, W) or (H, W, 3), uint8, uint16 or float32, and the seconds in the EXIF.

    FileError or MemoryLimitError name the file; AcquisitionError for camera RAW without rawpy.
    """
    input_file(path)
    if path.suffix.lower() in RAW:
        return _develop(path)
    codes = images.read_codes(path)
    if codes.dtype.kind == "f":
        with np.errstate(over="ignore"):
            codes = codes.astype(np.float32)
    return codes, _exposure(path)


def _develop(path: Path) -> tuple[np.ndarray, float | None]:
    rawpy = load_extra("rawpy", "camera", f"{path}: camera RAW", ", or save the photographs as 16-bit TIFF")
    try:
        with rawpy.imread(str(path)) as raw:
            # LibRaw holds the raw values, four colours while it works, and the result.
            checks.fits_host(
                "developing the RAW file", raw.sizes.raw_height * raw.sizes.raw_width * (2 + 8 + 6)
            )
            codes = raw.postprocess(
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
            return codes, _positive(raw.other.shutter_speed)
    except (rawpy.LibRawError, rawpy.NotSupportedError, ValueError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise FileError(f"{path}: is no readable camera RAW file: {reason}") from error


def _exposure(path: Path) -> float | None:
    """ExposureTime of a JPEG, PNG or TIFF; Pillow decodes no pixel for that."""
    kind = _FORMATS.get(path.suffix.lower())
    if kind is None:
        return None
    try:
        with warnings.catch_warnings(), path.open("rb") as file:
            warnings.simplefilter("ignore")  # damaged tags that are not read here, large pictures
            if kind == "TIFF":  # as a picture, Pillow would refuse float RGB
                exif = Image.Exif()
                exif.load_from_fp(file)
            else:
                exif = Image.open(file, formats=(kind,)).getexif()
            return _positive(({**exif, **exif.get_ifd(_EXIF)}).get(_EXPOSURE))
    except Exception as error:  # whatever hostile tags raise
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise FileError(f"{path}: has an EXIF header that cannot be read ({reason})") from error


def _positive(seconds: Any) -> float | None:
    try:
        value = float(seconds)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return value if math.isfinite(value) and value > 0 else None
