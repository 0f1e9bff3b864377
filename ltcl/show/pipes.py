# SPDX-License-Identifier: BSD-3-Clause
"""Raw video through a pipe: frames in, codes of the projector out, as FFmpeg's `rawvideo` has them.

A thread reads frames into a short queue while others are computed, and another one writes codes.
With ``late="wait"`` a full queue stops the reading, the pipe fills, and the program before waits:
each frame comes out. With ``late="drop"`` the reader never waits: the oldest frame of a full queue
is dropped, and the codes of the frame before it are written once more, so that the pace stays.

Known limit: raw video has no time stamps; the pace is that of the program that reads.
"""

from __future__ import annotations

import logging
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ltcl import checks
from ltcl.errors import FileError, InputError
from ltcl.show.projection import Projection

# Frames that wait to be computed, and those that wait to be written.
QUEUED_FRAMES = 3
LATE = ("wait", "drop")
# Seconds between two looks at a queue, in which Ctrl-C is heard.
POLL_SECONDS = 0.1

_logger = logging.getLogger(__name__)


class Readable(Protocol):
    """An unbuffered stream that can be read, such as ``open(0, "rb", buffering=0)``."""

    def readinto(self, buffer: Any, /) -> int | None:
        """Read up to as many bytes as `buffer` has, and return their number; 0 at the end."""
        ...


class Writable(Protocol):
    """An unbuffered stream that can be written."""

    def write(self, data: Any, /) -> int | None:
        """Write some of the bytes, and return their number."""
        ...


@dataclass(frozen=True)
class PixelFormat:
    """Layout of a pixel in the bytes of a frame.

    Attributes
    ----------
    dtype : str
        NumPy's name of a value, with its byte order.
    planes : str
        Order of the planes, each of all pixels; empty where red, green and blue of a pixel lie
        together.
    """

    dtype: str
    planes: str = ""


PIXEL_FORMATS = {
    "rgb24": PixelFormat("|u1"),
    "rgb48le": PixelFormat("<u2"),
    "gbrpf32le": PixelFormat("<f4", "gbr"),
}


@dataclass(frozen=True, kw_only=True)
class RawVideo:
    """Size and pixel format of raw video.

    Attributes
    ----------
    width, height : int
    pixel_format : "rgb24", "rgb48le" or "gbrpf32le"
        FFmpeg's names.
    fps : float

    Examples
    --------
    >>> video = RawVideo(width=4, height=2, pixel_format="gbrpf32le", fps=25.0)
    >>> frame = np.random.default_rng(0).random((2, 4, 3), np.float32)
    >>> data = video.to_bytes(frame)
    >>> len(data) == video.frame_bytes, np.array_equal(video.from_bytes(data), frame)
    (True, True)
    """

    width: int
    height: int
    pixel_format: str = "rgb24"
    fps: float = 25.0

    def __post_init__(self) -> None:
        checks.count("width", self.width)
        checks.count("height", self.height)
        checks.one_of("pixel_format", self.pixel_format, tuple(PIXEL_FORMATS))
        checks.number("fps", self.fps, above=0.0)
        frames = 2 * QUEUED_FRAMES * self.frame_bytes
        checks.fits_host(f"frames of {self.width} x {self.height} pixels", frames)

    @property
    def dtype(self) -> np.dtype:
        """Type of a value, in the byte order of this machine."""
        return np.dtype(self._format.dtype).newbyteorder("=")

    @property
    def frame_bytes(self) -> int:
        """Bytes of a frame."""
        return 3 * self.width * self.height * self.dtype.itemsize

    @property
    def options(self) -> str:
        """Options of FFmpeg and ffplay that describe this video."""
        return (
            f"-f rawvideo -pixel_format {self.pixel_format} "
            f"-video_size {self.width}x{self.height} -framerate {self.fps:g}"
        )

    @property
    def _format(self) -> PixelFormat:
        return PIXEL_FORMATS[self.pixel_format]

    def from_bytes(self, data: Any) -> np.ndarray:
        """Make a picture (height, width, 3) of the bytes of a frame."""
        values = np.frombuffer(data, self._format.dtype).astype(self.dtype, copy=False)
        if not self._format.planes:
            return values.reshape(self.height, self.width, 3)
        planes = values.reshape(3, self.height, self.width)
        order = [self._format.planes.index(colour) for colour in "rgb"]
        return np.stack([planes[plane] for plane in order], axis=-1)

    def to_bytes(self, picture: np.ndarray) -> bytes:
        """Make the bytes of a frame of a picture (height, width[, 3])."""
        if picture.ndim == 2:
            picture = np.repeat(picture[..., None], 3, axis=-1)
        checks.shape("picture", picture, (self.height, self.width, 3))
        values = picture.astype(self._format.dtype, copy=False)
        if not self._format.planes:
            return values.tobytes()
        planes = ["rgb".index(colour) for colour in self._format.planes]
        return b"".join(values[..., plane].tobytes() for plane in planes)


def parse_video_size(text: str) -> tuple[int, int]:
    """Parse FFmpeg's WIDTHxHEIGHT into (width, height).

    >>> parse_video_size("1280x720")
    (1280, 720)
    """
    match = re.fullmatch(r"\s*(\d+)x(\d+)\s*", text)
    if match is None or not int(match[1]) * int(match[2]):
        raise InputError(
            f"video_size is {text!r}; it must be WIDTHxHEIGHT as for FFmpeg, such as 1280x720"
        )
    return int(match[1]), int(match[2])


@dataclass(frozen=True, kw_only=True)
class PipeStatistics:
    """Statistics of the frames that went through a pipe.

    Attributes
    ----------
    written, dropped : int
        Frames that were written, and those of them that repeat the one before.
    frames_per_second : float
    is_cut_off : bool
        True if the program that reads the codes ended first.
    """

    written: int
    dropped: int
    frames_per_second: float
    is_cut_off: bool


@dataclass(kw_only=True)
class QueuedFrame:
    """A frame as bytes, and how many before it were dropped."""

    data: bytearray
    skipped: int


class FrameReader:
    """Frames of a stream, read by a thread of its own.

    Parameters
    ----------
    stream : Readable
    frame_bytes : int
    late : "wait" or "drop"
        What happens when `QUEUED_FRAMES` frames wait: nothing more is read, or the oldest is
        dropped.
    """

    def __init__(self, stream: Readable, frame_bytes: int, late: str = "wait") -> None:
        self._stream = stream
        self._frame_bytes = frame_bytes
        self._drops = checks.one_of("late", late, LATE) == "drop"
        self._changed = threading.Condition()
        self._frames: deque[QueuedFrame] = deque()
        self._is_at_end = False
        self._is_closed = False
        self._error: OSError | None = None
        # Bytes at the end that are no whole frame.
        self.rest = 0
        # A thread that waits for a pipe does not keep the program alive.
        self._thread = threading.Thread(target=self._read, name="ltcl-pipe-in", daemon=True)
        self._thread.start()

    def __iter__(self) -> Iterator[QueuedFrame]:
        """All frames until the end of the stream; FileError if it cannot be read."""
        while True:
            with self._changed:
                while not self._frames and not self._is_at_end:
                    self._changed.wait(POLL_SECONDS)
                if not self._frames:
                    break
                frame = self._frames.popleft()
                self._changed.notify_all()
            yield frame
        if self._error is not None:
            raise FileError(f"stdin: cannot be read: {self._error.strerror}") from self._error

    def close(self) -> None:
        """Read no further frame."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def _read(self) -> None:
        try:
            while not self._is_closed:
                data = bytearray(self._frame_bytes)
                count = self._fill(data)
                if count < self._frame_bytes:
                    self.rest = count
                    break
                self._put(data)
        except OSError as error:
            self._error = error
        finally:
            with self._changed:
                self._is_at_end = True
                self._changed.notify_all()

    def _fill(self, data: bytearray) -> int:
        """Read a frame, of which a pipe gives a piece at a time; the number of bytes."""
        view = memoryview(data)
        count = 0
        while count < len(data):
            piece = self._stream.readinto(view[count:])
            if not piece:
                break
            count += piece
        return count

    def _put(self, data: bytearray) -> None:
        with self._changed:
            if self._drops and len(self._frames) >= QUEUED_FRAMES:
                oldest = self._frames.popleft()
                self._frames[0].skipped += oldest.skipped + 1
            while len(self._frames) >= QUEUED_FRAMES and not self._is_closed:
                self._changed.wait()
            self._frames.append(QueuedFrame(data=data, skipped=0))
            self._changed.notify_all()


class FrameWriter:
    """Codes that a thread of its own writes in order, when they are there.

    `make_bytes` makes the bytes of a frame of its codes.
    """

    def __init__(self, stream: Writable, make_bytes: Callable[[np.ndarray], bytes]) -> None:
        self._stream = stream
        self._make_bytes = make_bytes
        self._changed = threading.Condition()
        self._waiting: deque[tuple[Future[Any], int]] = deque()
        self._is_closed = False
        self._error: Exception | None = None
        self.written = 0
        self.dropped = 0
        self._thread = threading.Thread(target=self._write, name="ltcl-pipe-out", daemon=True)
        self._thread.start()

    def put(self, codes: Future[Any], skipped: int) -> bool:
        """Write codes, after `skipped` repetitions of those before; False if nobody reads them.

        Waits while `QUEUED_FRAMES` frames are to be written. FileError if they cannot be, and
        errors of computing.
        """
        with self._changed:
            while len(self._waiting) >= QUEUED_FRAMES and self._error is None:
                self._changed.wait(POLL_SECONDS)
            self._waiting.append((codes, skipped))
            self._changed.notify_all()
        return not self._is_cut_off()

    def close(self) -> bool:
        """Write what is left; False if nobody reads it. Errors are those of `put`."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        while self._thread.is_alive():
            self._thread.join(POLL_SECONDS)
        return not self._is_cut_off()

    def _is_cut_off(self) -> bool:
        if self._error is None:
            return False
        if isinstance(self._error, BrokenPipeError):
            return True
        if isinstance(self._error, OSError):
            reason = self._error.strerror
            raise FileError(f"stdout: cannot be written: {reason}") from self._error
        raise self._error

    def _write(self) -> None:
        before = b""
        try:
            while True:
                with self._changed:
                    while not self._waiting and not self._is_closed:
                        self._changed.wait()
                    if not self._waiting:
                        return
                    codes, skipped = self._waiting[0]
                data = self._make_bytes(codes.result())
                for _ in range(skipped):
                    self._write_frame(before or data)
                    self.dropped += 1
                self._write_frame(data)
                before = data
                with self._changed:
                    self._waiting.popleft()
                    self._changed.notify_all()
        except Exception as error:  # noqa: BLE001 - the thread that gives frames raises it
            with self._changed:
                self._error = error
                self._changed.notify_all()

    def _write_frame(self, data: bytes) -> None:
        """Write a frame, of which a pipe takes a piece at a time."""
        view = memoryview(data)
        while view:
            view = view[self._stream.write(view) or 0 :]
        self.written += 1


def pipe(
    projection: Projection,
    source: RawVideo,
    stdin: Readable,
    stdout: Writable,
    *,
    late: str = "wait",
    progress: Callable[..., None],
) -> PipeStatistics:
    """Compensate raw video from `stdin` to `stdout`, until one of them ends.

    The codes are raw video of `projected_video`.
    """
    reader = FrameReader(stdin, source.frame_bytes, late)
    target = projected_video(projection, source)

    def make_bytes(codes: np.ndarray) -> bytes:
        return target.to_bytes(projection.enlarged(codes))

    writer = FrameWriter(stdout, make_bytes)
    begun_at = time.monotonic()
    is_read = True
    for frame in reader:
        codes = projection.submit(source.from_bytes(frame.data))
        is_read = writer.put(codes, frame.skipped)
        if not is_read:
            break
        progress("frames", writer.written)
    reader.close()
    is_read = writer.close() and is_read
    seconds = time.monotonic() - begun_at
    if reader.rest:
        _check_rest(reader.rest, writer.written, source)
    return PipeStatistics(
        written=writer.written,
        dropped=writer.dropped,
        frames_per_second=writer.written / max(seconds, 1e-9),
        is_cut_off=not is_read,
    )


def projected_video(projection: Projection, source: RawVideo) -> RawVideo:
    """Return size and pixel format of the codes for raw video of `source`."""
    height, width = projection.grid
    return RawVideo(width=width, height=height, pixel_format=source.pixel_format, fps=source.fps)


def _check_rest(rest: int, frames: int, source: RawVideo) -> None:
    """Refuse or tell a stream that does not end with a frame."""
    problem = f"stdin: ends {rest} bytes into a frame of {source.frame_bytes}"
    if not frames:
        raise FileError(f"{problem}, the first one; --video-size and --pixel-format say otherwise")
    _logger.warning("%s; that one is left out", problem)
