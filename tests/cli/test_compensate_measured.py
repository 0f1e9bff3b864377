# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl compensate` with an acquired transport: the codes for its projector, and what is seen then."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl import images
from ltcl.acquisition import Project, Setup
from ltcl.images.frames import open_frames

y, x = np.mgrid[:4, :8] / 8
DESIRED = (0.6 + 0.3 * np.sin(7 * x + 4 * y)).astype(np.float32)  # bright enough for this room


@pytest.fixture(scope="module")
def rig(acquired: Path) -> Iterator[Any]:
    with Project.open(acquired).rig() as rig:
        yield rig


@pytest.fixture
def store(acquired: Path) -> Path:
    return acquired / "transport.zarr"


@pytest.fixture
def waves(tmp_path: Path) -> Path:
    images.write(tmp_path / "waves.exr", DESIRED)
    return tmp_path / "waves.exr"


def codes_in(path: Path) -> np.ndarray:
    """Codes of a projector in a picture file."""
    stored = images.read_codes(path)
    return stored / np.float32(np.iinfo(stored.dtype).max)


def error_of(codes: np.ndarray, rig: Any) -> float:
    """Of what is seen under these codes, at the brightness at which it comes closest to the picture."""
    seen = rig.radiance(codes)
    scale = np.vdot(seen, DESIRED) / np.vdot(seen, seen)
    return float(np.linalg.norm(scale * seen - DESIRED) / np.linalg.norm(DESIRED))


def test_what_is_projected_looks_like_the_picture(program, store, waves, tmp_path, rig):
    """In the room with its light; a pattern in sRGB, or without the ambient light, would not."""
    told = program("compensate", store, waves, "--out", tmp_path / "out", "--rtol", "1e-3", "--json").json
    (entry,) = told["pictures"]
    assert (told["options"]["gain"], told["options"]["background"]) == ("auto", "measured")
    pattern = images.read(tmp_path / "out" / entry["pattern"]["exr"])
    codes = codes_in(tmp_path / "out" / entry["pattern"]["png"])
    assert (entry["clipped"], pattern.max()) == (0, pytest.approx(1.0, abs=1e-3))  # as bright as can be
    assert error_of(codes, rig) < 0.015
    assert error_of(images.to_srgb(pattern), rig) > 0.05
    np.testing.assert_allclose(codes, Setup.of(store).codes(pattern), atol=0.6 / 255)
    images.write(tmp_path / "none.exr", np.zeros((4, 8)))
    arguments = ["--out", tmp_path / "dark", "--background", tmp_path / "none.exr"]
    assert "the background is" not in program("compensate", store, waves, *arguments).out
    assert error_of(codes_in(tmp_path / "dark" / "waves_pattern.png"), rig) > 0.02


def test_codes_of_a_pattern_are_relit_as_its_light(program, store, waves, tmp_path):
    outcome = program("compensate", store, waves, "--out", tmp_path)
    assert "codes of the measured projector" in outcome.out
    assert "the background is the ambient light" in outcome.out
    seen = []
    for extension in ("exr", "png"):
        out = tmp_path / extension
        assert program("relight", store, tmp_path / f"waves_pattern.{extension}", "--out", out).code == 0
        seen.append(images.read(out / "waves_pattern_relit.exr"))
    np.testing.assert_allclose(seen[1], seen[0], rtol=0.02)
    appearance = images.read(tmp_path / "waves_appearance.exr")
    np.testing.assert_allclose(seen[0] + Setup.of(store).ambient, appearance, rtol=1e-4)


def test_light_is_within_black_and_white(program, store, waves, tmp_path):
    common = ["compensate", store, waves, "--out", tmp_path / "out"]
    program(*common, "--high", "2").refused("--high is 2", "from 0 to 1")
    program(*common, "--low", "-1").refused("--low is -1")
    assert program(*common, "--gain", "0.5", "--json").json["pictures"][0]["gain"] == 0.5
    assert "stays too dark" in program(*common, "--gain", "50").err


def test_frames_and_videos_hold_codes(program, store, tmp_path, rig):
    frames, videos = tmp_path / "frames", []
    images.write(frames / "0.exr", DESIRED)
    for format in ("png", "exr"):
        common = ["compensate", store, frames, "--out", tmp_path / format, "--format", format]
        outcome = program(*common, "--video", tmp_path / "out.mkv")
        assert outcome.code == 0, outcome.err
        videos.append(next(iter(open_frames(tmp_path / "out.mkv", encoding="linear"))).picture())
    codes = codes_in(tmp_path / "png" / "pattern_000001.png")
    assert error_of(codes, rig) < 0.015
    for shown in videos:
        np.testing.assert_allclose(shown, codes, atol=1.1 / 255)


def test_a_copy_is_told_where_its_calibration_is(program, store, waves, transport, tmp_path, rig):
    copies = {"compress": ["compress", store, "--out"], "convert": ["convert", store]}
    for name, command in copies.items():
        copy = tmp_path / f"{name}.npz"
        assert f"--calibration {store}" in program(*command, copy).err
        out = ["--calibration", store, "--rtol", "0.02", "--out", tmp_path / "out"]
        outcome = program("compensate", copy, waves, *out)
        assert outcome.code == 0, outcome.err
        assert error_of(codes_in(tmp_path / "out" / "waves_pattern.png"), rig) < 0.04
    arguments = ["--calibration", store, "--out", tmp_path / "no"]
    program("compensate", transport, waves, *arguments).refused("(4, 8)", "(5, 10)")
    arguments[1] = tmp_path / "none.zarr"
    program("compensate", tmp_path / "convert.npz", waves, *arguments).refused("none.zarr: no such folder")


def test_pixels_that_the_camera_does_not_see_stay_dark(program, tmp_path):
    """Without having to be asked for, since nobody could change it."""
    T = 0.5 * np.eye(32)
    T[5, 5] = 0.0
    rig = ltcl.acquisition.VirtualRig(T, (4, 8), bits=12, ambient=0.01)
    ltcl.acquire(rig, geometry="aligned", strategy="pixel", store=tmp_path / "T.zarr")
    images.write(tmp_path / "grey.exr", np.full((4, 8), 0.5))
    common = ["compensate", tmp_path / "T.zarr", tmp_path / "grey.exr", "--out", tmp_path / "out"]
    outcome = program(*common)
    assert outcome.code == 0, outcome.err
    assert "1 of 32 projector pixels give no direct light; they stay unlit" in outcome.err
    program(*common, "--on-dark", "raise").refused("T.zarr", "--on-dark")
