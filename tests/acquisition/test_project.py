# SPDX-License-Identifier: BSD-3-Clause
"""Folders with an acquisition.toml: their rigs, and refusals before anything is opened."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.acquisition import FolderRig, LiveRig, Project, VirtualRig
from ltcl.acquisition.radiometry import NoiseModel
from ltcl.errors import AcquisitionError, FileError, InputError

from .scanning.helpers import corner

GRID = (4, 8)
VIRTUAL = """[rig]
kind = "virtual"
transport = "truth.npz"
"""
LIVE = """[rig]
kind = "live"
[rig.camera]
kind = "opencv"
source = "{}"
[rig.display]
grid = [4, 8]
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    ltcl.save(tmp_path / "truth.npz", ltcl.Transport(corner(4), GRID))
    return tmp_path


def written(folder: Path, text: str) -> Path:
    (folder / "acquisition.toml").write_text(text, "utf-8")
    return folder


@pytest.mark.parametrize("aligned", [False, True])
def test_a_virtual_rig_is_described_by_its_files(folder: Path, aligned: bool) -> None:
    """Grid, colours and mixing come with the transport; a camera of its own pixels as a matrix."""
    M = np.array([[0.9, 0.1, 0.0], [0.0, 0.8, 0.1], [0.0, 0.2, 0.7]])
    ltcl.save(folder / "truth.npz", ltcl.Transport([corner(4)] * 3, GRID, mixing=M))
    view = scipy.sparse.kron(scipy.sparse.eye_array(32), np.ones((2, 1)))
    wide = scipy.sparse.csr_array(view)
    scipy.sparse.save_npz(folder / "camera.npz", wide)
    text = (
        'response = "film"\ngain = "none"\nread = 0.0\nambient = 0.1\nseed = 3\n'
        'camera_map = "camera.npz"\ncamera_grid = [4, 16]\n'
    )
    project = Project.open(written(folder, VIRTUAL + text))
    options: dict[str, Any] = {"response": "film", "gain": None, "read": 0.0}
    options |= {"ambient": 0.1, "seed": 3, "mixing": M}
    if not aligned:
        options |= {"camera_map": wide, "camera_grid": (4, 16)}
    expected = VirtualRig([corner(4)] * 3, GRID, **options)
    codes = np.linspace(0, 1, 32).reshape(GRID)
    with project.rig(aligned=aligned) as rig:
        image = rig.photograph(codes, 0.5)
        np.testing.assert_array_equal(image, expected.photograph(codes, 0.5))
        assert rig.describe() == expected.describe()
    _, outlook = project.outlook()
    assert outlook["grid"] == GRID
    assert outlook["channels"] == 3


def test_a_named_response_is_known(folder: Path) -> None:
    project = Project.open(written(folder, VIRTUAL + '[acquire]\nresponse = "srgb"\n'))
    light = project.settings["response"].linear(np.array([[0.5]]))
    assert float(light[0, 0]) == pytest.approx(0.214, abs=1e-3)


def test_a_folder_rig_works_in_the_folder(tmp_path: Path) -> None:
    text = (
        '[rig]\nkind = "folder"\nprojector_grid = [4, 8]\ncamera_bits = 12\n'
        "exposures = [0.1, 0.5, 2.0]\nprojector = [60, 100]\n"
    )
    project = Project.open(written(tmp_path, text))
    _, outlook = project.outlook()
    assert outlook["grid"] == GRID
    assert outlook["channels"] == 1
    assert outlook["noise"].levels == 4096
    assert set(outlook["exposures"]) <= {0.1, 0.5, 2.0}
    with project.rig() as rig:
        assert isinstance(rig, FolderRig)
        rig.prepare([(np.ones(GRID), 0.5)])
    pattern = ltcl.images.read_codes(tmp_path / "patterns" / "pattern_000001.png")
    assert pattern.shape == (60, 100)


@pytest.fixture
def without_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def test_a_live_rig_is_planned_without_a_camera(tmp_path: Path, without_display: None) -> None:
    project = Project.open(written(tmp_path, LIVE.format("nothing.avi")))
    _, outlook = project.outlook()
    assert outlook["channels"] == 3
    with project.rig(closed=True) as rig, pytest.raises(AcquisitionError, match="not open"):
        rig.photograph(np.ones(GRID), 0.1)
    with pytest.raises(AcquisitionError), project.rig():
        pass


def test_a_live_rig_is_opened_and_closed(tmp_path: Path, without_display: None) -> None:
    codec = cv2.VideoWriter.fourcc(*"MJPG")
    video = cv2.VideoWriter(str(tmp_path / "grey.avi"), codec, 30, (32, 16))
    video.write(np.full((16, 32, 3), 128, np.uint8))
    video.release()
    text = LIVE.format("grey.avi")
    text = text.replace("[rig.display]", "channels = 1\nseconds = 0.03\n[rig.display]")
    text = text.replace('"live"', '"live"\nperiod = "none"')
    project = Project.open(written(tmp_path, text))
    for _ in range(2):  # the second would fail if a display were left open
        with project.rig() as rig:
            assert isinstance(rig, LiveRig)
            assert rig.projector_grid == GRID
            assert rig.channels == 1
            assert rig.exposures == (0.03,)


def test_guesses_follow_the_sensor_and_the_light(folder: Path) -> None:
    text = "bits = 8\ngain = 500.0\nread = 0.01\nambient = 0.3\n[acquire]\nexposures = [8.0, 0.5]\n"
    _, outlook = Project.open(written(folder, VIRTUAL + text)).outlook()
    assert outlook["noise"] == NoiseModel(electrons=500.0, read=0.01, levels=256)
    assert outlook["light"].ambient == 0.3
    assert outlook["exposures"] == (0.5, 8.0)


WITHOUT_DISPLAY, _, _ = LIVE.partition("[rig.display]")


@pytest.mark.parametrize(
    ("content", "error", "text"),
    [
        (None, FileError, "no such file; .*ltcl simulate"),
        ("# nothing", InputError, r"no table \[rig\]"),
        ("[rig", FileError, "TOML"),
        ("[rig]\nbits = 8", InputError, r"\[rig\] kind is None; .* virtual, mitsuba, folder, live"),
        ('[rig]\nkind = "virtual"', InputError, r"\[rig\] .*'transport'"),
        (
            VIRTUAL + "bit = 8",
            InputError,
            r"\[rig\] has 'bit'; .* grid, camera_grid, .*bits, .*transport",
        ),
        (VIRTUAL + "[scan]", InputError, r"'scan'; .*\[rig\] and \[acquire\]"),
        (
            VIRTUAL + "[acquire]\nstore = 'a'",
            InputError,
            r"\[acquire\] has 'store'; .* geometry, strategy",
        ),
        (
            VIRTUAL + "[acquire]\nresponse = 'agfa'",
            InputError,
            "response is 'agfa'; .* linear, srgb",
        ),
        ('[rig]\nkind = "live"\n[rig.display]\ngrid = [4, 8]', InputError, r"\[rig\] .*'camera'"),
        (WITHOUT_DISPLAY, InputError, r"\[rig\] .*'display'"),
        ('[rig]\nkind = "live"\ncamera = 0\ndisplay = 0', InputError, r"no table \[rig\.camera\]"),
        (
            LIVE.replace("opencv", "eye"),
            InputError,
            r"\[rig\.camera\] kind is 'eye'; .* opencv, gphoto2",
        ),
        (LIVE.replace("grid", "grit"), InputError, r"\[rig\.display\] has 'grit'; .* grid"),
        (VIRTUAL + "bits = 40", InputError, r"acquisition\.toml: \[rig\] bits is 40"),
        (VIRTUAL + 'response = "agfa"', InputError, r"\[rig\] response is 'agfa'"),
        (VIRTUAL + "exposures = 0.5", InputError, r"\[rig\] exposures is 0\.5"),
        (VIRTUAL + "grid = [5, 5]", InputError, "grid is 5 x 5"),
        (VIRTUAL + 'camera_map = "no.npz"', FileError, r"no\.npz: no such file"),
        (VIRTUAL + "[acquire]\nexposures = 0.5", InputError, r"\[acquire\] exposures is 0\.5"),
        (VIRTUAL + "[acquire]\ngeometry = 'flat'", InputError, r"\[acquire\] geometry is 'flat'"),
    ],
)
def test_unusable_files_are_refused(
    folder: Path, content: str | None, error: type[Exception], text: str
) -> None:
    if content is not None:
        written(folder, content)
    with pytest.raises(error, match=text) as caught:
        Project.open(folder).outlook()
    assert str(caught.value).startswith(str(folder))
    assert "\n" not in str(caught.value)
