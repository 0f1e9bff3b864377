# SPDX-License-Identifier: BSD-3-Clause
"""What a camera wrote beside a photograph: how long it exposed, and when.

EXIF 2.32, tags ExposureTime (33434), DateTimeOriginal (36867) and SubSecTimeOriginal (37521), read by Pillow,
which decodes no pixel for that. EXR and BMP have none. Known limit: Pillow refuses JPEG and PNG past 179
million pixels.
"""

from __future__ import annotations

import contextlib
import math
import warnings
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from PIL import Image

from ltcl.errors import FileError

_FORMATS = {".jpg": "JPEG", ".jpeg": "JPEG", ".png": "PNG", ".tif": "TIFF", ".tiff": "TIFF"}
_EXIF, _EXPOSURE, _TAKEN, _FRACTION = 34665, 33434, 36867, 37521


class Taken(NamedTuple):
    """How long and when a photograph was exposed; None where its file does not say."""

    seconds: float | None = None
    time: datetime | None = None


def read(path: Path) -> Taken:
    """What the EXIF of a .jpg, .png or .tif file says; nothing for other extensions.

    Raises
    ------
    FileError
        The EXIF is damaged. Without the file's name, which the caller puts in front.

    Examples
    --------
    >>> read(Path("light.exr"))
    Taken(seconds=None, time=None)
    """
    kind = _FORMATS.get(path.suffix.lower())
    if kind is None:
        return Taken()
    try:
        tags = _tags(path, kind)
    except Exception as error:  # whatever hostile tags trip over
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise FileError(f"has an EXIF header that cannot be read ({reason})") from error
    return Taken(positive(tags.get(_EXPOSURE)), _time(tags.get(_TAKEN), tags.get(_FRACTION)))


def positive(seconds: Any) -> float | None:
    """`seconds` as a float, or None where it is no time of exposure.

    >>> positive(0.5), positive(0.0), positive("1/60")
    (0.5, None, None)
    """
    try:
        value = float(seconds)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return value if math.isfinite(value) and value > 0 else None


def _tags(path: Path, kind: str) -> dict[int, Any]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # damaged tags that are none of ours, large pictures
        if kind == "TIFF":  # as a picture, Pillow would refuse float RGB
            with path.open("rb") as file:
                exif = Image.Exif()
                exif.load_from_fp(file)
                return {**exif, **exif.get_ifd(_EXIF)}
        with Image.open(path, formats=(kind,)) as picture:
            exif = picture.getexif()
            return {**exif, **exif.get_ifd(_EXIF)}


def _time(taken: Any, fraction: Any) -> datetime | None:
    """Both are text: "2026:11:21 10:15:00" and the digits behind the point of its seconds."""
    text, digits = (str(part or "").strip().strip("\0") for part in (taken, fraction))
    time = None
    with contextlib.suppress(ValueError):
        time = datetime.strptime(text, "%Y:%m:%d %H:%M:%S")
        if digits.isascii() and digits.isdigit():
            time = time.replace(microsecond=int(digits[:6].ljust(6, "0")))
    return time
