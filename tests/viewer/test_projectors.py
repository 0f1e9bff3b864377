# SPDX-License-Identifier: BSD-3-Clause
"""The viewer's answers for several projectors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition.projectors import combine_scans
from ltcl.viewer.answers import ViewerScene
from tests.transport import projectors
from tests.transport.projectors import CAMERA


def ignore(step: int, residual: float) -> None:
    pass


@pytest.fixture(scope="module")
def scene(device):
    T = ltcl.combine(projectors.transports(device, projectors.corner()))
    picture = np.linspace(0.2, 0.4, CAMERA[0] * CAMERA[1]).reshape(CAMERA)
    return ViewerScene(T, "two", {"ramp": picture}, None)


def test_patterns_stand_side_by_side(scene):
    T = scene.T
    assert scene.hello()["bounces"]
    facts, shown = scene.answer("compensate", {"picture": 1}, ignore)
    assert shown["pattern"].shape == T.grid
    assert shown["appearance"].shape == CAMERA
    assert facts["error"] < 0.02
    _, shown = scene.answer("adjust", {"picture": 1, "gain": 0.9}, ignore)
    assert shown["pattern"].shape == T.grid
    _, shown = scene.answer("relight", {"picture": 1}, ignore)
    for pattern in T.split(shown["pattern"]):
        assert pattern.min() > 0.15


def test_projectors_have_numbers_where_they_have_no_names(scene):
    assert scene.hello()["projectors"] == [
        {"name": "projector 1", "grid": (10, 13), "left": 0},
        {"name": "projector 2", "grid": (12, 14), "left": 13},
    ]


def test_scans_bring_names_and_codes(room_of_two, tmp_path):
    stores = [room_of_two / "left.zarr", room_of_two / "right.zarr"]
    ltcl.save(tmp_path / "both.npz", combine_scans(stores))
    T: Any = ltcl.load(tmp_path / "both.npz")
    scene = ViewerScene(T, "room", {"grey": np.full(T.camera_grid, 0.15)}, None)
    assert [projector["name"] for projector in scene.hello()["projectors"]] == ["left", "right"]
    codes = scene.codes(scene.pattern, 1.0)
    # Each projector has 13 x 16 pixels of its own.
    assert codes.shape == (13, 32)
    black = T.black_pictures()[0]
    for question in ("compensate", "adjust"):
        _, shown = scene.answer(question, {"picture": 1, "gain": 1.0}, ignore)
        expected = T @ shown["pattern"] + black
        np.testing.assert_allclose(shown["appearance"], expected, rtol=1e-4)


def test_bounces_and_probes(scene):
    facts, shown = scene.answer("bounces", {"picture": 1, "count": 2}, ignore)
    assert shown["direct"].shape == CAMERA
    assert sum(facts["shares"]) == pytest.approx(1.0, abs=1e-3)
    _, shown = scene.answer("column", {"pixel": [5, 5]}, ignore)
    assert shown["picture"].shape == CAMERA
    _, shown = scene.answer("row", {"pixel": [4, 8]}, ignore)
    assert shown["pattern"].shape == scene.T.grid
