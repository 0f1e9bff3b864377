# SPDX-License-Identifier: BSD-3-Clause
"""Many pictures in a row, a folder of them or a video, read as linear light; videos written.

OpenCV's FFmpeg decodes videos to 8 bits a channel and leaves damaged frames out: they are counted.
`_COUNTED` formats keep their number; others, as Matroska, a duration, which sound may stretch: a
warning. Known limits: a decoder may replace damaged pixels by others, and FFmpeg itself also writes
to stderr about damage.
"""

from __future__ import annotations

import hashlib
import itertools
import logging
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ltcl import checks
from ltcl.errors import FileError, InputError
from ltcl.files import as_path, input_file, replace_file, unknown_extension
from ltcl.images.pictures import (
    BITS,
    ENCODINGS,
    Encoding,
    as_picture,
    decoding,
    from_linear,
    read,
    to_linear,
)

_COUNTED = (".mp4", ".m4v", ".mov", ".3gp", ".avi")
EXTENSIONS = (
    *_COUNTED,
    ".mkv",
    ".webm",
    ".mpg",
    ".mpeg",
    ".ts",
    ".wmv",
    ".flv",
    ".ogv",
)  # of videos
CODECS = {".mkv": "FFV1", ".avi": "FFV1", ".mp4": "mp4v"}  # of videos that can be written
_logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame: its `number`, from 1, and `name`, of its file or of the video with its number there."""

    number: int
    name: str
    stored: Path | np.ndarray  # BGR uint8, (h, w, 3), of a video
    encoding: Encoding

    def digest(self) -> str:
        """SHA-256 of the file or, in a video, of the pixels, in hexadecimal digits."""
        if isinstance(self.stored, Path):
            return hashlib.sha256(input_file(self.stored).read_bytes()).hexdigest()
        return hashlib.sha256(repr(self.stored.shape).encode() + self.stored.tobytes()).hexdigest()

    def picture(self) -> np.ndarray:
        """Linear float32, (h, w) or (h, w, 3); FileError where it cannot be read."""
        if isinstance(self.stored, Path):
            return read(self.stored, encoding=self.encoding)
        b, g, r = cv2.split(self.stored)
        is_grey = np.array_equal(b, g) and np.array_equal(g, r)  # which costs a third
        return to_linear(
            b if is_grey else cv2.cvtColor(self.stored, cv2.COLOR_BGR2RGB), self.encoding
        )


class Source:
    """The frames of a folder or a video, in order: `count`, an estimate of a video, and `fps`, or None."""

    def __init__(self, path: Path, encoding: Encoding) -> None:
        self.path, self.fps = path, None
        self.encoding: Encoding = encoding
        self._files = _pictures(path) if path.is_dir() else []
        self.count: int | None = len(self._files)
        if not self._files:
            capture = _opened(path)
            self.count = max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0) or None
            self.fps = max(capture.get(cv2.CAP_PROP_FPS), 0.0) or None

    def __iter__(self) -> Iterator[Frame]:
        """All frames from the first one on; FileError where one is missing."""
        if self._files:
            for number, file in enumerate(self._files, start=1):
                yield Frame(number, file.name, file, self.encoding)
            return
        number, capture = 0, _opened(self.path)
        while (decoded := capture.read())[0]:
            number += 1
            yield Frame(number, f"{self.path.name}:{number}", decoded[1], self.encoding)
        if number < (self.count or 1):
            text = f"{self.path}: {number} of {self.count or 'its'} frames can be read; the video is damaged"
            if not number or self.path.suffix.lower() in _COUNTED:
                raise FileError(text)
            _logger.warning("%s, or their number is an estimate, as this format may keep it", text)


def _pictures(folder: Path) -> list[Path]:
    """Those that stand directly in the folder, in natural order: numbers in names compare as numbers."""

    def order(file: Path) -> tuple[list[str | int], str]:
        pieces = re.split(r"(\d+)", file.stem.lower())  # numbers at the odd places
        return [int(piece) if place % 2 else piece for place, piece in enumerate(pieces)], file.name

    try:
        visible = [file for file in folder.iterdir() if not file.name.startswith(".")]
    except OSError as error:
        raise FileError(f"{folder}: cannot be read: {error.strerror}") from error
    files = sorted(
        (file for file in visible if file.suffix.lower() in BITS and file.is_file()), key=order
    )
    if not files:
        raise FileError(f"{folder}: holds no pictures; frames are {', '.join(BITS)}")
    for file, other in itertools.pairwise(files):
        if file.stem == other.stem:
            raise FileError(
                f"{folder}: holds {file.name} and {other.name}; each frame must be one file"
            )
    return files


def _opened(path: Path) -> cv2.VideoCapture:
    with decoding(input_file(path)):
        capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        if not capture.isOpened():
            raise FileError("is no video that can be decoded, or a damaged or truncated one")
        return capture


def is_frames(path: str | os.PathLike[str]) -> bool:
    """Whether `path` is a folder, or is called like a video."""
    return Path(path).is_dir() or Path(path).suffix.lower() in EXTENSIONS


def open_frames(path: str | os.PathLike[str], *, encoding: Encoding = "auto") -> Source:
    """Open a folder of pictures, in natural order, or a video, upright as a player shows it.

    Hidden and other files are left out; `encoding` is that of `ltcl.images.read`. FileError for no
    picture in the folder, two files of one name in it, an unknown extension, no readable video.
    """
    checks.one_of("encoding", encoding, ENCODINGS)
    path = as_path(path)
    if path.is_file() and not is_frames(path):
        raise FileError(f"{path}: {unknown_extension(path)}; videos are {', '.join(EXTENSIONS)}")
    return Source(path, encoding)


def check_video(path: str | os.PathLike[str], grid: tuple[int, int]) -> None:
    """Refuse a video of (h, w) frames by its extension, or by an odd size, which OpenCV would cut."""
    path = as_path(path)
    if path.suffix.lower() not in CODECS:
        raise FileError(f"{path}: {unknown_extension(path)}; a video must be {', '.join(CODECS)}")
    if grid[0] % 2 or grid[1] % 2:
        raise InputError(
            f"{path}: frames are {grid[0]} x {grid[1]} pixels; those of a video must be even"
        )


def write_video(
    path: str | os.PathLike[str], pictures: Iterable[np.ndarray], fps: float = 25.0
) -> int:
    """Write linear pictures as a video, which replaces another whole or not at all; their number.

    `path` ends in .mkv or .avi (lossless) or .mp4; 8 bits in sRGB. `pictures`, (h, w) or (h, w, 3),
    are cut to [0, 1]; h and w are even and the same for all. InputError for other sizes, no frames
    or NaN; FileError for another extension or a file that cannot be written.
    """
    path, fps = as_path(path), checks.number("fps", fps, above=0.0)
    check_video(path, (0, 0))
    writer, codec, shape, count = cv2.VideoWriter(), CODECS[path.suffix.lower()], (), 0
    with replace_file(path) as temporary:
        try:
            for count, picture in enumerate(pictures, start=1):
                codes = from_linear(as_picture("a frame", picture), "srgb", 8, is_float=False)
                codes = cv2.cvtColor(
                    codes, cv2.COLOR_GRAY2BGR if codes.ndim == 2 else cv2.COLOR_RGB2BGR
                )
                if count == 1:
                    shape = h, w, _ = codes.shape
                    check_video(path, (h, w))
                    writer.open(str(temporary), cv2.CAP_FFMPEG, writer.fourcc(*codec), fps, (w, h))
                if codes.shape != shape:
                    raise InputError(
                        f"frame {count} is {codes.shape[:2]}; the first is {shape[:2]}"
                    )
                writer.write(codes)
        finally:
            writer.release()
        if not count:
            raise InputError(f"{path}: there are no frames to write")
        written = int(
            cv2.VideoCapture(str(temporary), cv2.CAP_FFMPEG).get(cv2.CAP_PROP_FRAME_COUNT)
        )
        if written != count:  # of which OpenCV says nothing
            raise FileError(
                f"{path}: holds {written} of {count} frames in {codec}; is the disk full?"
            )
    return count
