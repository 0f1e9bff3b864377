# SPDX-License-Identifier: BSD-3-Clause
"""Scenes of `bench/scenes/perspective.py`: T in perspective, closed forms, and its bounces."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

# All scenes are made once, in 2 s.
pytestmark = pytest.mark.slow

BENCH = Path(__file__).resolve().parents[2] / "bench"
GRID = (10, 10)
# Form factor of unit squares at right angles with a common edge.
RIGHT_ANGLE = 0.2000437761
NAMES = ("dihedral", "coloured trihedral", "box with blocks", "glossy corner", "closed box")


@pytest.fixture(scope="module")
def perspective() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCH))
        return importlib.import_module("scenes.perspective")


@pytest.fixture(scope="module")
def scenes(perspective: Any) -> dict[str, Any]:
    return {name: perspective.PerspectiveTransport(name, GRID) for name in NAMES}


def test_every_scene_is_tested(perspective: Any) -> None:
    assert tuple(perspective.SCENES) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_T_is_the_sum_of_its_bounces_and_reciprocal(scenes: Any, name: str) -> None:
    scene = scenes[name]
    pattern = np.random.default_rng(1).random(GRID)
    bounces = scene.bounces(pattern, 60)
    for channel in range(scene.channels):
        T = scene.matrix(channel)
        np.testing.assert_allclose(bounces[:, :, channel].sum(axis=0), T @ pattern.ravel(), 1e-4)
        np.testing.assert_allclose(T, T.T, atol=1e-12)
        assert T.min() >= 0.0
    # Each bounce is as dark as surfaces make it.
    light = bounces.sum(axis=(1, 2))
    assert np.all(light[2:11] < light[1:10])


@pytest.mark.parametrize("name", NAMES)
def test_pieces_fill_every_pixel(scenes: Any, name: str) -> None:
    np.testing.assert_allclose(scenes[name].W.sum(axis=1), 1.0)


def test_walls_at_right_angles_exchange_light_as_the_closed_form_says(scenes: Any) -> None:
    scene = scenes["dihedral"]
    is_left = scene.shape.centre[:, 0] < 0.0
    area = scene.shape.area
    assert area[is_left].sum() == pytest.approx(1.0)
    exchange = (area[:, None] * scene.F)[np.ix_(is_left, ~is_left)].sum()
    assert exchange == pytest.approx(RIGHT_ANGLE, rel=0.005)
    np.testing.assert_array_equal(scene.F[np.ix_(is_left, is_left)], 0.0)


def test_a_closed_box_loses_no_light(scenes: Any) -> None:
    scene = scenes["closed box"]
    area = scene.shape.area
    assert area.sum() == pytest.approx(6.0)
    assert area @ scene.F.sum(axis=1) == pytest.approx(6.0, rel=0.005)


def test_direct_light_of_a_matt_wall_is_by_cosine_and_distance(scenes: Any) -> None:
    """In a box with its back at depth b, 1 / b^2 there, and h / z^3 on a side wall h away."""
    scene = scenes["closed box"]
    direct = scene.bounces(np.ones(GRID), 0)[0].reshape(GRID)
    back = direct[3:7, 3:7]
    np.testing.assert_allclose(back, back[0, 0], rtol=1e-9)
    depth = scene.scene.traced.eye
    side = 0.5 / (1.0 - 3.0 / GRID[1])
    expected = 0.5 / side**3 * depth**2
    # A pixel of the side wall is not small.
    assert direct[5, 1] / back[0, 0] == pytest.approx(expected, rel=0.06)


def test_a_block_hides_what_is_behind_it(perspective: Any) -> None:
    exchange = importlib.import_module("scenes.exchange")
    block = perspective.TRACED["blocks"].blocks[0]
    start = np.array([[-0.2, -0.2, 1.5], [0.4, 0.4, 1.5]])
    way = np.array([[0.0, 0.0, -1.5], [0.0, 0.0, -1.5]])
    np.testing.assert_array_equal(exchange.meets(start, way, [block]), [True, False])
    # It ends before the block.
    np.testing.assert_array_equal(exchange.meets(start, 0.3 * way, [block]), [False, False])
