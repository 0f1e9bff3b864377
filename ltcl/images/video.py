# SPDX-License-Identifier: BSD-3-Clause
"""Frames of a video file as codes, upright, with their times, decoded by FFmpeg (PyAV).

Codes have 8 bits, or 16 where those of the file have more than 8, such as 10 or 12.

The display matrix (x y) of the container moves a stored pixel (p q):

    x = a p + c q        a, d != 0 and b = c = 0: as stored, turned by 180 degrees, or mirrored
    y = b p + d q        b, c != 0 and a = d = 0: turned by 90 or 270 degrees, mirrored or not

Frames that cannot be decoded are left out, and their number tells that; FFmpeg conceals other
damage, of which a warning tells once. Known limits: colours of wide gamut are not converted, with a
warning; damage that a decoder does not notice, or does not tell, gives other pixels.
"""

from __future__ import annotations

import contextlib
import logging
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ltcl import checks
from ltcl.errors import FileError, LtclError
from ltcl.files import input_file

# Only these formats are opened: playlists name other files.
DEMUXERS = "mov,mp4,3gp,avi,matroska,webm,mpeg,mpegvideo,mpegts,asf,flv,ogg"
OPTIONS = {"protocol_whitelist": "file", "format_whitelist": DEMUXERS}

# Values of ITU-T H.273. PQ and HLG are HDR; LINEAR is linear light.
HDR_CURVES = {16: "PQ", 18: "HLG"}
LINEAR = 8
WIDE_PRIMARIES = {9: "BT.2020", 11: "DCI-P3", 12: "Display P3"}

# Each byte with its bits in reverse order; and a register of zlib's CRC that is zero.
REVERSED_BITS = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
NO_BITS = 0xFFFFFFFF

# Bits of a component up to which codes have 8, and their largest.
BITS = 8
WHITE = 255

_logger = logging.getLogger(__name__)


def load_av(user: str) -> Any:
    """Load PyAV, which brings all of FFmpeg: for videos alone."""
    return checks.load_extra("av", "film", user, FileError)


class Video:
    """The main video stream of a file.

    Attributes
    ----------
    count : int or None
        Number of frames: stored, or estimated by duration and rate; None if there are none.
    fps : float or None
        Frames per second.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with _decoding(input_file(path)), _open(path) as container:
            stream = _main_stream(container)
            self.count = _frame_count(container, stream)
            self.fps = float(stream.guessed_rate or 0) or None
            self._curve = stream.codec_context.color_trc
            self._gamut = WIDE_PRIMARIES.get(stream.codec_context.color_primaries)

    @property
    def encoding(self) -> Literal["auto", "linear"]:
        """Encoding of the codes by the file itself; FileError for HDR."""
        if self._curve in HDR_CURVES:
            raise FileError(
                f"{self.path}: has codes of the HDR curve {HDR_CURVES[self._curve]}, which is not "
                "known here; convert it to BT.709, or give the encoding 'srgb' or 'linear'"
            )
        if self._curve == LINEAR:
            return "linear"
        return "auto"

    def __iter__(self) -> Iterator[tuple[np.ndarray, float | None]]:
        """BGR codes of all frames that can be decoded, (h, w, 3) uint8 or uint16, and their times.

        A time is in seconds from the first frame; None where the file has none.
        """
        if self._gamut is not None:
            _logger.warning(
                "%s: has the primaries of %s; its red, green and blue are taken as those of sRGB",
                self.path,
                self._gamut,
            )
        with _decoding(input_file(self.path)), _open(self.path) as container:
            converter = _Converter()
            first: float | None = None
            for frame in _Decoder(self.path, container):
                seconds = frame.time
                if first is None:
                    first = seconds
                if seconds is not None and first is not None:
                    seconds -= first
                yield converter.codes(frame), seconds


class _Converter:
    """Frames as upright BGR codes."""

    def __init__(self) -> None:
        from av.video.reformatter import Interpolation, VideoReformatter

        self._reformatter = VideoReformatter()
        self._interpolation = Interpolation.BICUBIC

    def codes(self, frame: Any) -> np.ndarray:
        """BGR codes, (h, w, 3) uint8, or uint16 of a frame of more than 8 bits.

        FileError for a frame that is transparent or sheared.
        """
        components = frame.format.components
        is_deep = max(component.bits for component in components) > BITS
        if frame.format.has_palette or any(channel.is_alpha for channel in components):
            alpha = self._convert(frame, "rgba64le" if is_deep else "bgra")[..., 3]
            transparent = np.count_nonzero(alpha < _opaque(components, alpha.dtype))
            if transparent:
                raise FileError(
                    f"has {transparent} transparent pixel(s) in a frame, whose light is not known; "
                    "make them opaque"
                )
        matrix = frame.side_data.get("DISPLAYMATRIX")
        if is_deep:
            return _turn_upright(self._convert(frame, "rgb48le")[..., ::-1], matrix)
        return _turn_upright(self._convert(frame, "bgr24"), matrix)

    def _convert(self, frame: Any, format: str) -> np.ndarray:
        converted = self._reformatter.reformat(
            frame, format=format, interpolation=self._interpolation
        )
        return converted.to_ndarray()


def _opaque(components: Any, dtype: np.dtype) -> int:
    """The least code of alpha that is the largest one of the file, after its conversion."""
    largest = np.iinfo(dtype).max
    if largest <= WHITE:
        return largest
    bits = max(component.bits for component in components)
    # FFmpeg shifts codes to the left, and may leave zeros below.
    return largest + 1 - (1 << (16 - bits))


def _turn_upright(codes: np.ndarray, matrix: Any) -> np.ndarray:
    """Turn and mirror codes by a display matrix, nine integers by rows."""
    if matrix is None:
        return np.ascontiguousarray(codes)
    a, b, _, c, d, *_ = np.frombuffer(matrix, np.int32).tolist()
    if b == c == 0:
        x_sign, y_sign = a, d
    elif a == d == 0:
        codes = codes.swapaxes(0, 1)
        x_sign, y_sign = c, b
    else:
        raise FileError("is turned by other than quarter turns, by its display matrix")
    if x_sign < 0:
        codes = codes[:, ::-1]
    if y_sign < 0:
        codes = codes[::-1]
    return np.ascontiguousarray(codes)


@contextlib.contextmanager
def _decoding(path: Path) -> Iterator[None]:
    """Name the file in every error."""
    try:
        yield
    except LtclError as error:
        raise FileError(f"{path}: {error}") from None
    except Exception as error:
        reason = re.sub(r"\[Errno \d+\] |: '.*'", "", " ".join(str(error).split()))
        raise FileError(
            f"{path}: is no video that can be decoded, or a damaged or truncated one: {reason:.200}"
        ) from error


@contextlib.contextmanager
def _open(path: Path) -> Iterator[Any]:
    av = load_av("a video")
    # An open file, as FFmpeg takes names in UTF-8 alone.
    with (
        path.open("rb") as file,
        av.open(file, options=OPTIONS, metadata_errors="replace") as container,
    ):
        yield container


def _main_stream(container: Any) -> Any:
    """The main video stream; FileError if there is none that can be read."""
    stream = container.streams.best("video")
    if stream is None:
        raise FileError("has no video")
    if stream.codec_context is None:
        raise FileError(
            "is encoded in a way that FFmpeg cannot decode here; convert it, say to H.264"
        )
    if stream.metadata.get("alpha_mode") == "1":
        raise FileError("has transparency, whose light is not known; save it without")
    return stream


def _frame_count(container: Any, stream: Any) -> int | None:
    """The number of frames that is stored, else an estimate."""
    if stream.frames > 0:
        return stream.frames
    if container.duration is None or not stream.guessed_rate:
        return None
    # FFmpeg counts durations in microseconds.
    count = int(container.duration / 1e6 * float(stream.guessed_rate) + 0.5)
    return count if count > 0 else None


class _Decoder:
    """Frames of a file; a packet that cannot be decoded is left out, and damage is told once."""

    def __init__(self, path: Path, container: Any) -> None:
        self._path = path
        self._container = container
        self._stream = _main_stream(container)
        self._stream.thread_type = "AUTO"
        self._is_ffv1 = self._stream.codec_context.name == "ffv1"
        self._has_checksums = False
        self._has_mismatch = False
        self._has_told = False

    def __iter__(self) -> Iterator[Any]:
        from av.error import FFmpegError

        number = 0
        for packet in self._packets():
            self._check_slices(packet)
            try:
                frames = packet.decode()
            except FFmpegError:
                continue
            for frame in frames:
                number += 1
                if frame.is_corrupt:
                    self._tell_damage(f"frame {number}")
                yield frame

    def _packets(self) -> Iterator[Any]:
        """All packets; an empty one at the end gets the last frames out of the decoder."""
        from av import Packet
        from av.error import FFmpegError

        try:
            yield from self._container.demux(self._stream)
        except FFmpegError:
            # The file is cut off.
            packet = Packet()
            packet.stream = self._stream
            yield packet

    def _check_slices(self, packet: Any) -> None:
        """Compare checksums of FFV1 (RFC 9043), of which FFmpeg tells nobody but stderr."""
        if not self._is_ffv1 or packet.size == 0:
            return
        # A file whose checksums never hold has none.
        if ffv1_checksums_hold(bytes(packet)):
            self._has_checksums = True
        else:
            self._has_mismatch = True
        if self._has_checksums and self._has_mismatch:
            self._tell_damage("a frame")

    def _tell_damage(self, frame: str) -> None:
        if not self._has_told:
            self._has_told = True
            _logger.warning(
                "%s: %s is damaged, and perhaps others; its pixels are FFmpeg's guess",
                self._path,
                frame,
            )


def ffv1_checksums_hold(packet: bytes) -> bool:
    """True if a packet is made of slices, each with its size and a CRC that makes all of it zero.

    The CRC has its bits the other way round than that of zlib, and begins with zeros.
    """
    end = len(packet)
    while end > 0:
        size = int.from_bytes(packet[max(end - 8, 0) : max(end - 5, 0)]) + 8
        if size > end:
            return False
        reversed_slice = packet[end - size : end].translate(REVERSED_BITS)
        if zlib.crc32(reversed_slice, NO_BITS) != NO_BITS:
            return False
        end -= size
    return True
