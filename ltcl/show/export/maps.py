# SPDX-License-Identifier: BSD-3-Clause
"""Dense maps between camera and projector as EXR, NPZ and for OpenCV's remap; masks as PNG."""

from __future__ import annotations

import gzip
from pathlib import Path

import cv2
import numpy as np

from ltcl import images
from ltcl.files import replace_file
from ltcl.show.export.projector import ExportedProjector

# A coordinate that lies in no picture: OpenCV's remap shows its border there.
OUTSIDE = -1.0


def write_maps(folder: Path, projector: ExportedProjector) -> list[str]:
    """Write the maps; return the names of the files.

    NAME_camera_to_projector.exr : (H, W), red is the column and green the row of the projector,
        blue 1 where they are known, else all are 0.
    NAME_projector_to_camera.exr : (h, w), the same the other way.
    NAME_maps.npz : projector_x, projector_y (H, W) and camera_x, camera_y (h, w), NaN where they
        are not known; projector_grid and camera_grid.
    NAME_remap.yml.gz : `map_x`, `map_y` (h, w) of OpenCV, -1 where they are not known:
        ``cv2.remap(picture, map_x, map_y, cv2.INTER_LINEAR)`` brings a picture in the camera's
        pixels to the projector's. `inverse_map_x`, `inverse_map_y` (H, W) go the other way.
    """
    mapping = projector.mapping
    name = projector.name
    files = [f"{name}_camera_to_projector.exr", f"{name}_projector_to_camera.exr"]
    images.write(folder / files[0], _planes(mapping.x, mapping.y), bits=32)
    images.write(folder / files[1], _planes(projector.camera_x, projector.camera_y), bits=32)
    files.append(f"{name}_maps.npz")
    with replace_file(folder / files[-1]) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            projector_x=mapping.x,
            projector_y=mapping.y,
            camera_x=projector.camera_x,
            camera_y=projector.camera_y,
            projector_grid=np.array(projector.grid),
            camera_grid=np.array(projector.camera_grid),
        )
    files.append(f"{name}_remap.yml.gz")
    _write_remap(folder / files[-1], projector)
    return files


def _planes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Coordinates as red and green, and where they are known as blue."""
    is_known = np.isfinite(x) & np.isfinite(y)
    planes = np.stack([x, y, np.ones_like(x)], axis=-1)
    return np.where(is_known[..., None], planes, np.float32(0.0))


def _write_remap(path: Path, projector: ExportedProjector) -> None:
    storage = cv2.FileStorage(
        ".yml.gz", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_BASE64
    )
    for name, values in (
        ("map_x", projector.camera_x),
        ("map_y", projector.camera_y),
        ("inverse_map_x", projector.mapping.x),
        ("inverse_map_y", projector.mapping.y),
    ):
        storage.write(name, np.nan_to_num(values, nan=OUTSIDE))
    text = storage.releaseAndGetString()
    with replace_file(path) as temporary:
        temporary.write_bytes(gzip.compress(text.encode(), mtime=0))


def write_masks(folder: Path, projector: ExportedProjector) -> list[str]:
    """Write NAME_blend.png and NAME_black.png, 16 bits of linear light; return their names."""
    files = [f"{projector.name}_blend.png", f"{projector.name}_black.png"]
    for file, mask in zip(files, (projector.blend, projector.black), strict=True):
        images.write_codes(folder / file, mask_codes(mask))
    return files


def mask_codes(mask: np.ndarray, bits: int = 16) -> np.ndarray:
    """Codes of 8 or 16 bits of a mask in [0, 1]."""
    dtype = np.uint8 if bits == 8 else np.uint16
    return np.rint(np.iinfo(dtype).max * mask).astype(dtype)
