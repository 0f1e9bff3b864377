# SPDX-License-Identifier: BSD-3-Clause
"""Patches of walls: order, places, edges."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.errors import InputError
from ltcl.scenes.box import WALLS
from ltcl.scenes.patches import cut


def test_patches_lie_in_the_order_of_the_picture() -> None:
    n = 3
    patches = cut(WALLS, n)
    for r, w, c in [(0, 0, 0), (2, 1, 0), (1, 5, 2)]:
        wall = WALLS[w]
        number = r * len(WALLS) * n + w * n + c
        expected = (
            np.array(wall.corner) + (c + 0.5) / n * np.array(wall.right) + (r + 0.5) / n * np.array(wall.down)
        )
        np.testing.assert_allclose(patches.centre[number], expected)
        np.testing.assert_allclose(patches.normal[number], wall.normal)


def test_areas_add_up_to_those_of_the_walls() -> None:
    patches = cut(WALLS[:5], 4)
    assert len(patches) == 5 * 16
    np.testing.assert_allclose(patches.area.sum(), 5.0)


def test_no_patches_are_refused() -> None:
    with pytest.raises(InputError, match="n is 0"):
        cut(WALLS, 0)
    with pytest.raises(InputError, match="walls is empty"):
        cut([], 2)
