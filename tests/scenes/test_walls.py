# SPDX-License-Identifier: BSD-3-Clause
"""Walls, blocks and patches: places, order, how albedos are spread, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.scenes import Block, cut
from ltcl.scenes.builders import WALLS
from ltcl.scenes.walls import spread_albedo

FLOOR = WALLS[2]
BLOCK = Block(corner=(0.2, 0.3, 0.1), size=(0.4, 0.3, 0.5))


def test_patches_lie_in_the_order_of_the_picture() -> None:
    n, patches = 3, cut(WALLS, 3)
    assert patches.area.sum() == pytest.approx(6)
    for r, w, c in [(0, 0, 0), (2, 1, 0), (1, 5, 2)]:
        wall, number = WALLS[w], r * len(WALLS) * n + w * n + c
        right, down = np.array([wall.right, wall.down]) / n
        np.testing.assert_allclose(patches.centre[number], wall.corner + (c + 0.5) * right + (r + 0.5) * down)
        np.testing.assert_allclose(patches.normal[number], wall.normal)
        np.testing.assert_allclose(patches.frames[number] @ patches.frames[number].T, np.eye(3), atol=1e-15)


def test_faces_of_a_block_look_outwards_and_close_it() -> None:
    middle, flux = (BLOCK.low + BLOCK.high) / 2, 0.0
    for face in BLOCK.faces():
        outwards = face.outline.mean(axis=0) - middle
        np.testing.assert_allclose(np.cross(outwards, face.normal), 0, atol=1e-15)
        assert outwards @ face.normal > 0
        assert (np.abs(face.outline - middle) <= np.array(BLOCK.size) / 2 + 1e-12).all()
        flux += face.area * (outwards + middle) @ face.normal / 3
    assert flux == pytest.approx(0.4 * 0.3 * 0.5)  # the volume, by Gauss' theorem


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
    ],
)
def test_albedo_is_spread_over_walls_and_colours(albedo: Any, expected: Any) -> None:
    pictures = spread_albedo(albedo, walls=2, n=3).reshape(-1, 3, 2, 3)  # (channels, row, wall, column)
    assert pictures.tolist() == np.broadcast_to(np.array(expected)[:, None, :, None], pictures.shape).tolist()
