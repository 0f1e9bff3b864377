# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl compensate` with a measured transport: its projector's codes, the scene under them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl import images
from ltcl.acquisition import Project, Setup
from ltcl.images.frames import open_frames

from .conftest import write

y, x = np.mgrid[:4, :8] / 8
# Bright enough for this room.
DESIRED = (0.6 + 0.3 * np.sin(7 * x + 4 * y)).astype(np.float32)


@pytest.fixture(scope="module")
def rig(acquired: Path) -> Iterator[Any]:
    with Project.open(acquired).rig() as rig:
        yield rig


@pytest.fixture(scope="module")
def store(acquired: Path) -> Path:
    return acquired / "transport.zarr"


@pytest.fixture(scope="module")
def waves(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("waves") / "waves.exr", DESIRED)


@pytest.fixture(scope="module")
def compensated(program, store: Path, waves: Path) -> Any:
    """The folder, and the printed text."""
    out = waves.parent / "out"
    return out, program("compensate", store, waves, "--out", out, "--rtol", "1e-3").out


def read_codes(path: Path) -> np.ndarray:
    """Read the codes of a projector from a picture file, in [0, 1]."""
    stored = images.read_codes(path)
    return stored / np.float32(np.iinfo(stored.dtype).max)


def relative_error(codes: np.ndarray, rig: Any) -> float:
    """Return the error of the scene under these codes, at the brightness with the least error."""
    seen = rig.radiance(codes)
    scale = np.vdot(seen, DESIRED) / np.vdot(seen, seen)
    return float(np.linalg.norm(scale * seen - DESIRED) / np.linalg.norm(DESIRED))


@pytest.mark.slow
def test_the_scene_under_the_pattern_looks_like_the_picture(store, compensated, rig):
    """The room has light of its own; a pattern in sRGB would fail."""
    out, printed = compensated
    report = json.loads((out / "compensate.json").read_text())
    assert report["options"]["gain"] == "auto"
    assert report["options"]["background"] == "measured"
    for text in ("codes of the measured projector", "background"):
        assert text in printed
    (entry,) = report["pictures"]
    pattern = images.read(out / entry["pattern"]["exr"])
    codes = read_codes(out / entry["pattern"]["png"])
    assert entry["clipped"] == 0
    # The gain is the largest.
    assert pattern.max() == pytest.approx(1.0, abs=1e-3)
    assert relative_error(codes, rig) < 0.015
    assert relative_error(images.to_srgb(pattern), rig) > 0.05
    np.testing.assert_allclose(codes, Setup.of(store).codes(pattern), atol=0.6 / 255)


def test_a_background_replaces_the_measured_one(program, store, waves, tmp_path, rig):
    black = write(tmp_path / "black.exr", np.zeros((4, 8)))
    arguments = [store, waves, "--out", tmp_path, "--background", black]
    assert "the background is" not in program("compensate", *arguments).out
    assert relative_error(read_codes(tmp_path / "waves_pattern.png"), rig) > 0.02


@pytest.mark.rare
def test_codes_of_a_pattern_are_relit_as_its_light(program, store, compensated, tmp_path):
    out, _ = compensated
    relit = {}
    for extension in ("exr", "png"):
        folder = tmp_path / extension
        pattern = out / f"waves_pattern.{extension}"
        assert program("relight", store, pattern, "--out", folder).code == 0
        relit[extension] = images.read(folder / "waves_pattern_relit.exr")
    np.testing.assert_allclose(relit["png"], relit["exr"], rtol=0.02)
    appearance = images.read(out / "waves_appearance.exr")
    np.testing.assert_allclose(relit["exr"] + Setup.of(store).ambient, appearance, rtol=1e-4)


def test_frames_and_videos_hold_codes(program, store, tmp_path, rig):
    write(tmp_path / "frames" / "0.exr", DESIRED)
    out = tmp_path / "out"
    video = tmp_path / "out.mkv"
    assert program("film", store, tmp_path / "frames", "--out", out, "--video", video).code == 0
    codes = read_codes(out / "pattern_000001.png")
    assert relative_error(codes, rig) < 0.015
    shown = next(iter(open_frames(video, encoding="linear"))).picture()
    np.testing.assert_allclose(shown, codes, atol=1.1 / 255)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["compress", "convert"])
def test_a_copy_takes_the_calibration_of_its_store(program, store, waves, tmp_path, rig, name):
    copy = tmp_path / "copy.npz"
    target = ["--out", copy] if name == "compress" else [copy]
    assert f"--calibration {store}" in program(name, store, *target, "--json").err
    options = ["--calibration", store, "--rtol", "0.02", "--out", tmp_path / "out"]
    assert program("compensate", copy, waves, *options).code == 0
    codes = read_codes(tmp_path / "out" / "waves_pattern.png")
    assert relative_error(codes, rig) < 0.04


@pytest.mark.slow
def test_a_wrong_calibration_is_refused(program, store, waves, transport, tmp_path):
    common = [waves, "--out", tmp_path / "no", "--calibration"]
    program("compensate", transport, *common, store).assert_refused("(4, 8)", "(5, 10)")
    nowhere = tmp_path / "none.zarr"
    program("compensate", transport, *common, nowhere).assert_refused("none.zarr: ")


@pytest.mark.slow
def test_pixels_that_the_camera_does_not_see_stay_dark(program, tmp_path):
    """Nobody has to ask for it, since nobody could change it."""
    T = 0.5 * np.eye(32)
    T[5, 5] = 0.0
    store = tmp_path / "T.zarr"
    rig = ltcl.acquisition.VirtualRig(T, (4, 8), bits=12, ambient=0.01)
    ltcl.acquire(rig, geometry="aligned", strategy="pixel", store=store)
    grey = write(tmp_path / "grey.exr", np.full((4, 8), 0.5))
    common = ["compensate", store, grey, "--out", tmp_path / "out"]
    assert "T.zarr: 1 of 32 " in program(*common).err
    program(*common, "--on-dark", "raise").assert_refused("T.zarr", "on_dark")


@pytest.mark.parametrize(("scan", "pixels"), [("left.zarr", (13, 16)), ("both.npz", (13, 32))])
def test_one_of_several_projectors_is_fed_on_its_own_pixels(
    program, room_of_two: Path, tmp_path: Path, scan: str, pixels: tuple[int, int]
) -> None:
    """T is on squares of camera pixels, alone as well as in a combination."""
    transport = room_of_two / scan
    if scan == "both.npz":
        transport = tmp_path / scan
        program("combine", room_of_two, "--out", transport)
    picture = write(tmp_path / "even.exr", np.full((6, 12), 0.5, np.float32))
    program("compensate", transport, picture, "--out", tmp_path / "out")
    codes = tmp_path / "out" / "even_pattern.png"
    assert read_codes(codes).shape == pixels
    assert program("relight", transport, codes, "--out", tmp_path / "relit").code == 0
    relit = images.read(tmp_path / "relit" / "even_pattern_relit.exr")
    pattern = images.read(tmp_path / "out" / "even_pattern.exr")
    expected = ltcl.load(transport, on_dark="mask") @ pattern
    np.testing.assert_allclose(relit, expected, atol=0.01 * expected.max())


def test_a_store_without_the_files_beside_it_is_told(
    program, room_of_two: Path, tmp_path: Path
) -> None:
    """Then its codes are on squares of camera pixels, which no projector has."""
    (tmp_path / "left.zarr").symlink_to(room_of_two / "left.zarr")
    picture = write(tmp_path / "even.exr", np.full((6, 12), 0.5, np.float32))
    told = program("compensate", tmp_path / "left.zarr", picture, "--out", tmp_path / "out").err
    assert "has squares of camera pixels" in told
    assert "left.projector.json" in told
