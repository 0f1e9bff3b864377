# SPDX-License-Identifier: BSD-3-Clause
"""Form factors of near pairs against closed forms, closed rooms and their parts; which pairs are found."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.scenes.box import WALLS
from ltcl.scenes.exchange import near
from ltcl.scenes.patches import Patches, cut
from ltcl.scenes.walls import Vector, Wall, form_factors


@pytest.mark.parametrize(("n", "sides"), [(1, 2), (1, 6), (3, 6), (8, 3)])
def test_cube_faces_meet_their_closed_forms(n, sides):
    patches, exact = cut(WALLS[:sides], n), form_factors(WALLS[:sides], n)
    i, j = near.pairs(patches, 5.0)
    np.testing.assert_allclose(near.form_factors(patches, i, j), exact[i, j], rtol=1e-6)
    np.testing.assert_allclose(near.form_factors(patches, j, i), exact[j, i], rtol=1e-6)
    # Every pair within 5 patch sides that exchanges light is found, once.
    distance = n * np.linalg.norm(patches.centre[:, None] - patches.centre, axis=2)
    wanted = np.triu((distance < 5 * (1 - 1e-9)) & (exact > 0))
    found = np.zeros_like(wanted)
    found[i, j] = True
    assert len(i) == np.count_nonzero(found)
    assert not np.any(wanted & ~found)
    assert distance[i, j].max() <= 5 * (1 + 1e-9)


def turned(angle: float, width: float = 1.0) -> list[Wall]:
    """A floor and a wing that share an edge along y, `angle` degrees between them, seen from between."""
    t = np.deg2rad(angle)
    wing: Vector = (float(width * np.cos(t)), 0, float(width * np.sin(t)))
    return [Wall("floor", (0, 0, 0), (0, 1, 0), (1, 0, 0)), Wall("wing", (0, 0, 0), wing, (0, 1, 0))]


def leaning(angle: float) -> list[Wall]:
    """The inside of a parallelepiped whose floor and left side enclose `angle` degrees."""
    t = np.deg2rad(angle)
    x, y = np.eye(3)[:2]
    up = np.array([np.cos(t), 0, np.sin(t)])

    def wall(corner: np.ndarray, right: np.ndarray, down: np.ndarray) -> Wall:
        a, b, c = (tuple(float(part) for part in vector) for vector in (corner, right, down))
        return Wall("", (a[0], a[1], a[2]), (b[0], b[1], b[2]), (c[0], c[1], c[2]))

    return [
        wall(0 * x, y, x),
        wall(up, x, y),
        wall(0 * x, up, y),
        wall(x, y, up),
        wall(0 * x, x, up),
        wall(y, up, x),
    ]


def matrix(patches: Patches) -> np.ndarray:
    """All form factors, however far."""
    F = np.zeros((len(patches), len(patches)))
    i, j = np.triu_indices(len(patches), 1)
    F[i, j], F[j, i] = near.form_factors(patches, i, j), near.form_factors(patches, j, i)
    return F


@pytest.mark.parametrize("angle", [30, 60, 90, 110, 150])
@pytest.mark.parametrize("n", [1, 2])
def test_closed_rooms_lose_no_light(angle, n):
    """Six parallelograms that touch at angles and their supplements: rows of F sum to 1."""
    patches = cut(leaning(angle), n)
    F = matrix(patches)
    np.testing.assert_allclose(F.sum(axis=1), 1, atol=1e-7)
    exchange = patches.area[:, None] * F
    np.testing.assert_allclose(exchange, exchange.T, rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize("angle", [20, 60, 120, 160])
def test_parts_add_up_to_the_whole(angle):
    """F of two patches is the mean over the parts of one of the sum over the parts of the other."""
    whole, parts = cut(turned(angle, width=3), 1), cut(turned(angle, width=3), 3)
    first = np.arange(18) // 3 % 2 == 0
    total = matrix(parts)[np.ix_(first, ~first)].sum(axis=1).mean()
    assert matrix(whole)[0, 1] == pytest.approx(total, rel=1e-6)


def test_far_patches_see_a_disc_of_their_area():
    """Between distant facing patches F is area / (pi r^2)."""
    square = np.eye(3)[None]
    patches = Patches(
        np.array([[0, 0, 0], [0, 0, 50.0]]),
        np.concatenate([square[:, 1], square[:, 0]]),
        np.concatenate([square[:, 0], square[:, 1]]),
    )
    F = near.form_factors(patches, np.array([0]), np.array([1]))
    assert F[0] == pytest.approx(1 / (np.pi * 2500), rel=1e-3)


def test_patches_that_turn_away_are_no_pairs_and_see_nothing():
    outside = turned(270)  # beyond 180 degrees the two show each other their backs
    patches = cut(outside, 2)
    i, j = np.triu_indices(len(patches), 1)
    assert len(near.pairs(patches, 10.0)[0]) == 0
    assert near.form_factors(patches, i, j).max() < 1e-15


def test_planes_that_cut_a_patch_hide_a_part_of_it():
    """A wall half of which is under the floor: the floor sees the upper half alone."""
    floor = Wall("floor", (0, 0, 0), (0, 1, 0), (1, 0, 0))
    whole = Wall("whole", (-1, 0, -1), (0, 0, 2), (0, 1, 0))
    upper = Wall("upper", (-1, 0, 0), (0, 0, 1), (0, 1, 0))
    found, expected = (matrix(cut((floor, wall), 1))[0, 1] for wall in (whole, upper))
    assert expected > 0.01
    assert found == pytest.approx(expected, rel=1e-7)


def test_no_pairs():
    patches = cut(WALLS[:1], 3)
    i, j = near.pairs(patches, 5.0)
    assert len(i) == len(j) == len(near.form_factors(patches, i, j)) == 0
