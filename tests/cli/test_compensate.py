# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl compensate`, `separate` and `relight`: what they make of pictures and of films."""

from __future__ import annotations

import json
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import ltcl
from ltcl import images
from ltcl.batch import frames
from ltcl.files import locked
from ltcl.images.frames import open_frames, write_video

from .conftest import write

WEIGHTS = np.where(np.arange(50).reshape(5, 10) == 23, 0.0, 1.0)
SAMPLING = {"method": "monte_carlo", "samples": 300, "seed": 2**64 - 1}
EXACT, INVERSE = {"exact": "transport", "rtol": 1e-5}, {"inverse": "inverse"}
CALLS: list[
    tuple[str, dict[str, Any], str]
] = [  # options, the same of the library, and what is printed
    ("compensate {transport}", {}, ""),
    ("compensate {transport} --gain auto --loss 0.05", {"gain": "auto", "loss": 0.05}, ""),
    ("compensate {transport} --weights {weights} --gain 4", {"weights": WEIGHTS, "gain": 4}, ""),
    ("compensate {transport} --background {weights}", {"background": WEIGHTS}, ""),
    (
        "compensate {transport} --low 0.2 --high 0.4 --clamp",
        {"bounds": (0.2, 0.4), "clamp": True},
        "",
    ),
    (
        f"compensate {{transport}} --method monte_carlo --samples 300 --seed {2**64 - 1}",
        SAMPLING,
        "",
    ),
    ("compensate {transport} --inverse {inverse}", INVERSE, ""),
    ("compensate {compressed}", {}, "compressed transport"),
    ("compensate {compressed} --exact {transport} --rtol 1e-5", EXACT, "corner.npz"),
    ("separate {transport} --bounces 2", {"bounces": 2}, ""),
    ("separate {transport} --inverse {inverse}", INVERSE, "by the inverse is at most 0."),
    ("separate {compressed}", {}, "compressed transport"),
    ("separate {compressed} --exact {transport} --rtol 1e-5", EXACT, "corner.npz"),
    ("relight {transport}", {}, ""),
    ("relight {compressed}", {}, "compressed transport"),
]


def written_by(command: str, result: Any) -> dict[str, np.ndarray]:
    """The .exr files of a command, by their names, from what the library gives."""
    if command == "relight":
        return {"sky_relit": result}
    if command == "compensate":
        return {
            f"sky_{name}": getattr(result, name)
            for name in ("pattern", "appearance", "out_of_reach")
        }
    parts = {name: getattr(result, name) for name in ("direct", "indirect", "rest")}
    return parts | {f"bounce_{k}": bounce for k, bounce in enumerate(result.bounces, 1)}


def deviations_of(command: str, std: Any) -> dict[str, np.ndarray]:
    """What is in files of standard deviations, by their names."""
    if command == "compensate":
        return {"sky_pattern": std.pattern, "sky_appearance": std.appearance}
    return {"direct": std.direct} | {
        f"bounce_{k}": bounce for k, bounce in enumerate(std.bounces, 1)
    }


@pytest.mark.parametrize(("line", "arguments", "printed"), CALLS)
def test_a_command_does_what_the_library_does(
    program, transport, compressed, inverse, picture, tmp_path, line, arguments, printed
):
    files = {"transport": transport, "compressed": compressed, "inverse": inverse}
    files["weights"], out = write(tmp_path / "weights.exr", WEIGHTS), tmp_path / "out"
    command, path, *options = line.format(**files).split()
    outcome = program(command, path, picture, *options, "--out", out)
    assert (outcome.code, printed in outcome.out) == (0, True)
    report, T = json.loads((out / f"{command}.json").read_text()), ltcl.load(path)
    read = {"exact": lambda: ltcl.load(transport), "inverse": lambda: ltcl.load_inverse(inverse)}
    arguments = arguments | {name: read[name]() for name in arguments if name in read}
    result = getattr(ltcl, command)(T, images.read(picture), **arguments)
    for name, light in written_by(command, result).items():
        np.testing.assert_allclose(images.read(out / f"{name}.exr"), light, rtol=1e-6, atol=1e-7)
    if path == str(transport) and command != "relight":
        for name, deviation in deviations_of(command, result.std).items():
            seen = images.read(out / f"{name}_std.exr")
            np.testing.assert_allclose(seen, deviation, rtol=1e-3, atol=1e-3 * deviation.max())
    for name in ("gain", "error", "clipped", "gap", "transport_error"):
        if hasattr(result, name):
            assert report["pictures"][0][name] == pytest.approx(
                getattr(result, name), rel=1e-5, abs=1e-7
            )
    if command != "relight":
        default = max(T.error, 1e-2 if command == "compensate" else 1e-3)
        assert report["options"]["rtol"] == arguments.get("rtol", default)
    assert (report["transport"]["compressed"], report["transport"]["error"]) == (
        T.is_compressed,
        T.error,
    )
    if command == "compensate":  # pixel for pixel, white at the upper bound
        white, codes = (
            arguments.get("bounds", (0, 1))[1],
            images.read_codes(out / "sky_pattern.png"),
        )
        np.testing.assert_allclose(
            codes / 255, images.to_srgb(result.pattern / white), atol=0.6 / 255
        )


def test_reports_have_every_option_as_it_was_resolved(results):
    shared = {"on_dark": "mask", "encoding": "linear", "grid": [5, 10], "resize": True}
    solving = shared | {"first_bounce": "exact", "rtol": 1e-4, "method": "chebyshev"}
    asked = {
        "compensate": solving | {"low": 0, "high": 1, "gain": 1},
        "separate": solving,
        "relight": shared,
    }
    for command, options in asked.items():
        report = results[1][command]
        assert options.items() <= report["options"].items()
        assert report["versions"]["ltcl"] == ltcl.__version__
        entries = [part for entry in report["pictures"] for part in entry.get("parts", [entry])]
        methods = {solve["method"] for entry in entries for solve in entry.get("channels", [])}
        assert methods <= {"chebyshev"}
    shares = [part["share"] for part in results[1]["separate"]["pictures"][0]["parts"]]
    assert sum(shares[:2]) == pytest.approx(1, abs=1e-5)


COUNT = 10


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten 16-bit PNG of 5 x 10, within reach of `transport`."""
    folder, light = (
        tmp_path_factory.mktemp("film"),
        np.random.default_rng(5).uniform(0.33, 0.4, (COUNT, 5, 10)),
    )
    for number, picture in enumerate(light, 1):
        images.write(folder / f"f{number}.png", picture, bits=16)
    return folder


def test_a_second_run_in_a_folder_is_refused_at_once(program, transport, picture, film, tmp_path):
    for command, source in (("compensate", picture), ("film", film)):
        arguments = [command, transport, source, "--out", tmp_path / "out"]
        with locked(tmp_path / "out"):  # as the first one does
            program(*arguments).refused("out: another run")
        assert not (tmp_path / "out").exists()
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
    out, report = results
    for text in report.values():
        for entry in text["pictures"]:
            for part in entry.get("parts", [entry.get("appearance", entry)]):
                light = images.read(out / part["exr"]) * text["exposure"] / entry.get("gain", 1.0)
                exact, seen = images.to_srgb(np.clip(light, 0, 1)), content(out / part["png"])
                exact = np.broadcast_to(exact.reshape(5, 10, -1), seen.shape)
                np.testing.assert_allclose(seen, exact, atol=1.1 / 255)
    assert shown(out / "separate.png").shape[1] > 3 * 512
    assert shown(out / "compensate.png").shape[1] > 4 * 512


@pytest.mark.parametrize(
    ("value", "low", "colour", "advice"),
    [(5.0, 0, [1.0, 0.55, 0.0], "too_dark"), (0.0, 0.5, [0.1, 0.45, 1.0], "too_bright")],
)
def test_what_is_out_of_reach_is_named_and_seen(
    program, transport, tmp_path, value, low, colour, advice
):
    """Orange where it stays too dark, blue where too bright, and the picture in grey elsewhere."""
    desired = np.full((5, 10), 0.6)
    desired[2, 3] = value
    spot, out = write(tmp_path / "spot.exr", desired), tmp_path / "out"
    arguments = ["compensate", transport, spot, "--low", low, "--out", out]
    (entry,) = program(*arguments, "--json").json["pictures"]
    assert f"spot.exr: {100 * entry[advice]:.0f} % " in program(*arguments).err
    assert program(*arguments, "--quiet").err == ""
    missing = images.read(out / entry["out_of_reach"]["exr"])
    seen = content(out / entry["out_of_reach"]["png"])
    np.testing.assert_allclose(seen[2, 3], colour, atol=0.15)
    assert np.ptp(seen[missing == 0], axis=-1).max(initial=0) == 0
    assert seen.min(axis=(0, 1)).max() > 0.05
    assert (entry["too_dark"], entry["too_bright"]) == (np.mean(missing > 0), np.mean(missing < 0))


def test_commands_share_a_folder_and_list_their_files(results):
    out, report = results
    listed = [file for text in report.values() for file in text["files"]]
    assert {*listed, "mine.txt"} == files_in(out)
    for command, text in report.items():
        assert {"folder": str(out), **json.loads((out / f"{command}.json").read_text())} == text
        assert text["files"][-1] == f"{command}.json"


def test_many_transports_get_a_folder_each(program, transport, picture, tmp_path):
    pattern = str(transport.with_name("corne[r].npz"))
    report = program(
        "compensate", "--transports", pattern, picture, "--out", tmp_path, "--json"
    ).json
    (scene,) = report["scenes"]
    assert scene["folder"] == str(tmp_path / "corner")
    assert {*scene["files"]} == files_in(tmp_path / "corner")


def test_a_failed_run_changes_nothing(program, transport, picture, tmp_path):
    assert program("compensate", transport, picture, "--out", tmp_path).code == 0
    before = {name: (tmp_path / name).read_bytes() for name in files_in(tmp_path)}
    black = write(tmp_path.with_name("black.exr"), np.zeros((5, 10)))
    arguments = [transport, picture, "--weights", black, "--gain", "auto", "--out", tmp_path]
    program("compensate", *arguments).refused("weights", "0 to 0", "sky.exr")
    assert {name: (tmp_path / name).read_bytes() for name in files_in(tmp_path)} == before


def test_patterns_of_a_folder_are_listed_and_kept_after_ctrl_c(
    program, transport, film, tmp_path, monkeypatch
):
    solve, solves = frames.compensate, iter(range(2))

    def end_at_the_third(*arguments: Any, **options: Any) -> Any:
        if next(solves, None) is None:
            signal.raise_signal(signal.SIGINT)
        return solve(*arguments, **options)

    common, listed = (
        ["film", transport, film, "--out", tmp_path, "--batch", "3"],
        tmp_path / "frames.json",
    )
    with monkeypatch.context() as patch:
        patch.setattr(frames, "compensate", end_at_the_third)
        program(*common).refused("6 frame(s)", str(tmp_path), "--resume", code=130)
    assert (
        len(json.loads(listed.read_text())["frames"]) == len([*tmp_path.glob("pattern_*.png")]) == 6
    )
    program(*common).refused(f"{tmp_path}: ", "6 frame(s)", "resume=True")
    program(*common, "--resume", "--rtol", "1e-3").refused("rtol=0.01", "0.001")
    report = program(*common, "--resume", "--json").json
    assert (report["source"], report["solved"], report["options"]["rtol"]) == (
        str(film),
        COUNT - 6,
        1e-2,
    )
    assert [frame["name"] for frame in report["frames"]] == [
        f"f{number}.png" for number in range(1, COUNT + 1)
    ]
    assert report["worst"]["error"] == max(frame["error"] for frame in report["frames"])
    assert json.loads(listed.read_text())["frames"] == report["frames"]
    assert program(*common, "--resume").out.splitlines()[1].split()[:3] == [str(COUNT), "0", "-"]
    advice = program("film", transport, film, "--out", tmp_path / "b", "--gain", "2").err
    assert all(part in advice for part in (f"{COUNT} frame(s)", "--gain"))


def test_a_video_comes_back_as_one(program, colour_transport, tmp_path):
    film, out, video = tmp_path / "film.avi", tmp_path / "out", tmp_path / "made.mkv"
    write_video(film, np.random.default_rng(6).uniform(0.05, 0.08, (3, 4, 12)), fps=12.0)
    common = ["film", colour_transport, film, "--out", out, "--batch", "2", "--video", video]
    outcome = program(*common, "--high", "9", "--gain", "auto", "--appearance", "--format", "exr")
    assert str(video) in outcome.out
    source = open_frames(video)
    assert (source.count, source.fps) == (3, pytest.approx(12.0))
    for frame in source:
        codes = images.to_srgb(images.read(out / f"pattern_{frame.number:06}.exr") / 9.0)
        np.testing.assert_allclose(images.to_srgb(frame.picture()), codes, atol=0.6 / 255)
        assert images.read(out / f"appearance/appearance_{frame.number:06}.exr").shape == (4, 12, 3)
