# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import ltcl
from ltcl import images, scenes

from .conftest import Program


@pytest.fixture
def photo(transport: Path, tmp_path: Path) -> Path:
    """What the camera sees of the corner under a white pattern."""
    path = tmp_path / "photo.exr"
    images.write(path, ltcl.load(transport) @ np.ones((5, 10)))
    return path


def test_bounces_are_those_of_the_scene(
    program: Program, transport: Path, photo: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    arguments = ["--bounces", "2", "--rtol", "1e-5", "--out", out, "--json"]
    outcome = program("separate", transport, photo, *arguments)
    assert outcome.code == 0, outcome.err
    (entry,) = outcome.json["pictures"]
    assert [part["part"] for part in entry["parts"]] == ["direct", "indirect", "bounce_1", "bounce_2", "rest"]
    truth = np.full(50, 0.6)
    A = scenes.dihedral(5, albedo=0.6).A
    for name in ("direct", "bounce_1", "bounce_2"):
        found = images.read(out / f"{name}.exr").ravel()
        assert np.linalg.norm(found - truth) < 1e-3 * np.linalg.norm(truth)
        truth = A @ truth
    whole = sum(images.read(out / f"{name}.exr") for name in ("direct", "bounce_1", "bounce_2", "rest"))
    np.testing.assert_allclose(whole, images.read(photo), rtol=1e-5)
    shares = {part["part"]: part["share"] for part in entry["parts"]}
    assert shares["direct"] + shares["indirect"] == pytest.approx(1, abs=1e-5)


def test_negative_values_survive_in_exr(program: Program, transport: Path, tmp_path: Path) -> None:
    dark = np.full((5, 10), 0.01, np.float32)
    dark[:, :5] = 1.0  # no projector can leave the right wall that dark
    images.write(tmp_path / "dark.exr", dark)
    out = tmp_path / "out"
    assert program("separate", transport, tmp_path / "dark.exr", "--out", out).code == 0
    assert images.read(out / "direct.exr").min() < 0


def test_several_pictures_get_a_folder_each(
    program: Program, transport: Path, photo: Path, picture: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    outcome = program("separate", transport, photo, picture, "--bounces", "0", "--out", out)
    assert outcome.code == 0
    assert (out / "photo" / "direct.exr").is_file()
    assert (out / "sky" / "rest.png").is_file()
    assert str(out / "sky") in outcome.out


def test_wrong_size_is_refused(
    program: Program, transport: Path, large_picture: Path, tmp_path: Path
) -> None:
    program("separate", transport, large_picture, "--out", tmp_path / "out").refused("--resize")
    assert list(tmp_path.iterdir()) == []


def test_a_compressed_transport_separates_as_well_as_it_can(
    program: Program, transport: Path, compressed_transport: Path, photo: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    common = ("separate", compressed_transport, photo, "--bounces", "1", "--out", out)
    outcome = program(*common)
    assert outcome.code == 0, outcome.err
    assert "all of this is of the compressed transport, which itself is off by up to 0.41 %\n" in outcome.out
    told = program(*common, "--json").json
    assert told["options"]["rtol"] == 0.0041  # as `ltcl.separate` does
    assert (told["transport"]["error"], told["pictures"][0]["transport_error"]) == (0.0041, 0.0041)
    program(*common, "--rtol", "1e-3").refused("error: --rtol is 0.001; ", "give --exact FILE")
    corrected = program(*common, "--exact", transport, "--json").json
    assert (corrected["options"]["rtol"], corrected["options"]["exact"]) == (1e-3, str(transport))
    assert corrected["pictures"][0]["transport_error"] == 0.0
    np.testing.assert_allclose(images.read(out / "direct.exr"), 0.6, rtol=2e-3)
    assert f"all of this is of {transport}, by which" in program(*common, "--exact", transport).out


def test_an_inverse_separates_as_well_as_it_can(
    program: Program, transport: Path, photo: Path, tmp_path: Path
) -> None:
    inverse, out = tmp_path / "inverse.npz", tmp_path / "out"
    kept = ltcl.invert(ltcl.load(transport), 0.05, basis="db2")
    ltcl.save_inverse(inverse, kept)
    told = program("separate", transport, photo, "--inverse", inverse, "--out", out, "--json")
    assert told.code == 0, told.err
    assert told.json["options"]["rtol"] == max(kept.error, 1e-3)
