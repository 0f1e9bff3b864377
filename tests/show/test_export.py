# SPDX-License-Identifier: BSD-3-Clause
"""Static files for other software, read back by libraries that know nothing of ltcl."""

from __future__ import annotations

import dataclasses
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


@pytest.fixture(scope="module")
def lifted(projectors) -> list[export.ExportedProjector]:
    """The same with black to add, which photographs from elsewhere do not tell."""
    return [dataclasses.replace(each, black=0.02 * each.blend) for each in projectors]


@pytest.mark.parametrize("version", ["1.0", "2.0"])
def test_mpcdi_names_what_readers_look_up(lifted, tmp_path, version):
    path = tmp_path / "projectors.mpcdi"
    export.write_mpcdi(path, lifted, REMARK, version)
    width, levels = {
        "1.0": ("Xresolution", {"level": "4"}),
        "2.0": ("xResolution", {"geometry": "2", "color": "2"}),
    }[version]
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        root = ElementTree.fromstring(archive.read("mpcdi.xml"))  # noqa: S314 - we wrote it
    assert root.attrib["version"] == version
    assert root.attrib["profile"] == "2d"
    assert levels.items() <= root.attrib.items()
    regions = root.findall("./display/buffer/region")
    assert [region.attrib[width] for region in regions] == ["30", "30"]
    filesets = root.findall("./files/fileset")
    names = [fileset.attrib["region"] for fileset in filesets]
    assert names == [region.attrib["id"] for region in regions]


@pytest.mark.parametrize("version", ["1.0", "2.0"])
def test_mpcdi_reads_back(lifted, tmp_path, version):
    path = tmp_path / "projectors.mpcdi"
    export.write_mpcdi(path, lifted, REMARK, version)
    with zipfile.ZipFile(path) as archive:
        root = ElementTree.fromstring(archive.read("mpcdi.xml"))  # noqa: S314 - we wrote it
        filesets = root.findall("./files/fileset")
        for fileset, projector in zip(filesets, lifted, strict=True):
            warp = archive.read(text_of(fileset, "geometryWarpFile/path"))
            place = read_pfm(warp)
            # OpenCV reads the same, its colours in the order blue, green, red.
            decoded: Any = cv2.imdecode(np.frombuffer(warp, np.uint8), cv2.IMREAD_UNCHANGED)
            assert decoded.dtype == np.float32
            np.testing.assert_array_equal(decoded[..., ::-1], place)
            # From the left and from below, and none beyond the picture.
            right = (projector.camera_x + 0.5) / CAMERA[1]
            up = 1.0 - (projector.camera_y + 0.5) / CAMERA[0]
            np.testing.assert_allclose(place[..., 0], np.clip(right, 0, 1), atol=1e-6)
            np.testing.assert_allclose(place[..., 1], np.clip(up, 0, 1), atol=1e-6)
            # A beta map without an exponent has that of the alpha map.
            gamma = float(text_of(fileset, "alphaMap/gammaEmbedded"))
            assert fileset.findtext("betaMap/gammaEmbedded", str(gamma)) == str(gamma)
            for kind, mask in (("alphaMap", projector.blend), ("betaMap", projector.black)):
                data = np.frombuffer(archive.read(text_of(fileset, f"{kind}/path")), np.uint8)
                codes: Any = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
                assert 8 * codes.itemsize == int(text_of(fileset, f"{kind}/bitDepth"))
                relative = codes / float(np.iinfo(codes.dtype).max)
                half_a_code = 0.51 / np.iinfo(codes.dtype).max
                np.testing.assert_allclose(relative, mask ** (1.0 / gamma), atol=half_a_code)


def test_mpcdi_1_has_masks_of_bytes(lifted, tmp_path):
    """The reference library of 1.0 takes each byte of a mask for a pixel."""
    path = tmp_path / "projectors.mpcdi"
    export.write_mpcdi(path, lifted, REMARK, "1.0")
    with zipfile.ZipFile(path) as archive:
        for name in (name for name in archive.namelist() if name.endswith(".png")):
            data = np.frombuffer(archive.read(name), np.uint8)
            codes: Any = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
            assert codes.dtype == np.uint8
            assert codes.max() > 40


def test_opencv_reads_the_warp_map_as_a_file(projectors, tmp_path):
    """By its name, as programs that unpack an MPCDI do, and a picture is warped by it."""
    archive_path = tmp_path / "projectors.mpcdi"
    export.write_mpcdi(archive_path, projectors, REMARK)
    with zipfile.ZipFile(archive_path) as archive:
        archive.extractall(tmp_path)
    picture = np.add.outer(np.arange(60.0), 2.0 * np.arange(120.0)).astype(np.float32)
    for projector in projectors:
        warp: Any = cv2.imread(str(tmp_path / f"{projector.name}_warp.pfm"), cv2.IMREAD_UNCHANGED)
        assert warp.shape == (*GRID, 3)
        map_x = warp[..., 2] * CAMERA[1] - 0.5
        map_y = (1.0 - warp[..., 1]) * CAMERA[0] - 0.5
        shown = cv2.remap(picture, map_x, map_y, cv2.INTER_LINEAR)
        expected = 2.0 * projector.camera_x + projector.camera_y
        np.testing.assert_allclose(shown[2:-2, 2:-2], expected[2:-2, 2:-2], atol=0.3)


def text_of(fileset: ElementTree.Element, path: str) -> str:
    text = fileset.findtext(path)
    assert text is not None
    return text


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
    with pytest.raises(errors.InputError, match=r"camera of \(4, 5\) pixels"):
        export.read_projectors([*scans, tmp_path])
    with pytest.raises(errors.FileError, match="is no store"):
        export.read_projectors([tmp_path / "nowhere"])
