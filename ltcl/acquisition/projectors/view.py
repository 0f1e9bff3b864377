# SPDX-License-Identifier: BSD-3-Clause
"""`ProjectorView`: which projector pixel each camera pixel sees, measured before a scan.

White tells the exposure; Gray code at it gives the map, and a photograph of blocks is kept, so that
it can be seen later whether the camera has moved. In a file, NAME.map.npz, the map is one as
`ltcl acquire import` makes it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ltcl.acquisition.captures.map_file import read_map
from ltcl.acquisition.geometry import Correspondence, GrayCode, decode
from ltcl.acquisition.metering import find_white_exposure
from ltcl.acquisition.projectors.movement import blocks
from ltcl.acquisition.rig import Rig, Shots
from ltcl.acquisition.session import (
    CaptureSession,
    Photograph,
    acquisition_error,
    photograph_log,
)
from ltcl.errors import FileError
from ltcl.files import input_file, replace_file

# Photographs that usually find the exposure of white, and that of the blocks.
EXPECTED_PROBES = 2
BLOCK_PHOTOGRAPHS = 1


@dataclass(frozen=True, kw_only=True, eq=False)
class ProjectorView:
    """The map of a projector, and a photograph by which a movement is found.

    Attributes
    ----------
    mapping : Correspondence
    blocks : (H, W[, 3])
        Photograph of blocks, in [0, 1] of full scale.
    seconds : float
        Its exposure.
    """

    mapping: Correspondence
    blocks: np.ndarray
    seconds: float


def expected_photographs(grid: tuple[int, int]) -> int:
    """Photographs that `measure_view` takes, about.

    >>> expected_photographs((24, 32))
    25
    """
    return EXPECTED_PROBES + GrayCode(grid).count + BLOCK_PHOTOGRAPHS


def measure_view(
    rig: Rig, path: Path, progress: Callable[[str, int, int], object] | None = None
) -> ProjectorView:
    """Photograph Gray code, decode it, and keep the view in a file.

    Photographs of an earlier run that was stopped are used again. Errors are those of
    `ltcl.acquire`.
    """
    shots = Shots(rig)
    expected = expected_photographs(shots.grid)

    def count(done: int) -> None:
        if progress is not None:
            progress("Gray code", done, max(done, expected))

    with photograph_log(path, shots) as log:
        view = _photograph_view(CaptureSession(shots, log, count))
        _write_view(path, view)
    return view


def _photograph_view(session: CaptureSession) -> ProjectorView:
    shots = session.shots
    seconds = find_white_exposure(session)
    patterns = GrayCode(shots.grid).patterns()
    requests = [(codes, seconds) for codes in patterns]
    stripes, [of_blocks] = session.take([requests, [(blocks(shots.grid), seconds)]])
    images = [photograph.image for photograph in stripes]
    with acquisition_error("the geometry"):
        mapping = decode(images, shots.grid, levels=shots.levels)
    return ProjectorView(mapping=mapping, blocks=_image(of_blocks), seconds=seconds)


def _image(photograph: Photograph) -> np.ndarray:
    return photograph.image.astype(np.float32)


def photograph_blocks(rig: Rig, seconds: float) -> np.ndarray:
    """A photograph of the blocks of a projector, in [0, 1] of full scale."""
    shots = Shots(rig)
    shots.prepare([(blocks(shots.grid), seconds)])
    return shots.photograph(blocks(shots.grid), seconds)


def _write_view(path: Path, view: ProjectorView) -> None:
    mapping = view.mapping
    arrays: dict[str, Any] = {"x": mapping.x, "y": mapping.y, "grid": np.array(mapping.grid)}
    arrays |= {"blocks": view.blocks, "seconds": np.array(view.seconds)}
    with replace_file(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)


def read_view(path: Path) -> ProjectorView:
    """Read a view that `measure_view` kept; FileError if it is damaged or another file."""
    mapping = read_map(path)
    with np.load(input_file(path), allow_pickle=False) as arrays:
        if "blocks" not in arrays or "seconds" not in arrays:
            raise FileError(f"{path}: has no photograph of blocks; remove it to measure it again")
        return ProjectorView(
            mapping=mapping,
            blocks=arrays["blocks"],
            seconds=float(arrays["seconds"]),
        )
