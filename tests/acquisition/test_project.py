# SPDX-License-Identifier: BSD-3-Clause
"""Folders with an acquisition.toml: what they make, and what is refused before anything is opened."""

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
from ltcl.errors import AcquisitionError, FileError, InputError, InputTypeError

from .scanning.helpers import corner

GRID = (4, 8)
VIRTUAL = '[rig]\nkind = "virtual"\ntransport = "truth.npz"\n'
FOLDER = '[rig]\nkind = "folder"\n'
LIVE = '[rig]\nkind = "live"\n[rig.camera]\nkind = "opencv"\nsource = "{}"\n[rig.display]\ngrid = [4, 8]\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    ltcl.save(tmp_path / "truth.npz", ltcl.Transport(corner(4), GRID))
    return tmp_path


def written(folder: Path, text: str) -> Path:
    (folder / "acquisition.toml").write_text(text, "utf-8")
    return folder


def test_a_virtual_rig_is_what_its_files_say(folder: Path) -> None:
    """Grid, colours and mixing come with the transport; a camera of its own pixels as a matrix."""
    M = np.array([[0.9, 0.1, 0.0], [0.0, 0.8, 0.1], [0.0, 0.2, 0.7]])
    ltcl.save(folder / "truth.npz", ltcl.Transport([corner(4)] * 3, GRID, mixing=M))
    wide = scipy.sparse.csr_array(scipy.sparse.kron(scipy.sparse.eye_array(32), np.ones((2, 1))))
    scipy.sparse.save_npz(folder / "camera.npz", wide)
    sensor: dict[str, Any] = {"response": "film", "gain": None, "read": 0.0, "ambient": 0.1, "seed": 3}
    text = VIRTUAL + 'response = "film"\ngain = "none"\nread = 0.0\nambient = 0.1\nseed = 3\n'
    text += 'camera_map = "camera.npz"\ncamera_grid = [4, 16]\n[acquire]\nresponse = "srgb"\n'
    project = Project.open(written(folder, text))
    plain = VirtualRig([corner(4)] * 3, GRID, mixing=M, **sensor)
    warped = VirtualRig([corner(4)] * 3, GRID, mixing=M, camera_map=wide, camera_grid=(4, 16), **sensor)
    codes = np.linspace(0, 1, 32).reshape(GRID)
    for each, same in ((project, warped), (project.aligned(), plain)):
        with each.rig() as rig:
            np.testing.assert_array_equal(rig.photograph(codes, 0.5), same.photograph(codes, 0.5))
            assert rig.describe() == same.describe()
    assert (project.outlook().grid, project.outlook().channels) == (GRID, 3)
    light = project.settings["response"].linear(np.array([[0.5]]))
    assert float(light[0, 0]) == pytest.approx(0.214, abs=1e-3)


def test_a_folder_rig_works_in_the_folder(tmp_path: Path) -> None:
    text = "projector_grid = [4, 8]\ncamera_bits = 12\nexposures = [0.1, 0.5, 2.0]\nprojector = [60, 100]\n"
    project = Project.open(written(tmp_path, FOLDER + text))
    outlook = project.outlook()
    assert (outlook.grid, outlook.channels, outlook.noise.levels) == (GRID, 1, 4096)
    assert set(outlook.exposures) <= {0.1, 0.5, 2.0}
    with project.rig() as rig:
        assert isinstance(rig, FolderRig)
        rig.prepare([(np.ones(GRID), 0.5)])
    assert ltcl.images.read_codes(tmp_path / "patterns" / "pattern_000001.png").shape == (60, 100)


def test_a_live_rig_is_planned_without_a_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    project = Project.open(written(tmp_path, LIVE.format("nothing.avi")))
    assert project.outlook().channels == 3
    with pytest.raises(AcquisitionError), project.rig():
        pass
    video = cv2.VideoWriter(str(tmp_path / "grey.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30, (32, 16))
    video.write(np.full((16, 32, 3), 128, np.uint8))
    video.release()
    text = LIVE.format("grey.avi").replace("[rig.display]", "channels = 1\nseconds = 0.03\n[rig.display]")
    project = Project.open(written(tmp_path, text.replace('"live"', '"live"\nperiod = "none"')))
    for _ in range(2):  # the second would fail where a display is left open
        with project.rig() as rig:
            assert isinstance(rig, LiveRig)
            assert (rig.projector_grid, rig.channels, rig.exposures) == (GRID, 1, (0.03,))


def test_guesses_follow_the_sensor_and_the_light(folder: Path) -> None:
    text = VIRTUAL + "bits = 8\ngain = 500.0\nread = 0.01\nambient = 0.3\n[acquire]\nexposures = [8.0, 0.5]\n"
    outlook = Project.open(written(folder, text)).outlook()
    assert outlook.noise == NoiseModel(electrons=500.0, read=0.01, levels=256)
    assert (outlook.light.ambient, outlook.exposures) == (0.3, (0.5, 8.0))


@pytest.mark.parametrize(
    ("text", "error", "part"),
    [
        ("# nothing", InputError, r"no table \[rig\]"),
        ("[rig", FileError, "TOML"),
        ("[rig]\nbits = 8", InputError, r"\[rig\] kind is None; .* virtual, mitsuba, folder, live"),
        ('[rig]\nkind = "virtual"', InputError, r"\[rig\] .*'transport'"),
        (VIRTUAL + "bit = 8", InputError, r"\[rig\] has 'bit'; .* grid, camera_grid, .*bits, .*transport"),
        (VIRTUAL + "[scan]", InputError, r"'scan'; .*\[rig\] and \[acquire\]"),
        (VIRTUAL + "[acquire]\nstore = 'a'", InputError, r"\[acquire\] has 'store'; .* geometry, strategy"),
        (VIRTUAL + "[acquire]\nresponse = 'agfa'", InputError, "response is 'agfa'; .* linear, srgb"),
        ('[rig]\nkind = "live"\n[rig.display]\ngrid = [4, 8]', InputError, r"\[rig\] .*'camera'"),
        (LIVE.partition("[rig.d")[0], InputError, r"\[rig\] .*'display'"),
        ('[rig]\nkind = "live"\ncamera = 0\ndisplay = 0', InputError, r"no table \[rig\.camera\]"),
        (LIVE.replace("opencv", "eye"), InputError, r"\[rig\.camera\] kind is 'eye'; .* opencv, gphoto2"),
        (LIVE.replace("grid", "grit"), InputError, r"\[rig\.display\] has 'grit'; .* grid"),
    ],
)
def test_files_that_say_nothing_usable_are_refused(
    folder: Path, text: str, error: type[Exception], part: str
) -> None:
    with pytest.raises(error, match=part) as caught:
        Project.open(written(folder, text))
    assert str(caught.value).startswith(str(folder / "acquisition.toml"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("line", "error", "part"),
    [
        ("bits = 40", InputError, r"acquisition\.toml: \[rig\] bits is 40"),
        ('response = "agfa"', InputError, r"\[rig\] response is 'agfa'"),
        ("exposures = 0.5", InputTypeError, r"\[rig\] .*type"),
        ("grid = [5, 5]", InputError, "grid is 5 x 5"),
        ("[acquire]\nexposures = 0.5", InputError, r"\[acquire\] exposures is 0\.5"),
        ("[acquire]\ngeometry = 'flat'", InputError, r"\[acquire\] geometry is 'flat'"),
    ],
)
def test_values_are_refused_by_name(folder: Path, line: str, error: type[Exception], part: str) -> None:
    project = Project.open(written(folder, VIRTUAL + line))
    for use in (project.check, project.outlook):
        with pytest.raises(error, match=part):
            use()


def test_files_that_are_missing_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"acquisition\.toml: no such file; .*ltcl simulate"):
        Project.open(tmp_path / "nowhere")
    with pytest.raises(FileError, match=r"truth\.npz: no such file"):
        Project.open(written(tmp_path, VIRTUAL)).outlook()
