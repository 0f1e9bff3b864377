# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ltcl
from ltcl import checks, images

from .conftest import Program


@pytest.fixture(scope="module")
def inverse(transport: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("inverses") / "inverse.npz"
    ltcl.save_inverse(path, ltcl.invert(ltcl.load(transport), 1e-3, basis="pixels"))
    return path


def test_an_inverse_is_made_and_kept(program: Program, transport: Path, tmp_path: Path) -> None:
    out = tmp_path / "inverse.npz"
    outcome = program("invert", transport, "--out", out, "--rtol", "0.02", "--json")
    assert outcome.code == 0, outcome.err
    kept = ltcl.load_inverse(out)
    assert outcome.json["errors"] == list(kept.errors)
    assert kept.error <= 0.02
    S = ltcl.load(transport).systems[0].to_dense()
    assert np.linalg.norm(np.eye(50) - kept.systems[0].to_dense() @ S, 2) <= kept.error
    assert outcome.json["bytes_on_disk"] == out.stat().st_size
    assert outcome.json["command"] == "invert"


def test_it_says_what_it_made(program: Program, transport: Path, tmp_path: Path) -> None:
    out = tmp_path / "inverse.npz"
    outcome = program("invert", transport, "--out", out, "--basis", "haar", "--basis", "pixels")
    assert outcome.code == 0, outcome.err
    assert "solutions within 0.0" in outcome.out


def test_pictures_are_compensated_with_one_product(
    program: Program, transport: Path, picture: Path, inverse: Path, tmp_path: Path
) -> None:
    outs = [tmp_path / "ours", tmp_path / "solved"]
    outcome = program("compensate", transport, picture, "--inverse", inverse, "--out", outs[0], "--json")
    assert outcome.code == 0, outcome.err
    (entry,) = outcome.json["pictures"]
    (channel,) = entry["channels"]
    assert (channel["method"], channel["status"], channel["products"]) == ("precomputed", "precomputed", 1)
    assert 0.0 < channel["error"] <= 1e-3
    assert channel["residual"] is None
    assert program("compensate", transport, picture, "--rtol", "1e-5", "--out", outs[1]).code == 0
    ours, solved = (images.read(out / "sky_pattern.exr") for out in outs)
    assert np.linalg.norm(ours - solved) <= 2e-3 * np.linalg.norm(solved)
    assert program("compensate", transport, picture, "--inverse", inverse, "--out", outs[0]).code == 0


def test_clamping(program: Program, transport: Path, picture: Path, inverse: Path, tmp_path: Path) -> None:
    arguments = ["--inverse", inverse, "--high", "0.4", "--out", tmp_path / "out", "--json"]
    best, clamped = (
        program("compensate", transport, picture, *arguments, *more).json["pictures"][0]
        for more in ([], ["--clamp"])
    )
    assert clamped["clipped"] > 0.0
    assert best["limited"]
    assert clamped["limited"] == []
    assert clamped["error"] >= best["error"] * 0.99


def test_bounces_are_separated_with_one_product_each(
    program: Program, transport: Path, inverse: Path, tmp_path: Path
) -> None:
    photo = tmp_path / "photo.exr"
    images.write(photo, ltcl.load(transport) @ np.ones((5, 10)))
    arguments = ["--inverse", inverse, "--bounces", "1", "--out", tmp_path / "out", "--json"]
    outcome = program("separate", transport, photo, *arguments)
    assert outcome.code == 0, outcome.err
    (entry,) = outcome.json["pictures"]
    solved = [part["channels"][0] for part in entry["parts"] if part["channels"]]
    assert [channel["products"] for channel in solved] == [1, 1]
    np.testing.assert_allclose(images.read(tmp_path / "out" / "direct.exr"), 0.6, rtol=5e-3)


def test_what_does_not_fit_is_refused(
    program: Program, transport: Path, colour_transport: Path, picture: Path, inverse: Path, tmp_path: Path
) -> None:
    out = ["--out", tmp_path / "out"]
    program("invert", transport, "--out", tmp_path / "inverse.npy").refused("extension is '.npy'", ".npz")
    program("compensate", transport, picture, "--inverse", transport, *out).refused(
        "corner.npz: is no inverse"
    )
    program("compensate", transport, picture, "--inverse", tmp_path / "none.npz", *out).refused("none.npz")
    program("compensate", transport, picture, "--inverse", inverse, "--rtol", "1e-6", *out).refused(
        "error: --rtol is 1e-06, but what this inverse gives may be off by 0.0",
        "ask for no less, or make a better one with 'ltcl invert --rtol'",
    )
    program("compensate", transport, picture, "--inverse", inverse, "--method", "cg", *out).refused(
        "error: --method is given, but --inverse takes"
    )
    program("separate", colour_transport, picture, "--inverse", inverse, "--resize", *out).refused(
        "inverse has"
    )
    for command in (["relight", inverse, picture, *out], ["convert", inverse, tmp_path / "T.mtx"]):
        program(*command).refused(
            f"{inverse}: is a precomputed inverse, no transport; give it as --inverse FILE to compensate or"
        )
    program("compensate", transport, picture, "--inverse", inverse, "--exact", transport, *out).refused(
        "--exact is given, but --inverse takes the place of all solves"
    )
    assert not (tmp_path / "out").exists()


def test_info_tells_of_an_inverse(
    program: Program, inverse: Path, transport: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = ltcl.load_inverse(inverse)
    monkeypatch.setenv("LTCL_DEVICE", "nonsense")  # none is needed
    entry, other = program("info", inverse, transport, "--json").json
    assert (entry["stored"], other["stored"]) == ("inverse", "dense")
    assert (entry["shape"], entry["grid"], entry["channels"]) == ([50, 50], [5, 10], 1)
    assert entry["solution_error"] == kept.error > 0.0
    assert entry["dtype"].endswith(f"; error {checks.upwards(kept.error)}")
    assert entry["nbytes"] > 0
    assert entry["first_bounce"] == other["first_bounce"]
    assert f"inverse {entry['dtype']}" in program("info", inverse).out
    cut = inverse.with_name("cut.npz")
    cut.write_bytes(inverse.read_bytes()[:-40])
    program("info", cut).refused(f"{cut}: ")


def test_parts_by_an_inverse_have_a_bound_and_no_residual(
    program: Program, transport: Path, picture: Path, inverse: Path, tmp_path: Path
) -> None:
    outcome = program("separate", transport, picture, "--inverse", inverse, "--out", tmp_path / "parts")
    assert outcome.code == 0
    assert "diverges" not in outcome.out
    assert "by the inverse, each part is off by up to 0." in outcome.out


@pytest.mark.parametrize("rtol", ["0", "1", "1.5", "-1"])
def test_a_tolerance_has_one_range(
    program: Program, transport: Path, picture: Path, tmp_path: Path, rtol: str
) -> None:
    outcome = program("compensate", transport, picture, "--out", tmp_path / "out", "--rtol", rtol)
    outcome.refused("; it must be above 0 and below 1")
