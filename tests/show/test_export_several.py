# SPDX-License-Identifier: BSD-3-Clause
"""Static files of several projectors, against the geometry that they were simulated with."""

from __future__ import annotations

import dataclasses
import gzip
import shutil
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import ltcl
from ltcl import acquisition
from ltcl.acquisition import Project
from ltcl.acquisition.several import keep_facts
from ltcl.cli.side_by_side import VirtualProjector, side_by_side
from ltcl.errors import FileError, InputError
from ltcl.show import export
from ltcl.store import StoreRecord, formats

# Patches of the corner, and pixels of the camera, of which three lie along the side of a patch.
SCENE = (12, 24)
CAMERA = (36, 72)
MARGIN = 0.04
# Distances in camera pixels, of which a projector pixel has almost three along its side. The camera
# sees patches of three, so that it knows places to half of one each way, and to a quarter in the
# mean.
LARGEST_DISTANCE = 1.5 * np.sqrt(2.0)
MEAN_DISTANCE = 0.75


@pytest.fixture(scope="module")
def simulated() -> list[VirtualProjector]:
    return side_by_side(2, SCENE)


@pytest.fixture(scope="module")
def projectors(room_of_two: Path) -> list[export.ExportedProjector]:
    return export.read_projectors([str(room_of_two)])


def places(projector: VirtualProjector) -> tuple[np.ndarray, np.ndarray]:
    """Column and row of the camera at the centres of the projector's pixels, (h, w)."""
    height, width = projector.grid
    row, column = np.indices(projector.grid)
    across = projector.left + (column + 0.5) / width * (projector.right - projector.left)
    down = -MARGIN + (row + 0.5) / height * (1.0 + 2.0 * MARGIN)
    return across * CAMERA[1] - 0.5, down * CAMERA[0] - 0.5


def check_places(x: np.ndarray, y: np.ndarray, projector: VirtualProjector) -> None:
    """Compare places, NaN where they are not known, with the simulated ones."""
    true_x, true_y = places(projector)
    distance = np.hypot(x - true_x, y - true_y)
    # A fifth lies beyond the camera's picture.
    assert np.isfinite(distance).mean() > 0.8
    assert np.nanmean(distance) < MEAN_DISTANCE
    assert np.nanmax(distance) < LARGEST_DISTANCE


def test_a_scan_given_twice_is_refused(room_of_two: Path) -> None:
    again = room_of_two / ".." / room_of_two.name / "left.zarr"
    with pytest.raises(InputError, match="given twice"):
        export.read_projectors([room_of_two, again])


def test_maps_lead_to_the_projectors_own_pixels(projectors, simulated) -> None:
    assert [projector.name for projector in projectors] == ["left", "right"]
    for projector, truth in zip(projectors, simulated, strict=True):
        assert projector.grid == truth.grid
        assert projector.camera_grid == CAMERA
        for mask in (projector.blend, projector.black):
            assert mask.shape == truth.grid
        check_places(projector.camera_x, projector.camera_y, truth)
        true_x, true_y = places(truth)
        column = (true_x[0, 1] - true_x[0, 0]) * projector.mapping.x + true_x[0, 0]
        row = (true_y[1, 0] - true_y[0, 0]) * projector.mapping.y + true_y[0, 0]
        v, u = np.indices(CAMERA)
        assert np.nanmean(np.hypot(column - u, row - v)) < MEAN_DISTANCE
        # Each projector lights two thirds of the scene, less a border.
        assert 0.55 < projector.mapping.valid.mean() < 0.7


def spot(column: float, row: float) -> np.ndarray:
    """A picture of the camera with a round spot."""
    v, u = np.indices(CAMERA)
    squared = (u - column) ** 2 + (v - row) ** 2
    return np.exp(-0.5 * squared / 5.0**2).astype(np.float32)


def centre(picture: np.ndarray) -> np.ndarray:
    """Column and row of the middle of a spot, by the moments of its brighter half."""
    light = np.maximum(picture - 0.3 * picture.max(), 0.0)
    v, u = np.indices(picture.shape)
    return np.array([(u * light).sum(), (v * light).sum()]) / light.sum()


@pytest.mark.parametrize(("number", "column"), [(0, 18.0), (0, 32.0), (1, 38.0), (1, 52.0)])
def test_a_picture_lands_where_the_map_says(
    projectors, simulated, tmp_path: Path, number: int, column: float
) -> None:
    """OpenCV's remap makes the picture of the projector, which the virtual one shows."""
    files = export.write_maps(tmp_path, projectors[number])
    text = gzip.decompress((tmp_path / files[3]).read_bytes()).decode()
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    map_x = storage.getNode("map_x").mat()
    map_y = storage.getNode("map_y").mat()
    desired = spot(column, 17.0)
    shown = cv2.remap(desired, map_x, map_y, cv2.INTER_LINEAR)
    assert shown.shape == simulated[number].grid
    on_patches = (simulated[number].direct(SCENE) @ shown.ravel()).reshape(SCENE)
    seen = np.kron(on_patches, np.ones((3, 3)))
    distance = np.hypot(*(centre(seen) - centre(desired)))
    assert distance < 1.0


def test_mpcdi_has_the_projectors_pixels(projectors, simulated, tmp_path: Path) -> None:
    path = tmp_path / "projectors.mpcdi"
    export.write_mpcdi(path, projectors, "remark")
    with zipfile.ZipFile(path) as archive:
        for truth in simulated:
            _, size, _, values = archive.read(f"{truth.name}_warp.pfm").split(b"\n", 3)
            width, height = map(int, size.split())
            assert (height, width) == truth.grid
            warp = np.frombuffer(values, "<f4").reshape(height, width, 3)[::-1]
            x = warp[..., 0] * CAMERA[1] - 0.5
            y = (1.0 - warp[..., 1]) * CAMERA[0] - 0.5
            check_places(x, y, truth)
            for kind in ("alpha", "beta"):
                data = np.frombuffer(archive.read(f"{truth.name}_{kind}.png"), np.uint8)
                mask: Any = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
                assert mask.shape == truth.grid


def test_shares_add_up_to_one(projectors) -> None:
    total = np.zeros(CAMERA)
    for projector in projectors:
        mapping = projector.mapping
        share = cv2.remap(projector.blend, mapping.x, mapping.y, cv2.INTER_LINEAR)
        total += np.where(mapping.valid, share, 0.0)
    inner = total[6:-6, 6:-6]
    assert abs(inner - 1.0).mean() < 0.03


def test_stores_are_the_same_as_their_folder(projectors, room_of_two: Path) -> None:
    stores = [room_of_two / "right.zarr", room_of_two / "left.zarr"]
    right, left = export.read_projectors(stores)
    assert (left.name, right.name) == ("left", "right")
    np.testing.assert_array_equal(left.camera_x, projectors[0].camera_x)


def test_projectors_of_one_name_get_numbers(room_of_two: Path, tmp_path: Path) -> None:
    stores = [room_of_two / "left.zarr"]
    for folder in ("second", "third"):
        stores.append(shutil.copytree(room_of_two, tmp_path / folder) / "left.zarr")
    scans = export.read_scans(stores)
    assert [scan.name for scan in scans] == ["left", "left_2", "left_3"]


def test_a_store_without_its_map_is_refused(room_of_two: Path, tmp_path: Path) -> None:
    """Its own map leads to squares of camera pixels, which nobody wants as a file."""
    (tmp_path / "left.zarr").symlink_to(room_of_two / "left.zarr")
    with pytest.raises(FileError, match=r"squares of camera pixels.*left\.projector\.json"):
        export.read_scans([tmp_path / "left.zarr"])
    facts = (room_of_two / "left.projector.json").read_text()
    (tmp_path / "left.projector.json").write_text(facts)
    with pytest.raises(FileError, match=r"left\.map\.npz: no such file"):
        export.read_scans([tmp_path / "left.zarr"])


def test_unfinished_scans_are_named(room_of_two: Path, tmp_path: Path) -> None:
    (tmp_path / "acquisition.toml").write_text((room_of_two / "acquisition.toml").read_text())
    with pytest.raises(FileError, match=r"left\.zarr: no such folder yet; 'ltcl acquire run'"):
        export.read_scans([tmp_path])


@pytest.mark.slow
def test_a_projector_that_was_bumped_has_the_map_of_now(
    room_of_two: Path, simulated, tmp_path: Path
) -> None:
    """An update tells where squares of T went, and the map of the scan leads on from there."""
    folder = tmp_path / "room"
    shutil.copytree(room_of_two, folder)
    step = 0.5 * (simulated[0].right - simulated[0].left) / simulated[0].grid[1]
    moved = dataclasses.replace(
        simulated[0], left=simulated[0].left + step, right=simulated[0].right + step
    )
    S = ltcl.scenes.dihedral(SCENE[0], albedo=0.7).transport().to_numpy() / 0.7
    matrix = (S @ moved.direct(SCENE).toarray()).astype(np.float32)
    record = StoreRecord((matrix,), grid=moved.grid, camera_grid=SCENE)
    formats.write(folder / "left.npz", record)
    project = Project.open(folder, "left")
    target = folder / "left.updated.zarr"
    with project.rig() as rig:
        acquisition.update(rig, project.store, store=target)
    keep_facts(project, target)
    distances = []
    for store in (project.store, target):
        (projector,) = export.read_projectors([store])
        assert projector.name == "left"
        true_x, _ = places(moved)
        distances.append(float(np.nanmean(np.abs(projector.camera_x - true_x))))
    before, after = distances
    assert after < 0.6 * before
