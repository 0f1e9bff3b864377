# SPDX-License-Identifier: BSD-3-Clause
"""Photographs as files of a camera: their codes, unchanged, and the exposure in their header.

Camera RAW (extra `camera`) is developed to linear codes of 16 bits, of which nothing is automatic;
other files are decoded as `ltcl.images.read_codes` does.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from PIL import Image, UnidentifiedImageError

from ltcl import checks, images
from ltcl.errors import AcquisitionError, FileError, MemoryLimitError
from ltcl.files import input_file

T = TypeVar("T")

RAW_SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")
PHOTOGRAPH_SUFFIXES = (*images.BITS, *RAW_SUFFIXES)

# The same kinds of files in words.
PHOTOGRAPH_KINDS = "camera RAW, TIFF, PNG, EXR, BMP or JPEG"

# Full scale of floats, with what rounding adds.
MAX_FLOAT_CODE = 1.001

# Share of pixels that may be above full scale: defects.
MAX_DEFECT_SHARE = 0.01

# Tags of EXIF 2.32.
EXIF_IFD_TAG = 34665
EXPOSURE_TIME_TAG = 33434

# EXIF holds nominal values, 1/30 s for 1/32 s; neighbouring thirds of a stop differ by 26 %.
EXPOSURE_TOLERANCE = 0.05


def read_photograph(
    name: str,
    path: Path,
    channels: int,
    seconds: float | None,
    white_level: float | None = None,
) -> np.ndarray:
    """Codes of a file, for a rig of 1 or 3 channels.

    One channel of a colour photograph is the green one: a mean of channels with different response
    curves would follow none. AcquisitionError, which begins with `name`, for a file that cannot be
    used, or was not exposed for `seconds` by its EXIF.
    """
    codes, exposure = _read_with_exposure(name, path)
    if seconds is not None:
        _check_exposure(name, exposure, seconds)
    is_float = codes.dtype.kind == "f"
    is_unscaled = is_float and white_level is None
    if is_unscaled and np.mean(codes > MAX_FLOAT_CODE) > MAX_DEFECT_SHARE:
        raise AcquisitionError(
            f"{name} reaches {codes.max():.4g}; full scale of float photographs is 1: "
            "divide all by the largest value of the camera, or give it as white_level"
        )
    if codes.ndim == 3 and channels == 1:
        return np.ascontiguousarray(codes[..., 1])
    return codes


def _check_exposure(name: str, exposure: float | None, seconds: float) -> None:
    """Refuse a photograph whose header has another exposure; none or 0 says nothing."""
    if not exposure:
        return
    if abs(exposure / seconds - 1.0) > EXPOSURE_TOLERANCE:
        raise AcquisitionError(
            f"{name} was exposed for {exposure:.4g} s by its EXIF, not {seconds:.4g} s"
        )


def _read_with_exposure(name: str, path: Path) -> tuple[np.ndarray, float | None]:
    """Codes of a file, and the seconds in its header; None if there are none."""
    try:
        if path.suffix.lower() in RAW_SUFFIXES:
            return _develop_raw(path)
        return images.read_codes(path), _exif_exposure(path)
    except (FileError, MemoryLimitError) as error:
        raise AcquisitionError(f"{name} cannot be used: {error}") from error


def _develop_raw(path: Path) -> tuple[np.ndarray, float]:
    """Linear codes of camera RAW without any automatic correction, and the seconds in its header.

    The black level stays, as subtracting it would clip noise; 65535 is the sensor's white level.
    """
    user = f"{path}, camera RAW instead of 16-bit TIFF,"
    rawpy = checks.load_extra("rawpy", "camera", user, AcquisitionError)
    try:
        # An open file, as LibRaw takes names in UTF-8 alone.
        with input_file(path).open("rb") as file, rawpy.imread(file) as raw:
            codes = raw.postprocess(
                gamma=(1, 1),
                no_auto_bright=True,
                # else full scale follows the brightest pixel of each photograph
                adjust_maximum_thr=0.0,
                user_wb=[1.0, 1.0, 1.0, 1.0],
                output_color=rawpy.ColorSpace.raw,
                output_bps=16,
                user_flip=0,
                user_black=0,
                user_cblack=[0, 0, 0, 0],
                demosaic_algorithm=rawpy.DemosaicAlgorithm.LINEAR,
            )
            if codes.shape[2] == 1:
                # A monochrome camera.
                codes = codes[..., 0]
            return codes, raw.other.shutter_speed
    except (rawpy.LibRawError, rawpy.NotSupportedError, ValueError) as error:
        text = str(error)
        if not text.strip():
            text = type(error).__name__
        reason = " ".join(text.split())
        raise FileError(f"{path}: is not a readable camera RAW file: {reason}") from error


def _exif_exposure(path: Path) -> float | None:
    """ExposureTime in seconds; None if the header has none.

    Pillow reads no header of EXR, float TIFF, and pictures of more than 179 million pixels.
    """

    def seconds(tags: Mapping[int, Any]) -> float | None:
        value = tags.get(EXPOSURE_TIME_TAG)
        return None if value is None else float(value)

    return read_exif(path, seconds)


def read_exif(path: Path, convert: Callable[[Mapping[int, Any]], T]) -> T | None:
    """The value that `convert` makes of the tags in an EXIF header; None if Pillow reads none.

    FileError for hostile tags.
    """
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as picture:
            exif = picture.getexif()
            return convert({**exif, **exif.get_ifd(EXIF_IFD_TAG)})
    except (UnidentifiedImageError, Image.DecompressionBombError, ZeroDivisionError):
        return None
    except Exception as error:  # hostile tags raise anything
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise FileError(f"{path}: has an EXIF header that cannot be read ({reason})") from error
