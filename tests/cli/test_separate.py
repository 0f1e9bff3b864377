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
