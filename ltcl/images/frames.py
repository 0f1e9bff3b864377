# SPDX-License-Identifier: BSD-3-Clause
"""Frames of a folder of pictures or of a video, as linear light; videos written.

Videos are read with the bits that they have, and written with 8 bits a channel. Frames that cannot
be decoded are missing, so frames are counted: the
formats of `COUNTED_EXTENSIONS` store their number, and a missing frame is an error; others, as
Matroska, store a duration, which sound may stretch, and a missing frame is a warning.
"""

from __future__ import annotations

import hashlib
import itertools
import logging
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from ltcl import checks
from ltcl.errors import FileError, InputError
from ltcl.files import as_path, input_file, replace_file, unknown_extension
from ltcl.images.encoding import ENCODINGS, Encoding, from_linear, to_linear
from ltcl.images.pictures import BITS, as_picture, read, read_srgb
from ltcl.images.video import Video, load_av

# Videos that store the number of their frames.
COUNTED_EXTENSIONS = (".mp4", ".m4v", ".mov", ".3gp", ".avi")

# Videos that can be read.
OTHER_EXTENSIONS = (".mkv", ".webm", ".mpg", ".mpeg", ".ts", ".wmv", ".flv", ".ogv")
EXTENSIONS = COUNTED_EXTENSIONS + OTHER_EXTENSIONS


class Codec(NamedTuple):
    """Names that FFmpeg gives to a container, its codec, and the layout of its pixels."""

    container: str
    name: str
    pixel_format: str


# Videos that can be written, and the codec of each; FFV1 is lossless.
CODECS = {
    ".mkv": Codec("matroska", "ffv1", "bgr0"),
    ".avi": Codec("avi", "ffv1", "bgr0"),
    ".mp4": Codec("mp4", "mpeg4", "yuv420p"),
}
# MPEG-4 gets as many bits as it can use.
BITS_PER_PIXEL = 64
MAX_BIT_RATE = 1 << 30
# MPEG-4 stores the frames per second as a fraction of two 16-bit numbers.
MAX_DENOMINATOR = 1001

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame of a folder or a video.

    Attributes
    ----------
    number : int
        Position among the frames, from 1.
    name : str
        Name of the picture file, or of the video with the number.
    stored : Path or ndarray
        The picture file, or the BGR codes of a video, uint8 or uint16, (h, w, 3).
    encoding : "auto", "srgb" or "linear"
        Encoding of the codes.
    seconds : float, optional
        Time from the first frame of a video, by its own time stamps.
    """

    number: int
    name: str
    stored: Path | np.ndarray
    encoding: Encoding
    seconds: float | None = None

    def digest(self) -> str:
        """SHA-256 of the file or, in a video, of the pixels, in hexadecimal digits."""
        if isinstance(self.stored, Path):
            content = input_file(self.stored).read_bytes()
        else:
            content = repr(self.stored.shape).encode() + self.stored.tobytes()
        return hashlib.sha256(content).hexdigest()

    def picture(self) -> np.ndarray:
        """Linear light, float32, (h, w) or (h, w, 3); FileError if it cannot be read."""
        if isinstance(self.stored, Path):
            return read(self.stored, encoding=self.encoding)
        return to_linear(_grey_or_rgb(self.stored), self.encoding)

    def srgb(self) -> np.ndarray:
        """Codes of sRGB, uint8 or uint16, where it has such, else linear light, float32.

        (h, w) or (h, w, 3) RGB; FileError if it cannot be read.
        """
        if isinstance(self.stored, Path):
            return read_srgb(self.stored, encoding=self.encoding)
        if self.encoding == "linear":
            return self.picture()
        return _grey_or_rgb(self.stored)


def _grey_or_rgb(codes: np.ndarray) -> np.ndarray:
    """BGR codes as (h, w) where all are grey, which costs a third, or as RGB."""
    b, g, r = cv2.split(codes)
    is_grey = np.array_equal(b, g) and np.array_equal(g, r)
    return b if is_grey else cv2.cvtColor(codes, cv2.COLOR_BGR2RGB)


class Source:
    """The frames of a folder or a video, in order.

    Attributes
    ----------
    count : int or None
        Number of frames; of a video an estimate, or None if it stores none.
    fps : float or None
        Frames per second of a video; None for a folder.
    """

    def __init__(self, path: Path, encoding: Encoding) -> None:
        self.path = path
        self.encoding: Encoding = encoding
        self.count: int | None = None
        self.fps: float | None = None
        self._files: list[Path] = []
        self._video: Video | None = None
        if path.is_dir():
            self._files = _list_pictures(path)
            self.count = len(self._files)
            return
        self._video = Video(path)
        self.count = self._video.count
        self.fps = self._video.fps
        if encoding == "auto":
            self.encoding = self._video.encoding

    def __iter__(self) -> Iterator[Frame]:
        """All frames, from the first one on; FileError where one is missing."""
        for number, file in enumerate(self._files, start=1):
            yield Frame(number, file.name, file, self.encoding)
        if self._video is not None:
            yield from self._video_frames(self._video)

    def _video_frames(self, video: Video) -> Iterator[Frame]:
        number = 0
        for number, (codes, seconds) in enumerate(video, start=1):
            yield Frame(number, f"{self.path.name}:{number}", codes, self.encoding, seconds)
        self._check_count(number)

    def _check_count(self, decoded: int) -> None:
        """Refuse a video of fewer frames than it says, or warn where it may only estimate them."""
        if self.count is None:
            expected = 1
            counted = "its"
        else:
            expected = self.count
            counted = str(self.count)
        if decoded >= expected:
            return
        text = f"{self.path}: {decoded} of {counted} frames can be read; the video is damaged"
        if decoded == 0 or self.path.suffix.lower() in COUNTED_EXTENSIONS:
            raise FileError(text)
        _logger.warning("%s, or their number is an estimate, as this format may keep it", text)


def is_frames(path: str | os.PathLike[str]) -> bool:
    """True if `path` is a folder, or has the extension of a video."""
    return Path(path).is_dir() or Path(path).suffix.lower() in EXTENSIONS


def open_frames(path: str | os.PathLike[str], *, encoding: Encoding = "auto") -> Source:
    """Open a folder of pictures or a video.

    Parameters
    ----------
    path : path
        A folder, whose pictures come in natural order without hidden and other files; or a video,
        upright as a player shows it.
    encoding : "auto", "srgb" or "linear"
        Encoding of the codes, as in `ltcl.images.read`.

    Returns
    -------
    Source
        Iterates over the frames.

    Raises
    ------
    FileError
        The folder holds no picture, or two of one name; the extension is unknown; the video cannot
        be read.
    """
    checks.one_of("encoding", encoding, ENCODINGS)
    path = as_path(path)
    if path.is_file() and not is_frames(path):
        raise FileError(f"{path}: {unknown_extension(path)}; videos are {', '.join(EXTENSIONS)}")
    return Source(path, encoding)


def check_video(path: str | os.PathLike[str], grid: tuple[int, int]) -> None:
    """Refuse a video by its extension, by an odd height or width, or for want of its writer.

    MPEG-4 cannot hold odd sizes.
    """
    path = as_path(path)
    if path.suffix.lower() not in CODECS:
        raise FileError(f"{path}: {unknown_extension(path)}; a video must be {', '.join(CODECS)}")
    h, w = grid
    if h % 2 or w % 2:
        raise InputError(f"{path}: frames are {h} x {w} pixels; those of a video must be even")
    load_av(str(path))


def write_video(
    path: str | os.PathLike[str], pictures: Iterable[np.ndarray], fps: float = 25.0
) -> int:
    """Write linear pictures as a video, which replaces an earlier file whole or not at all.

    Parameters
    ----------
    path : path
        A .mkv or .avi file (lossless) or an .mp4 file, of 8 bits in sRGB.
    pictures : iterable of array_like
        (h, w) or (h, w, 3), clipped to [0, 1]; h and w are even, and the same for all.
    fps : float
        Frames per second.

    Returns
    -------
    int
        The number of frames.

    Raises
    ------
    InputError
        A size is odd or differs from the first one, a picture has NaN, or there are no frames.
    FileError
        The extension is unknown, or the file cannot be written.
    """
    path = as_path(path)
    fps = checks.number("fps", fps, above=0.0)
    check_video(path, (0, 0))
    FFmpegError = load_av(str(path)).error.FFmpegError
    with replace_file(path) as temporary:
        try:
            count = _encode_video(path, temporary, pictures, fps)
        except FFmpegError as error:
            raise FileError(f"{path}: cannot be encoded; perhaps the disk is full") from error
        if count == 0:
            raise InputError(f"{path}: there are no frames to write")
    return count


def _encode_video(path: Path, temporary: Path, pictures: Iterable[np.ndarray], fps: float) -> int:
    """Encode pictures into the file `temporary`, which is for `path`; their number."""
    av = load_av(str(path))
    codec = CODECS[path.suffix.lower()]
    count = 0
    shape: tuple[int, ...] = ()
    # FFmpeg does not tell that a disk is full, but Python does.
    with temporary.open("wb") as file, av.open(file, "w", format=codec.container) as video:
        stream: Any = video.add_stream(codec.name, Fraction(fps).limit_denominator(MAX_DENOMINATOR))
        stream.thread_type = "AUTO"
        stream.pix_fmt = codec.pixel_format
        for count, picture in enumerate(pictures, start=1):
            codes = _rgb_codes(picture)
            if count == 1:
                shape = codes.shape
                h, w = shape[:2]
                check_video(path, (h, w))
                stream.height = h
                stream.width = w
                stream.bit_rate = min(BITS_PER_PIXEL * fps * codes[..., 0].size, MAX_BIT_RATE)
            if codes.shape != shape:
                raise InputError(f"frame {count} is {codes.shape[:2]}; the first is {shape[:2]}")
            video.mux(stream.encode(av.VideoFrame.from_ndarray(codes, format="rgb24")))
        if count:
            video.mux(stream.encode(None))
    return count


def _rgb_codes(picture: np.ndarray) -> np.ndarray:
    """Codes of a linear picture in sRGB, uint8, (h, w, 3)."""
    codes = from_linear(as_picture("a frame", picture), "srgb", 8, is_float=False)
    if codes.ndim == 2:
        return np.repeat(codes[..., None], 3, axis=2)
    return np.ascontiguousarray(codes)


def _list_pictures(folder: Path) -> list[Path]:
    """Pictures that stand directly in the folder, in natural order."""
    try:
        entries = list(folder.iterdir())
    except OSError as error:
        raise FileError(f"{folder}: cannot be read: {error.strerror}") from error
    files = sorted(filter(_is_picture, entries), key=natural_order)
    if not files:
        raise FileError(f"{folder}: holds no pictures; frames are {', '.join(BITS)}")
    for file, next_file in itertools.pairwise(files):
        if file.stem == next_file.stem:
            raise FileError(
                f"{folder}: holds {file.name} and {next_file.name}; each frame must be one file"
            )
    return files


def _is_picture(file: Path) -> bool:
    is_hidden = file.name.startswith(".")
    return not is_hidden and file.suffix.lower() in BITS and file.is_file()


def natural_order(file: Path) -> tuple[list[str | int], str]:
    """Key to sort by: numbers in names compare as numbers."""
    key: list[str | int] = []
    for place, piece in enumerate(re.split(r"(\d+)", file.stem.lower())):
        if place % 2 == 1:
            key.append(int(piece))
        else:
            key.append(piece)
    return key, file.name
