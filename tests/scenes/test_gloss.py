# SPDX-License-Identifier: BSD-3-Clause
"""Glossy scenes: bins, lobes, beams keep light; eq. 28 and 29; limits; an integral without bins."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.stats

from ltcl.scenes import Block, GlossyScene, box, cut, dihedral, glossy
from ltcl.scenes.builders import WALLS
from ltcl.scenes.gloss import brdf
from ltcl.scenes.gloss.beams import exchange
from ltcl.scenes.walls import Wall
from ltcl.transport.diagnostics import reciprocity_defect

PROJECTOR = (1.5, 0.9, 0.8)
CAMERA = (0.8, 1.6, 0.4)


def corner(n: int = 3, gloss: Any = 0.6, exponent: Any = 10, **options: Any) -> GlossyScene:
    options = {"projector": PROJECTOR, "camera": CAMERA, "directions": 16, "rays": 32, **options}
    return glossy(dihedral(n), n, gloss=gloss, exponent=exponent, **options)


@pytest.mark.parametrize("k", [2, 3, 8])
def test_bins_hold_equal_projected_solid_angles(k: int) -> None:
    """Directions of a cosine law, made by rejection from a square: each bin gets its share."""
    points = np.random.default_rng(1).uniform(-1, 1, (200_000, 2))
    points = points[(points**2).sum(axis=1) < 1]
    counts = np.bincount(
        brdf.bins(np.column_stack([points, np.sqrt(1 - (points**2).sum(axis=1))]), k)
    )
    assert counts == pytest.approx(
        np.full(k * k, len(points) / k**2), abs=5 * (len(points) / k**2) ** 0.5
    )


@pytest.mark.parametrize(("k", "exponent"), [(2, 1), (4, 20), (8, 0.5), (8, 512)])
def test_lobes_return_all_light_and_are_reciprocal(k: int, exponent: float) -> None:
    shine = brdf.lobe(exponent, k)
    vectors = brdf.from_square(np.random.default_rng(0).random((40, 2)))
    for means in (shine.between.mean(axis=1), shine.towards(vectors).mean(axis=1)):
        assert means == pytest.approx(1, rel=1e-12)
    assert ((shine.between == shine.between.T) & (shine.between > 0)).all()
    there = shine.direct(vectors, vectors[::-1])
    back = shine.direct(vectors[::-1], vectors)
    assert there == pytest.approx(back, rel=1e-12)


UNEQUAL = (
    Wall("a", (1, 0, 2), (-1, 0, 0), (0, 0, -2)),
    Wall("b", (0, 0, 1), (0, 3, 0.5), (0, 0, -1)),
)


@pytest.mark.parametrize("walls", [WALLS, UNEQUAL])
def test_beams_exchange_the_same_light_both_ways(walls: tuple[Wall, ...]) -> None:
    G = exchange(walls, 3, directions=16, rays=64)
    area = cut(walls, 3).area
    E = np.repeat(area, 16)[:, None] * G.toarray()
    np.testing.assert_allclose(E, E.T, atol=1e-6 * E.max())
    assert G.sum(axis=1).max() <= 1 + 1e-12
    assert len(walls) < 6 or G.sum(axis=1).min() >= 1 - 1e-12  # a closed room keeps all light
    same = [
        (exchange(walls, 3, 16, 64, seed=seed).toarray() == G.toarray()).all() for seed in (0, 4)
    ]
    assert same == [True, False]
    curtain = exchange((WALLS[0], WALLS[4]), 2, 16, 16, blocks=[[(-1, 0.4, -1), (2, 0.5, 2)]])
    assert curtain.sum() == 0


@pytest.mark.parametrize("gloss", [0.0, 0.7, [0, 1, 0.2, 0, 0.5, 0.9]])
def test_white_furnace(gloss: Any) -> None:
    """Light that is 1 everywhere and to all sides of a closed room is `albedo` after a bounce."""
    place: dict[str, Any] = {"projector": (0.5, 0.5, 0.5), "camera": (0.3, 0.6, 0.4)}
    room = glossy(box(2), 2, 0.8, gloss, 30, **place, directions=16, rays=16)
    assert room.A @ np.ones(room.A.shape[1]) == pytest.approx(0.8, rel=1e-12)
    leaving = (room.K @ (room.Q @ np.ones(24))).reshape(24, 17)[:, :-1]
    assert leaving.mean(axis=1) == pytest.approx(0.8, rel=1e-12)  # the projector's light as well


def test_transport_solves_equation_28_and_bounces_equation_29() -> None:
    scene = corner(albedo=0.6)
    A = scene.A @ np.eye(scene.A.shape[0])
    pattern = np.random.default_rng(1).random(scene.grid)
    expected = scene.P @ np.linalg.solve(np.eye(len(A)) - A, scene.K @ scene.Q.toarray())
    (T,) = scene.matrices()
    np.testing.assert_allclose(T, expected, atol=2e-8)
    direct = (scene.P @ scene.K @ scene.Q).toarray()
    np.testing.assert_allclose(direct, np.diag(scene.first_bounce), atol=1e-15)
    bounces = scene.bounces(pattern, 40)
    light = scene.K @ (scene.Q @ pattern.ravel())
    assert bounces.sum(axis=0).ravel() == pytest.approx(T @ pattern.ravel(), rel=1e-6)
    for bounce in bounces[:4]:
        assert bounce.ravel() == pytest.approx(scene.P @ light, rel=1e-6)
        light = A @ light
    x, y = np.random.default_rng(0).random((2, len(A)))
    assert (scene.A @ x) @ y == pytest.approx(x @ (scene.A.H @ y), rel=1e-12)


def test_without_gloss_it_is_the_diffuse_scene_and_reciprocal() -> None:
    matte = corner(4, gloss=0, albedo=[0.7, 0.4])
    np.testing.assert_allclose(matte.matrices()[0], matte.matte.matrices()[0], atol=2e-8)
    assert reciprocity_defect(matte.matrices()[0], matte.first_bounce) < 1e-6
    shiny = corner(4, 0.4)
    assert reciprocity_defect(shiny.matrices()[0], shiny.first_bounce) > 0.02


def first_bounce_by_integration(gloss: float, exponent: float) -> float:
    """Light from left to right wall of `dihedral(1)` to the camera, by rays, without bins."""
    shine = brdf.lobe(exponent, 16)
    u, v, a, b = scipy.stats.qmc.Sobol(4, scramble=False).random_base2(12).T + 2.0**-13
    radius = np.sqrt(a)
    angle = 2 * np.pi * b
    # z along +x, off the right wall
    x = radius * np.cos(angle)
    y = radius * np.sin(angle)
    z = np.sqrt(1 - a)
    distance = np.where(x < 0, -u / x, np.inf)  # to y = 0; x here is along +y of the room
    reached = distance * z, v + distance * y
    room = np.column_stack([z, x, y])[(reached[0] < 1) & (reached[1] > 0) & (reached[1] < 1)]

    def reflect(
        normal: tuple[int, int, int], place: Any, centre: Any, other: np.ndarray
    ) -> np.ndarray:
        # Any frame does for an isotropic lobe.
        axes = np.stack([np.roll(normal, 1), np.roll(normal, 2), normal], axis=1)
        away = place - centre
        towards = np.broadcast_to(away / np.linalg.norm(away), room.shape)
        return 1 - gloss + gloss * shine.direct(towards @ axes, other @ axes)

    lit = reflect((0, 1, 0), np.array(PROJECTOR), (0.5, 0, 0.5), -room)
    seen = reflect((1, 0, 0), np.array(CAMERA), (0, 0.5, 0.5), room)
    return float((lit * seen).sum() / len(u))


@pytest.mark.rare
def test_first_bounce_approaches_an_integral_without_bins() -> None:
    expected = first_bounce_by_integration(0.8, 8)
    errors = []
    for directions in (4, 16, 64):
        scene = corner(1, 0.8, 8, albedo=0.5, directions=directions, rays=16384 // directions)
        errors.append(abs(scene.bounces(np.array([[1, 0]]), 1)[1, 0, 1] / 0.25 / expected - 1))
    assert errors[0] > 2 * errors[1] > 4 * errors[2]  # about as 1 / directions
    assert errors[2] < 0.04


@pytest.mark.slow
def test_a_glossy_block_casts_a_shadow_and_shows_a_highlight() -> None:
    cube = box(1, sides=3, occluder=Block(corner=(0.3, 0.3, 0.0), size=(0.3, 0.3, 0.4), albedo=0.5))
    gloss = [0.8 if wall.name.startswith("block") else 0.0 for wall in cube.walls]
    options: dict[str, Any] = {
        "projector": (0.9, 0.2, 1.4),
        "camera": (0.15, 0.75, 1.4),
        "rays": 16,
    }
    room = glossy(cube, 5, 0.5, gloss, 100, **options, directions=36)
    direct = room.picture(room.first_bounce).reshape(5, len(cube.walls), 5)
    names = [wall.name for wall in cube.walls]
    floor, top, side = (direct[:, names.index(name)] for name in ("floor", "block top", "block -x"))
    # The first is below it.
    assert (floor[2, 2], floor[4, 4], side.max()) == (
        0,
        pytest.approx(0.5),
        0,
    )
    assert top.max() > 20 * 0.5 * (1 - 0.8)  # of the matte part
    # Halfway between projector and camera, which are as high above it.
    assert np.unravel_index(np.argmax(top), top.shape) == (3, 2)
