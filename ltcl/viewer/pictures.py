# SPDX-License-Identifier: BSD-3-Clause
"""`KeptPictures`: pictures of a viewer, on the grids of its transport, by numbers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ltcl import checks, images
from ltcl.errors import InputError, LtclError
from ltcl.images.pictures import BITS, RESIZES
from ltcl.transport.projectors import CombinedTransport
from ltcl.viewer.messages import LARGEST_FILE

# Bytes of a decoded picture: 64 million pixels.
LARGEST_PICTURE = 3 << 29
MAX_NAME_LENGTH = 255
# Uploaded pictures that are kept; an older one is dropped.
MAX_UPLOADS = 16


@dataclass(frozen=True, kw_only=True)
class KeptPicture:
    """A picture on the grids of camera and projector, by the way of `RESIZES` that it took."""

    name: str
    for_camera: dict[str, np.ndarray]
    for_projector: dict[str, np.ndarray]


class KeptPictures:
    """The first pictures of a viewer, and the last `MAX_UPLOADS` that came later."""

    def __init__(self, first_count: int) -> None:
        self._first_count = first_count
        self._count = 0
        self._pictures: dict[int, KeptPicture] = {}

    def add(self, name: str, picture: np.ndarray, T: Any) -> int:
        """Keep a picture on both grids of a transport; return its number."""
        for_camera = _resized(picture, T.camera_grid)
        for_projector = for_camera
        if T.grid != T.camera_grid:
            for_projector = _for_projectors(picture, T)
        self._count += 1
        self._pictures[self._count] = KeptPicture(
            name=name, for_camera=for_camera, for_projector=for_projector
        )
        if self._count > self._first_count + MAX_UPLOADS:
            del self._pictures[self._count - MAX_UPLOADS]
        return self._count

    def get(self, number: Any) -> KeptPicture:
        """Return a picture by its number; InputError if there is none."""
        return self._pictures[checks.one_of("picture", number, self._pictures)]

    def entries(self) -> list[dict[str, Any]]:
        """Return numbers and names."""
        entries = []
        for number, picture in self._pictures.items():
            entries.append({"picture": number, "name": picture.name})
        return entries


def decode_file(name: Any, content: Any) -> np.ndarray:
    """Decode the picture of a file, of which `content` are the bytes (size,), uint8.

    InputError, before it is decoded, if it has too many pixels.
    """
    if not isinstance(name, str) or len(name) > MAX_NAME_LENGTH:
        problem = f"name is {checks.shown(name)}"
        raise InputError(f"{problem}; it must be a name of at most {MAX_NAME_LENGTH} characters")
    if not isinstance(content, np.ndarray) or content.ndim != 1:
        raise InputError(f"content is {checks.shown(content)}; it must be the bytes of a file")
    checks.count("size of the file", content.size, most=LARGEST_FILE)
    suffix = checks.one_of("extension", Path(name).suffix.lower(), BITS)
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"picture{suffix}"
        path.write_bytes(content.tobytes())
        try:
            return images.read(path, memory=LARGEST_PICTURE)
        except LtclError as error:
            raise InputError(str(error).removeprefix(f"{path}: ")) from None


def _for_projectors(picture: np.ndarray, T: Any) -> dict[str, np.ndarray]:
    """The picture on the projector's grid, or on that of each of several, side by side."""
    if not isinstance(T, CombinedTransport):
        return _resized(picture, T.grid)
    resized = [_resized(picture, grid) for grid in T.montage.grids]
    joined = {}
    for way in resized[0]:
        joined[way] = T.join([own[way] for own in resized])
    return joined


def _resized(picture: np.ndarray, grid: tuple[int, int]) -> dict[str, np.ndarray]:
    """Return a picture on a grid, by each way of `RESIZES`; one array where all are the same."""
    h, w = picture.shape[:2]
    if (h, w) == grid:
        return dict.fromkeys(RESIZES, picture)
    if h * grid[1] == w * grid[0]:
        return dict.fromkeys(RESIZES, images.resize(picture, grid))
    ways = {}
    for how in RESIZES:
        ways[how] = images.resize(picture, grid, how)
    return ways
