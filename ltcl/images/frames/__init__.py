# SPDX-License-Identifier: BSD-3-Clause
"""Many pictures in a row: a folder of them or a video file, read as linear light; videos written.

A frame is told by its number, from 1, in every refusal. Frames of one source have one size.
"""

from __future__ import annotations

import os
from pathlib import Path

from ltcl import checks
from ltcl.errors import FileError
from ltcl.files import as_path, unknown_extension
from ltcl.images.codes import ENCODINGS, Encoding
from ltcl.images.frames.folder import Folder
from ltcl.images.frames.source import Frame, Source
from ltcl.images.frames.video import Video
from ltcl.images.frames.writing import CODECS, check_video, write_video

__all__ = [
    "CODECS",
    "EXTENSIONS",
    "Folder",
    "Frame",
    "Source",
    "Video",
    "check_video",
    "is_frames",
    "open_frames",
    "write_video",
]

EXTENSIONS = (
    *(".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi"),
    *(".mpg", ".mpeg", ".ts", ".wmv", ".flv", ".ogv", ".3gp"),
)
"""Of video files; whether one can be decoded is for OpenCV's FFmpeg to say."""


def is_frames(path: str | os.PathLike[str]) -> bool:
    """Whether `path` is a folder, or is called like a video."""
    return Path(path).is_dir() or Path(path).suffix.lower() in EXTENSIONS


def open_frames(path: str | os.PathLike[str], *, encoding: Encoding = "auto") -> Source:
    """Open a folder of pictures or a video file.

    Parameters
    ----------
    path
        A folder, whose pictures (as of `ltcl.images.read`) are taken in natural order, frame2 before frame10,
        hidden files and other files left out; or a video file.
    encoding
        What the frames hold, as in `ltcl.images.read`; those of a video have 8 bits.

    Returns
    -------
    Source
        An iterable of `Frame`, from the first one at every iteration.

    Raises
    ------
    FileError
        Nothing there, no picture in the folder, two files of one name in it, an unknown extension, or no
        video that can be decoded.
    InputError
        An unknown encoding.

    Examples
    --------
    >>> import tempfile, numpy as np
    >>> from ltcl import images
    >>> folder = Path(tempfile.mkdtemp())
    >>> for number in (10, 9):
    ...     images.write(folder / f"sky{number}.exr", np.full((2, 3), number))
    >>> [(frame.number, frame.name, frame.picture().max()) for frame in open_frames(folder)]
    [(1, 'sky9.exr', np.float32(9.0)), (2, 'sky10.exr', np.float32(10.0))]
    """
    checks.one_of("encoding", encoding, ENCODINGS)
    path = as_path(path)
    if path.is_dir():
        return Folder(path, encoding)
    if path.exists() and path.suffix.lower() not in EXTENSIONS:
        raise FileError(
            f"{path}: {unknown_extension(path)}; frames are a folder, or a video: {', '.join(EXTENSIONS)}"
        )
    return Video(path, encoding)
