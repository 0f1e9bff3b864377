# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

from pathlib import Path

import numpy as np

import ltcl
from ltcl import images
from ltcl.device import Device

from .conftest import Program


def test_picture_is_the_product(program: Program, transport: Path, picture: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (entry,) = program("relight", transport, picture, "--out", out, "--json").json["pictures"]
    wanted = ltcl.load(transport) @ images.read(picture)
    np.testing.assert_allclose(images.read(out / entry["exr"]), wanted, rtol=1e-6)
    assert entry["png_scale"] <= entry["brightest"]


def test_rectangular_transport_lies_on_the_cameras_grid(
    program: Program, picture: Path, tmp_path: Path, device: Device
) -> None:
    path = tmp_path / "T.npy"
    np.save(path, np.random.default_rng(2).random((6, 50)))
    out = tmp_path / "out"
    arguments = ["--grid", "5x10", "--camera-grid", "2x3", "--out", out]
    assert program("relight", path, picture, *arguments).code == 0
    assert images.read(out / "sky_relit.exr").shape[:2] == (2, 3)


def test_refusals(program: Program, transport: Path, large_picture: Path, tmp_path: Path) -> None:
    program("relight", transport, large_picture, "--out", tmp_path / "out").refused("20 x 30", "--resize")
    program("relight", transport, "nowhere.exr", "--out", tmp_path / "out").refused("no such file")
    assert list(tmp_path.iterdir()) == []


def test_pictures_of_a_compressed_transport_are_told_from_those_of_the_scene(
    program: Program, compressed_transport: Path, picture: Path, tmp_path: Path
) -> None:
    arguments = ("relight", compressed_transport, picture, "--out", tmp_path / "out")
    assert (
        "they are of the compressed transport, which itself is off by up to 0.41 %" in program(*arguments).out
    )
    assert program(*arguments, "--json").json["transport"]["error"] == 0.0041
