# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl compensate` with an acquired transport: the codes for its projector, and what is seen then."""

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
DESIRED = (0.6 + 0.3 * np.sin(7 * x + 4 * y)).astype(np.float32)  # bright enough for this room


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
    """The folder, and what was printed."""
    out = waves.parent / "out"
    return out, program("compensate", store, waves, "--out", out, "--rtol", "1e-3").out


def codes_in(path: Path) -> np.ndarray:
    """Codes of a projector in a picture file."""
    stored = images.read_codes(path)
    return stored / np.float32(np.iinfo(stored.dtype).max)


def error_of(codes: np.ndarray, rig: Any) -> float:
    """Of what is seen under these codes, at the brightness at which it comes closest to the picture."""
    seen = rig.radiance(codes)
    scale = np.vdot(seen, DESIRED) / np.vdot(seen, seen)
    return float(np.linalg.norm(scale * seen - DESIRED) / np.linalg.norm(DESIRED))


def test_what_is_projected_looks_like_the_picture(
    program, store, waves, compensated, tmp_path, rig
):
    """In the room with its light; a pattern in sRGB, or without the ambient light, would not."""
    out, printed = compensated
    report = json.loads((out / "compensate.json").read_text())
    (entry,) = report["pictures"]
    assert (report["options"]["gain"], report["options"]["background"]) == ("auto", "measured")
    assert all(text in printed for text in ("codes of the measured projector", "background"))
    pattern, codes = (
        images.read(out / entry["pattern"]["exr"]),
        codes_in(out / entry["pattern"]["png"]),
    )
    assert (entry["clipped"], pattern.max()) == (
        0,
        pytest.approx(1.0, abs=1e-3),
    )  # as bright as can be
    assert error_of(codes, rig) < 0.015
    assert error_of(images.to_srgb(pattern), rig) > 0.05
    np.testing.assert_allclose(codes, Setup.of(store).codes(pattern), atol=0.6 / 255)
    none = write(tmp_path / "none.exr", np.zeros((4, 8)))
    assert (
        "background"
        not in program("compensate", store, waves, "--out", tmp_path, "--background", none).out
    )
    assert error_of(codes_in(tmp_path / "waves_pattern.png"), rig) > 0.02


def test_codes_of_a_pattern_are_relit_as_its_light(program, store, compensated, tmp_path):
    seen, (out, _) = [], compensated
    for extension in ("exr", "png"):
        arguments = [store, out / f"waves_pattern.{extension}", "--out", tmp_path / extension]
        assert program("relight", *arguments).code == 0
        seen.append(images.read(tmp_path / extension / "waves_pattern_relit.exr"))
    np.testing.assert_allclose(seen[1], seen[0], rtol=0.02)
    appearance = images.read(out / "waves_appearance.exr")
    np.testing.assert_allclose(seen[0] + Setup.of(store).ambient, appearance, rtol=1e-4)


def test_frames_and_videos_hold_codes(program, store, tmp_path, rig):
    write(tmp_path / "frames" / "0.exr", DESIRED)
    arguments = [
        store,
        tmp_path / "frames",
        "--out",
        tmp_path / "out",
        "--video",
        tmp_path / "out.mkv",
    ]
    assert program("film", *arguments).code == 0
    codes = codes_in(tmp_path / "out" / "pattern_000001.png")
    assert error_of(codes, rig) < 0.015
    shown = next(iter(open_frames(tmp_path / "out.mkv", encoding="linear"))).picture()
    np.testing.assert_allclose(shown, codes, atol=1.1 / 255)


def test_a_copy_is_told_where_its_calibration_is(program, store, waves, transport, tmp_path, rig):
    for name, command in {
        "compress": ["compress", store, "--out"],
        "convert": ["convert", store],
    }.items():
        copy = tmp_path / f"{name}.npz"
        assert f"--calibration {store}" in program(*command, copy, "--json").err
        out = ["--calibration", store, "--rtol", "0.02", "--out", tmp_path / "out"]
        assert program("compensate", copy, waves, *out).code == 0
        assert error_of(codes_in(tmp_path / "out" / "waves_pattern.png"), rig) < 0.04
    arguments = [waves, "--out", tmp_path / "no", "--calibration"]
    program("compensate", transport, *arguments, store).refused("(4, 8)", "(5, 10)")
    program("compensate", tmp_path / "convert.npz", *arguments, tmp_path / "none.zarr").refused(
        "none.zarr: "
    )


def test_pixels_that_the_camera_does_not_see_stay_dark(program, tmp_path):
    """Without having to be asked for, since nobody could change it."""
    T, store = 0.5 * np.eye(32), tmp_path / "T.zarr"
    T[5, 5] = 0.0
    rig = ltcl.acquisition.VirtualRig(T, (4, 8), bits=12, ambient=0.01)
    ltcl.acquire(rig, geometry="aligned", strategy="pixel", store=store)
    grey = write(tmp_path / "grey.exr", np.full((4, 8), 0.5))
    common = ["compensate", store, grey, "--out", tmp_path / "out"]
    assert "T.zarr: 1 of 32 " in program(*common).err
    program(*common, "--on-dark", "raise").refused("T.zarr", "on_dark")
