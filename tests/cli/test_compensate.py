# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import ltcl
from ltcl import images, scenes, store
from ltcl.cli import compensate_pictures
from ltcl.operators import IdentityPlus, ScaledColumns

from .conftest import Program


def test_pattern_pushed_through_the_transport_is_the_picture(
    program: Program, transport: Path, picture: Path, tmp_path: Path
) -> None:
    outcome = program("compensate", transport, picture, "--out", tmp_path / "out", "--rtol", "1e-4", "--json")
    assert outcome.code == 0, outcome.err
    (entry,) = outcome.json["pictures"]
    assert entry["clipped"] == 0
    pattern = images.read(tmp_path / "out" / entry["pattern"]["exr"])
    desired = images.read(picture)
    difference = np.linalg.norm(ltcl.load(transport) @ pattern - desired)
    assert difference < 2e-4 * np.linalg.norm(desired)
    shown = images.read(tmp_path / "out" / entry["pattern"]["png"])
    assert (
        np.abs(shown - np.stack([pattern] * 3, axis=-1) if shown.ndim == 3 else shown - pattern).max() < 0.01
    )


def test_report_tells_what_happened(
    program: Program, transport: Path, picture: Path, large_picture: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    arguments = [
        "--resize",
        "--out",
        out,
        "--method",
        "chebyshev",
        "--gain",
        "0.5",
        "--first-bounce",
        "exact",
    ]
    assert program("compensate", transport, picture, large_picture, *arguments).code == 0
    report = json.loads((out / "compensate.json").read_text())
    assert report["versions"]["ltcl"] == ltcl.__version__
    assert report["options"]["gain"] == 0.5
    assert [entry["file"] for entry in report["pictures"]] == [str(picture), str(large_picture)]
    for entry in report["pictures"]:
        assert {channel["method"] for channel in entry["channels"]} == {"chebyshev"}
        assert all(channel["products"] >= len(channel["residuals"]) - 1 for channel in entry["channels"])
        assert all(
            (out / entry[part][kind]).is_file()
            for part in ("pattern", "appearance")
            for kind in ("exr", "png")
        )


def test_colour(program: Program, colour_transport: Path, large_picture: Path, tmp_path: Path) -> None:
    outcome = program(
        "compensate",
        colour_transport,
        large_picture,
        "--out",
        tmp_path / "out",
        "--resize",
        "--high",
        "9",
        "--json",
    )
    (entry,) = outcome.json["pictures"]
    assert len(entry["channels"]) == 3
    assert images.read(tmp_path / "out" / entry["pattern"]["exr"]).shape == (4, 12, 3)
    assert entry["pattern"]["png_scale"] == 9


def test_background_is_taken_off(program: Program, transport: Path, picture: Path, tmp_path: Path) -> None:
    lamp = tmp_path / "lamp.exr"
    images.write(lamp, np.full((5, 10), 0.05, np.float32))
    out = tmp_path / "out"
    arguments = ["--background", lamp, "--rtol", "1e-4", "--out", out]
    assert program("compensate", transport, picture, *arguments).code == 0
    pattern = images.read(out / "sky_pattern.exr")
    seen = ltcl.load(transport) @ pattern + 0.05
    np.testing.assert_allclose(seen, images.read(picture), rtol=2e-3)


def test_pictures_of_one_name_do_not_collide(
    program: Program, transport: Path, picture: Path, tmp_path: Path
) -> None:
    copy = tmp_path / picture.name
    copy.write_bytes(picture.read_bytes())
    out = tmp_path / "out"
    assert program("compensate", transport, picture, copy, "--out", out).code == 0
    assert {"sky_exr_pattern.exr", "sky_exr_2_pattern.exr"} <= {path.name for path in out.iterdir()}


def test_clipping_comes_with_advice(program: Program, transport: Path, tmp_path: Path) -> None:
    bright = tmp_path / "bright.exr"
    images.write(bright, np.full((5, 10), 2.0, np.float32))
    outcome = program("compensate", transport, bright, "--out", tmp_path / "out")
    assert outcome.code == 0
    advised = outcome.err.rpartition("--gain ")[2].strip()
    assert float(advised) < 1
    outcome = program("compensate", transport, bright, "--out", tmp_path / "out", "--gain", advised, "--json")
    assert outcome.json["pictures"][0]["asks_above"] == 0
    assert outcome.json["pictures"][0]["too_dark"] == 0
    assert outcome.json["pictures"][0]["brightest"] > 0.9


@pytest.mark.parametrize(
    ("value", "shown"), [(0.6666, "0.66"), (0.999, "0.99"), (12.9, "12"), (0.5, "0.5"), (0.00129, "0.0012")]
)
def test_gains_are_rounded_down(value: float, shown: str) -> None:
    assert compensate_pictures._rounded_down(value) == shown


def test_a_background_brighter_than_the_picture_is_named(
    program: Program, transport: Path, picture: Path, tmp_path: Path
) -> None:
    out = ["--out", tmp_path / "out"]
    outcome = program("compensate", transport, picture, "--background", picture, *out)
    assert "100 % of it is no brighter than the background" in outcome.err
    assert "bounces" not in outcome.err
    dark = np.full((5, 10), 0.01, np.float32)
    dark[:, :5] = 0.5
    images.write(tmp_path / "dark.exr", dark)
    outcome = program("compensate", transport, tmp_path / "dark.exr", *out)
    assert "darker than the light that bounces there" in outcome.err


def test_divergence_is_one_line_and_touches_nothing(
    program: Program, large_picture: Path, tmp_path: Path
) -> None:
    closed = tmp_path / "closed.npz"
    store.save(closed, scenes.box(3, albedo=0.8).transport())
    out = tmp_path / "out"
    out.mkdir()
    (out / "compensate.json").write_text("old")
    outcome = program("compensate", closed, large_picture, "--resize", "--out", out, "--method", "jacobi")
    outcome.refused("jacobi: diverged", "--method chebyshev")
    assert (out / "compensate.json").read_text() == "old"
    assert len(list(out.iterdir())) == 1


def test_earlier_results_give_way_to_new_ones(
    program: Program, transport: Path, picture: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "compensate.json").write_text("old")
    (out / "mine.txt").write_text("mine")
    assert program("compensate", transport, picture, "--out", out).code == 0
    assert json.loads((out / "compensate.json").read_text())["command"] == "compensate"
    assert (out / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["{transport}", "{large}"], ["20 x 30", "5 x 10", "--resize"]),
        (["{transport}", "nowhere.png"], ["nowhere.png: no such file"]),
        (["{transport}", "{transport}"], ["extension .npz is unknown"]),
        (["{transport}", "nofolder"], ["nofolder: no such file or folder"]),
        (["{transport}", "{picture}", "sky.xyz"], ["sky.xyz: no such file or folder"]),
        (["nowhere.npz", "{picture}"], ["nowhere.npz: no such file"]),
        (["{transport}", "{picture}", "--device", "nonsense"], ["device is 'nonsense'"]),
        (["{transport}", "{picture}", "--grid", "7x7"], ["h * w must be 50"]),
        (["{transport}", "{picture}", "--gain", "0"], ["--gain is 0.0", "above 0"]),
        (
            ["{transport}", "{picture}", "--loss", "0.1"],
            ["--loss is 0.1, but --gain is 1; --loss is for --gain auto only"],
        ),
        (["{transport}", "{picture}", "--gain", "auto", "--loss", "2"], ["--loss is 2.0", "below 1"]),
        (["{transport}", "{picture}", "--gain", "auto", "--loss", "0"], ["--loss is 0.0", "at least 1e-06"]),
        (["{transport}", "{picture}", "--gain", "-1"], ["--gain is -1.0", "above 0"]),
        (["{transport}", "{picture}", "--weights", "{large}"], ["20 x 30", "--resize"]),
        (["{transport}", "{picture}", "--low", "1", "--high", "0"], ["(--low, --high) is (1.0, 0.0)"]),
        (["{transport}", "{picture}", "--rtol", "nan"], ["rtol is nan"]),
        (["{transport}", "{picture}", "--rtol", "0"], ["--rtol is 0; it must be above 0"]),
        (["{transport}", "{picture}", "--background", "{large}"], ["20 x 30", "--resize"]),
    ],
)
def test_refusals_leave_no_folder(
    program: Program,
    transport: Path,
    picture: Path,
    large_picture: Path,
    tmp_path: Path,
    arguments: list[str],
    parts: list[str],
) -> None:
    names = {"transport": transport, "picture": picture, "large": large_picture}
    filled = [argument.format(**names) for argument in arguments]
    program("compensate", *filled, "--out", tmp_path / "out").refused(*parts)
    assert list(tmp_path.iterdir()) == []


def test_rectangular_transport(program: Program, tmp_path: Path) -> None:
    T = np.random.default_rng(3).uniform(0, 1, (24, 10))
    np.save(tmp_path / "T.npy", T)
    desired = (T @ np.linspace(0.2, 0.8, 10)).reshape(4, 6)
    images.write(tmp_path / "p.exr", desired.astype(np.float32))
    arguments = [
        tmp_path / "T.npy",
        tmp_path / "p.exr",
        "--out",
        tmp_path / "out",
        "--rtol",
        "1e-4",
        "--json",
    ]
    program("compensate", *arguments).refused("does not tell how the 10 projector pixels lie")
    outcome = program("compensate", *arguments, "--grid", "2x5", "--camera-grid", "4x6")
    (entry,) = outcome.json["pictures"]
    pattern = images.read(tmp_path / "out" / entry["pattern"]["exr"])
    np.testing.assert_allclose(pattern.ravel(), np.linspace(0.2, 0.8, 10), atol=2e-3)
    assert entry["limited"] == entry["channels"]
    assert program("compensate", *arguments[:-1], "--grid", "2x5", "--camera-grid", "4x6").code == 0


def test_the_largest_gain(program: Program, transport: Path, picture: Path, tmp_path: Path) -> None:
    common = ["compensate", transport, picture, "--out", tmp_path / "out", "--gain", "auto", "--json"]
    (exact,) = program(*common).json["pictures"]
    assert exact["clipped"] == 0
    assert exact["limited"] == []
    assert images.read(tmp_path / "out" / "sky_pattern.exr").max() == pytest.approx(1.0, rel=1e-4)
    outcome = program(*common, "--loss", "0.05")
    (more,) = outcome.json["pictures"]
    assert outcome.json["options"]["gain"] == "auto"
    assert outcome.json["options"]["loss"] == 0.05
    assert more["gain"] > exact["gain"]
    assert more["error"] == pytest.approx(0.05, rel=0.05)
    assert more["clipped"] > 0
    assert program(*common[:-1]).out.split("\n")[1].split()[3] == f"{exact['gain']:.4g}"


def test_what_is_out_of_reach_is_drawn(
    program: Program, transport: Path, picture: Path, tmp_path: Path
) -> None:
    desired = np.full((5, 10), 0.3, np.float32)
    desired[2, 3] = 5.0
    images.write(tmp_path / "spot.exr", desired)
    weights = np.ones((5, 10), np.float32)
    arguments = ["compensate", transport, tmp_path / "spot.exr", "--out", tmp_path / "out", "--json"]
    (entry,) = program(*arguments).json["pictures"]
    missing = images.read(tmp_path / "out" / "spot_out_of_reach.exr")
    assert missing[2, 3] > 1.0
    shown = images.to_srgb(images.read(tmp_path / "out" / entry["out_of_reach"]["png"]))
    np.testing.assert_allclose(shown[2, 3], [1.0, 0.5, 0.0], atol=0.01)  # orange: too dark
    np.testing.assert_allclose(shown[0, 0], 0.5, atol=0.01)
    assert entry["too_dark"] == np.mean(missing > 0) > 0
    assert entry["too_bright"] == np.mean(missing < 0)
    assert entry["clipped"] > 0
    assert 0 < entry["gap"] <= 0.01
    weights[2, 3] = 0.0
    images.write(tmp_path / "weights.exr", weights)
    (told,) = program(*arguments, "--weights", tmp_path / "weights.exr").json["pictures"]
    assert told["error"] < 0.5 * entry["error"]


def test_too_bright_is_drawn_blue(program: Program, transport: Path, tmp_path: Path) -> None:
    desired = np.full((5, 10), 1.0, np.float32)
    desired[2, 3] = 0.0
    images.write(tmp_path / "hole.exr", desired)
    arguments = ["compensate", transport, tmp_path / "hole.exr", "--out", tmp_path / "out", "--high", "9"]
    (entry,) = program(*arguments, "--low", "0.5", "--json").json["pictures"]
    shown = images.to_srgb(images.read(tmp_path / "out" / entry["out_of_reach"]["png"]))[2, 3]
    assert shown[2] > 0.6 > 0.4 > shown[0]
    assert entry["too_bright"] > 0
    assert "orange stays too dark, blue too bright" in program(*arguments, "--low", "0.5").out


def test_nothing_out_of_reach_is_grey_all_over(
    program: Program, transport: Path, picture: Path, tmp_path: Path
) -> None:
    arguments = ["compensate", transport, picture, "--gain", "auto", "--out", tmp_path / "out", "--json"]
    (entry,) = program(*arguments).json["pictures"]
    assert entry["clipped"] == entry["too_dark"] == entry["too_bright"] == 0
    assert not images.read(tmp_path / "out" / entry["out_of_reach"]["exr"]).any()
    assert np.ptp(images.read(tmp_path / "out" / entry["out_of_reach"]["png"])) == 0


def test_refusals_name_the_file(program: Program, transport: Path, picture: Path, tmp_path: Path) -> None:
    black, colour = tmp_path / "black.exr", tmp_path / "colour.exr"
    images.write(black, np.zeros((5, 10), np.float32))
    images.write(colour, np.ones((5, 10, 3), np.float32) * [1, 0.5, 0.2])
    out = ["--out", tmp_path / "out"]
    black_picture = program("compensate", transport, black, "--gain", "auto", *out)
    black_picture.refused(f"{black}: --gain is auto, but desired is 0 everywhere")
    none_counts = program("compensate", transport, picture, "--weights", black, *out)
    none_counts.refused(f"{black}: weights range from 0 to 0")
    for option in ("--weights", "--background"):
        refused = program("compensate", transport, picture, option, colour, *out)
        refused.refused(f"{colour}: {option[2:]} has 1 frame(s) of 3 colour(s)")


def test_out_that_is_a_file_is_refused(
    program: Program, transport: Path, picture: Path, tmp_path: Path
) -> None:
    taken = tmp_path / "taken"
    taken.write_text("mine")
    program("compensate", transport, picture, "--out", taken).refused("is a file")
    assert taken.read_text() == "mine"


def test_a_compressed_transport_keeps_to_what_it_is_worth(
    program: Program, compressed_transport: Path, tmp_path: Path
) -> None:
    picture = tmp_path / "grey.exr"
    images.write(picture, np.full((5, 10), 0.4, np.float32))
    arguments = ("compensate", compressed_transport, picture, "--out", tmp_path / "out")
    assert program(*arguments, "--rtol", "0.0041").code == 0
    worse, few = tmp_path / "worse.npz", ltcl.load(compressed_transport)
    S = IdentityPlus(few.systems[0].R, solution_error=0.03)
    F = few.first_bounce
    ltcl.save(worse, ltcl.Transport(ScaledColumns(S, F), few.grid, first_bounce=F))
    told = program("compensate", worse, picture, "--out", tmp_path / "worse", "--json")
    assert told.code == 0, told.err
    assert told.json["options"]["rtol"] == 0.03  # and not 0.01
    program(*arguments, "--rtol", "1e-5").refused(
        "error: --rtol is 1e-05; ",
        "solutions may be off by 0.0041: ask for no less, or give --exact FILE, the uncompressed one",
    )


def test_reports_tell_that_a_transport_is_compressed(
    program: Program, transport: Path, compressed_transport: Path, tmp_path: Path
) -> None:
    picture = tmp_path / "grey.exr"
    images.write(picture, np.full((5, 10), 0.4, np.float32))
    arguments = ("compensate", compressed_transport, picture, "--out", tmp_path / "out")
    line = "errors are of the compressed transport, which itself is off by up to 0.41 %\n"
    assert line in program(*arguments).out
    told = program(*arguments, "--json").json
    assert (told["transport"]["compressed"], told["transport"]["error"]) == (True, 0.0041)
    assert told["pictures"][0]["transport_error"] == 0.0041
    told = program("compensate", transport, *arguments[2:], "--json").json
    assert (told["transport"]["compressed"], told["transport"]["error"]) == (False, 0.0)
    assert told["pictures"][0]["transport_error"] == 0.0
    assert "which itself" not in program("compensate", transport, *arguments[2:]).out


def test_what_a_transport_was_compressed_from_corrects_it(
    program: Program, transport: Path, compressed_transport: Path, tmp_path: Path
) -> None:
    picture, out = tmp_path / "grey.exr", tmp_path / "out"
    images.write(picture, np.full((5, 10), 0.4, np.float32))
    arguments = ("compensate", compressed_transport, picture, "--exact", transport, "--out", out)
    outcome = program(*arguments, "--rtol", "1e-5")
    assert outcome.code == 0, outcome.err
    assert f"errors are of {transport}, by which solutions were corrected\n" in outcome.out
    seen = ltcl.load(transport) @ images.read(out / "grey_pattern.exr")
    assert np.linalg.norm(seen - 0.4) <= 2e-5 * np.linalg.norm(np.full((5, 10), 0.4))
    told = program(*arguments, "--rtol", "1e-5", "--json").json
    assert told["options"]["exact"] == str(transport)
    assert told["transport"]["error"] == 0.0041
    (entry,) = told["pictures"]
    assert entry["transport_error"] == 0.0
    assert entry["error"] <= 2e-5


def test_what_it_was_not_compressed_from_is_refused(
    program: Program, transport: Path, colour_transport: Path, compressed_transport: Path, tmp_path: Path
) -> None:
    picture, out = tmp_path / "grey.exr", tmp_path / "out"
    images.write(picture, np.full((5, 10), 0.4, np.float32))
    other, untold = tmp_path / "other.npz", tmp_path / "untold.npy"
    T = ltcl.load(transport)
    matrix = T.matrices[0]
    ltcl.save(other, ltcl.Transport(matrix + 0.5 * (matrix - np.diag(np.diag(matrix))), T.grid))
    np.save(untold, matrix)
    common = ("compensate", compressed_transport, picture, "--out", out, "--exact")
    program(*common, other).refused(f"{other}: is not what TRANSPORT was compressed from", "0.0042 at most")
    program(*common, colour_transport).refused("error: --exact has grid (4, 12); it must be that of")
    program(*common, tmp_path / "none.npz").refused("none.npz: no such file")
    program(*common, untold).refused(f"{untold}: does not tell", "give --grid HxW")
    assert program(*common, untold, "--grid", "5x10", "--rtol", "1e-4").code == 0
    program(*common, transport, "--method", "monte_carlo").refused("--exact corrects iterates, but method")
