# SPDX-License-Identifier: BSD-3-Clause
"""PNG, JPEG, TIFF and BMP through OpenCV, as they are stored: RGB, no rotation, no transfer curve."""

from __future__ import annotations

import logging
import threading
from pathlib import Path

import cv2
import numpy as np

from ltcl import checks
from ltcl.errors import FileError
from ltcl.images import headers
from ltcl.images.decoder import overheard
from ltcl.images.pictures import check_opaque

BITS: dict[str, tuple[int, ...]] = {  # per channel that can be written, the default first
    ".png": (8, 16),
    ".jpg": (8,),
    ".jpeg": (8,),
    ".tif": (32, 8, 16),
    ".tiff": (32, 8, 16),
    ".bmp": (8,),
}
_log = logging.getLogger(__name__)
_PERHAPS = "extraneous bytes before marker"  # that some cameras leave; damaged data leave them, too
_STORED = ("uint8", "uint16", "float32", "float64")


class _Silence:
    """Keeps OpenCV off stderr while any thread decodes (its level is a global); ours is the one message."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside = 0
        self._level = 0

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                self._level = cv2.utils.logging.getLogLevel()
                cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                cv2.utils.logging.setLogLevel(self._level)


silence = _Silence()


def read(path: Path) -> np.ndarray:
    """Return the codes in a file: (h, w) or (h, w, 3) RGB; uint8, uint16, float32 or float64.

    An EXIF rotation is not applied: a picture must stay on the camera's pixels. Several pages are refused:
    nobody can tell which was meant.

    Raises
    ------
    FileError, MemoryLimitError
        Without the file's name, which the caller puts in front.
    """
    checks.fits_host("the file", path.stat().st_size)
    data = path.read_bytes()
    headers.check_size(headers.declared_size(data), len(data))
    if data.startswith(headers.PNG):
        headers.check_png_chunks(data)
    stored = _decode(path, data)
    if data[:4] in headers.TIFF:
        with silence:
            pages = cv2.imcount(str(path))
        if pages > 1:
            raise FileError(f"holds {pages} pages; it must hold one picture, so save each to a file")
    if stored.dtype.name not in _STORED:
        raise FileError(f"holds {stored.dtype} pixels; they must be one of {', '.join(_STORED)}")
    if stored.ndim == 3 and stored.shape[2] == 4:
        check_opaque(stored[..., 3], np.iinfo(stored.dtype).max if stored.dtype.kind == "u" else 1)
        stored = stored[..., :3]
    if stored.shape[2:] not in ((), (1,), (3,)):
        raise FileError(f"holds {stored.shape[2]} channels; it must be grey or RGB")
    if stored.ndim == 2 or stored.shape[2] == 1:
        return stored.reshape(stored.shape[:2])
    return np.ascontiguousarray(stored[..., ::-1])  # OpenCV keeps BGR


def write(path: Path, codes: np.ndarray) -> None:
    """Write `codes`, (h, w) or (h, w, 3) RGB uint8, uint16 or float32, in the format of the extension."""
    stored = codes if codes.ndim == 2 else np.ascontiguousarray(codes[..., ::-1])
    # 4:4:4 at 95: colour must not bleed between neighbouring projector pixels more than JPEG has to.
    options = [
        cv2.IMWRITE_JPEG_QUALITY,
        95,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    ]
    try:
        done, data = cv2.imencode(path.suffix, stored, options if "jp" in path.suffix.lower() else [])
    except cv2.error as error:
        raise FileError(f"a picture of {codes.shape} cannot be written: {error.err}") from None
    if not done:
        raise FileError(f"a picture of {codes.shape} {codes.dtype} cannot be written as {path.suffix}")
    path.write_bytes(data.tobytes())


def _decode(path: Path, data: bytes) -> np.ndarray:
    try:
        with silence, overheard() as said:
            stored = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise FileError(f"cannot be decoded: {' '.join(error.err.split())}") from None
    said = [
        line for line in said if not line.startswith("libpng warning")
    ]  # of colours and texts, not pixels
    certain = [line for line in said if _PERHAPS not in line]
    if certain:
        raise FileError(f"is damaged; its decoder says: {certain[0]:.200}")
    if stored is None:
        raise FileError(f"is no picture of a known kind, or a damaged one (it begins with {data[:8]!r})")
    if said:
        _log.warning("%s: may be damaged; its decoder says: %.200s", path, said[0])
    return stored
