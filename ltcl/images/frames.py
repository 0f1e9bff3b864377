# SPDX-License-Identifier: BSD-3-Clause
"""Many pictures in a row, a folder of them or a video, read as linear light; videos written.

Videos are decoded by OpenCV's FFmpeg to 8 bits a channel, in order: seeking is not exact in all formats.
Where one is damaged, FFmpeg leaves frames out without an error, so they are counted. Formats of `_COUNTED`
keep their number, and fewer are an error; others, as Matroska, keep a duration, which a sound track may
stretch: a warning. Known limit: a frame of wrong pixels, as a decoder conceals damage.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ltcl import checks
from ltcl.errors import FileError, InputError
from ltcl.files import as_path, input_file, replace_file, unknown_extension
from ltcl.images.io import BITS, as_picture, quiet, read
from ltcl.images.srgb import ENCODINGS, Encoding, from_linear, to_linear

_COUNTED = (".mp4", ".m4v", ".mov", ".3gp", ".avi")
EXTENSIONS = (*_COUNTED, ".mkv", ".webm", ".mpg", ".mpeg", ".ts", ".wmv", ".flv", ".ogv")  # of videos
CODECS = {".mkv": "FFV1", ".avi": "FFV1", ".mp4": "mp4v"}  # of videos that can be written
_logger = logging.getLogger(__name__)
# FFmpeg writes about damage to stderr, and OpenCV has no other switch for that; read at the first video.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


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
        b, g, r = np.moveaxis(self.stored, -1, 0)
        is_grey = np.array_equal(b, g) and np.array_equal(g, r)  # which costs a third
        return to_linear(b if is_grey else np.stack([r, g, b], axis=-1), self.encoding)


class Source:
    """The frames of a folder or a video, in order: `count` of them, or None; of a video an estimate.

    `fps` are a video's frames a second, None where they are not known.
    """

    def __init__(self, path: Path, encoding: Encoding) -> None:
        self.path = path
        self.encoding: Encoding = encoding
        self.count: int | None = None
        self.fps: float | None = None
        self._files = _pictures(path) if path.is_dir() else []
        if self._files:
            self.count = len(self._files)
            return
        with _opened(input_file(path)) as capture:
            count, fps = (capture.get(key) for key in (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FPS))
        self.count = int(count) if 0 < count < 1e12 else None
        self.fps = fps if 0 < fps < 1e6 else None

    def __iter__(self) -> Iterator[Frame]:
        """All frames from the first one on; FileError where one is missing."""
        if self._files:
            for number, file in enumerate(self._files, start=1):
                yield Frame(number, file.name, file, self.encoding)
            return
        number = 0
        with _opened(self.path) as capture:
            while True:
                with quiet():
                    success, stored = capture.read()
                if not success:
                    break
                number += 1
                yield Frame(number, f"{self.path.name}:{number}", stored, self.encoding)
        if number < (self.count or 1):
            text = f"{self.path}: {number} of {self.count or 'its'} frames can be read"
            if not number or self.path.suffix.lower() in _COUNTED:
                raise FileError(f"{text}; the video is damaged or cut off")
            _logger.warning("%s; in this format their number is an estimate, or the video is damaged", text)


def _pictures(folder: Path) -> list[Path]:
    """Those that stand directly in the folder, in natural order: numbers in names compare as numbers."""

    def order(file: Path) -> tuple[list[str | int], str]:
        pieces = re.split(r"(\d+)", file.stem.lower())  # numbers at the odd places
        return [int(piece) if place % 2 else piece for place, piece in enumerate(pieces)], file.name

    try:
        visible = sorted((file for file in folder.iterdir() if not file.name.startswith(".")), key=order)
    except OSError as error:
        raise FileError(f"{folder}: cannot be read: {error.strerror}") from error
    files = [file for file in visible if file.suffix.lower() in BITS and file.is_file()]
    if not files:
        raise FileError(f"{folder}: holds no pictures; frames are {', '.join(BITS)}")
    stem, times = Counter(file.stem for file in files).most_common(1)[0]
    if times > 1:
        twins = " and ".join(file.name for file in files if file.stem == stem)
        raise FileError(f"{folder}: holds {twins}; each frame must be one file")
    return files


@contextmanager
def _opened(path: Path) -> Iterator[cv2.VideoCapture]:
    with quiet():
        capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        if not capture.isOpened():
            raise FileError(f"{path}: is no video that can be decoded, or a damaged or truncated one")
        yield capture
    finally:
        capture.release()


def is_frames(path: str | os.PathLike[str]) -> bool:
    """Whether `path` is a folder, or is called like a video."""
    return Path(path).is_dir() or Path(path).suffix.lower() in EXTENSIONS


def open_frames(path: str | os.PathLike[str], *, encoding: Encoding = "auto") -> Source:
    """Open a folder of pictures or a video file as an iterable of `Frame`.

    Pictures of a folder are taken in natural order, frame2 before frame10, hidden and other files left out; a
    video is upright, as a player shows it. `encoding` is that of `ltcl.images.read`. FileError for no picture
    in the folder, two files of one name in it, an unknown extension, no readable video.

    Examples
    --------
    >>> import tempfile
    >>> from ltcl import images
    >>> folder = Path(tempfile.mkdtemp())
    >>> for number in (10, 9):
    ...     images.write(folder / f"sky{number}.exr", np.full((2, 3), number))
    >>> [(frame.number, frame.name, frame.picture().max()) for frame in open_frames(folder)]
    [(1, 'sky9.exr', np.float32(9.0)), (2, 'sky10.exr', np.float32(10.0))]
    """
    checks.one_of("encoding", encoding, ENCODINGS)
    path = as_path(path)
    if path.is_file() and path.suffix.lower() not in EXTENSIONS:
        kinds = ", ".join(EXTENSIONS)
        raise FileError(f"{path}: {unknown_extension(path)}; frames are a folder, or a video: {kinds}")
    return Source(path, encoding)


def check_video(path: str | os.PathLike[str], grid: tuple[int, int]) -> None:
    """Refuse a video of (h, w) frames by its extension, or by an odd size, which OpenCV would cut."""
    path = as_path(path)
    if path.suffix.lower() not in CODECS:
        raise FileError(f"{path}: {unknown_extension(path)}; a video must be {', '.join(CODECS)}")
    if grid[0] % 2 or grid[1] % 2:
        raise InputError(f"{path}: frames are {grid[0]} x {grid[1]} pixels; those of a video must be even")


def write_video(path: str | os.PathLike[str], pictures: Iterable[np.ndarray], fps: float = 25.0) -> int:
    """Write linear pictures as a video; an earlier file is replaced whole or not at all.

    `path` ends in .mkv or .avi (lossless) or .mp4; 8 bits in sRGB. `pictures`, (h, w) or (h, w, 3), are cut
    to [0, 1]; h and w are even and the same for all. Their number is returned. InputError for other sizes, no
    frames or NaN; FileError for another extension or a file that cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "grey.mkv"
    >>> write_video(path, [np.full((4, 6), level) for level in (0.0, 0.5, 1.0)])
    3
    >>> [float(frame.picture().mean().round(1)) for frame in open_frames(path)]
    [0.0, 0.5, 1.0]
    """
    path, fps = as_path(path), checks.number("fps", fps, above=0.0)
    check_video(path, (0, 0))
    writer, codec, grid, count = cv2.VideoWriter(), CODECS[path.suffix.lower()], (0, 0), 0
    with replace_file(path) as temporary:
        try:
            for count, picture in enumerate(pictures, start=1):
                codes = from_linear(as_picture("a frame", picture), "srgb", 8, is_float=False)
                if count == 1:
                    grid = h, w = codes.shape[:2]
                    check_video(path, grid)
                    with quiet():
                        writer.open(str(temporary), cv2.CAP_FFMPEG, writer.fourcc(*codec), fps, (w, h))
                    if not writer.isOpened():
                        raise FileError(f"{path}: OpenCV cannot write {codec} there")
                if codes.shape[:2] != grid:
                    raise InputError(f"frame {count} is {codes.shape[:2]}; it must be {grid} as the first")
                to_bgr = cv2.COLOR_GRAY2BGR if codes.ndim == 2 else cv2.COLOR_RGB2BGR
                writer.write(cv2.cvtColor(codes, to_bgr))
        finally:
            writer.release()
        if not count:
            raise InputError(f"{path}: there are no frames to write")
        written = Source(temporary, "auto").count  # OpenCV says nothing about a full disk
        if written != count:
            raise FileError(f"{path}: {written} of {count} frames could be written; is the disk full?")
    return count
