# SPDX-License-Identifier: BSD-3-Clause
"""The rim of the projector's picture, where no stripes end: seen by cameras anywhere."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import Shots, VirtualRig, camera_map
from ltcl.acquisition.geometry import Correspondence, GrayCode, Resampling, decode, measure
from tests.acquisition.scanning.helpers import corner

GRID = (8, 16)
random = np.random.default_rng()


def placed(seed: int) -> tuple[Any, tuple[int, int]]:
    """A camera of 3 to 4.5 pixels to a side, shifted by up to a projector pixel; odd ones are turned."""
    h, w = GRID
    rng = np.random.default_rng(seed)
    size, (dx, dy) = rng.uniform(3, 4.5), rng.uniform(-1, 1, 2)
    turn = rng.uniform(-0.1, 0.1) if seed % 2 else 0.0
    H, W = int(1.25 * size * h), int(1.25 * size * w)
    c, s = np.cos(turn) / size, np.sin(turn) / size

    def place(u: Any, v: Any) -> tuple[Any, Any]:
        a, b = u - W / 2, v - H / 2
        return c * a + s * b + (w - 1) / 2 + dx, c * b - s * a + (h - 1) / 2 + dy

    return place, (H, W)


def truth(place: Any, camera: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    v, u = np.mgrid[: camera[0], : camera[1]].astype(float)
    return place(u, v)


def at_the_rim(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Camera pixels that look at the outermost projector pixels, or are lit by a part of these."""
    h, w = GRID
    return (np.minimum(x, w - 1 - x) < 0.5) | (np.minimum(y, h - 1 - y) < 0.5)


@pytest.mark.parametrize("high_frequency", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_places_are_known_up_to_the_rim(seed: int, high_frequency: bool) -> None:
    place, camera = placed(seed)
    C = camera_map(place, camera, GRID, points=24)
    photographs = [(C @ p.ravel()).reshape(camera) for p in GrayCode(GRID, high_frequency).patterns()]
    found = decode(photographs, GRID, high_frequency=high_frequency)
    x, y = truth(place, camera)
    deviation = np.hypot(found.x - x, found.y - y)
    rim = found.valid & at_the_rim(x, y)
    assert rim.sum() > 100
    assert np.sqrt(np.mean(deviation[rim] ** 2)) < 0.04
    assert deviation[rim].max() < 0.08
    assert np.sqrt(np.mean(deviation[found.valid & ~rim] ** 2)) < 0.03


@pytest.mark.parametrize("seed", [0, 1, 16, 25])
def test_light_of_the_outermost_pixels_comes_out(seed: int) -> None:
    """A scene with light between its walls, ambient light and a camera of 12 bits."""
    place, camera = placed(seed)
    C = camera_map(place, camera, GRID, points=24)
    options: dict[str, Any] = {"bits": 12, "response": "srgb", "ambient": 0.01, "seed": seed}
    rig = VirtualRig(corner(), GRID, camera_grid=camera, camera_map=C, **options)
    R = Resampling.of(measure(Shots(rig), GRID, seconds=0.3))
    area = np.asarray(C.sum(axis=0)).reshape(GRID)
    wholly = area > 0.97 * area.max()
    assert R.seen[wholly].all()
    rim = np.ones(GRID, bool)
    rim[1:-1, 1:-1] = False
    white = R.apply(np.asarray(C @ np.ones(np.prod(GRID))).reshape(camera))
    assert np.abs(white - 1)[wholly].max() < 0.03
    assert np.sqrt(np.mean((white - 1)[wholly & rim] ** 2)) < 0.006
    for p in random.random((3, np.prod(GRID))):
        light = corner() @ p
        wrong = (R.apply(np.asarray(C @ light).reshape(camera)) - light.reshape(GRID))[R.seen]
        assert np.linalg.norm(wrong) < 0.006 * np.linalg.norm(light.reshape(GRID)[R.seen])


@pytest.mark.parametrize("shift", [0.25, 0.5, 0.75, 1.0])
def test_borders_along_rows_of_camera_pixels_are_shared_by_their_part(shift: float) -> None:
    """A camera that is not turned: all pixels of a row straddle alike, and an error would be that of all."""
    size, (h, w) = 3.7, GRID
    camera = (int(size * h), int(size * w))

    def place(u: Any, v: Any) -> tuple[Any, Any]:
        return (u + 0.3 * shift) / size - 0.3, (v + shift) / size - 0.3

    x, y = truth(place, camera)
    R = Resampling.of(Correspondence(x, y, np.ones(camera), np.ones(camera, bool), GRID))
    C = camera_map(place, camera, GRID, points=60)
    own = (R.weights @ C).diagonal()[R.seen.ravel()]
    assert np.abs(own - 1).max() < 0.012


def test_a_camera_that_lies_on_the_borders_sees_no_stripes_that_are_not_there() -> None:
    """Rows of camera pixels with their middle on a border: every bit is faint, and some are wrong."""
    size = 4.0

    def place(u: Any, v: Any) -> tuple[Any, Any]:
        return (u - 4) / size - 0.3, (v - 4) / size - 0.5

    camera = (int(size * GRID[0]) + 9, int(size * GRID[1]) + 9)
    C = camera_map(place, camera, GRID, points=24)
    photographs = [
        (C @ p.ravel()).reshape(camera) + 0.003 * random.standard_normal(camera)
        for p in GrayCode(GRID, high_frequency=True).patterns()
    ]
    found = decode(photographs, GRID, high_frequency=True)
    x, y = truth(place, camera)
    deviation = np.hypot(found.x - x, found.y - y)[found.valid]
    assert found.valid.sum() > 0.7 * C.sum()
    assert deviation.max() < 0.3
