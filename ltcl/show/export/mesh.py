# SPDX-License-Identifier: BSD-3-Clause
"""A warp mesh as Wavefront OBJ: the projector's picture, textured with the camera's."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ltcl.files import replace_file
from ltcl.show.export.projector import ExportedProjector

# Cells along the longer side.
MESH_CELLS = 128


def write_mesh(folder: Path, projector: ExportedProjector, remark: str) -> list[str]:
    """Write NAME.obj; return its name.

    Vertices lie in the projector's picture, from (0, 0) at the lower left to (1, 1); texture
    coordinates in the camera's picture, in the same way. Cells with a corner that is not seen are
    left out.
    """
    height, width = projector.grid
    step = max(-(-max(height, width) // MESH_CELLS), 1)
    rows = _places(height, step)
    columns = _places(width, step)
    u = projector.camera_x[np.ix_(rows, columns)]
    v = projector.camera_y[np.ix_(rows, columns)]
    is_seen = np.isfinite(u) & np.isfinite(v)
    # Numbers of vertices, from 1.
    number = np.cumsum(is_seen).reshape(is_seen.shape)
    camera_height, camera_width = projector.camera_grid
    lines = [f"# {remark}", f"o {projector.name}"]
    y, x = np.meshgrid(rows, columns, indexing="ij")
    for row, column in np.argwhere(is_seen):
        left = (x[row, column] + 0.5) / width
        up = 1.0 - (y[row, column] + 0.5) / height
        lines.append(f"v {left:.6f} {up:.6f} 0")
    for row, column in np.argwhere(is_seen):
        left = (u[row, column] + 0.5) / camera_width
        up = 1.0 - (v[row, column] + 0.5) / camera_height
        lines.append(f"vt {left:.6f} {up:.6f}")
    is_whole = is_seen[:-1, :-1] & is_seen[1:, :-1] & is_seen[:-1, 1:] & is_seen[1:, 1:]
    for row, column in np.argwhere(is_whole):
        # Against the clock, as seen from the front.
        corners = [
            number[row, column],
            number[row + 1, column],
            number[row + 1, column + 1],
            number[row, column + 1],
        ]
        words = [f"{corner}/{corner}" for corner in corners]
        lines.append("f " + " ".join(words))
    name = f"{projector.name}.obj"
    with replace_file(folder / name) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return [name]


def _places(side: int, step: int) -> np.ndarray:
    """Every `step`-th pixel, and the last one."""
    places = np.arange(0, side, step)
    if places[-1] == side - 1:
        return places
    return np.append(places, side - 1)
