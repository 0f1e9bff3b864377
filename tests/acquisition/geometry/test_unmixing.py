# SPDX-License-Identifier: BSD-3-Clause
"""Cameras of smaller pixels tell projector pixels apart: exact maps, photographs by rays through pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import camera_map
from ltcl.acquisition.geometry import Correspondence, Resampling
from ltcl.acquisition.geometry.footprints import jacobian
from ltcl.acquisition.geometry.unmixing import unmix

GRID = (13, 17)


def askance(size: float, turn: float = 0.1):
    """Places of a wall seen askance by a camera with about `size` pixels in one of the projector's."""
    h, w = GRID
    H, W = (int(np.ceil(1.3 * size * n)) for n in GRID)

    def place(u: Any, v: Any) -> tuple[Any, Any]:
        a, b = (u - W / 2) / size, (v - H / 2) / size
        d = 1 + 0.012 * a - 0.007 * b
        return w / 2 - 0.5 + (a + turn * b) / d, h / 2 - 0.5 + (b - turn * a) / d

    return place, (H, W)


def known(place, camera: tuple[int, int], valid=None) -> Correspondence:
    v, u = np.mgrid[: camera[0], : camera[1]].astype(float)
    x, y = place(u, v)
    h, w = GRID
    inside = (np.abs(x - (w - 1) / 2) < w / 2) & (np.abs(y - (h - 1) / 2) < h / 2)
    return Correspondence(x, y, np.ones(camera), inside if valid is None else inside & valid, GRID)


def noise(count: int = 3) -> np.ndarray:
    return np.random.default_rng(5).random((count, *GRID))


def off(R: Resampling, C: Any, p: np.ndarray) -> float:
    seen = R.apply((C @ p.ravel()).reshape(R.camera_grid))
    return float(np.linalg.norm((seen - p)[R.seen]) / np.linalg.norm(p[R.seen]))


@pytest.mark.parametrize("turn", [0.0, 0.1, 0.8])
@pytest.mark.parametrize(("size", "limit"), [(1.6, 0.04), (2.0, 0.015), (3.0, 0.005), (4.0, 0.005)])
def test_noise_pixel_by_pixel(size: float, limit: float, turn: float) -> None:
    place, camera = askance(size * np.hypot(1, turn), turn)
    C, R = camera_map(place, camera, GRID, points=24), Resampling.of(known(place, camera))
    assert R.seen.all()
    assert R.coverage.min() > 0.5
    for p in noise():
        assert off(R, C, p) < limit


def test_linear_pictures_and_constants_come_out() -> None:
    place, camera = askance(3.0)
    found = known(place, camera)
    R = Resampling.of(found)
    Y, X = np.mgrid[: GRID[0], : GRID[1]]
    inner = np.s_[1:-1, 1:-1]
    tilted = R.apply(np.nan_to_num(0.3 * found.x - 0.2 * found.y))
    wrong = np.abs(tilted - (0.3 * X - 0.2 * Y))[inner]
    assert np.quantile(wrong, 0.8) < 1e-3
    assert wrong.max() < 0.03  # where a weight would turn negative it is not quite exact
    np.testing.assert_allclose(R.apply(np.ones(camera)), 1.0, rtol=1e-5)


def test_large_camera_pixels_are_not_unmixed() -> None:
    place, camera = askance(1.0)
    found = known(place, camera)
    assert unmix(found, *jacobian(found)) is None


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_camera_pixels_that_are_missing_leave_the_others_right(share: float) -> None:
    place, camera = askance(3.0)
    valid = np.random.default_rng(1).random(camera) > share
    C, R = camera_map(place, camera, GRID, points=24), Resampling.of(known(place, camera, valid))
    assert R.seen.mean() > 0.98
    for p in noise():
        photograph = (C @ p.ravel()).reshape(camera)
        seen = R.apply(np.where(valid, photograph, 1e3))
        assert np.linalg.norm((seen - p)[R.seen]) < 0.02 * np.linalg.norm(p)


def test_an_occluder_hides_pixels_and_spoils_none() -> None:
    """A block nearer to the camera shifts what it covers; pixels behind its edge are not seen."""
    place, camera = askance(3.0)
    H, W = camera

    def occluded(u: Any, v: Any) -> tuple[Any, Any]:
        x, y = place(u, v)
        block = (np.abs(u - W / 2) < 6.3) & (np.abs(v - H / 2) < 7.7)
        return np.where(block, x + 5.0, x), y

    C, R = camera_map(occluded, camera, GRID, points=24), Resampling.of(known(occluded, camera))
    area = np.asarray(C.sum(axis=0)).reshape(GRID)  # camera pixels that see some of it
    assert not R.seen[area < 0.01].any()
    assert R.seen[area > 4].all()
    hidden = area < 0.01
    assert 4 <= hidden.sum() <= 40
    clear = R.seen & (area > 4)
    for p in noise():
        seen = R.apply((C @ p.ravel()).reshape(camera))
        assert np.abs(seen - p)[clear].mean() < 0.02
