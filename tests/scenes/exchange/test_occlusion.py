# SPDX-License-Identifier: BSD-3-Clause
"""A room with a block: energy, reciprocity, shadows against sampling, what the viewer sees, refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.device import Device
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.scenes import Block, FormFactor, Scene, box, cut
from ltcl.scenes.box import WALLS
from ltcl.scenes.exchange.occlusion import form_factors, lit_faces
from ltcl.scenes.viewer import frame
from tests.scenes.slanted import sampled_exchange

N = 4
TABLE = Block(corner=(0.3, 0.35, 0), size=(0.35, 0.3, 0.5), albedo=0.6)
LAMP = Block(corner=(0.31, 0.27, 0.2), size=(0.33, 0.41, 0.37), albedo=(0.9, 0.5, 0.2))


def sums(F: np.ndarray, n: int) -> np.ndarray:
    """Row sums by wall, (walls, n, n)."""
    return F.sum(axis=1).reshape(n, -1, n).swapaxes(0, 1)


@pytest.mark.parametrize("n", [4, 7])
def test_a_closed_room_with_a_block_in_it_loses_no_light(device: Device, n: int) -> None:
    rows = sums(form_factors(WALLS, lit_faces(LAMP), LAMP, n, device), n)
    assert len(rows) == 12
    assert rows.max() <= 1 + 1e-12
    assert rows[:6].min() > 0.99
    assert np.abs(rows[:6] - 1).mean() < 3e-3
    assert rows[6:].min() > 0.999  # its faces: exact before rows of the room were scaled


def test_the_floor_under_a_block_is_dark(device: Device) -> None:
    """Of the floor that share gives light which the block does not cover."""
    n = 10
    rows = sums(form_factors(WALLS, lit_faces(TABLE), TABLE, n, device), n)
    floor, others = rows[2], np.delete(rows, 2, axis=0)
    assert others.min() > 0.99
    assert floor.mean() == pytest.approx(1 - 0.35 * 0.3, abs=2e-3)
    assert not floor[4:6, 4:6].any()
    assert floor[0] == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("block", [TABLE, LAMP])
def test_exchange_of_walls_past_a_block_agrees_with_sampling(device: Device, block: Block) -> None:
    faces = lit_faces(block)
    F = form_factors(WALLS, faces, block, N, device).reshape(N, 6 + len(faces), N, N, 6 + len(faces), N)
    every = (*WALLS, *faces)
    for i, j in ((0, 4), (1, 5), (2, 3), (0, 5), (2, 4), (1, 6), (3, 10), (2, 6)):
        mean, error = sampled_exchange(every[i], every[j], 100_000, block)
        found = F[:, i, :, :, j].sum() * every[i].area / N**2
        assert found == pytest.approx(mean, abs=5 * error + 5e-3 * mean), (every[i].name, every[j].name)


def test_the_operator_that_stores_no_matrix_gives_the_same_bounce(device: Device) -> None:
    """Another code, with other formulas and other rays."""
    scene = box(8, occluder=LAMP, device=device)
    bounce = FormFactor(cut(scene.walls, 8), blocks=[(LAMP.low, LAMP.high)], device=device)
    light = np.random.default_rng(0).random(len(scene.area))
    found, expected = bounce @ light, scene.form_factors @ light
    assert np.linalg.norm(found - expected) < 0.01 * np.linalg.norm(expected)


def test_reciprocity_is_exact(device: Device) -> None:
    scene = box(N, occluder=LAMP, device=device)
    exchange = scene.area[:, None] * scene.form_factors
    np.testing.assert_allclose(exchange, exchange.T, rtol=1e-13)
    (T, *_) = scene.matrices()
    weighted = T / scene.area
    np.testing.assert_allclose(weighted, weighted.T, rtol=1e-9, atol=1e-12)


def test_a_partition_makes_two_rooms(device: Device) -> None:
    """Wall to wall: two faces are left, neither room sees the other, and both are closed."""
    partition = Block(corner=(0.25, 0, 0), size=(0.25, 1, 1), albedo=0.5)
    scene = box(N, occluder=partition, device=device)
    assert [wall.name for wall in scene.walls[6:]] == ["block +x", "block -x"]
    F = scene.form_factors.reshape(N, 8, N, N, 8, N)
    assert not F[:, 1, :, :, 5].any()
    assert not F[:, 5, :, :, 6 + 1].any()
    assert F[:, 5, :, :, 6].min() > 0
    rows = sums(scene.form_factors, N)
    assert rows[[1, 5, 6, 7]] == pytest.approx(1, abs=0.01)
    floor = rows[2]  # its rows lie at x = 1/8, 3/8, ...: the second is covered
    assert not floor[1].any()
    assert floor[[0, 2, 3]] == pytest.approx(1, abs=0.01)


def test_a_black_block_takes_light_away(device: Device) -> None:
    black = Block(TABLE.corner, TABLE.size)
    dark, lit, empty = (box(N, occluder=block, device=device) for block in (black, TABLE, None))
    assert dark.grid == empty.grid == (N, 6 * N)
    assert (dark.form_factors <= empty.form_factors).all()
    room = np.arange(len(lit.area)) // N % 11 < 6
    np.testing.assert_array_equal(lit.form_factors[np.ix_(room, room)] <= empty.form_factors, True)
    glow = [np.sum(scene.matrices()[0][:96]) for scene in (dark, empty)]
    assert glow[0] < 0.9 * glow[1]


def test_a_speck_changes_nothing(device: Device) -> None:
    speck = Block(corner=(0.5, 0.5, 0.5), size=(1e-4, 1e-4, 1e-4))
    found = form_factors(WALLS, (), speck, N, device)
    np.testing.assert_allclose(found, box(N).form_factors, atol=1e-4)


def test_colours_of_room_and_block_go_together(device: Device) -> None:
    grey = box(2, sides=2, albedo=0.5, occluder=LAMP, device=device)
    assert grey.channels == 3
    picture = grey.picture(grey.first_bounce)
    assert picture.shape == (2, 16, 3)
    assert picture[1, 3].tolist() == [0.5, 0.5, 0.5]
    assert picture[0, 4].tolist() == [0.9, 0.5, 0.2]
    coloured = box(2, sides=2, albedo=[(0.1, 0.2, 0.3), (0.4, 0.5, 0.6)], occluder=TABLE, device=device)
    assert coloured.picture(coloured.first_bounce)[1, [0, 2, -1]].tolist() == [
        [0.1, 0.2, 0.3],
        [0.4, 0.5, 0.6],
        [0.6, 0.6, 0.6],
    ]
    assert coloured.area[0] == 0.25
    assert coloured.area[4] == pytest.approx(0.3 * 0.5 / 4)  # its face +x


def look(scene: Scene, point: tuple[float, float, float], values: np.ndarray) -> float:
    """What the viewer sees in the direction of a point."""
    image = scene.view(values, size=400, supersample=1)
    ends = [scene.viewer.eye, scene.viewer.target]
    forward = np.subtract(ends[1], ends[0])
    right = np.cross(forward, (0, 0, 1))
    axes = np.stack([right, np.cross(forward, right), forward])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    x, y, depth = axes @ np.subtract(point, ends[0])
    visible = frame(scene.viewer, (*scene.walls, *(face for b in scene.blocks for face in b.faces())))
    scale = visible.scale(*image.shape)
    column = (x / depth - visible.centre[0]) * scale + image.shape[1] / 2
    row = (y / depth - visible.centre[1]) * scale + image.shape[0] / 2
    return float(image[int(row), int(column)])


def test_the_block_hides_what_is_behind_it(device: Device) -> None:
    scene = box(N, sides=3, occluder=TABLE, device=device)
    numbers = np.repeat(np.arange(1.0, 9.0), N)[None, :] * np.ones((N, 1))  # a number for each wall
    assert look(scene, (0.65, 0.5, 0.25), numbers) == 4  # +x
    assert look(scene, (0.5, 0.65, 0.25), numbers) == 6  # +y
    assert look(scene, (0.5, 0.5, 0.5), numbers) == 8  # top
    assert look(scene, (0.1, 0.9, 0.05), numbers) == 3  # the floor beside it
    behind = np.array((0.6, 0.6, 0.5)) + 0.3 * np.subtract((0.6, 0.6, 0.5), scene.viewer.eye)
    assert look(scene, tuple(behind), numbers) == 8
    black = box(N, sides=3, occluder=Block(TABLE.corner, TABLE.size), device=device)
    assert look(black, (0.65, 0.5, 0.25), numbers[:, :12]) == 0
    assert look(black, (0.1, 0.9, 0.05), numbers[:, :12]) == 3


def test_hidden_patches_sample_nothing(device: Device) -> None:
    scene = box(10, sides=3, occluder=TABLE, device=device)
    picture = scene.sample(np.ones((300, 300)))
    floor, top = picture[:, 20:30], picture[:, -10:]
    assert not floor[4:6, 4:6].any()  # under the block
    assert floor[9] == pytest.approx(1)
    assert top == pytest.approx(1)
    assert not picture[:, 40:50].any()  # its face -x, seen from behind


def test_a_lamp_above_casts_the_blocks_shadow(device: Device) -> None:
    scene = box(20, sides=3, occluder=TABLE, device=device)
    floor = scene.irradiance((0.475, 0.5, 0.99))[:, 40:60]
    dark = floor == 0
    assert dark[6:13, 7:13].all()  # under it
    assert 0.3 * 0.35 < dark.mean() < 4.5 * 0.3 * 0.35  # the shadow of its top, at half the lamp's height
    assert scene.irradiance((0.475, 0.5, 0.99))[:, -20:].min() > 0  # the top is lit


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ({"occluder": Block((0.8, 0, 0), (0.3, 0.1, 0.1))}, "occluder reaches from .* out of the room"),
        (
            {"occluder": Block((0.5, 0.5, -0.01), (0.1, 0.1, 0.1))},
            r"must stay within \(0, 0, 0\) and \(1, 1, 1\)",
        ),
        ({"occluder": Block((0, 0, 0), (1, 1, 1))}, "occluder fills the room"),
        ({"occluder": (0.1, 0.1, 0.1)}, "occluder is .*; it must be an ltcl.scenes.Block"),
        ({"sides": 0}, "sides is 0"),
        ({"sides": 7}, "sides is 7; it must be at most 6"),
        ({"n": 0}, "n is 0"),
        ({"albedo": 1.0}, r"outside \[0, 1\)"),
    ],
)
def test_bad_rooms_are_refused(arguments: dict[str, Any], part: str) -> None:
    with pytest.raises((InputError, InputTypeError), match=part):
        box(**{"n": 2, "occluder": TABLE, **arguments})
    with pytest.raises(MemoryLimitError, match=r"box with 6 side\(s\) and a block, .* needs"):
        box(10**5, occluder=TABLE)


def test_no_block_no_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LTCL_DEVICE", "none such")
    assert box(2).grid == (2, 12)
