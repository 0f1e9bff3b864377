# SPDX-License-Identifier: BSD-3-Clause
"""What a pixel out of focus lights around it, before and after the projector has moved."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.geometry import Correspondence, Resampling
from ltcl.acquisition.updating.focus import MIDDLE, Optics, find_focus
from ltcl.acquisition.updating.movement import Movement

GRID = (16, 20)
# Camera pixels along each side of a projector pixel.
PIXELS = 3.1


def mapping(movement: Movement) -> Correspondence:
    """The map of a camera that sees all of the picture, and no more."""
    shape = [int(side * PIXELS) for side in GRID]
    row, column = np.indices(shape)
    places = movement.forward((row + 0.5) / PIXELS - 0.5, (column + 0.5) / PIXELS - 0.5)
    y, x = (place.astype(np.float32) for place in places)
    valid = (y > -0.5) & (y < GRID[0] - 0.5) & (x > -0.5) & (x < GRID[1] - 0.5)
    return Correspondence(x, y, valid, GRID)


def optics(movement: Movement) -> Optics:
    """The same camera, after the projector has moved."""
    return Optics(
        mapping=mapping(Movement.shift(GRID)),
        resampling=Resampling.of(mapping(movement)),
        movement=movement,
        width=1 / PIXELS,
    )


def test_a_blur_is_found_and_moved() -> None:
    still = optics(Movement.shift(GRID))
    moved = optics(Movement.shift(GRID, 0.5, -0.3))
    paint = np.random.default_rng(0).uniform(0.2, 1.0, (16 * 20, 1))
    near = paint * still.flat_wall(0.2)
    focus = find_focus(near, still.mapping, still.resampling, moved.resampling, moved.movement)
    assert focus is not None
    np.testing.assert_allclose(focus.before, still.flat_wall(0.2), atol=2e-3)
    np.testing.assert_allclose(focus.now, moved.flat_wall(0.2), atol=2e-3)
    # The own light of pixels changes with the places of the camera's pixels on them.
    inside = np.zeros(GRID, bool)
    inside[3:-3, 3:-3] = True
    pixels = np.flatnonzero(inside)
    change = np.abs(focus.now - focus.before)[pixels, MIDDLE]
    assert change.max() > 0.03
    rows = np.eye(len(near))
    moved_light = focus.refocused(near, rows)[pixels]
    np.testing.assert_allclose(moved_light, (paint * focus.now)[pixels], atol=5e-3)
    ratio = focus.now[pixels, MIDDLE] / focus.before[pixels, MIDDLE]
    assert focus.own_change(rows)[pixels] == pytest.approx(ratio)


def test_a_sharp_picture_has_no_blur_to_be_found() -> None:
    still = optics(Movement.shift(GRID))
    near = np.zeros((16 * 20, 25))
    near[:, MIDDLE] = 1.0
    movement = Movement.shift(GRID, 0.5, -0.3)
    assert find_focus(near, still.mapping, still.resampling, still.resampling, movement) is None
    assert find_focus(0 * near, still.mapping, still.resampling, still.resampling, movement) is None
