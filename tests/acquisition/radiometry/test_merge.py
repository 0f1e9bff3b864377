# SPDX-License-Identifier: BSD-3-Clause
"""Merged radiance: unbiased from floor to saturation, with the variance that it says it has."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ltcl.acquisition.radiometry import NoiseModel, Response, merge
from ltcl.errors import InputError
from tests.acquisition.radiometry.cameras import CURVES, Camera, corner

SECONDS = [0.1, 0.2, 0.4, 0.8, 1.6, 3.2]
STEPS, REPEATS = 40, 8000


def ramp(low: float = 2.5e-3, high: float = 6.0) -> np.ndarray:
    """Each of 40 radiances 8000 times."""
    return np.repeat(np.geomspace(low, high, STEPS), REPEATS).reshape(STEPS, REPEATS)


@pytest.mark.parametrize("levels", [256, 4096, 0])
@pytest.mark.parametrize("curve", CURVES)
def test_merged_radiance_is_unbiased_and_its_variance_true(curve, levels):
    """At every brightness, from near the noise to all but the shortest exposure saturated.

    A mean of 8000 has the standard error 0.011 of the noise of one: four and a half are allowed. In 8 bits
    the read noise is half a code, so that it dithers them.
    """
    camera = Camera(curve, levels, read=0.002 if levels == 256 else 0.001, black=0.02)
    light, rng = ramp(), np.random.default_rng(3)
    shots = [camera.shoot(light, t, rng) for t in SECONDS]
    found = merge(shots, SECONDS, *_of(camera))
    assert found.valid.mean() > 0.999
    off = np.where(found.valid, found.value - light, 0.0)
    bias = off.mean(axis=1) / off.std(axis=1)
    assert np.abs(bias).max() < 0.05
    z = off / np.sqrt(found.variance)
    assert z.std(axis=1) == pytest.approx(np.ones(STEPS), abs=0.05)


def test_it_is_as_good_as_the_noise_allows():
    """Variance against the bound of Cramer and Rao, where the exposures that may count are clear."""
    camera, light = Camera("linear", 4096), np.full((200, 200), 0.2)
    found = merge([camera.shoot(light, t, np.random.default_rng(7)) for t in SECONDS], SECONDS, *_of(camera))
    t = np.array(SECONDS)
    best = 1.0 / np.sum(t**2 / camera.noise.variance(0.2 * t))
    assert np.var(found.value) == pytest.approx(best, rel=0.05)


def _of(camera: Camera) -> tuple[Response, NoiseModel]:
    return camera.response, camera.noise


def test_without_light_radiance_scatters_about_zero():
    camera = Camera("linear", 4096, black=0.02)
    rng = np.random.default_rng(11)
    found = merge([camera.shoot(np.zeros((300, 300)), t, rng) for t in SECONDS], SECONDS, *_of(camera))
    assert found.valid.all()
    assert (found.value < 0).mean() == pytest.approx(0.5, abs=0.02)
    z = found.value / np.sqrt(found.variance)
    assert abs(z.mean()) < 4 / 300
    assert z.std() == pytest.approx(1.0, abs=0.03)  # a variance is that of light, never of less than none


def test_pixels_that_no_exposure_tells_are_masked():
    codes = np.array([[0, 255, 100, 0, 255]], np.uint8)
    shots = [codes // 2 + (codes == 255) * np.uint8(128), codes]
    shots[1][0, 3] = 9
    found = merge(shots, [0.5, 1.0])
    np.testing.assert_array_equal(found.valid, [[False, False, True, True, False]])
    np.testing.assert_array_equal(found.value[~found.valid], 0.0)
    assert np.all(np.isinf(found.variance[~found.valid]))
    assert np.all(np.isfinite(found.value))
    assert found.value[0, 2] == pytest.approx(100 / 255, rel=1e-2)


def test_saturated_photographs_have_no_weight():
    light = np.array([[3.0, 0.3]])
    shots = [np.minimum(light * t, 1.0) for t in (0.1, 1.0, 10.0)]
    found = merge(shots, [0.1, 1.0, 10.0])
    np.testing.assert_allclose(found.value, light, rtol=1e-6)


def test_one_photograph_is_enough():
    shot = np.array([[0.2, 0.5], [0.7, 1.0]])
    found = merge([shot], [0.5])
    np.testing.assert_allclose(found.value[found.valid], [0.4, 1.0, 1.4], rtol=1e-6)
    variance = NoiseModel().variance(np.array([0.2, 0.5, 0.7])) / 0.25
    np.testing.assert_allclose(found.variance[found.valid], variance, rtol=1e-3)
    assert found.valid.tolist() == [[True, True], [True, False]]


def test_repeated_photographs_average():
    shots = [np.full((2, 2), 0.3), np.full((2, 2), 0.5), np.full((2, 2), 0.4)]
    found = merge(shots, [1.0, 1.0, 1.0])
    np.testing.assert_allclose(found.value, 0.4, rtol=1e-6)
    np.testing.assert_allclose(found.variance, NoiseModel().variance(0.4) / 3, rtol=1e-3)


@pytest.mark.parametrize("black", [0.1, [0.1, 0.1, 0.1], np.full((5, 7), 0.1), np.full((5, 7, 3), 0.1)])
def test_black_is_subtracted_and_nothing_is_clipped(black):
    shots = [0.1 + t * np.linspace(-0.05, 0.2, 105).reshape(5, 7, 3) for t in (1.0, 2.0)]
    found = merge(shots, [1.0, 2.0], black=black)
    np.testing.assert_allclose(found.value, shots[0] - 0.1, atol=1e-6)


def test_each_channel_has_its_own_response():
    cameras = [Camera(curve, 65536, electrons=1e9, read=0.0) for curve in ("srgb", "gamma2.2", "film")]
    response = Response(np.concatenate([camera.response.values for camera in cameras]))
    light, rng = corner(32), np.random.default_rng(0)
    shots = [np.stack([camera.shoot(light, t, rng) for camera in cameras], axis=-1) for t in (0.5, 1.0)]
    found = merge(shots, [0.5, 1.0], response, NoiseModel(1e9, 1e-5))
    np.testing.assert_allclose(
        found.value[found.valid], np.stack([light] * 3, axis=-1)[found.valid], rtol=4e-3
    )


@pytest.mark.parametrize("shape", [(1, 1), (1, 1, 3), (53, 7), (170, 211, 3)])
def test_any_size(shape):
    light = np.random.default_rng(0).uniform(0.1, 0.8, shape)
    shots = [np.rint(65535 * light * t).astype(np.uint16) for t in (0.25, 1.0)]
    found = merge(shots, [0.25, 1.0])
    assert found.value.shape == found.variance.shape == found.valid.shape == shape
    assert (found.value.dtype, found.variance.dtype, found.valid.dtype) == (np.float32, np.float32, bool)
    np.testing.assert_allclose(found.value, light, rtol=1e-4)


def test_the_difference_of_two_pictures_adds_variances():
    one, two = merge([np.full((1, 2), 0.5)], [1.0]), merge([np.array([[0.2, 1.0]])], [1.0])
    left = one - two
    np.testing.assert_allclose(left.value, [[0.3, 0.0]], rtol=1e-6)
    np.testing.assert_allclose(left.variance[0, 0], one.variance[0, 0] + two.variance[0, 0])
    assert left.valid.tolist() == [[True, False]]
    assert np.isinf(left.variance[0, 1])


@pytest.mark.parametrize("merger", [cv2.createMergeDebevec, cv2.createMergeRobertson])
def test_less_noise_than_opencv(merger):
    """Both are given the true response; OpenCV's weights know nothing of noise."""
    camera, rng = Camera("srgb", black=0.0), np.random.default_rng(4)
    light = corner(128)
    shots = [camera.shoot(light, t, rng) for t in SECONDS]
    table = np.maximum(camera.light(np.arange(256) / 255), 1e-6).astype(np.float32)
    colour = [np.repeat(shot[..., None], 3, axis=-1) for shot in shots]
    curves = np.repeat(table[:, None, None], 3, axis=2)
    theirs = merger().process(colour, times=np.array(SECONDS, np.float32), response=curves)[..., 0]
    theirs = theirs * np.median(light / theirs)  # it has a scale of its own
    ours = merge(shots, SECONDS, *_of(camera))
    off = [np.sqrt(np.mean((found / light - 1)[ours.valid] ** 2)) for found in (ours.value, theirs)]
    assert off[0] < off[1]


@pytest.mark.parametrize(
    ("options", "part"),
    [
        ({"response": Response(np.linspace([0.0] * 3, [1.0] * 3, 5, axis=1))}, "response has 3 channels"),
        ({"black": np.zeros((4, 5))}, r"black has shape \(4, 5\); it must be \(4, 4\)"),
        ({"black": np.nan}, "black"),
        ({"levels": 1}, "levels is 1"),
    ],
)
def test_what_does_not_fit_is_refused(options, part):
    with pytest.raises(InputError, match=part):
        merge([np.full((4, 4), 0.1), np.full((4, 4), 0.2)], [1.0, 2.0], **options)


@pytest.mark.parametrize("clear", [1, 2, 3, 8, 64])
@pytest.mark.parametrize(
    ("light", "noise", "ratio"), [(0.15, 0.05, 1.1), (0.002, 0.01, 2.0), (0.12, 0.1, 1.5)]
)
def test_a_few_noisy_pixels_beside_saturated_ones_are_no_wrong_order(clear, light, noise, ratio):
    """By chance 3 in 100000 are refused."""
    rng, refused = np.random.default_rng(5), 0
    for _ in range(500):
        shots = [np.ones((10, 20)) for _ in range(2)]
        for shot, t in zip(shots, (1.0, ratio), strict=True):
            shot.flat[:clear] = light * t + rng.normal(0, noise, clear)
        codes = [np.rint(np.clip(shot, 0, 1) * 255).astype(np.uint8) for shot in shots]
        try:
            merge(codes, [1.0, ratio])
        except InputError:
            refused += 1
    assert refused <= 1


@pytest.mark.parametrize("clear", [6, 64])
def test_a_few_pixels_tell_a_wrong_order_where_noise_is_small(clear):
    rng = np.random.default_rng(6)
    shots = [np.ones((10, 20)) for _ in range(2)]
    for shot, light in zip(shots, (0.4, 0.2), strict=True):
        shot.flat[:clear] = light + rng.normal(0, 0.005, clear)
    codes = [np.rint(np.clip(shot, 0, 1) * 255).astype(np.uint8) for shot in shots]
    with pytest.raises(InputError, match=r"images\[1\] has 2 s and is not brighter"):
        merge(codes, [1.0, 2.0])
    with pytest.raises(InputError, match=r"images\[1\] has 2 s and is not brighter"):
        merge([codes[1], codes[1]], [1.0, 2.0])


@pytest.mark.parametrize("bits", [8, 12, 14])
@pytest.mark.parametrize("black", [0.004, 0.0625, 0.13, 0.16])
@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_what_lies_beside_the_light_is_as_dark_at_any_exposure(bits, black, gamma):
    """Black cloth about a few pixels that are lit, or about none, for a camera of any offset."""
    rng, full = np.random.default_rng(7), 2**bits - 1
    for lit in (0.0, 0.01, 0.1, 0.3):
        light = np.zeros((40, 60))
        light.flat[: int(lit * light.size)] = 0.03 * rng.random(int(lit * light.size))
        for ratio in (1.5, 4.0, 60.0):
            shots = []
            for t in (1.0, ratio):
                value = rng.poisson(light * t * 1e4) / 1e4 + rng.normal(0, 5e-4, light.shape)
                codes = black + (1 - black) * np.clip(value, 0, 1) ** (1 / gamma)
                shots.append(np.rint(full * codes).astype(np.uint16))
            merge(shots, [1.0, ratio], levels=full + 1)


def test_stuck_pixels_tell_no_order():
    shots = [np.full((20, 20), 2, np.uint8) for _ in range(2)]
    for shot in shots:
        shot.flat[:4] = 128
    merge(shots, [1.0, 4.0])


@pytest.mark.parametrize("black", [0.0, 0.13])
def test_light_that_stays_is_refused_in_a_dark_picture(black):
    rng = np.random.default_rng(8)
    shot = black + rng.normal(0, 0.002, (40, 60))
    shot[:, :6] += 0.3
    again = shot + rng.normal(0, 0.002, (40, 60))
    with pytest.raises(InputError, match=r"images\[1\] has 4 s and is not brighter"):
        merge([shot, again], [1.0, 4.0])


def test_photographs_in_the_wrong_order_are_refused():
    with pytest.raises(InputError, match=r"images\[1\] has 2 s and is not brighter than images\[0\] of 1 s"):
        merge([np.full((4, 4), 0.2), np.full((4, 4), 0.1)], [1.0, 2.0])
