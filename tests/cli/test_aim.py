# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl acquire aim`."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl import images
from ltcl.acquisition.aiming import read_white
from ltcl.viewer.aim import AimScene


@pytest.mark.slow
def test_looks_of_a_rig(program, simulated):
    before = sorted(simulated.iterdir())
    outcome = program("acquire", "aim", simulated, "--looks", 3, "--no-browser", "--json")
    report = outcome.json
    assert report["looks"] == 3
    assert 0.0 < report["brightness"] <= 1.0
    assert 0.0 < report["focus"] <= 1.0
    assert sorted(simulated.iterdir()) == before
    words = ["acquire", "aim", simulated, "--photographs", simulated, "--no-browser"]
    program(*words).assert_refused("--photographs is given", "virtual")


@pytest.mark.slow
def test_newest_photograph(program, tmp_path):
    lines = ["[rig]", 'kind = "folder"', "projector_grid = [4, 8]", "channels = 1"]
    (tmp_path / "acquisition.toml").write_text("\n".join(lines))
    white = np.zeros((40, 60))
    white[5:35, 5:55] = 0.5
    for name in ("a.png", "b.png"):
        images.write(tmp_path / "card" / name, white, encoding="linear")
    words = ["acquire", "aim", tmp_path, "--photographs", tmp_path / "card", "--looks", 1]
    report = program(*words, "--no-browser", "--json").json
    assert report["lit"] == pytest.approx(0.625, abs=0.01)
    assert report["brightness"] == pytest.approx(0.5, abs=0.01)
    assert "focus" not in report
    assert report["advice"] == []


def test_page_gets_each_reading_once():
    scene = AimScene("corner")
    facts, _ = scene.scan(0)
    assert facts["notes"] == ["no photograph yet"]
    for number in (1, 2):
        scene.add_reading(f"look {number}", read_white(np.full((200, 320), 0.2 * number)))
    facts, pictures = scene.scan(1)
    assert [photograph["name"] for photograph in facts["photographs"]] == ["look 2"]
    assert pictures["0"].max() == 102
    assert facts["seen"] == 2
    assert scene.scan(2)[0]["photographs"] == []
