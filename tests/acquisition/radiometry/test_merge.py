# SPDX-License-Identifier: BSD-3-Clause
"""Merged radiance: unbiased from floor to saturation, with the variance that it says it has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ltcl.acquisition.radiometry import NoiseModel, Response, merge
from ltcl.errors import InputError
from tests.acquisition.radiometry.cameras import CURVES, Camera, corner, shoot_channels

SECONDS = [0.1, 0.2, 0.4, 0.8, 1.6, 3.2]
random = np.random.default_rng()
STEPS = 40
REPEATS = 8000


@pytest.mark.parametrize("levels", [256, 4096, 0])
@pytest.mark.parametrize("curve", CURVES)
def test_merged_radiance_is_unbiased_and_its_variance_true(curve, levels):
    """Brightness goes from near the noise to all but the shortest exposure saturated.

    A mean of 8000 has the standard error 0.011 of the noise of one: four and a half are allowed. In
    8 bits the read noise is half a code, so that it dithers them.
    """
    camera = Camera(curve, levels, read=0.002 if levels == 256 else 0.001, black=0.02)
    light = np.repeat(np.geomspace(2.5e-3, 6.0, STEPS), REPEATS).reshape(STEPS, REPEATS)
    shots = camera.bracket(light, SECONDS, random)
    merged = merge(shots, SECONDS, camera.response, camera.noise)
    assert merged.valid.mean() > 0.999
    error = np.where(merged.valid, merged.value - light, 0.0)
    assert np.abs(error.mean(axis=1) / error.std(axis=1)).max() < 0.05
    z = error / np.sqrt(merged.variance)
    assert z.std(axis=1) == pytest.approx(np.ones(STEPS), abs=0.05)


@pytest.mark.parametrize("light", [0.0, 0.2])
def test_it_is_as_good_as_the_noise_allows(light):
    """It reaches the bound of Cramer and Rao; without light radiance scatters about 0."""
    camera = Camera("linear", 4096, black=0.02)
    t = np.array(SECONDS)
    shots = camera.bracket(np.full((200, 200), light), SECONDS, random)
    merged = merge(shots, SECONDS, camera.response, camera.noise)
    bound = 1.0 / np.sum(t**2 / camera.noise.variance(light * t))
    assert merged.valid.all()
    assert abs(merged.value.mean() - light) < 4 * np.sqrt(bound) / 200
    assert [np.var(merged.value), merged.variance.mean()] == pytest.approx([bound, bound], rel=0.05)


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


@pytest.mark.parametrize("shots", [[0.4], [0.3, 0.5, 0.4]])
def test_the_mean_of_repeated_photographs_and_its_variance(shots):
    """Tabulated weights are good to a thousandth."""
    merged = merge([np.array([[shot, 1.0]]) for shot in shots], [0.5] * len(shots))
    np.testing.assert_allclose(merged.value, [[0.8, 0.0]], rtol=1e-6)
    np.testing.assert_allclose(
        merged.variance[0, 0], NoiseModel().variance(0.4) * 4 / len(shots), rtol=1e-3
    )
    assert merged.valid.tolist() == [[True, False]]


def test_each_channel_has_its_own_response():
    clean = Camera("srgb", 65536, electrons=1e9, read=0.0)
    cameras = [clean, replace(clean, curve="gamma2.2"), replace(clean, curve="film")]
    response = Response(np.concatenate([camera.response.values for camera in cameras]))
    shots = shoot_channels(cameras, corner(32), [0.5, 1.0])
    merged = merge(shots, [0.5, 1.0], response, NoiseModel(1e9, 1e-5))
    ratio = merged.value / corner(32)[..., None]
    np.testing.assert_allclose(ratio[merged.valid], 1.0, rtol=4e-3)


@pytest.mark.parametrize("shape", [(1, 1), (1, 1, 3), (53, 7), (170, 211, 3)])
def test_any_size(shape):
    light = random.uniform(0.1, 0.8, shape)
    shots = [np.rint(65535 * light * t).astype(np.uint16) for t in (0.25, 1.0)]
    merged = merge(shots, [0.25, 1.0])
    assert merged.value.shape == merged.variance.shape == merged.valid.shape == shape
    assert (merged.value.dtype, merged.variance.dtype, merged.valid.dtype) == (
        np.float32,
        np.float32,
        bool,
    )
    np.testing.assert_allclose(merged.value, light, rtol=1e-4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"response": Response(np.linspace([0.0] * 3, [1.0] * 3, 5, axis=1))},
            "response has 3 channels",
        ),
        ({"black": np.zeros((4, 4))}, r"black has shape \(4, 4\)"),
        ({"black": np.nan}, "black"),
        ({"levels": 1}, "levels is 1"),
    ],
)
def test_bad_input_is_refused(options, message):
    with pytest.raises(InputError, match=message):
        merge([np.full((4, 4), 0.1), np.full((4, 4), 0.2)], [1.0, 2.0], **options)


@pytest.mark.parametrize("pixels", [1, 3, 64])
@pytest.mark.parametrize(("light", "noise", "ratio"), [(0.15, 0.05, 1.2), (0.002, 0.01, 2.0)])
def test_a_few_noisy_pixels_among_saturated_ones_are_in_order(pixels, light, noise, ratio):
    """Three in 100000 are refused by chance."""
    for _ in range(200):
        shots = np.ones((2, 200))
        shots[:, :pixels] = light * np.array([[1.0], [ratio]]) + random.normal(
            0, noise, (2, pixels)
        )
        codes = np.rint(np.clip(shots, 0, 1) * 255).astype(np.uint8).reshape(2, 10, 20)
        assert merge(list(codes), [1.0, ratio]).value.shape == (10, 20)


@pytest.mark.parametrize("black", [0.004, 0.16])
@pytest.mark.parametrize(("lit", "hot"), [(0.0, 0.0), (0.01, 0.0), (0.3, 0.0), (0.0, 0.01)])
def test_a_dark_picture_is_as_dark_at_any_exposure(black, lit, hot):
    """Black cloth is around some lit pixels, around hot ones, which never change, or alone."""
    camera = Camera("gamma2.2", 16384, read=5e-4, black=black)
    light = np.zeros((40, 60))
    lit_pixels = int(lit * light.size)
    light.flat[:lit_pixels] = 0.03 * random.random(lit_pixels)
    stuck = random.random(light.shape) < hot
    for ratio in (1.5, 60.0):
        shots = np.stack(camera.bracket(light, [1.0, ratio], random))
        shots[:, stuck] = 11469
        assert merge(list(shots), [1.0, ratio], levels=16384).valid.any()


@pytest.mark.parametrize("order", [[0, 1, 3, 2, 4, 5], [0, 1, 2, 2, 4, 5], [0, 2, 3, 4, 5, 1]])
def test_photographs_in_the_wrong_order_are_named(order):
    shots = Camera().bracket(corner(), SECONDS, random)
    later = 5 if order[-1] == 1 else 3
    with pytest.raises(InputError, match=rf"images\[{later}\] .* images\[{later - 1}\]"):
        merge([shots[k] for k in order], SECONDS)


@pytest.mark.parametrize("black", [0.0, 0.13])
def test_a_longer_exposure_of_as_much_light_is_named(black):
    """A tenth of a dark picture is lit, as much for four times as long."""
    shot = black + random.normal(0, 0.002, (40, 60))
    shot[:, :6] += 0.3
    with pytest.raises(InputError, match=r"images\[1\] .* images\[0\]"):
        merge([shot, shot + random.normal(0, 0.002, shot.shape)], [1.0, 4.0])
