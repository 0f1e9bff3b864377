# SPDX-License-Identifier: BSD-3-Clause
"""Form factors at any angle: closed forms at 90 degrees, closed rooms, sampling, limits, reciprocity."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl import checks
from ltcl.errors import MemoryLimitError
from ltcl.scenes import walls as cube
from ltcl.scenes.box import WALLS
from ltcl.scenes.exchange.oblique import exchange, form_factors
from ltcl.scenes.patches import cut
from ltcl.scenes.walls import Wall
from tests.scenes.slanted import closed_room, sampled_exchange

FLOOR = Wall("floor", corner=(0, 0, 0), right=(0, 1, 0), down=(1, 0, 0))


def slope(angle: float, length: float = 1.0) -> Wall:
    """A wall that rises from the floor's edge along y, `angle` degrees from the floor."""
    up = (length * np.cos(np.radians(angle)), 0.0, length * np.sin(np.radians(angle)))
    return Wall("slope", corner=up, right=(0, 1, 0), down=(-up[0], 0.0, -up[2]))


@pytest.mark.parametrize("n", [1, 2, 9])
def test_faces_of_the_cube_meet_the_closed_forms(n: int) -> None:
    np.testing.assert_allclose(form_factors(WALLS, n), cube.form_factors(WALLS, n), rtol=1e-7, atol=1e-18)


@pytest.mark.parametrize("n", [1, 4])
@pytest.mark.parametrize(
    "edges",
    [
        [(1, 0, 0), (0.5, 0.8, 0), (0.3, 0.2, 0.9)],
        [
            (1, 0, 0),
            (np.cos(np.radians(8)), np.sin(np.radians(8)), 0),
            (0, 0, 1),
        ],  # 8 degrees
        [(1, 0, 0), (0, 0.1, 0), (0.1, 0, 1)],  # patches ten times as long as wide
    ],
)
def test_closed_rooms_lose_no_light(edges: list[tuple[float, float, float]], n: int) -> None:
    walls = closed_room(*edges)
    F, area = form_factors(walls, n), cut(walls, n).area
    np.testing.assert_allclose(F.sum(axis=1), 1, rtol=1e-7)
    assert F.min() >= 0
    np.testing.assert_allclose(area[:, None] * F, (area[:, None] * F).T, rtol=1e-14)


@pytest.mark.parametrize("angle", [1, 20, 60, 89.999, 135, 179])
def test_coarse_patches_average_fine_ones(angle: float) -> None:
    """6 x 6 patches add up to 2 x 2 and to whole walls, though other formulas serve other pairs."""
    fine = exchange(slope(angle), FLOOR, 6)
    coarse = fine.reshape(2, 3, 2, 3, 2, 3, 2, 3).sum(axis=(1, 3, 5, 7))
    np.testing.assert_allclose(coarse, exchange(slope(angle), FLOOR, 2), rtol=1e-7)
    np.testing.assert_allclose(fine.sum(), exchange(slope(angle), FLOOR, 1).item(), rtol=1e-7)


@pytest.mark.parametrize("angle", [30, 75, 120, 160])
def test_walls_at_an_angle_agree_with_sampling(angle: float) -> None:
    mean, error = sampled_exchange(slope(angle), FLOOR, samples=400_000)
    assert exchange(slope(angle), FLOOR, 3).sum() == pytest.approx(mean, abs=5 * error)


def test_a_long_wedge_takes_what_its_opening_lets_go() -> None:
    """Strips of infinite length that share an edge: F = 1 - sin(angle / 2); the ends take 1 / length."""
    for angle in (20, 60, 90, 150):
        found = []
        for length in (200.0, 400.0):
            walls = [
                Wall(wall.name, wall.corner, (0.0, length, 0.0), wall.down) for wall in (slope(angle), FLOOR)
            ]
            found.append(exchange(walls[0], walls[1], 1).item() / length)
        beyond = 2 * found[1] - found[0]
        assert beyond == pytest.approx(1 - np.sin(np.radians(angle / 2)), abs=2e-4)


def test_walls_that_face_away_exchange_nothing() -> None:
    back = Wall("back", corner=(0, 0, 0.5), right=(1, 0, 0), down=(0, 1, 0))  # looks down
    above = Wall("above", corner=(0, 0, 1), right=(0, 1, 0), down=(1, 0, 0))  # looks up
    assert exchange(back, FLOOR, 2).min() > 0
    assert not exchange(above, FLOOR, 2).any()
    assert not exchange(above, back, 2).any()
    assert not exchange(FLOOR, Wall("next", (1, 0, 0), (0, 1, 0), (1, 0, 0)), 3).any()


def test_a_wall_across_the_floor_sees_the_part_in_front() -> None:
    """It stands in the middle of a row of patches; the part beyond shows to neither."""
    across = Wall("across", corner=(0.3, 0, 1), right=(0, 1, 0), down=(0, 0, -1))  # looks along +x
    front = Wall("front", corner=(0.3, 0, 0), right=(0, 1, 0), down=(0.7, 0, 0))
    whole = exchange(across, front, 1).item()
    assert exchange(across, FLOOR, 5).sum() == pytest.approx(whole, rel=1e-9)
    found = exchange(across, FLOOR, 5)
    assert not found[:, :, 0].any()  # behind
    assert found[:, :, 1].min() > 0  # cut


def test_a_slanted_screen_in_the_room_agrees_with_sampling() -> None:
    """No edge in common with the floor, both cut by each other's plane, and not square."""
    screen = Wall("screen", corner=(0.2, 0.3, 0.9), right=(0.3, 0.5, -0.2), down=(0.1, -0.1, -0.6))
    for other in (FLOOR, WALLS[3], WALLS[5]):
        mean, error = sampled_exchange(screen, other, samples=400_000)
        assert exchange(screen, other, 2).sum() == pytest.approx(mean, abs=5 * error)


def test_size_of_the_room_does_not_matter() -> None:
    for scale in (1e-3, 1e3):
        walls = [
            Wall(w.name, *(tuple(scale * np.array(v)) for v in (w.corner, w.right, w.down)))
            for w in (slope(50), FLOOR)
        ]
        np.testing.assert_allclose(form_factors(walls, 2), form_factors((slope(50), FLOOR), 2), rtol=1e-9)


def test_too_many_patches_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "host_memory", lambda: 8 * 18**2 - 1)
    with pytest.raises(MemoryLimitError, match="18 x 18"):
        form_factors((slope(50), FLOOR), 3)
