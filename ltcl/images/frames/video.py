# SPDX-License-Identifier: BSD-3-Clause
"""The frames of a video file, decoded by OpenCV's FFmpeg to 8 bits a channel.

Where a file is cut off or damaged FFmpeg leaves frames out and OpenCV simply ends early, without an error.
So frames are counted and compared with what the file says of itself; where the time between two frames
jumped before, the first missing one stood there. Frames are read in order: seeking is not exact in all
formats. One that is grey, its three channels equal, is taken as grey: it costs a third.

Known limits: 8 bits, whatever the video holds; no rotation is applied; damage that a decoder conceals, a
frame with wrong pixels, is not told; in formats that keep a duration but no count, as Matroska, a sound track
that outlasts the picture looks like missing frames.
"""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from ltcl.errors import FileError
from ltcl.files import input_file
from ltcl.images import codes
from ltcl.images.codes import Encoding
from ltcl.images.frames.source import Frame, Source
from ltcl.images.raster import silence

# FFmpeg tells of damage on stderr by itself; ours is the one message. Read once, at the first video.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
_JUMP = 1.5  # frames: what the time between two of them may be


class Video(Source):
    """A video file."""

    def __init__(self, path: Path, encoding: Encoding = "auto") -> None:
        super().__init__(input_file(path), encoding)
        with self._opened() as capture:
            count, fps = (capture.get(what) for what in (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FPS))
        self.count = int(count) if 0 < count < 1e12 else None
        self.fps = fps if 0 < fps < 1e6 else None

    def __iter__(self) -> Iterator[Frame]:
        number, time, jump = 0, 0.0, None
        with self._opened() as capture:
            while (stored := _next(capture)) is not None:
                before, time = time, capture.get(cv2.CAP_PROP_POS_MSEC)
                if number and jump is None and self.fps and time - before > _JUMP * 1000 / self.fps:
                    jump = number + 1
                number += 1
                yield Frame(
                    number,
                    f"{self.path.name}:{number}",
                    functools.partial(_digest, stored),
                    functools.partial(self._picture, number, stored),
                )
        if not number or number < (self.count or 0):
            raise FileError(
                f"{self.place(jump or number + 1)} cannot be read: the video is damaged or cut off there, "
                f"{number} frame(s) can be read"
            )

    @contextmanager
    def _opened(self) -> Iterator[cv2.VideoCapture]:
        with silence:
            capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        try:
            if not capture.isOpened():
                raise FileError(
                    f"{self.path}: is no video that can be decoded, or a damaged or truncated one"
                )
            capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # pixels stay where the file has them
            yield capture
        finally:
            capture.release()

    def _picture(self, number: int, stored: np.ndarray) -> np.ndarray:
        blue, green, red = np.moveaxis(stored, -1, 0)
        grey = np.array_equal(blue, green) and np.array_equal(green, red)
        shown = blue if grey else np.ascontiguousarray(stored[..., ::-1])
        return self._same_size(number, codes.to_linear(shown, self.encoding))


def _next(capture: cv2.VideoCapture) -> np.ndarray | None:
    """BGR uint8, (h, w, 3); None after the last frame that can be read."""
    try:
        with silence:
            read, stored = capture.read()
    except cv2.error:
        return None
    return stored if read else None


def _digest(stored: np.ndarray) -> str:
    return hashlib.sha256(repr(stored.shape).encode() + stored.tobytes()).hexdigest()
