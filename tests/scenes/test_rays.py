# SPDX-License-Identifier: BSD-3-Clause
"""Nearest hits of rays, beside a plain search in float64 and cases known by hand."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.scenes.blocks import Block
from ltcl.scenes.box import WALLS
from ltcl.scenes.rays import cast, clear
from ltcl.scenes.walls import Wall

FLOOR = Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0))
SLANTED = Wall("slanted", corner=(0, 0, 1), right=(0.2, 1, 0.3), down=(1.5, 0.1, -0.4))


def test_ray_finds_the_place_on_a_slanted_parallelogram() -> None:
    rng = np.random.default_rng(0)
    u, v = rng.random((2, 50))
    targets = np.array(SLANTED.corner) + u[:, None] * SLANTED.right + v[:, None] * SLANTED.down
    origins = targets + SLANTED.normal + rng.uniform(-0.3, 0.3, (50, 3))
    hits = cast([SLANTED], origins, 3 * (targets - origins))
    assert (hits.wall == 0).all()
    assert hits.u == pytest.approx(u)
    assert hits.v == pytest.approx(v)
    assert hits.distance == pytest.approx(1 / 3)


def test_walls_are_black_from_behind_and_still_stop_light() -> None:
    up = np.array([[0.0, 0.0, 1.0]])
    ceiling = Wall("ceiling", corner=(0, 0, 2), right=(1, 0, 0), down=(0, 1, 0))
    start = np.array([[0.5, 0.5, -1.0]])
    assert cast([ceiling], start, up).wall.tolist() == [0]
    hits = cast([FLOOR, ceiling], start, up)
    assert hits.wall.tolist() == [-1]
    assert hits.distance.tolist() == [1.0]


def test_no_ray_leaves_a_closed_box() -> None:
    """Seams and corners included: rays from the middle aim at points of a lattice that holds them all."""
    side = np.linspace(0, 1, 11)
    points = np.stack(np.meshgrid(side, side, side), axis=-1).reshape(-1, 3)
    points = points[(np.abs(points - 0.5).max(axis=1)) == 0.5]
    middle = np.full_like(points, 0.5)
    hits = cast(WALLS, middle, points - middle)
    assert (hits.wall >= 0).all()
    assert hits.distance == pytest.approx(1)


def test_nearest_of_many_walls_wins_whatever_their_order() -> None:
    rng = np.random.default_rng(3)
    walls = [
        Wall(str(i), *(tuple(v) for v in (rng.random(3), rng.uniform(-1, 1, 3), rng.uniform(-1, 1, 3))))
        for i in range(8)
    ]
    origins, steps = rng.uniform(-1, 2, (900, 3)), rng.uniform(-1, 1, (900, 3))
    hits, turned = cast(walls, origins, steps), cast(walls[::-1], origins, steps)
    assert (np.where(hits.wall >= 0, 7 - hits.wall, -1) == turned.wall).all()
    assert (hits.wall >= 0).sum() > 20
    alone = np.min([cast([wall], origins, steps).distance for wall in walls], axis=0)
    assert (hits.distance == alone).all()


def test_blocks_stop_rays() -> None:
    block = np.array([[(0.4, 0.4, 0.2), (0.6, 0.6, 0.5)]])
    origins = np.array([[0.5, 0.5, 1], [0.5, 0.5, 0.1], [0.1, 0.5, 1], [0.5, 0.5, 0.3], [0.4, 0.5, 1.0]])
    down = np.broadcast_to([0.0, 0.0, -1.0], (5, 3))
    hits = cast([FLOOR], origins, down, block)
    assert hits.wall.tolist() == [-1, 0, 0, -1, 0]  # above, below, beside, inside, along a face
    assert hits.distance == pytest.approx([0.5, 0.1, 1, 0, 1])


def test_wall_on_the_face_of_a_block_is_in_front_of_it() -> None:
    block = Block(corner=(0.1, 0.2, 0.0), size=(0.3, 0.7, 0.3))
    rng = np.random.default_rng(4)
    origins = rng.uniform(-2, 3, (2000, 3))
    origins = origins[~block.covers(origins)]
    aims = rng.uniform(block.low, block.high, (len(origins), 3))
    corners = np.array([(block.low, block.high)])
    hits = cast(block.faces(), origins, aims - origins, corners)
    assert (hits.wall >= 0).all()
    alone = cast((), origins, aims - origins, corners)
    assert hits.distance == pytest.approx(alone.distance)
    away = cast(block.faces(), origins + hits.distance[:, None] * (aims - origins), origins - aims, corners)
    assert np.isinf(away.distance).all()


def test_places_on_surfaces_are_reached_from_their_front() -> None:
    """A lamp that touches a ceiling, and one on top of a block: rounding must not hide them."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.random((500, 2)), np.zeros((500, 1))], axis=1)
    ceiling = Wall("ceiling", corner=(0, 0, 0.7), right=(1, 0, 0), down=(0, 1, 0))  # faces down
    assert clear([ceiling], points, np.array([0.3, 0.4, 0.7])).all()
    assert not clear([ceiling], points, np.array([0.3, 0.4, 0.9])).any()
    block = np.array([[(0.2, 0.2, 0.1), (0.4, 0.4, 0.1 + 0.2)]])
    top, above = np.array([0.3, 0.3, 0.1 + 0.2]), points + np.array([0, 0, 1])
    assert clear((), above, top, block).all()
    assert not clear((), points, top, block).any()
