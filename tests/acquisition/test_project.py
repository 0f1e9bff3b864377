# SPDX-License-Identifier: BSD-3-Clause
"""Folders with an acquisition.toml: what they make, and what is refused before anything is opened."""

from __future__ import annotations

from pathlib import Path

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
    text = VIRTUAL + 'camera_map = "camera.npz"\ncamera_grid = [4, 16]\n[acquire]\nresponse = "srgb"\n'
    project = Project.open(written(folder, text))
    with project.rig() as rig:
        assert rig.photograph(np.ones(GRID), 0.5).shape == (4, 16, 3)
        np.testing.assert_allclose(rig.describe()["mixing"], M)
    assert (project.outlook().grid, project.outlook().channels) == (GRID, 3)
    light = project.settings["response"].linear(np.array([[0.5]]))
    assert float(light[0, 0]) == pytest.approx(0.214, abs=1e-3)


def test_a_virtual_rig_is_what_the_file_says(folder: Path) -> None:
    text = VIRTUAL + 'bits = 12\nresponse = "film"\ngain = "none"\nread = 0.0\nambient = 0.1\nseed = 3\n'
    wanted = VirtualRig(corner(4), GRID, bits=12, response="film", gain=None, read=0.0, ambient=0.1, seed=3)
    with Project.open(written(folder, text)).rig() as rig:
        codes = np.linspace(0, 1, 32).reshape(GRID)
        np.testing.assert_array_equal(rig.photograph(codes, 0.5), wanted.photograph(codes, 0.5))
        assert rig.describe() == wanted.describe()


def test_a_folder_rig_works_in_the_folder(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """With keys of today, and one of an earlier version."""
    text = '[rig]\nkind = "folder"\nprojector_grid = [4, 8]\ncamera_bits = 12\nexposures = [0.1, 0.5, 2.0]\n'
    text += "projector = [60, 100]\nin_order = false\n"
    project = Project.open(written(tmp_path, text))
    seen = project.outlook()
    assert (seen.grid, seen.channels, seen.noise.levels) == (GRID, 1, 4096)
    assert set(seen.exposures) <= {0.1, 0.5, 2.0}
    with project.rig() as rig:
        assert isinstance(rig, FolderRig)
        rig.prepare([(np.ones(GRID), 0.5)])
    assert ltcl.images.read_codes(tmp_path / "patterns" / "pattern_000001.png").shape == (60, 100)
    assert "in_order" in caplog.text


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
    with project.rig() as rig:
        assert isinstance(rig, LiveRig)
        assert (rig.projector_grid, rig.channels, rig.exposures) == (GRID, 1, (0.03,))
    with project.rig() as rig:  # which a display that was left open would not let
        assert rig.channels == 1


def test_guesses_follow_the_sensor_and_the_light(folder: Path) -> None:
    seen = Project.open(
        written(folder, VIRTUAL + "bits = 8\ngain = 500.0\nread = 0.01\nambient = 0.3\n")
    ).outlook()
    assert seen.noise == NoiseModel(electrons=500.0, read=0.01, levels=256)
    assert seen.light.ambient == 0.3
    assert seen.exposures[-1] == pytest.approx(1.0)  # 0.3 of the range
    text = VIRTUAL + "[acquire]\nexposures = [8.0, 0.5]\n"
    assert Project.open(written(folder, text)).outlook().exposures == (0.5, 8.0)


@pytest.mark.parametrize(
    ("text", "error", "part"),
    [
        ("# nothing", InputError, r"acquisition\.toml: has no table \[rig\]"),
        ("[rig", FileError, "is no TOML"),
        (
            "[rig]\nbits = 8",
            InputError,
            r"\[rig\] kind is None; it must be one of virtual, mitsuba, folder, live",
        ),
        ('[rig]\nkind = "virtual"', InputError, r"\[rig\] has no 'transport'"),
        (
            VIRTUAL + "bit = 8",
            InputError,
            r"\[rig\] has 'bit'; it may have transport, grid, camera_grid, .*bits",
        ),
        (VIRTUAL + "T = 8", InputError, r"\[rig\] has 'T'"),
        (VIRTUAL + "[scan]", InputError, r"has 'scan'; it must have the tables \[rig\] and \[acquire\] only"),
        ("rig = 3", InputError, "has 'rig'"),
        (
            VIRTUAL + "[acquire]\nstore = 'a'",
            InputError,
            r"\[acquire\] has 'store'; it may have geometry, strategy",
        ),
        (VIRTUAL + "[acquire]\nresponse = 'agfa'", InputError, "response is 'agfa'; it must be linear, srgb"),
        (VIRTUAL + "[acquire]\nexposures = 0.5", InputTypeError, r"exposures is 0\.5; it must be a list"),
        ('[rig]\nkind = "folder"', InputError, r"\[rig\] has no 'projector_grid'"),
        ('[rig]\nkind = "mitsuba"\nprojector_grid = [4, 4]', InputError, r"\[rig\] has no 'scene'"),
        ('[rig]\nkind = "live"', InputError, r"has no table \[rig\.camera\]"),
        (
            '[rig]\nkind = "live"\n[rig.camera]\nkind = "opencv"\nsource = 0',
            InputError,
            r"no table \[rig\.display\]",
        ),
        (
            LIVE.replace("opencv", "eye"),
            InputError,
            r"\[rig\.camera\] kind is 'eye'; it must be one of opencv, gph",
        ),
        (LIVE.replace("source", "sauce"), InputError, r"\[rig\.camera\] has 'sauce'; it may have source"),
        (LIVE.replace("grid", "grit"), InputError, r"\[rig\.display\] has 'grit'; it may have grid"),
    ],
)
def test_what_cannot_be_meant_is_refused(folder: Path, text: str, error: type[Exception], part: str) -> None:
    with pytest.raises(error, match=part) as caught:
        Project.open(written(folder, text))
    assert str(caught.value).startswith(str(folder / "acquisition.toml"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("line", "error", "part"),
    [
        ("bits = 40", InputError, r"acquisition\.toml: \[rig\] bits is 40"),
        ('response = "agfa"', InputError, r"\[rig\] response is 'agfa'"),
        ("exposures = 0.5", InputTypeError, r"\[rig\] holds a value of an unusable type"),
        ("grid = [5, 5]", InputError, r"\[rig\] grid is 5 x 5"),
        ("gain = 'much'", InputError, r"\[rig\] gain"),
        ("read = -1.0", InputError, r"\[rig\] read"),
    ],
)
def test_values_are_refused_by_the_rig(folder: Path, line: str, error: type[Exception], part: str) -> None:
    project = Project.open(written(folder, VIRTUAL + line))
    with pytest.raises(error, match=part), project.rig():
        pass
    with pytest.raises(error, match=part):
        project.outlook()


def test_files_that_are_missing_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"acquisition\.toml: no such file; 'ltcl simulate' makes one"):
        Project.open(tmp_path / "nowhere")
    (tmp_path / "file").write_text("text")
    with pytest.raises(FileError, match="file: is a file; an acquisition is a folder with an acquisition"):
        Project.open(tmp_path / "file")
    with pytest.raises(FileError, match=r"truth\.npz: no such file"):
        Project.open(written(tmp_path, VIRTUAL)).outlook()
