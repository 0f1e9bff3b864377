# SPDX-License-Identifier: BSD-3-Clause
"""The viewer's answers for several projectors."""

from __future__ import annotations

import numpy as np
import pytest

import ltcl
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


def test_bounces_and_probes(scene):
    facts, shown = scene.answer("bounces", {"picture": 1, "count": 2}, ignore)
    assert shown["direct"].shape == CAMERA
    assert sum(facts["shares"]) == pytest.approx(1.0, abs=1e-3)
    _, shown = scene.answer("column", {"pixel": [5, 5]}, ignore)
    assert shown["picture"].shape == CAMERA
    _, shown = scene.answer("row", {"pixel": [4, 8]}, ignore)
    assert shown["pattern"].shape == scene.T.grid
