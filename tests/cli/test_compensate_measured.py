# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl compensate` with a transport that was acquired: what its projector is fed, and what is seen then."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl import images
from ltcl.acquisition import Calibration, Setup, VirtualRig
from ltcl.acquisition.radiometry import Response
from ltcl.cli.main import main
from ltcl.images.frames import open_frames

from .conftest import Program

GRID = (6, 12)
ROOM: dict[str, Any] = {"bits": 12, "projector_response": "film", "response": "film"}


def rig_of(albedo: Any = 0.6) -> VirtualRig:
    """A corner in a room that is not dark, a projector that is not sRGB and whose black is none."""
    truth = ltcl.scenes.dihedral(6, albedo=albedo).matrices()
    y, x = np.mgrid[:6, :12] / 12
    room = 0.03 + 0.03 * (x + y).ravel()
    return VirtualRig(
        truth if len(truth) == 3 else truth[0], GRID, ambient=room, projector_black=0.02, **ROOM
    )


def linear() -> np.ndarray:
    """A picture that is bright enough for this room."""
    y, x = np.mgrid[:6, :12] / 12
    return (0.6 + 0.3 * np.sin(7 * x + 4 * y)).astype(np.float32)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("measured") / "transport.zarr"
    ltcl.acquire(rig_of(), geometry="aligned", strategy="pixel", store=path)
    return path


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    path = tmp_path / "waves.exr"
    images.write(path, linear())
    return path


def off(codes: np.ndarray, desired: np.ndarray, rig: VirtualRig) -> float:
    """Of the photograph under these codes, at the brightness at which it comes closest to the picture."""
    seen = rig.radiance(codes)
    scale = np.vdot(seen, desired) / np.vdot(seen, seen)
    return float(np.linalg.norm(scale * seen - desired) / np.linalg.norm(desired))


def fed(path: Path) -> np.ndarray:
    """What a projector is fed from a picture file."""
    stored = images.read_codes(path)
    return stored / np.float32(np.iinfo(stored.dtype).max)


def test_what_is_projected_looks_like_the_picture(
    program: Program, store: Path, picture: Path, tmp_path: Path
) -> None:
    """In the room with its light; a pattern in sRGB, as for any other transport, would not."""
    told = program("compensate", store, picture, "--out", tmp_path / "out", "--rtol", "1e-3", "--json").json
    (entry,) = told["pictures"]
    assert (told["options"]["gain"], told["options"]["background"]) == ("auto", "measured")
    assert entry["clipped"] == 0
    pattern = images.read(tmp_path / "out" / entry["pattern"]["exr"])
    codes = fed(tmp_path / "out" / entry["pattern"]["png"])
    assert pattern.max() == pytest.approx(1.0, abs=1e-3)  # as bright as can be
    assert off(codes, linear(), rig_of()) < 0.015
    assert off(images.to_srgb(pattern), linear(), rig_of()) > 0.05
    np.testing.assert_allclose(codes, Setup.of(store).codes(pattern), atol=0.6 / 255)


def test_photographs_say_the_same(program: Program, store: Path, picture: Path, tmp_path: Path) -> None:
    """Through the camera, and the response that was found of it."""
    assert program("compensate", store, picture, "--out", tmp_path / "out").code == 0
    codes, told = fed(tmp_path / "out" / "waves_pattern.png"), Calibration.of(store)
    rig = rig_of()
    photographs = [rig.photograph(codes, 0.4) / np.float32(4095) for _ in range(16)]
    seen = (np.mean([told.response.linear(one) for one in photographs], axis=0) - told.offset[0]) / 0.4
    report = json.loads((tmp_path / "out" / "compensate.json").read_text())
    wanted = report["pictures"][0]["gain"] * linear()
    assert np.linalg.norm(seen - wanted) < 0.02 * np.linalg.norm(wanted)  # the very brightness, in its units


def test_without_the_ambient_light_it_would_not(
    program: Program, store: Path, picture: Path, tmp_path: Path
) -> None:
    images.write(tmp_path / "none.exr", np.zeros(GRID))
    arguments = ["--out", tmp_path / "out", "--background", tmp_path / "none.exr"]
    outcome = program("compensate", store, picture, *arguments)
    assert outcome.code == 0
    assert "the background is" not in outcome.out
    assert off(fed(tmp_path / "out" / "waves_pattern.png"), linear(), rig_of()) > 0.02


def test_the_shell_says_what_it_does(program: Program, store: Path, picture: Path, tmp_path: Path) -> None:
    outcome = program("compensate", store, picture, "--out", tmp_path / "out")
    assert (
        "pattern .png holds the codes to feed to the measured projector as they are; the background"
        in outcome.out
    )
    program("compensate", store, picture, "--out", tmp_path / "b", "--high", "2").refused(
        "--high is 2; it must be from 0 to 1, the black and the white of the projector"
    )
    program("compensate", store, picture, "--out", tmp_path / "b", "--low", "-1").refused("--low is -1")
    loss = program("compensate", store, picture, "--out", tmp_path / "c", "--loss", "0.01")
    assert loss.code == 0, loss.err
    dim = program("compensate", store, picture, "--out", tmp_path / "d", "--gain", "0.5", "--json").json
    assert dim["pictures"][0]["gain"] == 0.5
    too_bright = program("compensate", store, picture, "--out", tmp_path / "d", "--gain", "50")
    assert "the projector gives 1; try --gain" in too_bright.err


def test_colours_are_fed_by_their_own_curves(program: Program, tmp_path: Path) -> None:
    truth = ltcl.scenes.dihedral(4, albedo=(0.7, 0.5, 0.6)).matrices()
    curves = ["srgb", "gamma2.2", "linear"]
    rig = VirtualRig(truth, (4, 8), bits=12, ambient=[0.02, 0.03, 0.01], projector_response=curves)
    ltcl.acquire(rig, geometry="aligned", strategy="pixel", store=tmp_path / "T.zarr")
    y, x = np.mgrid[:4, :8] / 8
    desired = np.stack([0.5 + 0.3 * np.sin(5 * x + k + 3 * y) for k in range(3)], axis=-1).astype(np.float32)
    images.write(tmp_path / "waves.exr", desired)
    outcome = program("compensate", tmp_path / "T.zarr", tmp_path / "waves.exr", "--out", tmp_path / "out")
    assert outcome.code == 0, outcome.err
    seen = rig.radiance(fed(tmp_path / "out" / "waves_pattern.png"))
    gains = [np.vdot(seen[..., c], desired[..., c]) / np.vdot(seen[..., c], seen[..., c]) for c in range(3)]
    for c in range(3):
        error = np.linalg.norm(gains[c] * seen[..., c] - desired[..., c])
        assert error < 0.02 * np.linalg.norm(desired[..., c])


def test_frames_and_videos_hold_codes(program: Program, store: Path, tmp_path: Path) -> None:
    frames = tmp_path / "frames"
    for number, shift in enumerate((0.0, 0.1)):
        images.write(frames / f"{number}.exr", linear() - np.float32(shift))
    arguments = ["--video", tmp_path / "out.mkv", "--format"]
    assert program("compensate", store, frames, "--out", tmp_path / "png", *arguments, "png").code == 0
    again = program(
        "compensate", store, frames, "--out", tmp_path / "png", *arguments, "png", "--resume", "--json"
    )
    assert (again.code, again.json["solved"]) == (0, 0)
    codes = fed(tmp_path / "png" / "pattern_000001.png")
    assert off(codes, linear(), rig_of()) < 0.015
    videos = [next(iter(open_frames(tmp_path / "out.mkv", encoding="linear"))).picture()]
    assert program("compensate", store, frames, "--out", tmp_path / "exr", *arguments, "exr").code == 0
    videos += [next(iter(open_frames(tmp_path / "out.mkv", encoding="linear"))).picture()]
    for shown in videos:
        np.testing.assert_allclose(shown, codes, atol=1.1 / 255)
    light = images.read(tmp_path / "exr" / "pattern_000001.exr")
    np.testing.assert_allclose(Setup.of(store).codes(light), codes, atol=0.01)


def test_what_the_camera_does_not_see_stays_dark(program: Program, tmp_path: Path) -> None:
    """Without having to be asked for, since nobody could change it."""
    T = 0.02 * np.eye(32)
    T[5, 5] = 5.0  # which saturates always, so that nothing is known of it
    made = VirtualRig(T, (4, 8), bits=12, response="linear")
    line = Response(np.array([[-0.004 / 0.996, 1.0]]))
    given: dict[str, Any] = {"strategy": "pixel", "exposures": [4.0, 8.0], "response": line}
    ltcl.acquire(made, geometry="aligned", store=tmp_path / "T.zarr", **given)
    images.write(tmp_path / "grey.exr", np.full((4, 8), 0.5))
    outcome = program("compensate", tmp_path / "T.zarr", tmp_path / "grey.exr", "--out", tmp_path / "out")
    assert outcome.code == 0, outcome.err
    assert "1 of 32 projector pixels give no direct light; they stay unlit" in outcome.err
    arguments = ["--on-dark", "raise", "--out", tmp_path / "b"]
    program("compensate", tmp_path / "T.zarr", tmp_path / "grey.exr", *arguments).refused("--on-dark mask")


def test_a_copy_is_told_where_its_calibration_is(
    program: Program, store: Path, picture: Path, tmp_path: Path
) -> None:
    small = tmp_path / "small.npz"
    outcome = program("compress", store, "--out", small)
    assert f"give compensate --calibration {store}" in outcome.err
    assert f"give compensate --calibration {store}" in program("convert", store, tmp_path / "T.npz").err
    for source in (small, tmp_path / "T.npz"):
        arguments = ["--calibration", store, "--rtol", "0.02", "--out", tmp_path / "out"]
        outcome = program("compensate", source, picture, *arguments)
        assert outcome.code == 0, outcome.err
        assert off(fed(tmp_path / "out" / "waves_pattern.png"), linear(), rig_of()) < 0.03
    other = _saved(tmp_path)
    arguments = ["--calibration", store, "--out", tmp_path / "no"]
    program("compensate", other, picture, *arguments).refused(
        "is of (6, 12) pixels and 1", "TRANSPORT has (4, 8)"
    )
    arguments = ["--calibration", tmp_path / "none.zarr", "--out", tmp_path / "no"]
    program("compensate", small, picture, *arguments).refused("none.zarr: no such folder")


def test_codes_of_a_pattern_are_relit_as_its_light(
    program: Program, store: Path, picture: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    assert program("compensate", store, picture, "--out", out).code == 0
    shown = []
    for extension in ("exr", "png"):
        assert (
            program("relight", store, out / f"waves_pattern.{extension}", "--out", tmp_path / extension).code
            == 0
        )
        shown.append(images.read(tmp_path / extension / "waves_pattern_relit.exr"))
    np.testing.assert_allclose(shown[1], shown[0], rtol=0.02)
    ambient = Setup.of(store).ambient
    np.testing.assert_allclose(shown[0] + ambient, images.read(out / "waves_appearance.exr"), rtol=1e-4)


def test_other_transports_are_as_before(program: Program, tmp_path: Path) -> None:
    assert main(["convert", str(_saved(tmp_path)), str(tmp_path / "T.zarr")]) == 0
    images.write(tmp_path / "grey.exr", np.full((4, 8), 0.3))
    outcome = program(
        "compensate", tmp_path / "T.zarr", tmp_path / "grey.exr", "--out", tmp_path / "out", "--json"
    )
    assert (outcome.json["options"]["gain"], outcome.json["pattern_png"]) == (1.0, "sRGB")


def _saved(folder: Path) -> Path:
    ltcl.save(folder / "T.npz", ltcl.scenes.dihedral(4, albedo=0.6).transport())
    return folder / "T.npz"
