# SPDX-License-Identifier: BSD-3-Clause
"""Maps measured with folds and occluders, of a corner with indirect light: what is known and what is not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import Correspondence, Shots, VirtualRig, camera_map
from ltcl.acquisition.geometry import Resampling, measure
from tests.acquisition.scanning.helpers import corner

GRID, CAMERA, SIZE = (8, 16), (30, 60), 3.0
random = np.random.default_rng()
Place = Callable[[Any, Any], tuple[Any, Any]]


def folded(u: Any, v: Any) -> tuple[Any, Any]:
    """The camera is beside the projector: at the corner's edge the map is continuous, its slope is not."""
    a, b = u / SIZE - 1.0, v / SIZE - 0.8
    bend = np.maximum(a - 7.5, 0.0)
    return a - 0.25 * bend, b + 0.02 * a


def occluded(u: Any, v: Any) -> tuple[Any, Any]:
    """A board nearer to both shifts what it shows: some pixels behind it only the projector sees."""
    x, y = folded(u, v)
    board = (np.abs(u - 14.7) < 7.2) & (np.abs(v - 14.4) < 7.4)
    return np.where(board, x + 3.0, x), y


def rig(place: Place, **options: Any) -> VirtualRig:
    C = camera_map(place, CAMERA, GRID)
    return VirtualRig(corner(), GRID, camera_grid=CAMERA, camera_map=C, **{"bits": 12, "seed": 4, **options})


def truth(place: Place) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x, y and whether a pixel looks at the projector's grid."""
    v, u = np.mgrid[: CAMERA[0], : CAMERA[1]].astype(float)
    x, y = place(u, v)
    return x, y, (np.abs(x - 7.5) < 7.5) & (np.abs(y - 3.5) < 3.5)


def error(found: Correspondence, place: Place) -> np.ndarray:
    """Distance from the truth of valid pixels that look at the grid; 0 of others."""
    x, y, inside = truth(place)
    return np.where(found.valid & inside, np.hypot(found.x - x, found.y - y), 0.0)


@pytest.mark.parametrize("response", ["linear", "srgb"])
@pytest.mark.parametrize(("place", "limit"), [(folded, 0.1), (occluded, 0.25)])
def test_valid_pixels_are_right_at_folds_and_borders(place: Place, limit: float, response: str) -> None:
    found = measure(Shots(rig(place, response=response)), GRID)
    inside = truth(place)[2]
    off = error(found, place)
    assert found.valid[inside].mean() > 0.9
    assert np.sqrt(np.mean(off[inside & found.valid] ** 2)) < limit
    assert np.mean(off > 0.4) < 0.01  # beside the border of the board
    x, y, _ = truth(place)
    beside = (x < -1) | (x > 16) | (y < -1) | (y > 8)
    assert not found.valid[beside].any()
    assert (found.confidence[~found.valid] == 0).all()


def test_pixels_in_the_dark_are_not_valid_whatever_their_noise() -> None:
    """Noise alone has bits, too; of many dark pixels none may pass for lit ones."""
    dark = rig(lambda u, v: (np.where(u < 27, np.nan, folded(u, v)[0]), v / SIZE), read=0.005, gain=2000.0)
    found = measure(Shots(dark), GRID)
    assert not found.valid[:, :26].any()
    assert found.valid[:, 28:44].mean() > 0.5


@pytest.mark.parametrize("place", [folded, occluded])
def test_light_of_single_pixels_survives_folds_and_occluders(place: Place) -> None:
    made = rig(place)
    R = Resampling.of(measure(Shots(made), GRID))
    C = camera_map(place, CAMERA, GRID)
    area = np.asarray(C.sum(axis=0)).reshape(GRID)  # in camera pixels
    hidden = area < 0.05
    assert hidden.any() == (place is occluded)
    assert not R.seen[hidden].any()
    assert R.seen[area > 4].all()
    clear = area > 7.5  # all of it, or nearly
    assert clear.mean() > 0.5
    for p in random.random((4, 128)):
        light = corner() @ p
        seen = R.apply((C @ light).reshape(CAMERA))
        wrong = (seen - light.reshape(GRID))[clear]
        assert np.linalg.norm(wrong) < 0.03 * np.linalg.norm(light.reshape(GRID)[clear])
