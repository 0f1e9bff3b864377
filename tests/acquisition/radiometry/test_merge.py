# SPDX-License-Identifier: BSD-3-Clause
"""Merged radiance: unbiased from floor to saturation, with the variance that it says it has."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.radiometry import NoiseModel, Response, merge
from ltcl.errors import InputError
from tests.acquisition.radiometry.cameras import CURVES, Camera, corner

SECONDS = [0.1, 0.2, 0.4, 0.8, 1.6, 3.2]
random = np.random.default_rng()
STEPS, REPEATS = 40, 8000


@pytest.mark.parametrize("levels", [256, 4096, 0])
@pytest.mark.parametrize("curve", CURVES)
def test_merged_radiance_is_unbiased_and_its_variance_true(curve, levels):
    """At every brightness, from near the noise to all but the shortest exposure saturated.

    A mean of 8000 has the standard error 0.011 of the noise of one: four and a half are allowed. In 8 bits
    the read noise is half a code, so that it dithers them.
    """
    camera = Camera(curve, levels, read=0.002 if levels == 256 else 0.001, black=0.02)
    light = np.repeat(np.geomspace(2.5e-3, 6.0, STEPS), REPEATS).reshape(STEPS, REPEATS)
    shots = [camera.shoot(light, t, random) for t in SECONDS]
    merged = merge(shots, SECONDS, camera.response, camera.noise)
    assert merged.valid.mean() > 0.999
    off = np.where(merged.valid, merged.value - light, 0.0)
    bias = off.mean(axis=1) / off.std(axis=1)
    assert np.abs(bias).max() < 0.05
    z = off / np.sqrt(merged.variance)
    assert z.std(axis=1) == pytest.approx(np.ones(STEPS), abs=0.05)


def test_it_is_as_good_as_the_noise_allows():
    """Variance against the bound of Cramer and Rao, where the exposures that may count are clear."""
    camera, light = Camera("linear", 4096), np.full((200, 200), 0.2)
    merged = merge([camera.shoot(light, t, random) for t in SECONDS], SECONDS, camera.response, camera.noise)
    t = np.array(SECONDS)
    best = 1.0 / np.sum(t**2 / camera.noise.variance(0.2 * t))
    assert np.var(merged.value) == pytest.approx(best, rel=0.05)


def test_without_light_radiance_scatters_about_zero():
    camera = Camera("linear", 4096, black=0.02)
    merged = merge(
        [camera.shoot(np.zeros((300, 300)), t, random) for t in SECONDS],
        SECONDS,
        camera.response,
        camera.noise,
    )
    assert merged.valid.all()
    assert (merged.value < 0).mean() == pytest.approx(0.5, abs=0.02)
    z = merged.value / np.sqrt(merged.variance)
    assert abs(z.mean()) < 4 / 300
    assert z.std() == pytest.approx(1.0, abs=0.03)  # a variance is that of light, never of less than none


def test_pixels_without_a_valid_exposure_are_masked():
    codes = np.array([[0, 255, 100, 0, 255]], np.uint8)
    shots = [codes // 2 + (codes == 255) * np.uint8(128), codes]
    shots[1][0, 3] = 9
    merged = merge(shots, [0.5, 1.0])
    np.testing.assert_array_equal(merged.valid, [[False, False, True, True, False]])
    np.testing.assert_array_equal(merged.value[~merged.valid], 0.0)
    assert np.all(np.isinf(merged.variance[~merged.valid]))
    assert np.all(np.isfinite(merged.value))
    assert merged.value[0, 2] == pytest.approx(100 / 255, rel=1e-2)


def test_saturated_photographs_have_no_weight():
    light = np.array([[3.0, 0.3]])
    shots = [np.minimum(light * t, 1.0) for t in (0.1, 1.0, 10.0)]
    merged = merge(shots, [0.1, 1.0, 10.0])
    np.testing.assert_allclose(merged.value, light, rtol=1e-6)


def test_one_photograph_is_enough():
    shot = np.array([[0.2, 0.5], [0.7, 1.0]])
    merged = merge([shot], [0.5])
    np.testing.assert_allclose(merged.value[merged.valid], [0.4, 1.0, 1.4], rtol=1e-6)
    variance = NoiseModel().variance(np.array([0.2, 0.5, 0.7])) / 0.25
    np.testing.assert_allclose(merged.variance[merged.valid], variance, rtol=1e-3)
    assert merged.valid.tolist() == [[True, True], [True, False]]


def test_repeated_photographs_average():
    shots = [np.full((2, 2), 0.3), np.full((2, 2), 0.5), np.full((2, 2), 0.4)]
    merged = merge(shots, [1.0, 1.0, 1.0])
    np.testing.assert_allclose(merged.value, 0.4, rtol=1e-6)
    np.testing.assert_allclose(merged.variance, NoiseModel().variance(0.4) / 3, rtol=1e-3)


@pytest.mark.parametrize("black", [0.1, [0.1, 0.1, 0.1]])
def test_black_is_subtracted_and_nothing_is_clipped(black):
    shots = [0.1 + t * np.linspace(-0.05, 0.2, 105).reshape(5, 7, 3) for t in (1.0, 2.0)]
    merged = merge(shots, [1.0, 2.0], black=black)
    np.testing.assert_allclose(merged.value, shots[0] - 0.1, atol=1e-6)


def test_each_channel_has_its_own_response():
    cameras = [Camera(curve, 65536, electrons=1e9, read=0.0) for curve in ("srgb", "gamma2.2", "film")]
    response = Response(np.concatenate([camera.response.values for camera in cameras]))
    light = corner(32)
    shots = [np.stack([camera.shoot(light, t, random) for camera in cameras], axis=-1) for t in (0.5, 1.0)]
    merged = merge(shots, [0.5, 1.0], response, NoiseModel(1e9, 1e-5))
    np.testing.assert_allclose(
        merged.value[merged.valid], np.stack([light] * 3, axis=-1)[merged.valid], rtol=4e-3
    )


@pytest.mark.parametrize("shape", [(1, 1), (1, 1, 3), (53, 7), (170, 211, 3)])
def test_any_size(shape):
    light = random.uniform(0.1, 0.8, shape)
    shots = [np.rint(65535 * light * t).astype(np.uint16) for t in (0.25, 1.0)]
    merged = merge(shots, [0.25, 1.0])
    assert merged.value.shape == merged.variance.shape == merged.valid.shape == shape
    assert (merged.value.dtype, merged.variance.dtype, merged.valid.dtype) == (np.float32, np.float32, bool)
    np.testing.assert_allclose(merged.value, light, rtol=1e-4)


def test_the_difference_of_two_pictures_adds_variances():
    one, two = merge([np.full((1, 2), 0.5)], [1.0]), merge([np.array([[0.2, 1.0]])], [1.0])
    left = one - two
    np.testing.assert_allclose(left.value, [[0.3, 0.0]], rtol=1e-6)
    np.testing.assert_allclose(left.variance[0, 0], one.variance[0, 0] + two.variance[0, 0])
    assert left.valid.tolist() == [[True, False]]
    assert np.isinf(left.variance[0, 1])


@pytest.mark.parametrize(
    ("options", "part"),
    [
        ({"response": Response(np.linspace([0.0] * 3, [1.0] * 3, 5, axis=1))}, "response has 3 channels"),
        ({"black": np.zeros((4, 4))}, r"black has shape \(4, 4\)"),
        ({"black": np.nan}, "black"),
        ({"levels": 1}, "levels is 1"),
    ],
)
def test_bad_input_is_refused(options, part):
    with pytest.raises(InputError, match=part):
        merge([np.full((4, 4), 0.1), np.full((4, 4), 0.2)], [1.0, 2.0], **options)


def eight_bits(*shots: np.ndarray) -> list[np.ndarray]:
    return [np.rint(np.clip(shot, 0, 1) * 255).astype(np.uint8) for shot in shots]


@pytest.mark.parametrize("clear", [1, 2, 3, 8, 64])
@pytest.mark.parametrize(
    ("light", "noise", "ratio"), [(0.15, 0.05, 1.1), (0.002, 0.01, 2.0), (0.12, 0.1, 1.5)]
)
def test_a_few_noisy_pixels_among_saturated_ones_are_in_order(clear, light, noise, ratio):
    """Three in 100000 are refused by chance."""
    refused = 0
    for _ in range(300):
        shots = np.ones((2, 200))
        shots[:, :clear] = light * np.array([[1.0], [ratio]]) + random.normal(0, noise, (2, clear))
        try:
            merge(eight_bits(*shots.reshape(2, 10, 20)), [1.0, ratio])
        except InputError:
            refused += 1
    assert refused <= 1


@pytest.mark.parametrize("bits", [8, 14])
@pytest.mark.parametrize("black", [0.004, 0.0625, 0.16])
@pytest.mark.parametrize("gamma", [1.0, 2.2])
@pytest.mark.parametrize("lit", [0.0, 0.01, 0.1, 0.3])
def test_a_dark_picture_is_as_dark_at_any_exposure(bits, black, gamma, lit):
    """Black cloth around a few pixels that are lit, or around none, for a camera of any offset."""
    light = np.zeros((40, 60))
    light.flat[: int(lit * light.size)] = 0.03 * random.random(int(lit * light.size))
    for ratio in (1.5, 4.0, 60.0):
        shots = []
        for t in (1.0, ratio):
            value = random.poisson(light * t * 1e4) / 1e4 + random.normal(0, 5e-4, light.shape)
            codes = black + (1 - black) * np.clip(value, 0, 1) ** (1 / gamma)
            shots.append(np.rint((2**bits - 1) * codes).astype(np.uint16))
        assert merge(shots, [1.0, ratio], levels=2**bits).valid.any()


def test_hot_pixels_do_not_decide_the_order():
    shots = [np.full((20, 20), 2, np.uint8) for _ in range(2)]
    for shot in shots:
        shot.flat[:4] = 128
    value = merge(shots, [1.0, 4.0]).value[1:]
    assert np.all((value >= 0.5 / 255) & (value <= 2 / 255))  # as after 4 s, and as after 1 s


def exchanged() -> tuple[list[np.ndarray], list[float]]:
    shots = [Camera().shoot(corner(), t, random) for t in SECONDS]
    return [*shots[:2], shots[3], shots[2], *shots[4:]], SECONDS


def repeated() -> tuple[list[np.ndarray], list[float]]:
    shots = [Camera().shoot(corner(), t, random) for t in SECONDS]
    return [*shots[:3], shots[2], *shots[4:]], SECONDS


def few(second: float, noise: float = 0.005) -> tuple[list[np.ndarray], list[float]]:
    """Six pixels that are not saturated."""
    shots = np.ones((2, 200))
    shots[:, :6] = np.array([[0.4], [second]]) + random.normal(0, noise, (2, 6))
    return eight_bits(*shots.reshape(2, 10, 20)), [1.0, 2.0]


def constant(black: float) -> tuple[list[np.ndarray], list[float]]:
    """A tenth of a dark picture is lit, as much for four times as long."""
    shot = black + random.normal(0, 0.002, (40, 60))
    shot[:, :6] += 0.3
    return [shot, shot + random.normal(0, 0.002, shot.shape)], [1.0, 4.0]


@pytest.mark.parametrize(
    ("case", "numbers"),
    [
        (exchanged, (3, 2)),
        (repeated, (3, 2)),
        (lambda: few(0.2), (1, 0)),
        (lambda: few(0.4), (1, 0)),
        (lambda: constant(0.0), (1, 0)),
        (lambda: constant(0.13), (1, 0)),
        (lambda: ([np.full((4, 4), 0.2), np.full((4, 4), 0.1)], [1.0, 2.0]), (1, 0)),
    ],
)
def test_photographs_in_the_wrong_order_are_named(case, numbers):
    later, earlier = numbers
    with pytest.raises(InputError, match=rf"images\[{later}\] has .* s .* images\[{earlier}\]"):
        merge(*case())
