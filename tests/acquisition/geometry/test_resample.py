# SPDX-License-Identifier: BSD-3-Clause
"""Photographs on the projector's grid against rays through camera pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import camera_map
from ltcl.acquisition.geometry import Correspondence, Resampling
from ltcl.errors import InputError
from tests.acquisition.geometry.scenes import homography, places, turned

# Camera pixels as large as the projector's, and narrow ones; and a third, which are unmixed.
SIZES = [((64, 80), (56, 70)), ((40, 40), (34, 200)), ((64, 80), (200, 260))]
WALL = (13, 17)
random = np.random.default_rng()


def known(x: np.ndarray, y: np.ndarray, grid: tuple[int, int], valid: Any = True) -> Correspondence:
    return Correspondence(x, y, np.broadcast_to(valid, x.shape), grid)


def picture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Band-limited: waves 25 and 30 projector pixels long."""
    return 0.5 + 0.2 * np.sin(2 * np.pi * x / 25 + 0.3) + 0.15 * np.cos(2 * np.pi * y / 30)


@pytest.mark.parametrize(("grid", "camera"), SIZES)
def test_smooth_pictures_come_out_where_the_camera_sees(grid, camera):
    """Constants are exact, waves good to a hundredth of their contrast; none is seen outside."""
    x, y = places(homography(camera, grid), camera)
    R = Resampling.of(known(x, y, grid))
    Y, X = np.mgrid[: grid[0], : grid[1]].astype(float)
    assert R.weights[~R.seen.ravel()].nnz == 0
    np.testing.assert_allclose(R.apply(np.full(camera, 7.5))[R.seen], 7.5, rtol=2e-6)
    full = R.coverage > 0.9
    assert full.sum() > 0.4 * full.size
    deviation = (R.apply(picture(x, y)) - picture(X, Y))[full]
    assert np.abs(deviation).max() < 0.012
    assert np.sqrt(np.mean(deviation**2)) < 0.01 * np.std(picture(X, Y))
    tilted = np.abs(R.apply(0.3 * x - 0.2 * y) - (0.3 * X - 0.2 * Y))[full]
    assert np.mean(tilted) < 0.012  # of 0.3 a pixel
    assert not R.seen[(x.max() + 5 - X < 0) | (y.max() + 5 - Y < 0)].any()
    inside_x = np.minimum(X - x[:, 0].max(), x[:, -1].min() - X)
    inside_y = np.minimum(Y - y[0].max(), y[-1].min() - Y)
    inside = np.minimum(inside_x, inside_y) > 4
    assert np.quantile(R.coverage[inside], 0.05) > 0.85


def test_variance_is_that_of_independent_pixels():
    x, y = places(homography((60, 80), (20, 30)), (60, 80))
    R = Resampling.of(known(x, y, (20, 30)))
    variance = 0.01 * (1 + picture(x, y))
    expected = (R.weights.toarray() ** 2 @ variance.ravel()).reshape(20, 30)
    np.testing.assert_allclose(R.variance(variance), expected, rtol=1e-5)
    # Small camera pixels are averaged: a projector pixel holds about seven of them.
    assert np.median(expected[R.coverage > 0.95]) < np.median(variance) / 7


def test_nothing_leaks_across_the_border_of_an_object():
    """The right half lies 12 projector pixels further: no footprint spans the gap."""
    v, u = np.mgrid[:40, :40].astype(float)
    x = u + np.where(u >= 20, 12.0, 0.0)
    R = Resampling.of(known(x, v, (40, 52)))
    assert not R.seen[:, 22:30].any()
    image = R.apply(np.where(u >= 20, 1.0, 0.0))
    np.testing.assert_allclose(image[:, :22], 0.0, atol=1e-6)
    np.testing.assert_allclose(image[:, 30:][R.seen[:, 30:]], 1.0, rtol=1e-5)


@pytest.mark.parametrize("camera", [(1, 30), (30, 1), (2, 2)])
def test_cameras_of_every_shape(camera):
    grid = (min(camera[0], 15), min(camera[1], 15))
    x, y = places(homography(camera, grid), camera)
    R = Resampling.of(known(x, y, grid))
    assert R.seen.any()
    np.testing.assert_allclose(R.apply(np.ones(camera))[R.seen], 1.0, rtol=1e-6)


def test_bad_pictures_and_maps_are_refused():
    R = Resampling.aligned((4, 5))
    with pytest.raises(InputError, match=r"image has shape \(5, 4\)"):
        R.apply(np.ones((5, 4)))
    with pytest.raises(InputError, match="image has 1 NaN"):
        R.apply(np.where(np.eye(4, 5) * np.arange(5) == 2, np.nan, 1.0))
    x, y = places(homography((6, 6), (4, 4)), (6, 6))
    with pytest.raises(InputError, match="no two valid neighbours"):
        Resampling.of(known(x, y, (4, 4), False))


@pytest.mark.parametrize("turn", [0.0, 0.1, 0.8])
@pytest.mark.parametrize(
    ("size", "missing", "limit"),
    [
        (1.6, 0, 0.04),
        (2.0, 0, 0.015),
        (3.0, 0, 0.005),
        (4.0, 0, 0.005),
        (3.0, 0.1, 0.02),
        (3.0, 0.3, 0.02),
    ],
)
def test_smaller_camera_pixels_separate_noise_pixel_by_pixel(size, missing, limit, turn):
    """Also without a part of them, whatever these show."""
    place, camera = turned(WALL, size * np.hypot(1, turn), turn, wide=1.32)
    valid = random.random(camera) >= missing
    x, y = places(place, camera)
    h, w = WALL
    inside_x = np.abs(x - (w - 1) / 2) < w / 2
    inside_y = np.abs(y - (h - 1) / 2) < h / 2
    C = camera_map(place, camera, WALL, points=24)
    R = Resampling.of(known(x, y, WALL, inside_x & inside_y & valid))
    assert R.seen.mean() > (0.98 if missing else 0.999)
    assert R.coverage[R.seen].min() > (0.1 if missing else 0.5)
    for p in random.random((3, *WALL)):
        seen = R.apply(np.where(valid, (C @ p.ravel()).reshape(camera), 1e3))
        assert np.linalg.norm((seen - p)[R.seen]) < limit * np.linalg.norm(p)


def test_what_most_pixels_separate_but_some_do_not_is_not_seen_there():
    """A wall at a right angle to the other: each camera pixel covers two of its columns."""
    u, v = np.meshgrid(np.arange(40.0), np.arange(40.0))
    R = Resampling.of(known(u / 3 + np.maximum(u - 24, 0) * 5 / 3, v / 3, (13, 38)))
    assert R.seen[1:-1, 1:7].all()
    assert not R.seen[:, 10:].any()
    assert abs(R.weights).sum(axis=1).max() < 10  # a photograph's noise is not multiplied
