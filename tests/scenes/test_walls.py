# SPDX-License-Identifier: BSD-3-Clause
"""Walls: geometry, the gathered matrix, and how albedos are spread or refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl import checks
from ltcl.errors import InputError, InputTypeError, MemoryLimitError
from ltcl.scenes.box import WALLS
from ltcl.scenes.exchange.cube_tables import parallel, perpendicular
from ltcl.scenes.walls import Wall, form_factors, spread_albedo


def centre(wall: Wall, n: int, row: int, column: int) -> np.ndarray:
    right, down = np.array(wall.right, float), np.array(wall.down, float)
    return np.array(wall.corner) + (column + 0.5) / n * right + (row + 0.5) / n * down


def test_walls_are_the_six_faces_seen_from_inside() -> None:
    for wall in WALLS:
        middle = centre(wall, 1, 0, 0)
        assert np.array([0.5, 0.5, 0.5]) - middle == pytest.approx(wall.normal / 2)
    assert len({tuple(wall.normal) for wall in WALLS}) == 6


def test_upright_walls_unroll_seamlessly() -> None:
    """left, right, near right, near left: each begins where the one before ends."""
    around = [WALLS[k] for k in (0, 1, 4, 5)]
    for wall, following in zip(around, around[1:] + around[:1], strict=True):
        assert np.add(wall.corner, wall.right).tolist() == list(following.corner)


def test_wall_without_area_is_refused() -> None:
    with pytest.raises(InputError, match=r"wall 'flat' .* no area"):
        Wall("flat", corner=(0, 0, 0), right=(1, 0, 0), down=(2, 0, 0))


def test_every_entry_belongs_to_its_pair_of_patches() -> None:
    """Offsets recomputed in space, from centres and normals, for random pairs."""
    n, rng = 5, np.random.default_rng(3)
    F, meeting, facing = form_factors(WALLS, n), perpendicular(n), parallel(n, gap=n)
    for _ in range(300):
        (a, r, c), (b, s, d) = rng.integers((6, n, n), size=(2, 3))
        apart = np.abs(centre(WALLS[a], n, r, c) - centre(WALLS[b], n, s, d)) * n
        across = np.abs(WALLS[a].normal) + np.abs(WALLS[b].normal) > 0
        if a == b:
            expected = 0.0
        elif across.sum() == 1:
            expected = facing[tuple(np.round(apart[~across]).astype(int))]
        else:
            p, q = np.round(apart[across] - 0.5).astype(int)
            expected = meeting[round(apart[~across].item()), p, q]
        assert F[r * 6 * n + a * n + c, s * 6 * n + b * n + d] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("n", [1, 3, 10])
def test_closed_box_loses_no_light_and_is_reciprocal(n: int) -> None:
    F = form_factors(WALLS, n)
    assert F.sum(axis=1) == pytest.approx(np.ones(len(F)), abs=1e-10)
    assert (F == F.T).all()  # equal areas: a_i F_ij = a_j F_ji
    assert (F >= 0).all()


def test_form_factors_that_do_not_fit_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "host_memory", lambda: 10**6)
    with pytest.raises(MemoryLimitError, match="600 x 600 matrix of form factors needs"):
        form_factors(WALLS, 10)


COLOURS = np.array([(0.1, 0.2, 0.3), (0.4, 0.5, 0.6)])


@pytest.mark.parametrize(
    ("albedo", "expected"),  # of the first patch of each of two walls, (channels, walls)
    [
        (0.5, [[0.5, 0.5]]),
        ([0.5, 0.25], [[0.5, 0.25]]),
        ([0.1, 0.2, 0.3], [[0.1, 0.1], [0.2, 0.2], [0.3, 0.3]]),
        ([[0.1, 0.2, 0.3]], [[0.1, 0.1], [0.2, 0.2], [0.3, 0.3]]),
        ([[0.5], [0.25]], [[0.5, 0.25]]),
        (COLOURS, COLOURS.T),
        (0, [[0.0, 0.0]]),
    ],
)
def test_albedo_is_spread_over_walls_and_colours(albedo: Any, expected: Any) -> None:
    patches = spread_albedo(albedo, walls=2, n=3)
    pictures = patches.reshape(-1, 3, 2, 3)  # (channels, row, wall, column)
    assert pictures.tolist() == np.broadcast_to(np.array(expected)[:, None, :, None], pictures.shape).tolist()


@pytest.mark.parametrize(
    ("albedo", "walls", "part"),
    [
        ([0.1, 0.2, 0.3], 3, r"one per wall, or one colour\? .* \(3, 1\) .* \(1, 3\)"),
        ([0.1, 0.2], 3, r"shape \(2,\)"),
        (np.zeros((2, 2)), 2, r"shape \(2, 2\)"),
        (1.0, 2, r"outside \[0, 1\), the first 1;"),
        ([0.5, -0.25], 2, "the first -0.25;"),
        ([0.5, np.nan], 2, "albedo has 1 NaN"),
    ],
)
def test_bad_albedos_are_refused(albedo: Any, walls: int, part: str) -> None:
    with pytest.raises(InputError, match=part):
        spread_albedo(albedo, walls=walls, n=2)


def test_three_walls_take_an_explicit_shape() -> None:
    mono = spread_albedo([[0.1], [0.2], [0.3]], walls=3, n=1)
    colour = spread_albedo([[0.1, 0.2, 0.3]], walls=3, n=1)
    assert mono.tolist() == [[0.1, 0.2, 0.3]]
    assert colour.tolist() == [[0.1] * 3, [0.2] * 3, [0.3] * 3]


def test_albedo_must_be_numbers() -> None:
    with pytest.raises(InputTypeError, match="albedo is"):
        spread_albedo("white", walls=2, n=2)
