# SPDX-License-Identifier: BSD-3-Clause
"""Photographs on the projector's grid: what is exact, averaged or masked; by rays through camera pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import camera_map
from ltcl.acquisition.geometry import Correspondence, Resampling
from ltcl.errors import InputError
from tests.acquisition.geometry.scenes import MAPS, homography

# Camera pixels as large as the projector's, three times, narrow ones; and a third, which are unmixed.
LARGE = [((64, 80), (56, 70)), ((120, 160), (40, 52)), ((40, 40), (34, 200))]
SIZES = [*LARGE, ((64, 80), (200, 260))]
WALL = (13, 17)
random = np.random.default_rng()


def known(x: np.ndarray, y: np.ndarray, grid: tuple[int, int], valid: Any = True) -> Correspondence:
    return Correspondence(x, y, np.ones(x.shape), np.broadcast_to(valid, x.shape), grid)


def jacobian(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    slopes = [np.asarray(np.gradient(a, axis=k)) for a in (x, y) for k in (1, 0)]
    return np.stack(slopes, axis=-1).reshape(*x.shape, 2, 2)


def picture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Band-limited: waves 25 and 30 projector pixels long."""
    return 0.5 + 0.2 * np.sin(2 * np.pi * x / 25 + 0.3) + 0.15 * np.cos(2 * np.pi * y / 30)


@pytest.fixture(params=[(*size, name) for size in SIZES for name in MAPS], ids=str)
def case(request):
    grid, camera, name = request.param
    x, y = MAPS[name](camera, grid)
    return Resampling.of(known(x, y, grid)), x, y, np.mgrid[: grid[0], : grid[1]][::-1].astype(float)


@pytest.mark.parametrize(("grid", "camera"), LARGE)
@pytest.mark.parametrize("name", MAPS)
def test_large_camera_pixels_are_averaged(grid, camera, name):
    assert Resampling.of(known(*MAPS[name](camera, grid), grid)).weights.data.min() >= 0


def test_constants_stay(case):
    R, x, _, _ = case
    W = R.weights
    np.testing.assert_allclose(W.sum(axis=1)[R.seen.ravel()], 1.0, rtol=0, atol=1e-6)
    assert W[~R.seen.ravel()].nnz == 0
    np.testing.assert_allclose(R.apply(np.full(x.shape, 7.5))[R.seen], 7.5, rtol=2e-6)


def test_a_band_limited_picture_comes_out_but_for_the_blur_of_the_filter(case):
    """The kernel's variance an axis is q / 8, with q = 1.54 s^2 + 1.1 for a camera pixel s long."""
    R, x, y, (X, Y) = case
    q = 1.54 * (jacobian(x, y) ** 2).sum(axis=-1).max() + 1.1
    curve = q / 16 * (2 * np.pi / 25) ** 2 * 0.35
    full = R.coverage > 0.9
    assert full.sum() > 0.4 * full.size
    deviation = (R.apply(picture(x, y)) - picture(X, Y))[full]
    assert np.abs(deviation).max() < curve + 1e-3
    assert np.sqrt(np.mean(deviation**2)) < 0.5 * curve


def test_linear_pictures_are_exact_where_samples_surround_the_pixel(case):
    R, x, y, (X, Y) = case
    deviation = np.abs(R.apply(0.3 * x - 0.2 * y) - (0.3 * X - 0.2 * Y))[R.coverage > 0.9]
    assert np.quantile(deviation, 0.9) < 1e-3
    assert np.mean(deviation) < 2e-3


def test_light_is_kept(case):
    """Coverage times the picture sums to area times the photograph."""
    R, x, y, _ = case
    area = np.abs(np.linalg.det(jacobian(x, y)))
    inside = (x > 2) & (x < R.grid[1] - 3) & (y > 2) & (y < R.grid[0] - 3)
    photograph = picture(x, y) * inside
    # Half a camera pixel is missing at each border, and rows are corrected to first order.
    assert np.sum(R.coverage * R.apply(photograph)) == pytest.approx(np.sum(area * photograph), rel=0.04)


def test_the_adjoint(case):
    R, x, _, _ = case
    a, b = random.random(x.shape), random.random(R.grid)
    back = R.weights.T @ b.ravel()
    assert np.sum(R.apply(a) * b) == pytest.approx(a.ravel() @ back, rel=1e-5)


def test_coverage_is_whole_inside_and_nothing_outside(case):
    R, x, y, (X, Y) = case
    outside = (x.max() + 5 - X < 0) | (y.max() + 5 - Y < 0)
    assert not R.seen[outside].any()
    left, right, top, bottom = x[:, 0].max(), x[:, -1].min(), y[0].max(), y[-1].min()
    inside = np.minimum(np.minimum(X - left, right - X), np.minimum(Y - top, bottom - Y)) > 4
    assert inside.any()
    assert np.quantile(R.coverage[inside], 0.05) > 0.85


def test_variance_is_that_of_repeated_photographs():
    x, y = homography((60, 80), (20, 30))
    R = Resampling.of(known(x, y, (20, 30)))
    variance = 0.01 * (1 + picture(x, y))
    expected = (R.weights.toarray() ** 2 @ variance.ravel()).reshape(20, 30)
    np.testing.assert_allclose(R.variance(variance), expected, rtol=1e-5)
    shots = [R.apply(np.sqrt(variance) * random.standard_normal(x.shape)) for _ in range(400)]
    ratio = np.var(shots, axis=0)[R.seen] / expected[R.seen]
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.02)
    # Small camera pixels are averaged: a projector pixel holds about seven of them.
    assert np.median(expected[R.coverage > 0.95]) < np.median(variance) / 7


def test_nothing_leaks_across_the_border_of_an_object():
    """The right half lies 12 projector pixels further on: no footprint spans the gap, which stays unseen."""
    v, u = np.mgrid[:40, :40].astype(float)
    x = u + np.where(u >= 20, 12.0, 0.0)
    R = Resampling.of(known(x, v, (40, 52)))
    assert not R.seen[:, 22:30].any()
    image = R.apply(np.where(u >= 20, 1.0, 0.0))
    np.testing.assert_allclose(image[:, :22], 0.0, atol=1e-6)
    np.testing.assert_allclose(image[:, 30:][R.seen[:, 30:]], 1.0, rtol=1e-5)


def test_pixels_that_are_not_valid_have_no_weight():
    x, y = homography((90, 90), (30, 30))
    valid = random.random(x.shape) > 0.3
    image = np.where(valid, picture(x, y), 1e6)
    R = Resampling.of(known(np.where(valid, x, np.nan), y, (30, 30), valid))
    Y, X = np.mgrid[:30, :30]
    full = R.coverage > 0.5
    assert full.mean() > 0.5
    assert np.abs(R.apply(image) - picture(X, Y))[full].max() < 0.05


def test_aligned_cameras_stay_as_they_are():
    image = random.random((5, 7, 3)).astype(np.float32)
    R = Resampling.aligned((5, 7))
    np.testing.assert_array_equal(R.apply(image), image)
    np.testing.assert_array_equal(R.variance(image), image)
    assert R.seen.all()


@pytest.mark.parametrize("camera", [(1, 1), (1, 30), (30, 1), (2, 2)])
def test_cameras_of_every_shape(camera):
    grid = (min(camera[0], 15), min(camera[1], 15))
    x, y = homography(camera, grid)
    R = Resampling.of(known(x, y, grid))
    assert R.seen.any()
    np.testing.assert_allclose(R.apply(np.ones(camera))[R.seen], 1.0, rtol=1e-6)


def test_bad_pictures_and_maps_are_refused():
    R = Resampling.aligned((4, 5))
    with pytest.raises(InputError, match=r"image has shape \(5, 4\)"):
        R.apply(np.ones((5, 4)))
    with pytest.raises(InputError, match="image has 1 NaN"):
        R.apply(np.where(np.eye(4, 5) * np.arange(5) == 2, np.nan, 1.0))
    x, y = homography((6, 6), (4, 4))
    with pytest.raises(InputError, match="no two valid neighbours"):
        Resampling.of(known(x, y, (4, 4), False))
    with pytest.raises(InputError, match="must be a Correspondence"):
        Resampling.of(np.ones((4, 4)))  # pyright: ignore[reportArgumentType]


def askance(size: float, turn: float = 0.1):
    """Places of a wall seen askance by a camera with about `size` pixels in one of the projector's."""
    h, w = WALL
    H, W = (int(np.ceil(1.3 * size * n)) for n in WALL)

    def place(u: Any, v: Any) -> tuple[Any, Any]:
        a, b = (u - W / 2) / size, (v - H / 2) / size
        d = 1 + 0.012 * a - 0.007 * b
        return w / 2 - 0.5 + (a + turn * b) / d, h / 2 - 0.5 + (b - turn * a) / d

    return place, (H, W)


def of_place(place: Any, camera: tuple[int, int], valid: Any = True) -> Correspondence:
    v, u = np.mgrid[: camera[0], : camera[1]].astype(float)
    x, y = place(u, v)
    inside = (np.abs(x - (WALL[1] - 1) / 2) < WALL[1] / 2) & (np.abs(y - (WALL[0] - 1) / 2) < WALL[0] / 2)
    return known(x, y, WALL, inside & valid)


@pytest.mark.parametrize("turn", [0.0, 0.1, 0.8])
@pytest.mark.parametrize(("size", "limit"), [(1.6, 0.04), (2.0, 0.015), (3.0, 0.005), (4.0, 0.005)])
def test_smaller_camera_pixels_separate_noise_pixel_by_pixel(size, limit, turn):
    place, camera = askance(size * np.hypot(1, turn), turn)
    C, R = camera_map(place, camera, WALL, points=24), Resampling.of(of_place(place, camera))
    assert R.seen.all()
    assert R.coverage.min() > 0.5
    for p in random.random((3, *WALL)):
        seen = R.apply((C @ p.ravel()).reshape(camera))
        assert np.linalg.norm(seen - p) < limit * np.linalg.norm(p)


def test_linear_pictures_come_out_of_smaller_camera_pixels():
    place, camera = askance(3.0)
    found = of_place(place, camera)
    R = Resampling.of(found)
    Y, X = np.mgrid[: WALL[0], : WALL[1]]
    tilted = R.apply(np.nan_to_num(0.3 * found.x - 0.2 * found.y))
    deviation = np.abs(tilted - (0.3 * X - 0.2 * Y))[1:-1, 1:-1]
    assert np.quantile(deviation, 0.8) < 1e-3
    assert deviation.max() < 0.03  # where a weight would turn negative it is not quite exact


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_missing_camera_pixels_leave_the_others_right(share):
    place, camera = askance(3.0)
    valid = random.random(camera) > share
    C, R = camera_map(place, camera, WALL, points=24), Resampling.of(of_place(place, camera, valid))
    assert R.seen.mean() > 0.98
    for p in random.random((3, *WALL)):
        seen = R.apply(np.where(valid, (C @ p.ravel()).reshape(camera), 1e3))
        assert np.linalg.norm((seen - p)[R.seen]) < 0.02 * np.linalg.norm(p)


def test_an_occluder_hides_pixels_and_spoils_none():
    """A block nearer to the camera shifts what it covers; pixels behind its edge are not seen."""
    place, camera = askance(3.0)
    H, W = camera

    def occluded(u: Any, v: Any) -> tuple[Any, Any]:
        x, y = place(u, v)
        block = (np.abs(u - W / 2) < 6.3) & (np.abs(v - H / 2) < 7.7)
        return np.where(block, x + 5.0, x), y

    C, R = camera_map(occluded, camera, WALL, points=24), Resampling.of(of_place(occluded, camera))
    area = np.asarray(C.sum(axis=0)).reshape(WALL)  # camera pixels that see some of it
    assert 4 <= np.sum(area < 0.01) <= 40
    assert not R.seen[area < 0.01].any()
    assert R.seen[area > 4].all()
    for p in random.random((3, *WALL)):
        seen = R.apply((C @ p.ravel()).reshape(camera))
        assert np.abs(seen - p)[area > 4].mean() < 0.02
