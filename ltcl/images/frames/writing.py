# SPDX-License-Identifier: BSD-3-Clause
"""Frames written as a video file by OpenCV's FFmpeg, 8 bits a channel in sRGB.

Only codecs that every OpenCV wheel brings are used: FFV1, which loses nothing, in Matroska and AVI; MPEG-4,
which does, in MP4, for the eye. OpenCV cuts odd sizes to even ones without a word, so they are refused.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from ltcl import checks
from ltcl.errors import FileError, InputError
from ltcl.files import as_path, replace_file, unknown_extension
from ltcl.images import codes
from ltcl.images.frames.video import Video
from ltcl.images.pictures import as_picture
from ltcl.images.raster import silence

CODECS = {".mkv": "FFV1", ".avi": "FFV1", ".mp4": "mp4v"}
"""Extensions of videos that can be written, and the codec of each; FFV1 is lossless."""


def check_video(path: str | os.PathLike[str], grid: tuple[int, int]) -> None:
    """Refuse a video of (h, w) frames that could not be written, before there are any.

    Raises
    ------
    FileError
        An extension without codec.
    InputError
        An odd size.
    """
    path = as_path(path)
    if path.suffix.lower() not in CODECS:
        raise FileError(f"{path}: {unknown_extension(path)}; a video must be {', '.join(CODECS)}")
    h, w = grid
    if h % 2 or w % 2:
        raise InputError(
            f"{path}: frames are {h} x {w} pixels; those of a video must be even, pictures need not"
        )


def write_video(path: str | os.PathLike[str], pictures: Iterable[np.ndarray], fps: float = 25.0) -> int:
    """Write linear pictures as a video; an earlier file is replaced whole or not at all.

    Parameters
    ----------
    path
        .mkv or .avi, lossless, or .mp4.
    pictures : iterable of (h, w) or (h, w, 3)
        Linear, clipped to [0, 1]; h and w even, the same for all.
    fps : float
        Frames a second.

    Returns
    -------
    int
        The number of frames.

    Raises
    ------
    InputError
        An odd size, frames of different sizes, none, NaN.
    FileError
        An unknown extension, or the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "grey.mkv"
    >>> write_video(path, [np.full((4, 6), level) for level in (0.0, 0.5, 1.0)])
    3
    >>> [float(frame.picture().mean().round(1)) for frame in Video(path)]
    [0.0, 0.5, 1.0]
    """
    path = as_path(path)
    fps = checks.number("fps", fps, above=0.0)
    ordered = (as_picture("a frame", picture) for picture in pictures)
    first = next(ordered, None)
    if first is None:
        raise InputError(f"{path}: there are no frames to write")
    grid = first.shape[:2]
    check_video(path, (grid[0], grid[1]))
    with replace_file(path) as temporary:
        with _writer(path, temporary, fps, (grid[1], grid[0])) as writer:
            writer.write(_codes(first))
            count = 1
            for count, picture in enumerate(ordered, start=2):
                if picture.shape[:2] != grid:
                    raise InputError(f"frame {count} is {picture.shape[:2]}; it must be {grid} as the first")
                writer.write(_codes(picture))
        found = Video(temporary).count  # the writer is silent where the disk is full
        if found != count:
            raise FileError(
                f"{path}: cannot be written: {found} of {count} frames are there; is the disk full?"
            )
    return count


@contextmanager
def _writer(path: Path, temporary: Path, fps: float, size: tuple[int, int]):
    fourcc = cv2.VideoWriter.fourcc(*CODECS[path.suffix.lower()])
    with silence:
        writer = cv2.VideoWriter(str(temporary), cv2.CAP_FFMPEG, fourcc, fps, size)
    try:
        if not writer.isOpened():
            raise FileError(f"{path}: this OpenCV cannot write {CODECS[path.suffix.lower()]} there")
        yield writer
    finally:
        writer.release()


def _codes(picture: np.ndarray) -> np.ndarray:
    """BGR uint8 (h, w, 3), sRGB."""
    stored = codes.from_linear(picture, "srgb", 8, is_float=False)
    if stored.ndim == 2:
        stored = np.repeat(stored[..., None], 3, axis=-1)
    return np.ascontiguousarray(stored[..., ::-1])
