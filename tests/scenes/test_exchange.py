# SPDX-License-Identifier: BSD-3-Clause
"""Exact form factors: closed forms at right angles, closed rooms, parts, sampling, limits."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.scenes import cut
from ltcl.scenes.builders import WALLS
from ltcl.scenes.exchange import exchange_of_walls, form_factors, form_factors_of_pairs
from ltcl.scenes.walls import Vector, Wall
from tests.scenes.closed_forms import closed_room, parallel, perpendicular, sampled, slope

FLOOR = WALLS[2]
X = (1.0, 0.0, 0.0)
Y = (0.0, 1.0, 0.0)
Z = (0.0, 0.0, 1.0)


@pytest.mark.parametrize("n", [1, 2, 7])
def test_faces_of_the_cube_meet_the_closed_forms(n: int) -> None:
    """All pairs of all walls, which touch along an edge, at a corner, or lie apart."""
    patches = cut(WALLS, n)
    meeting = perpendicular(n)
    facing = parallel(n, n)
    F = form_factors(WALLS, n)
    apart = np.abs(patches.centre[:, None] - patches.centre) * n
    across = (np.abs(patches.normal[:, None]) + np.abs(patches.normal)) > 0.5
    for i, j in np.random.default_rng(0).integers(len(F), size=(300, 2)):
        along = apart[i, j][~across[i, j]]
        away = apart[i, j][across[i, j]]
        if len(along) == 2:
            expected = facing[tuple(np.round(along).astype(int))] if away[0] > 0.5 else 0.0
        else:
            expected = meeting[(round(along.item()), *np.round(away - 0.5).astype(int))]
        assert F[i, j] == pytest.approx(expected, rel=1e-9, abs=1e-15)


@pytest.mark.parametrize("angle", [1, 20, 60, 89.999, 135, 179])
def test_coarse_patches_average_fine_ones(angle: float) -> None:
    """6 x 6 patches add up to 2 x 2 and to whole walls, though other formulas serve other pairs."""
    fine = exchange_of_walls(slope(angle), FLOOR, 6)
    for n in (1, 2):
        coarse = fine.reshape(4 * [n, 6 // n]).sum(axis=(1, 3, 5, 7))
        np.testing.assert_allclose(coarse, exchange_of_walls(slope(angle), FLOOR, n), rtol=1e-7)


TEN_TIMES = [X, (0, 0.1, 0), (0.1, 0, 1)]  # patches ten times as long as wide
NARROW = [X, (float(np.cos(np.radians(8))), float(np.sin(np.radians(8))), 0.0), Z]


@pytest.mark.parametrize(
    "edges", [[X, (0.5, 0.8, 0), (0.3, 0.2, 0.9)], NARROW, TEN_TIMES, [X, Y, Z]]
)
@pytest.mark.parametrize("n", [1, 4, 9])
def test_closed_rooms_lose_no_light(edges: list[Vector], n: int) -> None:
    walls = closed_room(*edges)
    F = form_factors(walls, n)
    area = cut(walls, n).area
    np.testing.assert_allclose(F.sum(axis=1), 1, rtol=1e-7 if edges[-1] != Z else 1e-9)
    assert F.min() >= 0
    np.testing.assert_allclose(area[:, None] * F, (area[:, None] * F).T, rtol=1e-14)
    if n < 9:  # pairs of a list take outlines, however far
        i, j = np.nonzero(F)
        np.testing.assert_allclose(
            form_factors_of_pairs(cut(walls, n), i, j), F[i, j], rtol=1e-6, atol=1e-12
        )


# No edge in common with the others, cut by their planes and not square.
SCREEN = Wall("screen", (0.2, 0.3, 0.9), (0.3, 0.5, -0.2), (0.1, -0.1, -0.6))


@pytest.mark.parametrize(
    "walls", [(slope(30), FLOOR), (slope(120), FLOOR), (SCREEN, FLOOR), (SCREEN, WALLS[5])]
)
def test_walls_at_any_angle_agree_with_sampling(walls: tuple[Wall, Wall]) -> None:
    mean, error = sampled(*walls, samples=400_000)
    assert exchange_of_walls(*walls, 2).sum() == pytest.approx(mean, abs=5 * error)


def test_a_long_wedge_takes_what_its_opening_lets_go() -> None:
    """Strips of infinite length with a shared edge: F = 1 - sin(angle / 2); ends: 1 / length."""
    floors = [
        Wall("floor", FLOOR.corner, (0.0, length, 0.0), FLOOR.down) for length in (200.0, 400.0)
    ]
    for angle in (20, 60, 90, 150):
        short, long = (
            exchange_of_walls(slope(angle, width=f.right[1]), f, 1).item() / f.right[1]
            for f in floors
        )
        edge = 2 * long - short
        assert edge == pytest.approx(1 - np.sin(np.radians(angle / 2)), abs=2e-4)
