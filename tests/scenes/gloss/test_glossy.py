# SPDX-License-Identifier: BSD-3-Clause
"""Glossy scenes: energy, eq. 28 and 29, the diffuse limit, highlights, refusals.

The first bounce is checked by an integral of its own, with exact directions and no bins.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
import scipy.stats

import ltcl
from ltcl import checks
from ltcl.diagnostics import reciprocity_defect
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.scenes import Block, GlossyScene, box, dihedral, glossy, trihedral
from ltcl.scenes.box import WALLS
from ltcl.scenes.gloss.brdf import lobe
from ltcl.scenes.walls import Wall

PROJECTOR, CAMERA = (1.5, 0.9, 0.8), (0.8, 1.6, 0.4)
BLOCK = Block(corner=(0.3, 0.3, 0.0), size=(0.3, 0.3, 0.4), albedo=0.5)


def corner(n: int = 3, gloss: Any = 0.6, exponent: Any = 10, **options: Any) -> GlossyScene:
    given = {"projector": PROJECTOR, "camera": CAMERA, "directions": 16, "rays": 32, **options}
    return glossy(dihedral(n), n, gloss=gloss, exponent=exponent, **given)


@pytest.fixture(scope="module")
def scene() -> GlossyScene:
    return corner(albedo=0.6)


@pytest.mark.parametrize("gloss", [0.0, 0.7, [0, 1, 0.2, 0, 0.5, 0.9]])
def test_white_furnace(gloss: Any) -> None:
    """In a closed room, light that is 1 everywhere and to all sides is `albedo` after a bounce."""
    place: dict[str, Any] = {"projector": (0.5, 0.5, 0.5), "camera": (0.3, 0.6, 0.4)}
    room = glossy(box(2), 2, 0.8, gloss, 30, **place, directions=16, rays=16)
    assert room.A @ np.ones(room.A.shape[1]) == pytest.approx(0.8, rel=1e-12)


def test_projector_light_is_reflected_whole(scene: GlossyScene) -> None:
    """Mean radiance over the bins is albedo times irradiance."""
    leaving = (scene.K @ (scene.Q @ np.ones(18))).reshape(18, 17)[:, :-1]
    assert leaving.mean(axis=1) == pytest.approx(0.6, rel=1e-12)


def test_bounce_is_self_adjoint_in_the_measure_of_beams(scene: GlossyScene) -> None:
    """K between bins is symmetric, and so is area x G."""
    blocks = scene.K.toarray().reshape(18, 17, 18, 17)[np.arange(18), :-1, np.arange(18), :-1]
    assert (blocks == blocks.transpose(0, 2, 1)).all()


def test_shapes_of_the_operators(scene: GlossyScene) -> None:
    size = 18 * 17
    assert scene.A.shape == scene.G.shape == scene.K.shape == (size, size)
    assert (scene.P.shape, scene.Q.shape) == ((18, size), (size, 18))
    assert (scene.grid, scene.directions, scene.channels, len(scene.walls)) == ((3, 6), 16, 1, 2)


def test_transport_solves_equation_28_densely(scene: GlossyScene) -> None:
    A = scene.A @ np.eye(scene.A.shape[0])
    expected = scene.P @ np.linalg.solve(np.eye(len(A)) - A, scene.K @ scene.Q.toarray())
    (T,) = scene.matrices()
    assert pytest.approx(expected, abs=2e-8) == T
    direct = (scene.P @ scene.K @ scene.Q).toarray()
    assert direct == pytest.approx(np.diag(scene.first_bounce), abs=1e-15)
    assert scene.transport().matrices[0] == pytest.approx(T)


def test_adjoint_of_the_bounce(scene: GlossyScene) -> None:
    x, y = np.random.default_rng(0).random((2, scene.A.shape[0]))
    assert (scene.A @ x) @ y == pytest.approx(x @ (scene.A.H @ y), rel=1e-12)


def test_bounces_add_up_to_the_picture_and_follow_equation_29(scene: GlossyScene) -> None:
    pattern = np.random.default_rng(1).random(scene.grid)
    bounces = scene.bounces(pattern, 40)
    assert bounces.dtype == np.float64
    (T,) = scene.matrices()
    assert bounces.sum(axis=0).ravel() == pytest.approx(T @ pattern.ravel(), rel=1e-6)
    light = scene.K @ (scene.Q @ pattern.ravel())
    for bounce in bounces[:4]:
        assert bounce.ravel() == pytest.approx(scene.P @ light, rel=1e-6)
        light = scene.A @ light


def test_colours_and_frames() -> None:
    colour = corner(2, albedo=(0.8, 0.4, 0.2))
    patterns = np.random.default_rng(2).random((2, *colour.grid, 3))
    bounces = colour.bounces(patterns, 2)
    assert bounces.shape == (3, 2, 2, 4, 3)
    for channel, albedo in enumerate((0.8, 0.4, 0.2)):
        grey = corner(2, albedo=albedo)
        assert bounces[:, 1, ..., channel] == pytest.approx(grey.bounces(patterns[1, ..., channel], 2))
        assert colour.matrices()[channel] == pytest.approx(grey.matrices()[0])
    assert len(colour.A) == len(colour.K) == colour.transport().channels == 3
    assert colour.first_bounce.shape == (3, 8)


def test_without_gloss_it_is_the_diffuse_scene_of_its_form_factors() -> None:
    matte = corner(4, gloss=0, albedo=[0.7, 0.4])
    (T,), (expected,) = matte.matrices(), matte.matte.matrices()
    assert pytest.approx(expected, abs=2e-8) == T


def test_without_gloss_it_approaches_the_exact_box_as_rays_grow() -> None:
    exact = box(3, sides=3, albedo=0.6).matrices()[0]
    indirect = np.linalg.norm(exact - 0.6 * np.eye(27))
    errors = []
    for rays in (4, 32, 256):
        near = glossy(box(3, sides=3), 3, 0.6, 0, projector=(2, 1, 1), directions=16, rays=rays)
        errors.append(np.linalg.norm(near.matrices()[0] - exact) / indirect)
    assert errors[0] > 2 * errors[1] > 4 * errors[2]
    assert errors[2] < 0.02


def first_bounce_by_integration(gloss: float, exponent: float) -> float:
    """Light from left to right wall of `dihedral(1)` to the camera, by rays in closed form, without bins."""
    shine = lobe(exponent, 16)
    u, v, a, b = scipy.stats.qmc.Sobol(4, scramble=False).random_base2(12).T + 2.0**-13
    radius, angle = np.sqrt(a), 2 * np.pi * b
    x, y, z = radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - a)  # z along +x, off the right wall
    distance = np.where(x < 0, -u / x, np.inf)  # to y = 0; x here is along +y of the room
    reached = distance * z, v + distance * y
    hit = (reached[0] < 1) & (reached[1] > 0) & (reached[1] < 1)
    room = np.column_stack([z, x, y])[hit]

    def reflect(normal: tuple[int, int, int], one: np.ndarray, other: np.ndarray) -> np.ndarray:
        # Any frame does for an isotropic lobe.
        axes = np.stack([np.roll(normal, 1), np.roll(normal, 2), normal], axis=1)
        return 1 - gloss + gloss * shine.direct(one @ axes, other @ axes)

    def towards(place: tuple[float, ...], centre: tuple[float, ...]) -> np.ndarray:
        away = np.subtract(place, centre)
        return np.broadcast_to(away / np.linalg.norm(away), room.shape)

    lit = reflect((0, 1, 0), towards(PROJECTOR, (0.5, 0, 0.5)), -room)
    seen = reflect((1, 0, 0), towards(CAMERA, (0, 0.5, 0.5)), room)
    return float((lit * seen).sum() / len(u))


def test_first_bounce_approaches_an_integral_without_bins() -> None:
    gloss, exponent, errors = 0.8, 8, []
    expected = first_bounce_by_integration(gloss, exponent)
    for directions in (4, 16, 64):
        scene = corner(1, gloss, exponent, albedo=0.5, directions=directions, rays=16384 // directions)
        found = scene.bounces(np.array([[1, 0]]), 1)[1, 0, 1] / 0.25
        errors.append(abs(found / expected - 1))
    assert errors[0] > 2 * errors[1] > 4 * errors[2]  # about as 1 / directions
    assert errors[2] < 0.04


def test_highlight_lies_where_the_mirror_image_of_the_projector_is_seen() -> None:
    floor = Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0))
    flat = glossy([floor], 15, 0.5, 0.5, 200, projector=(0.2, 0.5, 1), camera=(0.8, 0.5, 1), rays=1)
    direct = flat.picture(flat.first_bounce)
    assert np.unravel_index(np.argmax(direct), (15, 15)) == (7, 7)
    assert direct[7, 7] > 20 * direct[0, 0]
    assert direct == pytest.approx(direct[::-1], rel=0.05)
    assert direct == pytest.approx(direct[:, ::-1], rel=0.05)


def test_gloss_breaks_reciprocity_of_one_camera_and_one_projector_but_not_of_a_matte_room() -> None:
    matte, shiny = corner(4, 0), corner(4, 0.4)
    assert reciprocity_defect(matte.matrices()[0], matte.first_bounce) < 1e-6
    assert reciprocity_defect(shiny.matrices()[0], shiny.first_bounce) > 0.02


def test_compensation_is_exact_of_glossy_scenes(scene: GlossyScene) -> None:
    T = scene.transport()
    wanted = T @ np.random.default_rng(3).uniform(0.2, 0.8, scene.grid)
    found = ltcl.compensate(T, wanted, rtol=1e-5)
    assert found.clipped == 0
    assert found.error < 1e-4


def test_glossy_block_casts_a_shadow_and_shows_a_highlight() -> None:
    """Faces of a block are walls of their own size; what the block hides is dark."""
    cube = box(1, sides=3, occluder=BLOCK)
    gloss = [0.8 if wall.name.startswith("block") else 0.0 for wall in cube.walls]
    place: dict[str, Any] = {"projector": (0.9, 0.2, 1.4), "camera": (0.15, 0.75, 1.4)}
    room = glossy(cube, 5, 0.5, gloss, 100, **place, directions=36, rays=16)
    direct = room.picture(room.first_bounce).reshape(5, len(cube.walls), 5)
    names = [wall.name for wall in cube.walls]
    floor, top = direct[:, names.index("floor")], direct[:, names.index("block top")]
    assert floor[2, 2] == 0  # below the block
    assert floor[4, 4] == pytest.approx(0.5)
    assert (direct[:, names.index("block -x")] == 0).all()
    assert top.max() > 20 * 0.5 * (1 - 0.8)  # of the matte part
    # Halfway between projector and camera, which are as high above it.
    assert np.unravel_index(np.argmax(top), top.shape) == (3, 2)
    T = room.transport(room.first_bounce, on_dark="mask")
    assert T.masked.sum() == (direct == 0).sum() > 0
    assert room.matte.area.reshape(direct.shape)[0, names.index("block top"), 0] == pytest.approx(0.3**2 / 25)
    assert room.matte.blocks == (BLOCK,)


def test_black_block_takes_light_away() -> None:
    options: dict[str, Any] = {"projector": PROJECTOR, "camera": CAMERA, "directions": 16, "rays": 16}
    free = glossy(WALLS[:3], 4, **options)
    beside = glossy(WALLS[:3], 4, blocks=[BLOCK], **options)
    of_scene = glossy(box(1, sides=3, occluder=Block(BLOCK.corner, BLOCK.size)), 4, **options)
    assert (of_scene.matrices()[0] == beside.matrices()[0]).all()
    lost = free.matte.form_factors.sum(axis=1) - beside.matte.form_factors.sum(axis=1)
    assert lost.max() > 0.1
    assert (beside.first_bounce == 0).sum() > 0
    with pytest.raises(InputTypeError, match=r"blocks is .* it must be a sequence of ltcl.scenes.Block"):
        glossy(WALLS[:3], 4, blocks=cast(Any, [[(0, 0, 0), (1, 1, 1)]]), **options)


def test_walls_at_any_angle() -> None:
    """Form factors of slanted rhombs by rays, beside the exact ones of `trihedral`."""
    sharp = trihedral(3, angle=70)
    room = glossy(sharp, 3, projector=sharp.viewer.eye, directions=16, rays=256)
    error = np.linalg.norm(room.matte.form_factors - sharp.form_factors)
    assert error < 0.03 * np.linalg.norm(sharp.form_factors)


def test_scene_and_walls_make_the_same_room() -> None:
    options: dict[str, Any] = {"projector": PROJECTOR, "camera": CAMERA, "directions": 16, "rays": 8}
    one, other = glossy(dihedral(2), 2, **options), glossy(WALLS[:2], 2, **options)
    assert (one.matrices()[0] == other.matrices()[0]).all()
    assert other.viewer.eye == CAMERA
    assert (other.sample(np.ones((20, 30))) > 0).all()


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"n": 0}, "n is 0"),
        ({"gloss": -0.1}, "gloss has the value -0.1; all must be at least 0 and at most 1"),
        ({"gloss": [0.2, 1.5]}, "gloss has the value 1.5"),
        ({"gloss": [0.2] * 3}, r"gloss has shape \(3,\); it must be \(\) or \(2,\)"),
        ({"exponent": 0}, "exponent is 0"),
        ({"exponent": [5, -1]}, "exponent is -1"),
        ({"exponent": 1e4}, "raise directions"),
        ({"albedo": 1.0}, r"outside \[0, 1\)"),
        ({"directions": 3}, "directions is 3"),
        ({"rays": 0}, "rays is 0"),
        ({"projector": (0, 0.5, 0.5)}, "projector is at .*, on the wall 'right'"),
        ({"projector": (-1, -1, 0.5)}, "projector is at .*, where it faces none of 2 wall"),
        ({"camera": (-1, -1, 0.5)}, "camera is at .*, where it faces none of 2 wall"),
    ],
)
def test_bad_scenes_are_refused(change: dict[str, Any], part: str) -> None:
    with pytest.raises(InputError, match=part):
        corner(**{"n": 2, **change})


def test_rooms_that_are_none_are_refused() -> None:
    with pytest.raises(InputTypeError, match="room is 5; it must be a scene, or one or more walls"):
        glossy(cast(Any, 5), 2, projector=PROJECTOR)
    with pytest.raises(InputError, match="camera is None; it must be a place"):
        glossy(WALLS[:2], 2, projector=PROJECTOR)


def test_memory_is_checked_before_rays_are_cast(monkeypatch: pytest.MonkeyPatch, scene: GlossyScene) -> None:
    with pytest.raises(MemoryLimitError, match=r"glossy dihedral, 20000000000 patches .* needs"):
        glossy(dihedral(2), 10**5, projector=PROJECTOR)
    monkeypatch.setattr(checks, "host_memory", lambda: 1 << 10)
    with pytest.raises(MemoryLimitError, match="transport of glossy dihedral, 1 of 18 x 18, needs"):
        scene.matrices()
    assert scene.bounces(np.ones(scene.grid), 1).shape == (2, 3, 6)


def test_bad_patterns_are_refused(scene: GlossyScene) -> None:
    with pytest.raises(InputError, match="pattern has shape"):
        scene.bounces(np.ones((2, 2)), 1)
    with pytest.raises(InputError, match="count is -1"):
        scene.bounces(np.ones(scene.grid), -1)
