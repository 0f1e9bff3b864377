# SPDX-License-Identifier: BSD-3-Clause
"""The map from camera to projector as a file: .npz with the arrays x, y and grid.

x and y are (H, W) float32, the column and the row of the projector that a camera pixel sees, with
centres of pixels at integers; NaN where it is not known. grid is the projector's (height, width).
"""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from ltcl import checks
from ltcl.acquisition.geometry import Correspondence
from ltcl.errors import FileError, InputError
from ltcl.files import input_file, replace_file

NAMES = ("x", "y", "grid")


def write_map(path: Path, mapping: Correspondence) -> None:
    """Write a map as .npz."""
    with replace_file(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, x=mapping.x, y=mapping.y, grid=np.array(mapping.grid))


def read_map(path: Path) -> Correspondence:
    """Read a map that `write_map` wrote; FileError if it is damaged or another file."""
    try:
        with np.load(input_file(path), allow_pickle=False) as arrays:
            x, y, grid = (arrays[name] for name in NAMES)
            size = checks.grid("grid", tuple(grid.tolist()))
        return Correspondence(x, y, np.isfinite(x) & np.isfinite(y), size)
    except (KeyError, ValueError, OSError, zipfile.BadZipFile, InputError, EOFError) as error:
        if isinstance(error, FileError):
            raise
        raise FileError(f"{path}: is not a map with the arrays {NAMES}: {error}") from error
