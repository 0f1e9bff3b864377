# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl compensate`, `separate` and `relight`: results of pictures, files and reports."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import ltcl
from ltcl import images
from ltcl.files import locked

from .conftest import write

GRID = (5, 10)
WEIGHTS = np.where(np.arange(50).reshape(GRID) == 23, 0.0, 1.0)
SEED = 2**64 - 1
SAMPLING = {"method": "monte_carlo", "samples": 300, "seed": SEED}
EXACT = {"exact": "transport", "rtol": 1e-5}
INVERSE = {"inverse": "inverse"}
# Smallest width of a picture for viewing.
PANEL_WIDTH = 512

# A command line, the same options of the library, and what is printed.
CALLS: list[tuple[str, dict[str, Any], str]] = [
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
        f"compensate {{transport}} --method monte_carlo --samples 300 --seed {SEED}",
        SAMPLING,
        "",
    ),
    ("compensate {transport} --inverse {inverse}", INVERSE, ""),
    ("compensate {compressed}", {}, "compressed transport"),
    ("compensate {compressed} --exact {transport} --rtol 1e-5", EXACT, "corner.npz"),
    ("separate {transport} --bounces 2", {"bounces": 2}, ""),
    ("separate {transport} --inverse {inverse}", INVERSE, "by the inverse"),
    ("separate {compressed}", {}, "compressed transport"),
    ("separate {compressed} --exact {transport} --rtol 1e-5", EXACT, "corner.npz"),
    ("relight {transport}", {}, ""),
    ("relight {compressed}", {}, "compressed transport"),
]
DEFAULT_RTOL = {"compensate": 1e-2, "separate": 1e-3}
FACTS = ("gain", "error", "clipped", "gap", "transport_error")


def light_files(command: str, result: Any) -> dict[str, np.ndarray]:
    """Return the content of a command's .exr files by their names, from the library's result."""
    if command == "relight":
        return {"sky_relit": result}
    if command == "compensate":
        return {
            "sky_pattern": result.pattern,
            "sky_appearance": result.appearance,
            "sky_out_of_reach": result.out_of_reach,
        }
    parts = {"direct": result.direct, "indirect": result.indirect, "rest": result.rest}
    for number, bounce in enumerate(result.bounces, 1):
        parts[f"bounce_{number}"] = bounce
    return parts


def std_files(command: str, std: Any) -> dict[str, np.ndarray]:
    """Return the content of the files of standard deviations by their names."""
    if command == "compensate":
        return {"sky_pattern_std": std.pattern, "sky_appearance_std": std.appearance}
    deviations = {"direct_std": std.direct}
    for number, bounce in enumerate(std.bounces, 1):
        deviations[f"bounce_{number}_std"] = bounce
    return deviations


@pytest.mark.slow
@pytest.mark.parametrize(("line", "arguments", "printed"), CALLS)
def test_a_command_does_what_the_library_does(
    program, transport, compressed, inverse, picture, tmp_path, line, arguments, printed
):
    out = tmp_path / "out"
    files = {
        "transport": transport,
        "compressed": compressed,
        "inverse": inverse,
        "weights": write(tmp_path / "weights.exr", WEIGHTS),
    }
    command, path, *options = line.format(**files).split()
    outcome = program(command, path, picture, *options, "--out", out)
    assert outcome.code == 0
    assert printed in outcome.out
    T = ltcl.load(path)
    arguments = dict(arguments)
    if "exact" in arguments:
        arguments["exact"] = ltcl.load(transport)
    if "inverse" in arguments:
        arguments["inverse"] = ltcl.load_inverse(inverse)
    result = getattr(ltcl, command)(T, images.read(picture), **arguments)
    for name, light in light_files(command, result).items():
        np.testing.assert_allclose(images.read(out / f"{name}.exr"), light, rtol=1e-6, atol=1e-7)
    if path == str(transport) and command != "relight":
        for name, std in std_files(command, result.std).items():
            seen = images.read(out / f"{name}.exr")
            np.testing.assert_allclose(seen, std, rtol=1e-3, atol=1e-3 * std.max())
    report = json.loads((out / f"{command}.json").read_text())
    for name in FACTS:
        if hasattr(result, name):
            expected = pytest.approx(getattr(result, name), rel=1e-5, abs=1e-7)
            assert report["pictures"][0][name] == expected
    if command in DEFAULT_RTOL:
        default = max(T.error, DEFAULT_RTOL[command])
        assert report["options"]["rtol"] == arguments.get("rtol", default)
    assert report["transport"]["compressed"] == T.is_compressed
    assert report["transport"]["error"] == T.error
    if command == "compensate":
        # Pixel for pixel, white at the upper bound.
        _, white = arguments.get("bounds", (0, 1))
        codes = images.read_codes(out / "sky_pattern.png")
        expected = images.to_srgb(result.pattern / white)
        np.testing.assert_allclose(codes / 255, expected, atol=0.6 / 255)


@pytest.mark.slow
def test_reports_have_every_option_as_it_was_resolved(results):
    _, reports = results
    shared = {"on_dark": "mask", "encoding": "linear", "grid": [5, 10], "resize": "stretch"}
    solving = {**shared, "first_bounce": "exact", "rtol": 1e-4, "method": "chebyshev"}
    expected = {
        "compensate": {**solving, "low": 0, "high": 1, "gain": 1},
        "separate": solving,
        "relight": shared,
    }
    for command, options in expected.items():
        assert options.items() <= reports[command]["options"].items()
        assert reports[command]["versions"]["ltcl"] == ltcl.__version__
    methods = set()
    for picture in reports["compensate"]["pictures"]:
        methods |= {solve["method"] for solve in picture["channels"]}
    for picture in reports["separate"]["pictures"]:
        for part in picture["parts"]:
            methods |= {solve["method"] for solve in part["channels"]}
    assert methods == {"chebyshev"}
    direct, indirect, *_ = reports["separate"]["pictures"][0]["parts"]
    assert direct["share"] + indirect["share"] == pytest.approx(1, abs=1e-5)


def test_a_second_run_in_a_folder_is_refused_at_once(program, transport, picture, tmp_path):
    arguments = ["compensate", transport, picture, "--out", tmp_path / "out"]
    with locked(tmp_path / "out"):
        program(*arguments).assert_refused("out: another run")
    assert not (tmp_path / "out").exists()
    assert program(*arguments).code == 0


def read_shown(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")) / 255


def read_panel(path: Path) -> np.ndarray:
    """Return the pixels of a labelled picture, (h, w, 3); each must be a square of one colour."""
    picture = read_shown(path)
    height, width = GRID
    side = picture.shape[1] // width
    assert side * width >= PANEL_WIDTH
    label = picture[: -side * height]
    assert np.ptp(label) > 0.5
    squares = picture[-side * height :].reshape(height, side, width, side, 3)
    assert np.ptp(squares, axis=(1, 3)).max() == 0
    return squares[:, 0, :, 0]


def files_in(out: Path) -> set[str]:
    return {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}


def shown_parts(report: dict[str, Any]) -> list[tuple[dict[str, Any], float]]:
    """Return all pictures of a report for viewing, and their gains."""
    parts = []
    for picture in report["pictures"]:
        if "appearance" in picture:
            parts.append((picture["appearance"], picture["gain"]))
        elif "parts" in picture:
            parts += [(part, 1.0) for part in picture["parts"]]
        else:
            parts.append((picture, 1.0))
    return parts


def test_a_picture_for_viewing_is_the_linear_one_at_the_exposure_of_the_run(results):
    out, reports = results
    for report in reports.values():
        for part, gain in shown_parts(report):
            light = images.read(out / part["exr"]) * report["exposure"] / gain
            expected = images.to_srgb(np.clip(light, 0, 1)).reshape(*GRID, -1)
            seen = read_panel(out / part["png"])
            expected = np.broadcast_to(expected, seen.shape)
            np.testing.assert_allclose(seen, expected, atol=1.1 / 255)


@pytest.mark.slow
def test_contact_sheets_have_all_panels(results):
    out, _ = results
    assert read_shown(out / "separate.png").shape[1] > 3 * PANEL_WIDTH
    assert read_shown(out / "compensate.png").shape[1] > 4 * PANEL_WIDTH


@pytest.mark.parametrize(
    ("value", "low", "colour", "share"),
    [(5.0, 0, [1.0, 0.55, 0.0], "too_dark"), (0.0, 0.5, [0.1, 0.45, 1.0], "too_bright")],
)
def test_pixels_out_of_reach_are_named_and_seen(
    program, transport, tmp_path, value, low, colour, share
):
    """Orange where it stays too dark, blue where too bright, and the picture in grey elsewhere."""
    desired = np.full(GRID, 0.6)
    desired[2, 3] = value
    spot = write(tmp_path / "spot.exr", desired)
    out = tmp_path / "out"
    arguments = ["compensate", transport, spot, "--low", low, "--out", out]
    (entry,) = program(*arguments, "--json").json["pictures"]
    assert f"spot.exr: {100 * entry[share]:.0f} % " in program(*arguments).err
    assert program(*arguments, "--quiet").err == ""
    missing = images.read(out / entry["out_of_reach"]["exr"])
    assert entry["too_dark"] == np.mean(missing > 0)
    assert entry["too_bright"] == np.mean(missing < 0)
    seen = read_panel(out / entry["out_of_reach"]["png"])
    np.testing.assert_allclose(seen[2, 3], colour, atol=0.15)
    assert np.ptp(seen[missing == 0], axis=-1).max(initial=0) == 0
    assert seen.min(axis=(0, 1)).max() > 0.05


def test_commands_share_a_folder_and_list_their_files(results):
    out, reports = results
    listed = {"mine.txt"}
    for command, report in reports.items():
        written = json.loads((out / f"{command}.json").read_text())
        assert {"folder": str(out), **written} == report
        assert report["files"][-1] == f"{command}.json"
        listed |= {*report["files"]}
    assert listed == files_in(out)


def test_many_transports_get_a_folder_each(program, transport, picture, tmp_path):
    pattern = str(transport.with_name("corne[r].npz"))
    arguments = ["--transports", pattern, picture, "--out", tmp_path]
    (scene,) = program("compensate", *arguments, "--json").json["scenes"]
    assert scene["folder"] == str(tmp_path / "corner")
    assert {*scene["files"]} == files_in(tmp_path / "corner")


def test_a_failed_run_changes_nothing(program, transport, picture, tmp_path):
    assert program("compensate", transport, picture, "--out", tmp_path).code == 0
    before = {name: (tmp_path / name).read_bytes() for name in files_in(tmp_path)}
    black = write(tmp_path.with_name("black.exr"), np.zeros(GRID))
    arguments = [transport, picture, "--weights", black, "--gain", "auto", "--out", tmp_path]
    program("compensate", *arguments).assert_refused("weights", "0 to 0", "sky.exr")
    assert {name: (tmp_path / name).read_bytes() for name in files_in(tmp_path)} == before


@pytest.mark.parametrize("gain", ["5", "auto"])
def test_advice_is_not_what_was_asked_for(program, transport, picture, tmp_path, gain):
    options = ["--gain", gain, "--out", tmp_path / "out"]
    if gain == "auto":
        options += ["--loss", "0.6"]
    outcome = program("compensate", transport, picture, *options)
    assert "stays too dark" in outcome.err
    assert ("--gain auto" in outcome.err) == (gain != "auto")
