# SPDX-License-Identifier: BSD-3-Clause
"""Patterns of rounds, which are fine where light is unknown at fine scales."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.estimation.hats import HatLevels
from ltcl.acquisition.scanning.refined_patterns import refined_patterns

LEVELS = 6


@pytest.mark.parametrize("grid", [(4, 4), (5, 9), (16, 32), (33, 70)])
def test_they_are_on_or_off_and_all_different(grid: tuple[int, int]) -> None:
    unknown = np.ones((len(HatLevels(grid).sizes), *grid))
    shown = refined_patterns(unknown, 16, seed=(0, 1))
    again = refined_patterns(unknown, 16, seed=(0, 1))
    other = refined_patterns(unknown, 16, seed=(0, 2))
    assert len({pattern.tobytes() for pattern in (*shown, *other)}) > 28
    np.testing.assert_array_equal(shown, again)
    for pattern in shown:
        assert pattern.shape == grid
        assert set(np.unique(pattern)) <= {0.0, 1.0}
    assert 0.4 < np.mean(shown) < 0.6


@pytest.mark.parametrize("level", [0, 1, 3])
def test_squares_are_of_the_scale_that_is_unknown(level: int) -> None:
    grid = 32, 48
    unknown = np.zeros((LEVELS, *grid))
    unknown[level] = 1.0
    for pattern in refined_patterns(unknown, 4, seed=(1, 1)):
        edges = np.flatnonzero(np.abs(np.diff(pattern, axis=1)).sum(axis=0))
        assert len(edges)
        # Edges of squares are at the same place in each.
        assert len(set(edges % 2**level)) == 1


def test_a_place_is_fine_where_fine_light_is_unknown() -> None:
    grid = 64, 64
    unknown = np.zeros((LEVELS, *grid))
    unknown[5, :, :32] = 1.0
    unknown[0, :, 40:] = 1.0
    shown = np.array(refined_patterns(unknown, 8, seed=(2, 1)))
    changes = np.abs(np.diff(shown, axis=2)).mean(axis=(0, 1))
    assert changes[40:].mean() > 0.3
    assert changes[:30].mean() < 0.05


def test_nothing_unknown_is_no_fault() -> None:
    [pattern] = refined_patterns(np.zeros((3, 4, 4)), 1, seed=(0, 0))
    assert pattern.shape == (4, 4)
