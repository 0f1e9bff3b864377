# SPDX-License-Identifier: BSD-3-Clause
"""Patterns for many frames: each as good as alone, and the same however often a run was ended early."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl import files, images
from ltcl.batch import CompensatedFrames, compensate_frames, identity
from ltcl.errors import ConvergenceError, FileError, InputError, InputTypeError
from ltcl.images.frames import open_frames, write_video
from tests.problems import lambertian

GRID = (8, 8)
LISTED = b'{"format": 1, "frames": [], "settings": [], "transport": {}, "gain": 1.0}'
SCENE = lambertian(64, 0.8, seed=70)
COUNT = 13
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
    folder = tmp_path_factory.mktemp("source")
    fill(folder, seen(LIGHT))
    return folder


def fill(folder: Path, pictures: np.ndarray | list[np.ndarray]) -> None:
    folder.mkdir(exist_ok=True)
    for number, picture in enumerate(pictures):
        images.write(folder / f"f{number}.exr", np.asarray(picture, np.float32))


def everything(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }


def patterns(done: CompensatedFrames) -> list[np.ndarray]:
    kinds = "exr" if any(done.folder.glob("*.exr")) else "png"
    return [images.read(done.folder / f"pattern_{record.number:06}.{kinds}") for record in done.records]


@pytest.mark.parametrize("batch", [1, 4, 8, 20])
def test_pushed_through_T_the_patterns_give_the_frames(T, source, tmp_path, batch):
    calls = []
    done = compensate_frames(
        T,
        source,
        tmp_path / "out",
        batch=batch,
        format="exr",
        rtol=1e-4,
        progress=lambda *now: calls.append(now),
    )
    np.testing.assert_allclose(np.stack(patterns(done)), LIGHT, rtol=5e-4)
    assert [record.number for record in done.records] == list(range(1, COUNT + 1))
    assert [record.name for record in done.records] == [f"f{number}.exr" for number in range(COUNT)]
    assert calls == [(n, COUNT) for n in [0, *range(batch, COUNT, batch), COUNT]]
    assert done.solved == COUNT
    assert done.worst.error < 1e-4
    assert done.most_clipped.clipped == 0
    assert done.frames_per_second > 0
    assert str(done.folder) in repr(done)


def test_png_patterns_are_those_of_exr_with_white_at_the_upper_bound(T, source, tmp_path):
    common: dict[str, Any] = {"bounds": (0.0, 2.0), "appearance": True, "gain": 0.5}
    png = compensate_frames(T, source, tmp_path / "png", **common)
    exr = compensate_frames(T, source, tmp_path / "exr", format="exr", **common)
    for coarse, exact in zip(patterns(png), patterns(exr), strict=True):
        np.testing.assert_allclose(coarse, exact / 2.0, atol=1e-4)
    for number, frame in enumerate(open_frames(source), start=1):
        shown = images.read(tmp_path / f"png/appearance/appearance_{number:06}.png")
        np.testing.assert_allclose(shown, frame.picture(), rtol=0.02, atol=1e-3)
        light = images.read(tmp_path / f"exr/appearance/appearance_{number:06}.exr")
        np.testing.assert_allclose(light, 0.5 * frame.picture(), rtol=0.02)


def test_records_are_those_of_each_frame_alone(T, tmp_path):
    scale = np.array([0.5, 1.0, 2.0, 4.0])
    pictures = scale[:, None, None] * seen(LIGHT[:4])
    fill(tmp_path / "in", pictures)
    done = compensate_frames(T, tmp_path / "in", tmp_path / "out", rtol=1e-4)
    for record, picture in zip(done.records, pictures, strict=True):
        alone = ltcl.compensate(T, picture, rtol=1e-4)
        assert record.error == pytest.approx(alone.error, abs=1e-3)
        assert record.clipped == pytest.approx(alone.clipped, abs=0.05)
    assert done.most_clipped.number == done.worst.number == 4
    told = json.loads((tmp_path / "out/frames.json").read_text())
    assert [entry["error"] for entry in told["frames"]] == [record.error for record in done.records]


def test_grey_and_coloured_frames_keep_their_kind(T, tmp_path):
    kinds = [seen(LIGHT[:3])[n] if n != 1 else np.stack(list(seen(LIGHT[3:6])), axis=-1) for n in range(3)]
    fill(tmp_path / "in", kinds)
    done = compensate_frames(T, tmp_path / "in", tmp_path / "out", format="exr", rtol=1e-4)
    found = patterns(done)
    assert [pattern.shape for pattern in found] == [GRID, (*GRID, 3), GRID]
    np.testing.assert_allclose(found[1], np.moveaxis(LIGHT[3:6], 0, -1), rtol=1e-3)
    np.testing.assert_allclose(found[2], LIGHT[2], rtol=1e-3)
    (tmp_path / "film").mkdir()
    done = compensate_frames(
        T, tmp_path / "in", tmp_path / "film", gain="auto", video=tmp_path / "a.mkv", encoding="auto"
    )
    assert open_frames(tmp_path / "a.mkv").count == 3


def test_a_transport_in_colour_and_a_rectangular_one(device, tmp_path):
    grid = (2, 3)
    parts = [lambertian(6, rho, seed=80 + c).T for c, rho in enumerate((0.5, 0.9, 1.5))]
    light = random.uniform(0.3, 0.7, (5, *grid, 3))
    flat = light.reshape(5, 6, 3)
    frames = np.stack([flat[..., c] @ part.T for c, part in enumerate(parts)], axis=-1).reshape(5, *grid, 3)
    fill(tmp_path / "colour", frames)
    T = ltcl.Transport(parts, grid, device=device)
    done = compensate_frames(T, tmp_path / "colour", tmp_path / "a", batch=2, format="exr", rtol=1e-4)
    np.testing.assert_allclose(np.stack(patterns(done)), light, rtol=1e-3)
    tall = random.uniform(0, 1, (20, 6))
    fill(tmp_path / "tall", (light[..., 0].reshape(5, 6) @ tall.T).reshape(5, 4, 5))
    T = ltcl.Transport(tall, grid, camera_grid=(4, 5), device=device)
    done = compensate_frames(T, tmp_path / "tall", tmp_path / "b", batch=2, format="exr", rtol=1e-5)
    np.testing.assert_allclose(np.stack(patterns(done)), light[..., 0], atol=2e-3)


def test_one_frame_of_one_pixel(device, tmp_path):
    fill(tmp_path / "in", [np.full((1, 1), 0.1)])
    done = compensate_frames(
        ltcl.Transport([[0.5]], (1, 1), device=device), tmp_path / "in", tmp_path / "out"
    )
    np.testing.assert_allclose(patterns(done)[0], [[0.2]], atol=1e-4)


def test_black_frames_are_black(T, tmp_path):
    fill(tmp_path / "in", [np.zeros(GRID), seen(LIGHT[:1])[0], np.zeros(GRID)])
    done = compensate_frames(T, tmp_path / "in", tmp_path / "out", gain="auto")
    assert not patterns(done)[0].any()
    assert [record.error for record in done.records][::2] == [0.0, 0.0]
    assert done.gain > 1


def test_one_gain_for_all_frames_from_a_sample_of_all(T, tmp_path):
    scale = np.linspace(1.0, 0.2, 9)
    pictures = scale[:, None, None] * seen(LIGHT[:9])
    fill(tmp_path / "in", pictures)
    done = compensate_frames(
        T, tmp_path / "in", tmp_path / "out", batch=3, gain="auto", format="exr", rtol=1e-4
    )
    sample = ltcl.compensate(T, pictures[[0, 4, 8]], gain="auto", rtol=1e-4)
    assert done.gain == pytest.approx(sample.gain, rel=1e-3)
    for pattern, light, factor in zip(patterns(done)[3:], LIGHT[3:9], scale[3:], strict=True):
        np.testing.assert_allclose(pattern, done.gain * factor * light, rtol=1e-3)
    told = json.loads((tmp_path / "out/frames.json").read_text())
    assert told["gain"] == done.gain
    assert told["settings"]["gain"] == "auto"


def test_a_frame_brighter_than_the_sample_is_clipped_and_told(T, tmp_path):
    pictures = seen(LIGHT[:9])
    pictures[2] *= 5.0
    fill(tmp_path / "in", pictures)
    done = compensate_frames(T, tmp_path / "in", tmp_path / "out", batch=3, gain="auto")
    assert done.most_clipped.number == 3
    assert done.most_clipped.clipped > 0.5
    assert sum(record.clipped > 0.05 for record in done.records) == 1


def test_background_and_weights_serve_all_frames(T, source, tmp_path):
    dark = 0.1 * seen(LIGHT[:1])[0]
    done = compensate_frames(
        T, source, tmp_path / "out", background=dark, weights=np.ones(GRID), format="exr", rtol=1e-4
    )
    np.testing.assert_allclose(np.stack(patterns(done)), LIGHT - 0.1 * LIGHT[0], rtol=2e-3)
    for name in ("background", "weights"):
        options: dict[str, Any] = {name: np.ones((8, *GRID))}
        with pytest.raises(InputError, match=rf"{name} holds 8 frame\(s\); it must be one picture"):
            compensate_frames(T, source, tmp_path / "more", **options)


@pytest.mark.parametrize("suffix", [".mkv", ".avi"])
def test_videos_in_and_out(T, tmp_path, suffix):
    film, out = tmp_path / f"film{suffix}", tmp_path / f"out{suffix}"
    write_video(film, seen(LIGHT), fps=30.0)
    done = compensate_frames(T, film, tmp_path / "patterns", video=out, rtol=1e-4, batch=4)
    shown = open_frames(out)
    assert (shown.count, shown.fps) == (COUNT, pytest.approx(30.0))
    assert [record.name for record in done.records][:2] == [f"film{suffix}:1", f"film{suffix}:2"]
    for frame, pattern in zip(shown, patterns(done), strict=True):
        np.testing.assert_allclose(images.to_srgb(frame.picture()), images.to_srgb(pattern), atol=0.6 / 255)
    for frame, pattern in zip(open_frames(film), patterns(done), strict=True):
        looks = (SCENE.T @ pattern.ravel()).reshape(GRID)
        assert np.linalg.norm(looks - frame.picture()) < 1e-2 * np.linalg.norm(looks)
    again = compensate_frames(
        T, film, tmp_path / "patterns", video=out, rtol=1e-4, batch=4, resume=True, fps=10
    )
    assert again.solved == 0
    assert again.records == done.records
    assert open_frames(out).fps == pytest.approx(10.0)


def test_only_the_first_frames_and_then_the_rest(T, source, tmp_path):
    whole = compensate_frames(T, source, tmp_path / "whole", batch=4)
    done = compensate_frames(T, source, tmp_path / "part", batch=4, frames=6)
    assert len(done.records) == 6
    done = compensate_frames(T, source, tmp_path / "part", batch=4, resume=True)
    assert done.solved == COUNT - 4  # the second batch was not whole
    assert everything(tmp_path / "part") == everything(tmp_path / "whole")
    assert done.records == whole.records


def test_frames_are_scaled_when_asked(T, source, tmp_path):
    fill(tmp_path / "in", [np.full((4, 16), 0.2), np.full((4, 16), 0.3)])
    with pytest.raises(
        InputError, match=r"frame 1 of 2 is 4 x 16 pixels, but the camera has 8 x 8; give res"
    ):
        compensate_frames(T, tmp_path / "in", tmp_path / "out")
    assert not (tmp_path / "out").exists()
    done = compensate_frames(T, tmp_path / "in", tmp_path / "out", resize=True, format="exr")
    exact = ltcl.compensate(T, np.full(GRID, 0.2)).pattern
    np.testing.assert_allclose(patterns(done)[0], exact, rtol=0.02, atol=1e-3)


@pytest.mark.parametrize(
    ("bad", "part"),
    [
        (b"", "frame 11 of 13 cannot be read: f10.exr: the file is empty"),
        (b"no picture", "frame 11 of 13 cannot be read: f10.exr: is no EXR picture"),
        (np.ones((5, 8)), "frame 11 of 13 is 5 x 8 pixels; it must be 8 x 8 as frame 1"),
        (np.full(GRID, np.nan), "frame 11 of 13 cannot be read: f10.exr: the picture has 64 NaN"),
    ],
)
@pytest.mark.parametrize("mended", [True, False])
def test_a_bad_frame_is_one_line_and_those_before_stay(T, source, tmp_path, bad, part, mended):
    folder, out = tmp_path / "in", tmp_path / "out"
    shutil.copytree(source, folder)
    if isinstance(bad, bytes):
        (folder / "f10.exr").write_bytes(bad)
    else:
        write_any(folder / "f10.exr", bad)
    with pytest.raises(InputError) as error:
        compensate_frames(T, folder, out, batch=4)
    assert part in str(error.value)
    assert str(error.value).endswith(
        f"; 8 frame(s) are done and stay in {out}, resume=True goes on from there"
    )
    assert "\n" not in str(error.value)
    assert len(list(out.glob("pattern_*.png"))) == 8
    before = {name: content for name, content in everything(out).items() if name.startswith("pattern")}
    if not mended:
        done = compensate_frames(T, folder, out, batch=4, frames=10, resume=True)
        assert done.solved == 2
        return
    shutil.copy(source / "f10.exr", folder / "f10.exr")
    done = compensate_frames(T, folder, out, batch=4, resume=True)
    assert done.solved == COUNT - 8
    assert before.items() <= everything(out).items()
    compensate_frames(T, source, tmp_path / "whole", batch=4)
    assert everything(out) == everything(tmp_path / "whole")


def write_any(path: Path, picture: np.ndarray) -> None:
    """An EXR of any values; `ltcl.images` writes no NaN."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"Y": picture.astype(np.float32)}).write(str(path))


def test_a_truncated_video_keeps_what_could_be_read(T, tmp_path):
    film, out = tmp_path / "film.mkv", tmp_path / "out"
    write_video(film, seen(LIGHT))
    whole = film.read_bytes()
    film.write_bytes(whole[: len(whole) * 2 // 3])
    found = []
    with pytest.raises(FileError):
        found.extend(open_frames(film))
    readable = len(found)
    assert 4 <= readable < COUNT
    batch = 2
    with pytest.raises(
        FileError, match=f"frame {readable + 1} of 13 cannot be read: .*; .* are done and stay"
    ):
        compensate_frames(T, film, out, batch=batch)
    assert len(list(out.glob("pattern_*.png"))) == readable // batch * batch
    done = compensate_frames(T, film, out, batch=batch, resume=True, frames=readable)
    assert len(done.records) == readable
    film.write_bytes(whole)
    compensate_frames(T, film, out, batch=batch, resume=True)
    compensate_frames(T, film, tmp_path / "whole", batch=batch)
    assert everything(out) == everything(tmp_path / "whole")


def test_an_earlier_run_is_not_begun_anew(T, source, tmp_path):
    compensate_frames(T, source, tmp_path / "out", frames=2)
    before = everything(tmp_path / "out")
    with pytest.raises(InputError, match=r"out: holds 2 frame\(s\) of an earlier run; give resume=True"):
        compensate_frames(T, source, tmp_path / "out")
    assert everything(tmp_path / "out") == before


@pytest.mark.parametrize(
    ("changed", "part"),
    [
        ({"rtol": 1e-3}, "that run had rtol=0.01, this one has 0.001"),
        ({"gain": 0.5}, "that run had gain=1.0, this one has 0.5"),
        ({"bounds": (0.0, 2.0)}, "that run had bounds=[0.0, 1.0], this one has [0.0, 2.0]"),
        ({"batch": 3}, "that run had batch=4, this one has 3"),
        ({"format": "exr"}, "that run had format='png', this one has 'exr'"),
        ({"background": np.full(GRID, 0.1)}, "that run had background=None, this one has '8 x 8, sha256"),
        ({"encoding": "linear"}, "that run had encoding='auto', this one has 'linear'"),
    ],
)
def test_other_settings_are_refused_by_their_name(T, source, tmp_path, changed, part):
    common: dict[str, Any] = {"batch": 4}
    compensate_frames(T, source, tmp_path / "out", frames=8, rtol=0.01, **common)  # which is usual
    before = everything(tmp_path / "out")
    with pytest.raises(InputError) as error:
        compensate_frames(T, source, tmp_path / "out", resume=True, **{**common, **changed})
    assert part in str(error.value)
    assert "\n" not in str(error.value)
    assert everything(tmp_path / "out") == before


def test_another_T_is_refused_and_the_same_one_known_again(T, source, tmp_path, device):
    compensate_frames(T, source, tmp_path / "out", frames=8)
    other = SCENE.T.copy()
    other[5, 7] *= 1.0001
    for T_other in (other, SCENE.T.astype(np.float32), [SCENE.T] * 3):
        with pytest.raises(InputError, match="that run was with another T"):
            compensate_frames(ltcl.Transport(T_other, GRID), source, tmp_path / "out", resume=True)
    ltcl.save(tmp_path / "T.npz", T)
    again = ltcl.load(tmp_path / "T.npz", first_bounce=SCENE.F)  # compensation does not depend on it
    assert compensate_frames(again, source, tmp_path / "out", resume=True).solved == COUNT - 8


def test_operators_without_entries_are_known_by_their_products(source, tmp_path, device):
    from scipy.sparse.linalg import aslinearoperator

    def T(matrix):
        return ltcl.Transport(aslinearoperator(matrix), GRID, first_bounce=SCENE.F, device=device)

    compensate_frames(T(SCENE.T), source, tmp_path / "out", frames=8)
    with pytest.raises(InputError, match="that run was with another T"):
        compensate_frames(T(1.001 * SCENE.T), source, tmp_path / "out", resume=True)
    nearly = SCENE.T * (1.0 + 1e-7)  # as products in another order may be
    assert compensate_frames(T(nearly), source, tmp_path / "out", resume=True).solved == COUNT - 8


def test_what_T_is_off_by_is_told_and_not_compared(T):
    """It depends on the first bounce, and patterns do not."""
    known = identity.of_transport(T)
    assert known["error"] == T.error == 0.0
    assert identity.same_transport(known, {**known, "error": 0.01})
    assert not identity.same_transport(known, {**known, "channels": 3})


def test_other_frames_are_refused_by_the_first(T, source, tmp_path):
    folder = tmp_path / "in"
    shutil.copytree(source, folder)
    compensate_frames(T, folder, tmp_path / "out", batch=4, frames=8)
    (folder / "f3.exr").write_bytes((source / "f4.exr").read_bytes())
    with pytest.raises(
        InputError, match="frame 4 of 13 is not what it was when its pattern was made"
    ) as error:
        compensate_frames(T, folder, tmp_path / "out", batch=4, resume=True)
    assert "goes on from there" not in str(error.value)


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b'{"format": 9}', b'{"format": 1, "frames": [{}]}', LISTED, b"\xff"]
)
def test_a_damaged_list_is_refused(T, source, tmp_path, content):
    (tmp_path / "frames.json").write_bytes(content)
    for resume in (False, True):
        with pytest.raises(
            FileError, match=r"frames\.json: (is no list of frames|the file is empty)"
        ) as error:
            compensate_frames(T, source, tmp_path, resume=resume)
        assert "\n" not in str(error.value)
    assert len(list(tmp_path.iterdir())) == 1


def test_a_lost_pattern_is_made_again(T, source, tmp_path):
    compensate_frames(T, source, tmp_path / "out", batch=4)
    before = everything(tmp_path / "out")
    (tmp_path / "out/pattern_000006.png").unlink()
    assert compensate_frames(T, source, tmp_path / "out", batch=4, resume=True).solved == 4
    assert everything(tmp_path / "out") == before


def test_resuming_nothing_begins(T, source, tmp_path):
    assert compensate_frames(T, source, tmp_path / "out", resume=True).solved == COUNT


@pytest.mark.parametrize(
    ("options", "error", "text"),
    [
        ({"batch": 0}, InputError, "batch is 0"),
        ({"frames": 0}, InputError, "frames is 0"),
        ({"format": "gif"}, InputError, "format is 'gif'; it must be one of png, exr"),
        ({"fps": -1}, InputError, "fps is -1"),
        ({"gain": 0}, InputError, "gain is 0"),
        ({"loss": 0.1}, InputError, "loss is 0.1, but gain is 1.0"),
        ({"bounds": (1, 0)}, InputError, r"bounds is \(1, 0\)"),
        ({"video": "a.gif"}, FileError, r"a\.gif: extension \.gif is unknown"),
        (
            {"exact": np.eye(64)},
            InputTypeError,
            "exact is a ndarray; it must be a ltcl.Transport",
        ),
        ({"nonsense": 1}, InputTypeError, "frames 1 to 8: unknown option 'nonsense'"),
        ({"encoding": "log"}, InputError, "encoding is 'log'"),
        ({"weights": [[1.0], [1.0, 2.0]]}, InputError, "weights is ragged"),
        ({"background": np.ones((3, 3))}, InputError, r"background has shape \(3, 3\)"),
    ],
)
def test_bad_settings_leave_no_folder(T, source, tmp_path, options, error, text):
    with pytest.raises(error, match=text):
        compensate_frames(T, source, tmp_path / "out", **options)
    assert list(tmp_path.iterdir()) == []


def test_other_bad_arguments(T, source, tmp_path, device):
    with pytest.raises(InputTypeError, match="T is a ndarray"):
        compensate_frames(SCENE.T, source, tmp_path / "out")  # pyright: ignore[reportArgumentType]
    odd = ltcl.Transport(np.eye(15), (3, 5), device=device)
    with pytest.raises(InputError, match="frames are 3 x 5 pixels; those of a video must be even"):
        compensate_frames(odd, source, tmp_path / "out", video="a.mkv")
    with pytest.raises(FileError, match="nowhere: no such file"):
        compensate_frames(T, tmp_path / "nowhere", tmp_path / "out")
    with pytest.raises(InputError, match=r"out is .*, where the frames are; it must be another place"):
        compensate_frames(T, source, source)
    film = tmp_path / "film.mkv"
    write_video(film, seen(LIGHT))
    with pytest.raises(InputError, match=r"video is .*film\.mkv, where the frames are"):
        compensate_frames(T, film, tmp_path / "out", video=film)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(FileError):
        compensate_frames(T, source, tmp_path / "file")
    assert (tmp_path / "file").read_text() == "mine"


def test_a_solve_that_fails_tells_the_frames(device, source, tmp_path):
    far = lambertian(64, 3.0, seed=72)
    T = ltcl.Transport(far.T, GRID, device=device)
    with pytest.raises(ConvergenceError, match="frames 1 to 8: jacobi: diverged") as error:
        compensate_frames(T, source, tmp_path / "out", method="jacobi")
    assert not error.value.solution.converged
    assert not (tmp_path / "out").exists()


def test_an_interrupt_at_any_file_costs_its_batch_at_most(T, source, tmp_path, monkeypatch):
    compensate_frames(T, source, tmp_path / "whole", batch=4, gain="auto")
    replace, moved = os.replace, []

    def interrupted(*paths, **options):
        moved.append(paths)
        if len(moved) % 6 == 5:
            raise KeyboardInterrupt
        replace(*paths, **options)

    monkeypatch.setattr(files.os, "replace", interrupted)
    ends = 0
    for _ in range(50):
        listed = tmp_path / "out/frames.json"
        before = len(json.loads(listed.read_text())["frames"]) if listed.exists() else 0
        try:
            compensate_frames(T, source, tmp_path / "out", batch=4, gain="auto", resume=True)
            break
        except KeyboardInterrupt:
            ends += 1
            after = len(json.loads(listed.read_text())["frames"]) if listed.exists() else 0
            assert after >= before
            assert after in (0, 4, 8, 12, 13)
    assert ends >= 2
    assert everything(tmp_path / "out") == everything(tmp_path / "whole")


RUN = """
import sys
import numpy as np
import ltcl

_, matrix, source, out = sys.argv
T = ltcl.Transport(np.load(matrix), (8, 8))
say = lambda done, total: print(done, flush=True)
ltcl.batch.compensate_frames(T, source, out, batch=2, gain="auto", resume=True, appearance=True, progress=say)
"""


def test_a_killed_run_goes_on_to_the_same_bytes(T, tmp_path):
    source, matrix = tmp_path / "in", tmp_path / "T.npy"
    np.save(matrix, SCENE.T)
    fill(source, seen(random.uniform(0.2, 0.9, (60, *GRID))))
    common: dict[str, Any] = {"batch": 2, "gain": "auto", "appearance": True}
    compensate_frames(T, source, tmp_path / "whole", **common)
    wanted = everything(tmp_path / "whole")
    ended = 0
    for trial in range(10):
        out = tmp_path / f"out{trial}"
        command = [sys.executable, "-c", RUN, *map(str, (matrix, source, out))]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
            assert child.stdout is not None
            for _ in range(random.integers(1, 20)):
                child.stdout.readline()
            time.sleep(random.uniform(0, 0.02))
            child.kill()
        listed = out / "frames.json"
        done = len(json.loads(listed.read_text())["frames"]) if listed.exists() else 0
        made = len(list(out.glob("pattern_*.png")))
        assert done <= made <= done + 2
        ended += done < 60
        assert compensate_frames(T, source, out, resume=True, **common).solved == 60 - done
        assert everything(out) == wanted
    assert ended > 0
