# SPDX-License-Identifier: BSD-3-Clause
"""Bins of directions: the map keeps areas, undoes itself, and bins hold equal projected solid angles."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.errors import InputError
from ltcl.scenes.gloss import directions


def test_square_to_directions_and_back() -> None:
    square = np.random.default_rng(0).random((500, 2))
    vectors = directions.from_square(square)
    assert np.linalg.norm(vectors, axis=1) == pytest.approx(1)
    assert (vectors[:, 2] >= 0).all()
    assert directions.to_square(vectors) == pytest.approx(square, abs=1e-12)


def test_edge_of_the_square_is_the_horizon() -> None:
    edge = np.array([[0, 0.3], [1, 0.9], [0.2, 0], [0.7, 1], [0, 0], [1, 0]])
    assert directions.from_square(edge)[:, 2] == pytest.approx(0, abs=1e-7)


@pytest.mark.parametrize("k", [2, 3, 8])
def test_bins_hold_equal_projected_solid_angles(k: int) -> None:
    """Directions of a cosine law, made by rejection from a cube: each bin gets its share."""
    points = np.random.default_rng(1).uniform(-1, 1, (200_000, 2))
    points = points[(points**2).sum(axis=1) < 1]
    vectors = np.column_stack([points, np.sqrt(1 - (points**2).sum(axis=1))])
    counts = np.bincount(directions.bins(vectors, k), minlength=k * k)
    expected = len(points) / k**2
    assert counts == pytest.approx(np.full(k * k, expected), abs=5 * expected**0.5)


def test_lattice_lies_in_its_bins_and_its_mean_cosine_is_that_of_a_uniform_sky() -> None:
    places = directions.lattice(6, points=4)
    assert (directions.bins(places, 6) == np.arange(36)[:, None]).all()
    # The midpoint rule is off by a step to 1.5 here, as z falls to the horizon like a root.
    assert places[..., 2].mean() == pytest.approx(2 / 3, abs=(1 / 24) ** 1.5)


@pytest.mark.parametrize(
    ("value", "part"),
    [
        (3, "directions is 3; it must be a whole number of at least 4"),
        (0, "directions is 0"),
        (60, "directions is 60; it must be a square number"),
        (16.0, "directions is 16.0"),
    ],
)
def test_other_numbers_of_directions_are_refused(value: Any, part: str) -> None:
    with pytest.raises(InputError, match=part):
        directions.side(value)
