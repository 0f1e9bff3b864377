# SPDX-License-Identifier: BSD-3-Clause
"""Pictures for the eye: large, labelled, at one exposure; and files of several runs in a folder."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import ltcl
from ltcl import images
from ltcl.cli import results

random = np.random.default_rng(0)


def shown(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")) / 255


def content(path: Path, grid: tuple[int, int]) -> np.ndarray:
    """The pixels of a labelled picture, (h, w, 3), each of which must be a square of one colour."""
    picture = shown(path)
    side = picture.shape[1] // grid[1]
    squares = picture[len(picture) - side * grid[0] :].reshape(grid[0], side, grid[1], side, 3)
    assert np.ptp(squares, axis=(1, 3)).max() == 0
    assert np.ptp(picture[: -side * grid[0]]) > 0.5  # the label
    return squares[:, 0, :, 0]


def test_all_pictures_of_a_run_are_large_and_share_an_exposure(program, colour_transport, tmp_path):
    T = ltcl.load(colour_transport)
    for name, light in (("bright", 1.0), ("dim", 0.25)):
        images.write(tmp_path / f"{name}.exr", T @ (light * random.uniform(0.5, 1.0, (4, 12, 3))))
    files = [tmp_path / "bright.exr", tmp_path / "dim.exr"]
    out = tmp_path / "out"
    told = program("separate", colour_transport, *files, "--bounces", "1", "--out", out, "--json").json
    for entry in told["pictures"]:
        for part in entry["parts"]:
            seen = content(out / part["png"], (4, 12))
            exact = images.to_srgb(np.clip(images.read(out / part["exr"]) * told["exposure"], 0, 1))
            np.testing.assert_allclose(seen, exact, atol=1.1 / 255)
    assert max(images.read(file).max() for file in files) * told["exposure"] == pytest.approx(1, rel=0.01)
    told = program("relight", colour_transport, *files, "--out", out, "--json").json
    for entry in told["pictures"]:
        exact = images.to_srgb(np.clip(images.read(out / entry["exr"]) * told["exposure"], 0, 1))
        np.testing.assert_allclose(content(out / entry["png"], (4, 12)), exact, atol=1.1 / 255)
    for sheet in ("separate.png",):
        assert shown(out / sheet).shape[1] > 3 * 512


def test_patterns_keep_their_pixels(program, transport, picture, large_picture, tmp_path):
    arguments = ["--resize", "--high", "2", "--rtol", "1e-4", "--out", tmp_path, "--json"]
    told = program("compensate", transport, picture, large_picture, *arguments).json
    for entry in told["pictures"]:
        codes = images.read_codes(tmp_path / entry["pattern"]["png"])
        assert codes.shape[:2] == (5, 10)
        light = images.read(tmp_path / entry["pattern"]["exr"])
        np.testing.assert_allclose(codes / 255, images.to_srgb(light / 2), atol=0.6 / 255)
        scale = told["exposure"] / entry["gain"]
        exact = images.to_srgb(np.clip(images.read(tmp_path / entry["appearance"]["exr"]) * scale, 0, 1))
        seen = content(tmp_path / entry["appearance"]["png"], (5, 10))
        np.testing.assert_allclose(
            seen, np.broadcast_to(exact.reshape(5, 10, -1), seen.shape), atol=1.1 / 255
        )
    assert shown(tmp_path / "compensate.png").shape[1] > 4 * 512


@pytest.mark.parametrize(
    ("value", "low", "bright"), [(5.0, "0", [1.0, 0.55, 0.0]), (0.0, "0.5", [0.1, 0.45, 1.0])]
)
def test_what_is_out_of_reach_is_seen_at_a_glance(program, transport, tmp_path, value, low, bright):
    """Orange where it stays too dark, blue where too bright, and the picture in grey elsewhere."""
    desired = np.full((5, 10), 0.6, np.float32)
    desired[2, 3] = value
    images.write(tmp_path / "spot.exr", desired)
    arguments = [
        "compensate",
        transport,
        tmp_path / "spot.exr",
        "--low",
        low,
        "--out",
        tmp_path / "out",
        "--json",
    ]
    (entry,) = program(*arguments).json["pictures"]
    missing = images.read(tmp_path / "out" / entry["out_of_reach"]["exr"])
    seen = content(tmp_path / "out" / entry["out_of_reach"]["png"], (5, 10))
    np.testing.assert_allclose(seen[2, 3], bright, atol=0.15)
    within = np.abs(missing) == 0
    assert np.ptp(seen[within], axis=-1).max(initial=0) == 0
    assert seen.min(axis=(0, 1)).max() > 0.05
    assert entry["too_dark"] == np.mean(missing > 0)
    assert entry["too_bright"] == np.mean(missing < 0)


def test_nothing_out_of_reach_is_grey_all_over(program, transport, picture, tmp_path):
    arguments = ["compensate", transport, picture, "--gain", "auto", "--out", tmp_path, "--json"]
    (entry,) = program(*arguments).json["pictures"]
    assert entry["clipped"] == entry["too_dark"] == entry["too_bright"] == 0
    assert np.ptp(content(tmp_path / entry["out_of_reach"]["png"], (5, 10)), axis=-1).max() == 0


def test_pictures_of_one_name_do_not_collide(program, transport, picture, tmp_path):
    copy, out = tmp_path / picture.name, tmp_path / "out"
    copy.write_bytes(picture.read_bytes())
    assert program("compensate", transport, picture, copy, "--out", out).code == 0
    assert {"sky_pattern.exr", "sky_2_pattern.exr"} <= found(out)


def found(out: Path) -> set[str]:
    return {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}


def test_commands_share_a_folder_and_remove_what_an_earlier_run_left(program, transport, picture, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    for bounces in ("2", "1"):
        assert (
            program("separate", transport, picture, picture, "--bounces", bounces, "--out", tmp_path).code
            == 0
        )
    for command in ("compensate", "relight"):
        assert program(command, transport, picture, "--out", tmp_path).code == 0
    files = found(tmp_path)
    assert "sky/bounce_1.exr" in files
    assert "sky/bounce_2.exr" not in files
    names = ("separate", "compensate", "relight")
    listed = [json.loads((tmp_path / f"{name}.json").read_text())["files"] for name in names]
    assert {*listed[0], *listed[1], *listed[2], "mine.txt"} == files
    assert program("separate", transport, picture, "--bounces", "0", "--out", tmp_path).code == 0
    assert not (tmp_path / "sky").exists()


def test_a_report_cannot_point_outside_its_folder_and_a_damaged_one_is_ignored(tmp_path):
    out, outside = tmp_path / "out", tmp_path / "outside"
    (out / "kept").mkdir(parents=True)
    outside.mkdir()
    for name in ("a", "b", "c"):
        (outside / name).write_text("mine")
    (out / "link").symlink_to(outside)
    (out / "arrow").symlink_to(outside / "c")
    files = ["../outside/a", str(outside / "b"), "link/c", "arrow", "kept", "kept/../../outside/a", "", "\0"]
    texts = [json.dumps({"files": [*files, 5, None]}), "", "old", "[]", "5", '{"files": 5}', "[" * 9999]
    for text in texts:
        (out / "compensate.json").write_text(text)
        with results.fill(out, {"command": "compensate"}) as folder:
            (folder / "new.exr").write_text("new")
    assert {path.name for path in outside.iterdir()} == {"a", "b", "c"}
    assert {path.name for path in out.iterdir()} == {"arrow", "compensate.json", "kept", "link", "new.exr"}


def test_a_failed_run_changes_nothing(program, transport, picture, tmp_path):
    assert program("compensate", transport, picture, "--out", tmp_path).code == 0
    before = {name: (tmp_path / name).read_bytes() for name in found(tmp_path)}
    black = tmp_path.with_name("black.exr")
    images.write(black, np.zeros((5, 10), np.float32))
    arguments = ["--weights", black, "--gain", "auto", "--out", tmp_path]
    program("compensate", transport, picture, *arguments).refused(f"{black}: weights")
    assert {name: (tmp_path / name).read_bytes() for name in found(tmp_path)} == before
