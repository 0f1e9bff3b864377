# SPDX-License-Identifier: BSD-3-Clause
"""Static files for other software, read back by libraries that know nothing of ltcl."""

from __future__ import annotations

import gzip
import xml.etree.ElementTree as ElementTree
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
import pytest

from ltcl import errors
from ltcl.acquisition import Correspondence
from ltcl.acquisition.captures.map_file import write_map
from ltcl.acquisition.radiometry import Response
from ltcl.show import export
from ltcl.show.export.cube import colour_codes

GRID = (20, 30)
CAMERA = (60, 120)
REMARK = "light between walls -- is not here"


def mapping(left: float) -> Correspondence:
    """A projector of 20 x 30 pixels that covers 66 of 120 columns of the camera, from `left` on."""
    row, column = np.indices(CAMERA, np.float32)
    x = (column - left) / 2.2 - 0.3
    y = row / 3.0 - 0.2
    valid = (x > -0.5) & (x < GRID[1] - 0.5) & (y > -0.5) & (y < GRID[0] - 0.5)
    return Correspondence(x, y, valid, GRID)


@pytest.fixture(scope="module")
def scans(tmp_path_factory) -> list[Path]:
    """Two projectors that overlap."""
    folders = []
    for left in (5.0, 49.0):
        folder = tmp_path_factory.mktemp("scan")
        write_map(folder / "map.npz", mapping(left))
        folders.append(folder)
    return folders


@pytest.fixture(scope="module")
def projectors(scans) -> list[export.ExportedProjector]:
    return export.read_projectors(scans)


def test_maps_lead_back(projectors):
    for projector, left in zip(projectors, (5.0, 49.0), strict=True):
        assert projector.seen.mean() > 0.9
        row, column = np.indices(GRID)
        x = (column + 0.3) * 2.2 + left
        y = (row + 0.2) * 3.0
        inner = np.s_[2:-2, 2:-2]
        np.testing.assert_allclose(projector.camera_x[inner], x[inner], atol=0.1)
        np.testing.assert_allclose(projector.camera_y[inner], y[inner], atol=0.1)


def test_shares_add_up_to_one(projectors):
    total = np.zeros(CAMERA)
    for projector in projectors:
        share = cv2.remap(
            projector.blend, projector.mapping.x, projector.mapping.y, cv2.INTER_LINEAR
        )
        total += np.where(projector.mapping.valid, share, 0.0)
    inner = total[6:-6, 12:-12]
    np.testing.assert_allclose(inner, 1.0, atol=0.08)
    assert abs(inner - 1.0).mean() < 0.01
    left, right = projectors
    # They are whole where one projector is alone, and fall to 0 at the border in the overlap.
    assert left.blend[10, 2] == pytest.approx(1.0)
    assert left.blend[10, -1] < 0.1
    assert right.blend[10, 0] < 0.1
    assert left.black.max() == 0.0


def test_opencv_remaps_by_the_file(projectors, tmp_path):
    files = export.write_maps(tmp_path, projectors[0])
    text = gzip.decompress((tmp_path / files[3]).read_bytes()).decode()
    storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    map_x = storage.getNode("map_x").mat()
    map_y = storage.getNode("map_y").mat()
    picture = np.add.outer(np.arange(60.0), np.arange(120.0)).astype(np.float32)
    shown = cv2.remap(picture, map_x, map_y, cv2.INTER_LINEAR)
    expected = projectors[0].camera_x + projectors[0].camera_y
    np.testing.assert_allclose(shown[2:-2, 2:-2], expected[2:-2, 2:-2], atol=0.2)


def test_maps_as_exr_and_npz(projectors, tmp_path):
    files = export.write_maps(tmp_path, projectors[0])
    with OpenEXR.File(str(tmp_path / files[0])) as file:
        planes = file.channels()["RGB"].pixels
    known = planes[..., 2] == 1.0
    np.testing.assert_array_equal(known, projectors[0].mapping.valid)
    np.testing.assert_array_equal(planes[known][:, 0], projectors[0].mapping.x[known])
    with np.load(tmp_path / files[2]) as arrays:
        np.testing.assert_array_equal(arrays["camera_x"], projectors[0].camera_x)
        assert arrays["projector_grid"].tolist() == [*GRID]


def read_pfm(data: bytes) -> np.ndarray:
    """Read a PFM of three channels, little-endian, the top row first."""
    magic, size, scale, values = data.split(b"\n", 3)
    assert magic == b"PF"
    assert float(scale) < 0
    width, height = map(int, size.split())
    return np.frombuffer(values, "<f4").reshape(height, width, 3)[::-1]


@pytest.mark.parametrize(("version", "width"), [("2.0", "xResolution"), ("1.0", "Xresolution")])
def test_mpcdi_reads_back(projectors, tmp_path, version, width):
    path = tmp_path / "projectors.mpcdi"
    export.write_mpcdi(path, projectors, REMARK, version)
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        root = ElementTree.fromstring(archive.read("mpcdi.xml"))  # noqa: S314 - we wrote it
        assert root.attrib["version"] == version
        assert root.attrib["profile"] == "2d"
        regions = root.findall("./display/buffer/region")
        assert [region.attrib[width] for region in regions] == ["30", "30"]
        filesets = root.findall("./files/fileset")
        names = [fileset.attrib["region"] for fileset in filesets]
        assert names == [region.attrib["id"] for region in regions]
        for fileset, projector in zip(filesets, projectors, strict=True):
            place = read_pfm(archive.read(path_of(fileset, "geometryWarpFile")))
            np.testing.assert_allclose(place[..., 0], (projector.camera_x + 0.5) / CAMERA[1])
            np.testing.assert_allclose(place[..., 1], (projector.camera_y + 0.5) / CAMERA[0])
            for kind, mask in (("alphaMap", projector.blend), ("betaMap", projector.black)):
                data = np.frombuffer(archive.read(path_of(fileset, kind)), np.uint8)
                codes: Any = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
                assert codes.dtype == np.uint16
                np.testing.assert_allclose(codes / 65535.0, mask, atol=1e-5)


def path_of(fileset: ElementTree.Element, kind: str) -> str:
    element = fileset.find(f"{kind}/path")
    assert element is not None
    assert element.text is not None
    return element.text


def test_mesh_covers_what_is_seen(projectors, tmp_path):
    (name,) = export.write_mesh(tmp_path, projectors[0], REMARK)
    vertices = []
    textures = []
    faces = []
    for line in (tmp_path / name).read_text().splitlines():
        kind, *words = line.split()
        if kind == "v":
            vertices.append([float(word) for word in words])
        elif kind == "vt":
            textures.append([float(word) for word in words])
        elif kind == "f":
            faces.append([int(word.split("/")[0]) - 1 for word in words])
    assert len(vertices) == len(textures) == projectors[0].seen.sum()
    corners = np.array(vertices)[np.array(faces)][..., :2]
    x, y = corners[..., 0], corners[..., 1]
    # Areas by the shoelace formula are positive: corners go against the clock.
    area = 0.5 * (x * np.roll(y, -1, 1) - np.roll(x, -1, 1) * y).sum(axis=1)
    assert (area > 0).all()
    inner_cells = (GRID[0] - 1) * (GRID[1] - 1)
    assert area.sum() == pytest.approx(len(faces) / inner_cells * 19 / 20 * 29 / 30, rel=1e-3)


class Calibrated:
    """What .cube files need of a calibration."""

    projector = Response(np.linspace(0.0, 1.0, 257)[None] ** 1.8)
    mixing = np.array([[1.0, 0.1, 0.0], [0.05, 1.0, 0.1], [0.0, 0.2, 1.0]])


def test_colours_are_undone():
    calibration: Any = Calibrated()
    codes = colour_codes(calibration, 5)
    light = codes.astype(np.float64) ** 1.8 @ calibration.mixing.T
    # White and grey stay, as the projector can show them.
    np.testing.assert_allclose(codes[-1], 1.0, atol=1e-5)
    grey = codes.reshape(5, 5, 5, 3)[2, 2, 2]
    np.testing.assert_allclose(grey, ((0.5 + 0.055) / 1.055) ** (2.4 / 1.8), rtol=1e-3)
    inside = ((codes > 0) & (codes < 1)).all(axis=1)
    steps = ((np.linspace(0, 1, 5) + 0.055) / 1.055) ** 2.4
    blue, green, red = np.meshgrid(steps, steps, steps, indexing="ij")
    wanted = np.stack([red, green, blue], -1).reshape(-1, 3) * calibration.mixing.sum(axis=1)
    np.testing.assert_allclose(light[inside], wanted[inside], rtol=2e-3)


def test_cameras_must_agree(scans, tmp_path):
    write_map(tmp_path / "map.npz", Correspondence.aligned((4, 5)))
    with pytest.raises(errors.InputError, match=r"camera of \(4, 5\) pixels; it must be"):
        export.read_projectors([*scans, tmp_path])
    with pytest.raises(errors.FileError, match="is no store"):
        export.read_projectors([tmp_path / "nowhere"])
