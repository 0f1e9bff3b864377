# SPDX-License-Identifier: BSD-3-Clause
"""Maps from Gray code against the truth: smooth ones, the rim, folds and occluders."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import Shots, VirtualRig, camera_map
from ltcl.acquisition.geometry import GrayCode, Resampling, decode
from tests.acquisition.geometry.scenes import homography, photographs, places, turned
from tests.acquisition.scanning.helpers import corner

GRID = (8, 16)
CAMERA = (30, 60)
random = np.random.default_rng()


@pytest.mark.parametrize(
    ("camera", "grid", "noise", "limit"),
    [
        ((180, 230), (96, 128), 0.01, 0.08),  # whole numbers deviate by 0.41
        # Projector pixels as large as camera pixels, and half as large: of a camera pixel a tenth
        # at most.
        ((180, 230), (180, 230), 0.003, 0.03),
        ((180, 230), (300, 400), 0.003, 0.05),
        ((6, 162), (1, 40), 0.001, 0.25),
        ((162, 6), (40, 1), 0.001, 0.25),
    ],
)
def test_known_maps_to_a_fraction_of_a_pixel(camera, grid, noise, limit):
    place = homography(camera, grid)
    mapping = decode(list(photographs(place, camera, grid, noise, random)), grid)
    x, y = places(place, camera)
    assert mapping.decoded > (0.99 if min(grid) > 3 else 0.9)
    square = (mapping.x - x * (grid[1] > 1)) ** 2 + (mapping.y - y * (grid[0] > 1)) ** 2
    assert np.sqrt(np.mean(square[mapping.valid])) < limit


@pytest.mark.parametrize(
    ("size", "turn", "shift"),
    [
        (4.0, 0.0, (-0.5, -0.9)),
        (3.7, -0.08, (0.9, -0.7)),
        (3.1, 0.0, (0.6, 0.2)),
        (3.3, 0.1, (-0.2, 0.8)),
    ],
)
def test_places_and_light_are_known_up_to_the_rim(size, turn, shift) -> None:
    place, camera = turned(GRID, size, turn, shift)
    C = camera_map(place, camera, GRID, points=24)
    mapping = decode([(C @ p.ravel()).reshape(camera) for p in GrayCode(GRID).patterns()], GRID)
    x, y = places(place, camera)
    deviation = np.hypot(mapping.x - x, mapping.y - y)
    h, w = GRID
    valid = mapping.valid
    rim = valid & ((np.minimum(x, w - 1 - x) < 0.5) | (np.minimum(y, h - 1 - y) < 0.5))
    assert rim.sum() > 100
    assert np.sqrt(np.mean(deviation[rim] ** 2)) < 0.04
    assert deviation[rim].max() < 0.08
    assert np.sqrt(np.mean(deviation[valid & ~rim] ** 2)) < 0.03
    R = Resampling.of(mapping)
    area = np.asarray(C.sum(axis=0)).reshape(GRID)
    assert R.seen[area > 0.97 * area.max()].all()
    for p in random.random((3, np.prod(GRID))):
        light = corner() @ p
        wrong = (R.apply(np.asarray(C @ light).reshape(camera)) - light.reshape(GRID))[R.seen]
        assert np.linalg.norm(wrong) < 0.006 * np.linalg.norm(light.reshape(GRID)[R.seen])


def folded(u: Any, v: Any) -> tuple[Any, Any]:
    """The camera is beside the projector: at the corner's edge the slope of the map jumps."""
    a = u / 3.0 - 1.0
    b = v / 3.0 - 0.8
    bend = np.maximum(a - 7.5, 0.0)
    return a - 0.25 * bend, b + 0.02 * a


def occluded(u: Any, v: Any) -> tuple[Any, Any]:
    """A board nearer to both shifts places: some pixels behind it only the projector sees."""
    x, y = folded(u, v)
    board = (np.abs(u - 14.7) < 7.2) & (np.abs(v - 14.4) < 7.4)
    return np.where(board, x + 3.0, x), y


@pytest.mark.parametrize(
    ("place", "response", "limit"),
    [(folded, "linear", 0.1), (folded, "srgb", 0.1), (occluded, "linear", 0.25)],
)
def test_folds_and_occluders(place: Any, response: str, limit: float) -> None:
    """Valid pixels are right, and the light of single projector pixels survives."""
    C = camera_map(place, CAMERA, GRID)
    rig = VirtualRig(
        corner(),
        GRID,
        camera_grid=CAMERA,
        camera_map=C,
        bits=12,
        seed=4,
        ambient=0.01,
        response=response,
    )
    shots = Shots(rig)
    images = [shots.photograph(codes, 0.5) for codes in GrayCode(GRID).patterns()]
    mapping = decode(images, GRID, levels=shots.levels)
    x, y = places(place, CAMERA)
    inside = (np.abs(x - 7.5) < 7.5) & (np.abs(y - 3.5) < 3.5)
    deviation = np.where(mapping.valid & inside, np.hypot(mapping.x - x, mapping.y - y), 0.0)
    assert mapping.valid[inside].mean() > 0.9
    assert np.sqrt(np.mean(deviation[inside & mapping.valid] ** 2)) < limit
    assert np.mean(deviation > 0.4) < 0.01  # next to the border of the board
    assert not mapping.valid[(x < -1) | (x > 16) | (y < -1) | (y > 8)].any()
    R = Resampling.of(mapping)
    area = np.asarray(C.sum(axis=0)).reshape(GRID)  # in camera pixels
    hidden = area < 0.05
    clear = area > 7.5
    assert hidden.any() == (place is occluded)
    assert not R.seen[hidden].any()
    assert R.seen[area > 4].all()
    assert clear.mean() > 0.5
    for p in random.random((4, 128)):
        light = corner() @ p
        wrong = (R.apply((C @ light).reshape(CAMERA)) - light.reshape(GRID))[clear]
        assert np.linalg.norm(wrong) < 0.03 * np.linalg.norm(light.reshape(GRID)[clear])
