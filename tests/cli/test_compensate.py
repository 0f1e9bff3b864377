# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl compensate`, `separate` and `relight`: what they make of pictures and of films."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import ltcl
from ltcl import images, scenes
from ltcl.batch.manifest import locked
from ltcl.images.frames import open_frames, write_video

from .conftest import write


def test_a_pattern_pushed_through_T_is_the_picture(program, results, transport, picture, tmp_path):
    out, told = results
    entry, T = told["compensate"]["pictures"][0], ltcl.load(transport)
    pattern, desired = images.read(out / entry["pattern"]["exr"]), images.read(picture)
    assert entry["clipped"] == entry["too_dark"] == entry["too_bright"] == 0
    assert np.linalg.norm(T @ pattern - desired) < 2e-4 * np.linalg.norm(desired)
    arguments = [transport, out / entry["pattern"]["exr"], "--out", tmp_path, "--json"]
    (relit,) = program("relight", *arguments).json["pictures"]
    seen = images.read(tmp_path / relit["exr"])
    np.testing.assert_allclose(seen, T @ pattern, rtol=1e-6)
    assert relit["brightest"] == pytest.approx(seen.max())


def test_reports_have_every_option_as_it_was_resolved(results):
    shared = {"on_dark": "mask", "encoding": "linear", "grid": [5, 10], "resize": True}
    solving = {"first_bounce": "exact", "rtol": 1e-4, "method": "chebyshev"}
    for command, more in (("compensate", solving | {"low": 0, "high": 1, "gain": 1}), ("separate", solving)):
        text = results[1][command]
        assert shared.items() <= text["options"].items()
        assert more.items() <= text["options"].items()
        assert text["versions"]["ltcl"] == ltcl.__version__
        entries = [part for entry in text["pictures"] for part in entry.get("parts", [entry])]
        assert {solve["method"] for entry in entries for solve in entry["channels"]} == {"chebyshev"}
    assert shared.items() <= results[1]["relight"]["options"].items()


def test_bounces_are_those_of_the_scene(program, transport, tmp_path):
    photo, out = write(tmp_path / "photo.exr", ltcl.load(transport) @ np.ones((5, 10))), tmp_path / "out"
    arguments = ["--bounces", "2", "--rtol", "1e-5", "--out", out, "--json"]
    (entry,) = program("separate", transport, photo, *arguments).json["pictures"]
    assert [part["part"] for part in entry["parts"]] == ["direct", "indirect", "bounce_1", "bounce_2", "rest"]
    truth, A = np.full(50, 0.6), scenes.dihedral(5, albedo=0.6).A
    parts = {part["part"]: images.read(out / part["exr"]) for part in entry["parts"]}
    for name in ("direct", "bounce_1", "bounce_2"):
        assert np.linalg.norm(parts[name].ravel() - truth) < 1e-3 * np.linalg.norm(truth)
        truth = A @ truth
    whole = parts["direct"] + parts["bounce_1"] + parts["bounce_2"] + parts["rest"]
    np.testing.assert_allclose(whole, images.read(photo), rtol=1e-5)
    assert sum(part["share"] for part in entry["parts"][:2]) == pytest.approx(1, abs=1e-5)


def test_negative_light_survives_in_exr_and_advice_says_what_is_out_of_reach(program, transport, tmp_path):
    """No projector can leave the right wall that dark."""
    dark = write(tmp_path / "dark.exr", [[0.5] * 5 + [0.01] * 5] * 5)
    bright, out = write(tmp_path / "bright.exr", np.full((5, 10), 2.0)), ["--out", tmp_path / "out"]
    assert program("separate", transport, dark, *out).code == 0
    assert images.read(tmp_path / "out" / "direct.exr").min() < 0
    advice = program("compensate", transport, bright, dark, *out).err
    assert "bright.exr: 100 % of it stays too dark" in advice
    assert "--gain auto" in advice
    assert "of it stays too bright" in advice
    assert program("compensate", transport, bright, *out, "--gain", "auto").err == ""
    assert program("compensate", transport, bright, *out, "--quiet").err == ""


def test_the_largest_gain_and_weights(program, transport, picture, tmp_path):
    common = ["compensate", transport, picture, "--out", tmp_path, "--gain", "auto", "--json"]
    (exact,) = program(*common).json["pictures"]
    assert images.read(tmp_path / "sky_pattern.exr").max() == pytest.approx(1.0, rel=1e-4)
    (more,) = program(*common, "--loss", "0.05").json["pictures"]
    assert more["gain"] > exact["gain"]
    assert more["error"] == pytest.approx(0.05, rel=0.05)
    desired, weights = np.full((5, 10), 0.3), np.ones((5, 10))
    desired[2, 3], weights[2, 3] = 5.0, 0.0
    spot = f"compensate {transport} {tmp_path}/spot.exr --out {tmp_path}/out --json".split()
    write(tmp_path / "spot.exr", desired)
    (entry,) = program(*spot).json["pictures"]
    assert 0 < entry["gap"] <= 0.01
    (other,) = program(*spot, "--weights", write(tmp_path / "weights.exr", weights)).json["pictures"]
    assert other["error"] < 0.5 * entry["error"]


def test_methods_that_sample(program, transport, picture, tmp_path):
    sampling = {"method": "monte_carlo", "samples": 300, "seed": 2**64 - 1}
    options = [word for name, value in sampling.items() for word in (f"--{name}", value)]
    told = program("compensate", transport, picture, "--out", tmp_path, "--high", 9, *options, "--json").json
    assert sampling.items() <= told["options"].items()
    T, desired = ltcl.load(transport), images.read(picture)
    direct: Any = ltcl.compensate(T, desired, bounds=(0, 9), rtol=1e-2, **sampling)
    np.testing.assert_array_equal(images.read(tmp_path / "sky_pattern.exr"), direct.pattern)
    (channel,) = told["pictures"][0]["channels"]
    assert channel["standard_error"]["largest"] == pytest.approx(direct.solution.standard_error.max())


def test_a_compressed_transport_is_corrected(program, transport, compressed, picture, tmp_path):
    """As `ltcl.compensate` and `ltcl.separate` do it."""
    error, desired = ltcl.load(compressed).error, images.read(picture)
    for command, rtol in (("compensate", 1e-2), ("separate", 1e-3), ("relight", None)):
        arguments = [command, compressed, picture, "--out", tmp_path]
        assert "of the compressed transport, whose own relative error" in program(*arguments).out
        told = program(*arguments, "--json").json
        assert (told["transport"]["compressed"], told["transport"]["error"]) == (True, error)
        if rtol is not None:
            assert told["pictures"][0]["transport_error"] == error
            assert told["options"]["rtol"] == max(error, rtol)
            corrected = [*arguments, "--exact", transport, "--rtol", "1e-5"]
            assert f"of {transport}, by which solutions were corrected" in program(*corrected).out
            assert program(*corrected, "--json").json["pictures"][0]["transport_error"] == 0.0
    seen = ltcl.load(transport) @ images.read(tmp_path / "sky_pattern.exr")
    assert np.linalg.norm(seen - desired) <= 2e-5 * np.linalg.norm(desired)


def test_an_inverse_takes_one_product_a_picture(program, transport, picture, inverse, results, tmp_path):
    common = ["compensate", transport, picture, "--inverse", inverse, "--out", tmp_path, "--json"]
    (entry,) = program(*common).json["pictures"]
    (channel,) = entry["channels"]
    assert (channel["method"], channel["products"], channel["residual"]) == ("precomputed", 1, None)
    assert 0.0 < channel["error"] <= 1e-3
    ours, solved = (images.read(out / "sky_pattern.exr") for out in (tmp_path, results[0]))
    assert np.linalg.norm(ours - solved) <= 2e-3 * np.linalg.norm(solved)
    limited = [*common, "--high", "0.4"]
    best, clamped = (program(*limited, *more).json["pictures"][0]["limited"] for more in ([], ["--clamp"]))
    assert (bool(best), clamped) == (True, [])
    parts = program("separate", transport, picture, "--inverse", inverse, "--out", tmp_path / "parts")
    assert "relative error of each part by the inverse is at most 0." in parts.out


def test_a_second_run_in_a_folder_is_refused_at_once(program, transport, picture, tmp_path):
    arguments = ["compensate", transport, picture, "--out", tmp_path / "out"]
    with locked(tmp_path / "out"):  # as the first one does
        program(*arguments).refused("out: another run writes")
    assert program(*arguments).code == 0


def shown(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")) / 255


def content(path: Path, grid: tuple[int, int] = (5, 10)) -> np.ndarray:
    """The pixels of a labelled picture, (h, w, 3), each of which must be a square of one colour."""
    picture = shown(path)
    side = picture.shape[1] // grid[1]
    assert side * grid[1] >= 512
    squares = picture[len(picture) - side * grid[0] :].reshape(grid[0], side, grid[1], side, 3)
    assert np.ptp(squares, axis=(1, 3)).max() == 0
    assert np.ptp(picture[: -side * grid[0]]) > 0.5  # the label
    return squares[:, 0, :, 0]


def files_in(out: Path) -> set[str]:
    return {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}


def test_what_is_for_the_eye_is_the_linear_picture_at_the_exposure_of_the_run(results):
    out, told = results
    compensated = [entry["appearance"] | {"gain": entry["gain"]} for entry in told["compensate"]["pictures"]]
    separated = [part for entry in told["separate"]["pictures"] for part in entry["parts"]]
    everything = {"compensate": compensated, "separate": separated, "relight": told["relight"]["pictures"]}
    for command, entries in everything.items():
        for entry in entries:
            scale = told[command]["exposure"] / entry.get("gain", 1.0)
            exact = images.to_srgb(np.clip(images.read(out / entry["exr"]) * scale, 0, 1)).reshape(5, 10, -1)
            seen = content(out / entry["png"])
            np.testing.assert_allclose(seen, np.broadcast_to(exact, seen.shape), atol=1.1 / 255)
    assert shown(out / "separate.png").shape[1] > 3 * 512
    assert shown(out / "compensate.png").shape[1] > 4 * 512


def test_patterns_keep_their_pixels(program, transport, picture, results, tmp_path):
    out, told = results
    patterns = [(out, entry["pattern"], 1) for entry in told["compensate"]["pictures"]]
    assert program("compensate", transport, picture, "--high", 2, "--out", tmp_path).code == 0
    for folder, pattern, white in [*patterns, (tmp_path, patterns[0][1], 2)]:
        codes, light = images.read_codes(folder / pattern["png"]), images.read(folder / pattern["exr"])
        assert codes.shape[:2] == (5, 10)
        np.testing.assert_allclose(codes / 255, images.to_srgb(light / white), atol=0.6 / 255)


@pytest.mark.parametrize(
    ("value", "low", "bright"), [(5.0, 0, [1.0, 0.55, 0.0]), (0.0, 0.5, [0.1, 0.45, 1.0])]
)
def test_what_is_out_of_reach_is_seen_at_a_glance(program, transport, tmp_path, value, low, bright):
    """Orange where it stays too dark, blue where too bright, and the picture in grey elsewhere."""
    desired = np.full((5, 10), 0.6)
    desired[2, 3] = value
    spot, out = write(tmp_path / "spot.exr", desired), tmp_path / "out"
    (entry,) = program("compensate", transport, spot, "--low", low, "--out", out, "--json").json["pictures"]
    missing = images.read(out / entry["out_of_reach"]["exr"])
    seen = content(out / entry["out_of_reach"]["png"])
    np.testing.assert_allclose(seen[2, 3], bright, atol=0.15)
    assert np.ptp(seen[missing == 0], axis=-1).max(initial=0) == 0
    assert seen.min(axis=(0, 1)).max() > 0.05
    assert (entry["too_dark"], entry["too_bright"]) == (np.mean(missing > 0), np.mean(missing < 0))


def test_commands_share_a_folder_and_list_their_files(results):
    out, told = results
    listed = [file for text in told.values() for file in text["files"]]
    assert {*listed, "mine.txt"} == files_in(out)
    for command, text in told.items():
        assert {"folder": str(out), **json.loads((out / f"{command}.json").read_text())} == text
        assert text["files"][-1] == f"{command}.json"


def test_a_failed_run_changes_nothing(program, transport, picture, tmp_path):
    assert program("compensate", transport, picture, "--out", tmp_path).code == 0
    before = {name: (tmp_path / name).read_bytes() for name in files_in(tmp_path)}
    black = write(tmp_path.with_name("black.exr"), np.zeros((5, 10)))
    arguments = [transport, picture, "--weights", black, "--gain", "auto", "--out", tmp_path]
    program("compensate", *arguments).refused("weights", "0 to 0", "sky.exr")
    assert {name: (tmp_path / name).read_bytes() for name in files_in(tmp_path)} == before


COUNT = 10


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten 16-bit PNG of 5 x 10, within reach of `transport`."""
    frames, values = tmp_path_factory.mktemp("film"), np.random.default_rng(5)
    for number in range(1, COUNT + 1):
        images.write(
            frames / f"f{number}.png", values.uniform(0.33, 0.4, (5, 10)).astype(np.float32), bits=16
        )
    return frames


def test_patterns_of_a_folder_are_listed(program, transport, film, tmp_path):
    out = tmp_path / "out"
    told = program("compensate", transport, film, "--out", out, "--rtol", "1e-4", "--json").json
    assert (told["source"], told["solved"], told["options"]["rtol"]) == (str(film), COUNT, 1e-4)
    assert told["frames_per_second"] > 0
    assert [frame["name"] for frame in told["frames"]] == [f"f{number}.png" for number in range(1, COUNT + 1)]
    assert told["worst"]["error"] == max(frame["error"] for frame in told["frames"])
    assert len(list(out.glob("pattern_*.png"))) == COUNT
    assert json.loads((out / "frames.json").read_text())["frames"] == told["frames"]
    advice = program("compensate", transport, film, "--out", tmp_path / "b", "--gain", "2").err
    assert f"ltcl: {COUNT} frame(s) ask for light beyond the projector's, frame " in advice
    assert "--gain" in advice


def test_a_video_comes_back_as_one(program, colour_transport, tmp_path):
    film, out, video = tmp_path / "film.avi", tmp_path / "out", tmp_path / "made.mkv"
    write_video(film, np.random.default_rng(6).uniform(0.05, 0.08, (COUNT, 4, 12)), fps=12.0)
    common = ["compensate", colour_transport, film, "--out", out, "--batch", "4", "--video", video]
    outcome = program(*common, "--high", "9", "--gain", "auto", "--appearance", "--format", "exr")
    assert f"as a video in {video}" in outcome.out
    source = open_frames(video)
    assert (source.count, source.fps) == (COUNT, pytest.approx(12.0))
    for frame in source:
        codes = images.to_srgb(images.read(out / f"pattern_{frame.number:06}.exr") / 9.0)
        np.testing.assert_allclose(images.to_srgb(frame.picture()), codes, atol=0.6 / 255)
        assert images.read(out / f"appearance/appearance_{frame.number:06}.exr").shape == (4, 12, 3)


def test_resume_goes_on_and_says_what_there_is(program, transport, film, tmp_path):
    common = ["compensate", transport, film, "--out", tmp_path, "--batch", "3"]
    assert program(*common, "--frames", "6").code == 0
    program(*common).refused(f"{tmp_path}: holds 6 frame(s)", "resume=True")
    program(*common, "--resume", "--rtol", "1e-3").refused("rtol=0.01", "0.001")
    told = program(*common, "--resume", "--json").json
    assert (told["solved"], len(told["frames"])) == (COUNT - 6, COUNT)
    assert program(*common, "--resume").out.splitlines()[1].split()[:3] == [str(COUNT), "0", "-"]


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for one process there")
def test_a_real_ctrl_c_is_taken_between_files(transport, tmp_path):
    frames, out = tmp_path / "in", tmp_path / "out"
    for number in range(100):
        images.write(frames / f"{number}.exr", np.full((5, 10), 0.3 + 1e-4 * number))
    words = [sys.executable, *f"-m ltcl compensate {transport} {frames} --out {out} --batch 1 --json".split()]
    with subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as child:
        while not (out / "frames.json").exists():
            assert child.poll() is None
        child.send_signal(signal.SIGINT)
        stdout, stderr = child.communicate()
    done = json.loads((out / "frames.json").read_text())["frames"]
    assert child.returncode == json.loads(stdout)["exit_code"] == 130
    assert "--resume goes on from there" in stderr
    assert "Traceback" not in stderr
    assert 1 <= len(done) < 100
    assert all((out / f"pattern_{record['number']:06}.png").is_file() for record in done)
    assert not [name for name in os.listdir(out) if name.startswith(".")]
