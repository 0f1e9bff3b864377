# SPDX-License-Identifier: BSD-3-Clause
"""Patterns for many frames: each as good as alone, the same however often a run was ended."""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl import images
from ltcl.batch import CompensatedFrames, compensate_frames
from ltcl.errors import ConvergenceError, FileError, InputError, InputTypeError
from ltcl.images.frames import open_frames, write_video
from tests.problems import lambertian

pytestmark = pytest.mark.slow

GRID = (8, 8)
SCENE = lambertian(64, 0.8, seed=70)
COUNT = 13
NEARLY = SCENE.T.copy()
NEARLY[5, 7] *= 1.0001
FAR = ltcl.Transport(lambertian(64, 3.0, seed=72).T, GRID)
random = np.random.default_rng(71)
LIGHT = random.uniform(0.3, 0.7, (COUNT, *GRID))  # patterns whose pictures are wanted


@pytest.fixture(scope="module")
def T(device):
    return ltcl.Transport(SCENE.T, GRID, device=device)


def seen(pattern: np.ndarray) -> np.ndarray:
    """T pattern in float64, of frames without colour."""
    return (pattern.reshape(len(pattern), -1) @ SCENE.T.T).reshape(-1, *GRID)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """COUNT grey pictures of 8 x 8."""
    return fill(tmp_path_factory.mktemp("source"), seen(LIGHT))


def fill(folder: Path, pictures: np.ndarray | list[np.ndarray]) -> Path:
    folder.mkdir(exist_ok=True)
    for number, picture in enumerate(pictures):
        images.write(folder / f"f{number}.exr", np.asarray(picture, np.float32))
    return folder


def everything(folder: Path) -> dict[Path, bytes]:
    return {
        path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }


def patterns(done: CompensatedFrames) -> list[np.ndarray]:
    return [
        images.read(next(done.folder.glob(f"pattern_{each.number:06}.*"))) for each in done.records
    ]


@pytest.mark.parametrize("batch", [1, 4, 20])
def test_pushed_through_T_the_patterns_give_the_frames(T, source, tmp_path, batch):
    calls = []
    common: dict[str, Any] = {
        "format": "exr",
        "rtol": 1e-4,
        "progress": lambda *now: calls.append(now),
    }
    done = compensate_frames(T, source, tmp_path, batch=batch, **common)
    np.testing.assert_allclose(np.stack(patterns(done)), LIGHT, rtol=5e-4)
    assert [(r.number, r.name) for r in done.records] == [
        (n + 1, f"f{n}.exr") for n in range(COUNT)
    ]
    assert calls == [("frames", n, COUNT) for n in [*range(0, COUNT, batch), COUNT]]
    assert (done.solved, done.worst.error < 1e-4, done.most_clipped.clipped) == (COUNT, True, 0)


@pytest.mark.parametrize("gain", [1.0, "auto"])
def test_three_grey_frames_in_a_batch_are_no_colours(device, source, tmp_path, gain):
    T = ltcl.Transport([SCENE.T] * 3, GRID, device=device)
    common: dict[str, Any] = {"format": "exr", "rtol": 1e-4, "frames": 3, "gain": gain}
    together = compensate_frames(T, source, tmp_path / "three", batch=3, **common)
    apart = compensate_frames(T, source, tmp_path / "two", batch=2, **common)
    if gain == 1.0:
        np.testing.assert_allclose(patterns(together), patterns(apart), rtol=1e-3)
    assert np.shape(patterns(together)) == (3, *GRID, 3)


def test_png_patterns_are_those_of_exr_with_white_at_the_upper_bound(T, source, tmp_path):
    common: dict[str, Any] = {"bounds": (0.0, 2.0), "appearance": True, "gain": 0.5, "frames": 5}
    png = compensate_frames(T, source, tmp_path / "png", **common)
    exr = compensate_frames(T, source, tmp_path / "exr", format="exr", **common)
    for coarse, exact in zip(patterns(png), patterns(exr), strict=True):
        np.testing.assert_allclose(coarse, exact / 2.0, atol=1e-4)
    for frame in list(open_frames(source))[:5]:
        name = f"appearance/appearance_{frame.number:06}"
        shown = images.read(tmp_path / f"png/{name}.png")
        light = images.read(tmp_path / f"exr/{name}.exr")
        np.testing.assert_allclose(shown, frame.picture(), rtol=0.02, atol=1e-3)
        np.testing.assert_allclose(light, 0.5 * frame.picture(), rtol=0.02)


def test_grey_coloured_black_and_bright_frames_are_what_each_is_alone(T, tmp_path):
    grey = seen(LIGHT[:4])
    colour = np.stack(list(seen(LIGHT[4:7])), axis=-1)
    pictures = [grey[0], colour, 4.0 * grey[2], np.zeros(GRID), 0.5 * grey[3]]
    done = compensate_frames(
        T, fill(tmp_path / "in", pictures), tmp_path / "out", format="exr", rtol=1e-4
    )
    for record, picture, pattern in zip(done.records, pictures, patterns(done), strict=True):
        alone = ltcl.compensate(T, picture, rtol=1e-4)
        # A batch with one in colour is in colour.
        shown = pattern[..., 0] if picture.ndim == 2 else pattern
        np.testing.assert_allclose(shown, alone.pattern, atol=2e-3)
        assert record.error == pytest.approx(alone.error, abs=1e-3)
        assert record.clipped == pytest.approx(alone.clipped, abs=0.05)
    assert done.most_clipped.number == done.worst.number == 3


def test_one_gain_for_all_frames_from_a_sample_of_all(T, tmp_path):
    scale = np.linspace(1.0, 0.2, 9)
    scale[2] = 5.0  # not in the sample
    pictures = scale[:, None, None] * seen(LIGHT[:9])
    common = {"gain": "auto", "rtol": 1e-4}
    source = fill(tmp_path / "in", pictures)
    done = compensate_frames(T, source, tmp_path / "out", batch=3, format="exr", **common)
    sample = ltcl.compensate(T, pictures[[0, 4, 8]], **common)
    assert done.gain == pytest.approx(sample.gain, rel=1e-3)
    for pattern, light, factor in zip(patterns(done)[3:], LIGHT[3:9], scale[3:], strict=True):
        np.testing.assert_allclose(pattern, done.gain * factor * light, rtol=1e-3)
    assert [record.number for record in done.records if record.clipped > 0.05] == [3]
    listed = json.loads((tmp_path / "out/frames.json").read_text())
    assert (listed["gain"], listed["settings"]["gain"]) == (done.gain, "auto")


def test_background_and_weights_serve_all_frames_and_sizes_are_scaled_when_asked(
    T, source, tmp_path
):
    options: dict[str, Any] = {"background": 0.1 * seen(LIGHT[:1])[0], "weights": np.ones(GRID)}
    done = compensate_frames(T, source, tmp_path / "out", format="exr", rtol=1e-4, **options)
    np.testing.assert_allclose(np.stack(patterns(done)), LIGHT - 0.1 * LIGHT[0], rtol=2e-3)
    wide = fill(tmp_path / "in", [np.full((4, 16), 0.2)])
    with pytest.raises(InputError, match=r"frame 1 \(f0\.exr\).* 4 x 16 .* 8 x 8"):
        compensate_frames(T, wide, tmp_path / "wide")
    done = compensate_frames(T, wide, tmp_path / "wide", resize="stretch", format="exr")
    np.testing.assert_allclose(seen(patterns(done)[0][None])[0], 0.2, rtol=0.02)


def test_videos_in_and_out_also_where_sound_outlasts_the_picture(T, tmp_path, caplog):
    film = tmp_path / "film.mkv"
    out = tmp_path / "out.avi"
    write_video(film, seen(LIGHT), fps=30.0)
    data = film.read_bytes()
    # Its duration, of which the number of frames is estimated.
    place = data.index(b"\x44\x89\x88") + 3
    (duration,) = struct.unpack_from(">d", data, place)
    film.write_bytes(data[:place] + struct.pack(">d", 1.2 * duration) + data[place + 8 :])
    common: dict[str, Any] = {"out": tmp_path / "patterns", "video": out, "rtol": 1e-4, "batch": 4}
    done = compensate_frames(T, film, **common)
    shown = open_frames(out)
    assert f"{film}: 13 of 16" in caplog.text
    assert (shown.count, shown.fps) == (COUNT, pytest.approx(30.0))
    assert [record.name for record in done.records][:2] == ["film.mkv:1", "film.mkv:2"]
    for frame, source, pattern in zip(shown, open_frames(film), patterns(done), strict=True):
        np.testing.assert_allclose(
            images.to_srgb(frame.picture()), images.to_srgb(pattern), atol=0.6 / 255
        )
        desired = source.picture()
        assert np.linalg.norm(seen(pattern[None])[0] - desired) < 1e-2 * np.linalg.norm(desired)
    again = compensate_frames(T, film, fps=10, resume=True, **common)
    assert (again.solved, again.records) == (0, done.records)
    assert open_frames(out).fps == pytest.approx(10.0)


def test_resuming_makes_what_is_missing_and_an_earlier_run_is_not_begun_anew(T, source, tmp_path):
    whole = compensate_frames(T, source, tmp_path / "whole", batch=4, resume=True)
    common = {"T": T, "source": source, "out": (out := tmp_path / "out"), "batch": 4}
    for frames, solved in ((4, 4), (6, 2), (None, COUNT - 6)):  # each is solved once
        done = compensate_frames(**common, frames=frames, resume=True)
        assert (done.solved, len(done.records)) == (solved, frames or COUNT)
        before = everything(out)
        with pytest.raises(InputError, match=rf"out: .* {frames or COUNT} .*resume=True"):
            compensate_frames(**common)
        assert everything(out) == before
        ltcl.save(tmp_path / "T.npz", T)  # compensation does not depend on the first bounce
        common["T"] = ltcl.load(tmp_path / "T.npz", first_bounce=SCENE.F)
    (out / "pattern_000006.png").unlink()
    assert compensate_frames(**common, resume=True).solved == 1
    # 5 to 8 were not one batch.
    np.testing.assert_allclose(patterns(done), patterns(whole), atol=1e-3)


@pytest.mark.parametrize("name", ["pattern_000003.png", "appearance/appearance_000002.png"])
@pytest.mark.parametrize("damage", ["empty", "other", "cut", "flipped", "removed"])
def test_a_damaged_pattern_is_made_again(T, source, tmp_path, name, damage):
    common: dict[str, Any] = {"batch": 4, "frames": 5, "appearance": True}
    done = compensate_frames(T, source, tmp_path, **common)
    file = tmp_path / name
    before = everything(tmp_path)
    good = file.read_bytes()
    if damage == "removed":
        file.unlink()
    else:
        middle = len(good) // 2
        flipped = good[:middle] + bytes([good[middle] ^ 1]) + good[middle + 1 :]
        file.write_bytes(
            {"empty": b"", "other": b"damaged", "cut": good[:-20], "flipped": flipped}[damage]
        )
    again = compensate_frames(T, source, tmp_path, resume=True, **common)
    assert (again.solved, len(again.records)) == (1, len(done.records))
    np.testing.assert_allclose(images.read(file), _read(good, file.suffix, tmp_path), atol=1e-3)
    assert everything(tmp_path).keys() == before.keys()


def _read(data: bytes, suffix: str, folder: Path) -> np.ndarray:
    """The picture in these bytes."""
    file = folder.with_suffix(suffix)
    file.write_bytes(data)
    return images.read(file)


class Projector:
    """A curve as a bound method, which has no identity of its own."""

    def __init__(self, gamma: float) -> None:
        self.gamma = gamma

    def codes(self, light: np.ndarray) -> np.ndarray:
        return np.clip(light, 0, 1) ** (1 / self.gamma)


@pytest.mark.parametrize(
    ("changed", "text"),
    [
        ({"rtol": 1e-3}, "rtol=0.01.* 0.001"),
        ({"bounds": (0.0, 2.0)}, r"bounds=\[0.0, 1.0\].* \[0.0, 2.0\]"),
        ({"background": np.full(GRID, 0.1)}, "background=None.* '8 x 8, sha256"),
        ({"codes": Projector(2.2).codes}, "codes='sha256"),
        ({"exact": ltcl.Transport(NEARLY, GRID)}, "exact='Transport, sha256"),
        ({"T": ltcl.Transport(NEARLY, GRID)}, "another T"),
        ({"T": ltcl.Transport(np.float32(SCENE.T), GRID)}, "another T"),
        ({"T": ltcl.Transport([SCENE.T] * 3, GRID)}, "another T"),
        ({"source": "f3.exr"}, r"frame 4 \(f3\.exr\)"),
    ],
)
def test_another_run_is_refused_by_what_differs(T, source, tmp_path, changed, text):
    out = tmp_path / "out"
    common = {"batch": 4, "rtol": 0.01, "codes": Projector(1.8).codes, "T": T}
    if "exact" in changed:
        common["exact"] = ltcl.Transport(SCENE.T, GRID)
    if "source" in changed:  # one of its files is another
        changed = {"source": shutil.copytree(source, tmp_path / "in")}
        shutil.copy(source / "f4.exr", tmp_path / "in" / "f3.exr")
    common |= {"source": source, "out": out}
    compensate_frames(**common, frames=4)
    before = everything(out)
    with pytest.raises(InputError, match=text) as error:
        compensate_frames(**{**common, **changed}, resume=True)
    assert ("\n" in str(error.value), everything(out)) == (False, before)
    common["codes"] = Projector(1.8).codes  # another object, the same curve
    assert compensate_frames(**common, frames=5, resume=True).solved == 1


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b'{"format": 9}', b'{"format": 2, "frames": [{}]}', b"\xff"]
)
def test_a_damaged_list_is_refused(T, source, tmp_path, content):
    (tmp_path / "frames.json").write_bytes(content)
    with pytest.raises(FileError, match=r"frames\.json: .*(damaged|empty)"):
        compensate_frames(T, source, tmp_path, resume=True)
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    ("options", "error", "text"),
    [
        ({"nonsense": 1}, InputTypeError, "^unknown option 'nonsense'"),
        ({"codes": "sRGB"}, InputTypeError, "codes is 'sRGB'"),
        ({"progress": 3}, InputTypeError, "progress is 3"),
        ({"T": SCENE.T}, InputTypeError, "T is a ndarray"),
        ({"T": ltcl.Transport(np.eye(15), (3, 5)), "video": "a.mkv"}, InputError, "3 x 5"),
        ({"source": "nowhere"}, FileError, "nowhere: "),
        ({"T": FAR, "method": "jacobi"}, ConvergenceError, "frames 1 to 8: jacobi: diverged"),
    ],
)
def test_bad_settings_leave_no_folder(T, source, tmp_path, options, error, text):
    with pytest.raises(error, match=text):
        compensate_frames(**{"T": T, "source": source, "out": tmp_path / "a" / "out", **options})
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(InputError, match=f"out is {source}"):
        compensate_frames(T, source, source)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"nonsense": 1}, "nonsense"),
        ({"method": "no"}, "method is 'no'"),
        ({"method": "cg", "omega": 1.0}, "omega"),
        ({"rtol": -1.0}, "rtol is -1"),
        ({"maxiter": 0}, "maxiter is 0"),
        ({"clamp": "yes"}, "clamp is 'yes'"),
        ({"inverse": 3}, "inverse is a int"),
        ({"exact": 3}, "exact is a int"),
        ({"gain": "follow"}, "gain is 'follow'"),
        ({"bounds": (1.0, 0.0)}, "bounds"),
    ],
)
def test_options_are_refused_before_a_frame_is_read(T, tmp_path, monkeypatch, options, text):
    monkeypatch.setattr("ltcl.batch.frames.open_frames", pytest.fail)
    with pytest.raises((InputError, InputTypeError), match=text):
        compensate_frames(T, "film", tmp_path / "out", **options)


RUN = """
import sys
import numpy as np
import ltcl

_, matrix, source, out = sys.argv
T = ltcl.Transport(np.load(matrix), (8, 8))
say = lambda step, done, total: print(done, flush=True)
ltcl.batch.compensate_frames(
    T, source, out, batch=2, gain="auto", resume=True, appearance=True, progress=say
)
"""


@pytest.mark.rare
def test_a_killed_run_goes_on_to_the_same_bytes(T, tmp_path):
    np.save(tmp_path / "T.npy", SCENE.T)
    source = fill(tmp_path / "in", seen(random.uniform(0.2, 0.9, (60, *GRID))))
    common: dict[str, Any] = {"batch": 2, "gain": "auto", "appearance": True}
    compensate_frames(T, source, tmp_path / "whole", **common)
    for trial in range(2):
        out = tmp_path / f"out{trial}"
        command = [sys.executable, "-c", RUN, str(tmp_path / "T.npy"), str(source), str(out)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
            assert child.stdout is not None
            for _ in range(random.integers(1, 20)):
                child.stdout.readline()
            time.sleep(random.uniform(0, 0.02))
            child.kill()
        listed = out / "frames.json"
        done = len(json.loads(listed.read_text())["frames"]) if listed.exists() else 0
        written = len(list(out.glob("pattern_*.png")))
        # A batch of two is recorded once the next one is on its way.
        assert done <= written <= done + 4
        assert compensate_frames(T, source, out, resume=True, **common).solved == 60 - done
        assert everything(out) == everything(tmp_path / "whole")
