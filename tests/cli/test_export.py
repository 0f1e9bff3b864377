# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl export`."""

from __future__ import annotations

import pytest


@pytest.mark.slow
def test_scan_becomes_files(program, acquired, tmp_path):
    out = tmp_path / "out"
    report = program("export", acquired, "--out", out, "--json").json
    assert sorted(path.name for path in out.iterdir()) == sorted(report["files"])
    (projector,) = report["projectors"]
    loss = projector["loss"]
    # The corner has walls that light each other: files alone cannot hold that.
    assert loss["ltcl"] < 0.01 < 0.05 < loss["direct"] <= loss["maps"] * 1.01
    text = (out / "README.txt").read_text()
    assert f"{100 * loss['maps']:.1f} % by maps alone" in text
    lut = (out / "projector_1_response.cube").read_text().splitlines()
    assert lut[2] == "LUT_1D_SIZE 1024"
    assert len(lut) == 3 + 1024


def test_formats_are_chosen(program, acquired, tmp_path):
    words = ["export", acquired, "--no-error", "--out", tmp_path / "out", "--format"]
    report = program(*words, "obj", "--format", "png", "--json").json
    assert report["projectors"][0]["loss"] is None
    assert len(report["files"]) == 4
    program(*words, "fbx").assert_refused("'fbx' is not a format", "mpcdi", code=2)


def test_folder_of_several_projectors(program, room_of_two, tmp_path):
    words = ["export", room_of_two, "--out", tmp_path / "out"]
    report = program(*words, "--format", "png", "--format", "mpcdi", "--json").json
    assert [projector["name"] for projector in report["projectors"]] == ["left", "right"]
    assert [projector["grid"] for projector in report["projectors"]] == [[13, 16]] * 2
    assert report["camera_grid"] == [36, 72]
    assert {"left_blend.png", "right_black.png", "projectors.mpcdi"} <= {*report["files"]}
    text = (tmp_path / "out" / "README.txt").read_text()
    for projector in report["projectors"]:
        error = 100 * projector["loss"]["maps"]
        assert f"{projector['name']} {error:.1f} % by maps alone" in text
