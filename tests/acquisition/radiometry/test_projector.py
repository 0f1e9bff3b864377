# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.radiometry import ProjectorResponse, Radiance, projector
from ltcl.errors import InputError, InputTypeError
from tests.acquisition.radiometry.cameras import CURVES, corner

CODES = np.linspace(0, 1, 33)
random = np.random.default_rng()


def ramp(decode, sigma: float, scale: float = 1.0) -> list[Radiance]:
    """Pictures of uniform codes on a scene with ambient light, with noise."""
    ambient, share = 0.05 * corner(64), scale * corner(64)[::-1]
    ones = np.ones(share.shape)
    clean = [ambient + decode(c) * share for c in CODES]
    return [Radiance(part + random.normal(0, sigma, ones.shape), sigma**2 * ones, ones > 0) for part in clean]


@pytest.mark.parametrize("curve", CURVES)
def test_the_projectors_curve_is_estimated(curve):
    decode = CURVES[curve][1]
    response = projector.measure(CODES, ramp(decode, 0.005))
    codes = np.linspace(0, 1, 500)
    np.testing.assert_allclose(response.linear(codes), decode(codes), atol=2e-3)
    np.testing.assert_allclose(response.linear(response.codes(codes)), codes, atol=1e-5)
    assert isinstance(response, ProjectorResponse)


def test_noise_in_black_and_white_is_no_bias():
    """Noise as large as the light itself: the product of two noisy pictures would be far off."""
    at = np.array([0.25, 0.5, 0.75])
    light = [projector.measure(CODES, ramp(lambda c: c, 0.1, 0.3)).linear(at) for _ in range(12)]
    error = np.std(light, axis=0) / np.sqrt(len(light))
    assert np.all(np.abs(np.mean(light, axis=0) - at) < 4 * error)
    assert error.max() < 0.03


def test_each_channel_has_a_curve():
    names = ("srgb", "linear", "film")
    response = projector.measure(CODES, [ramp(CURVES[name][1], 0.002) for name in names])
    codes = np.linspace(0, 1, 50)
    exact = np.stack([CURVES[name][1](codes) for name in names], axis=-1)
    np.testing.assert_allclose(response.linear(np.stack([codes] * 3, axis=-1)), exact, atol=2e-3)


def test_a_colour_that_the_channel_does_not_light_does_not_decide():
    """Such a colour has next to no variance; its noise must not outweigh the others."""
    valid = np.full((4, 4, 3), True)
    light, variance, _ = np.broadcast_arrays([-2e-4, 0.3, 0.6], [1e-12, 3e-5, 6e-5], valid)
    pictures = [Radiance(c * light, variance, valid) for c in CODES]
    np.testing.assert_allclose(projector.measure(CODES, pictures).linear(CODES), CODES, atol=0.01)


def test_invalid_pixels_do_not_count():
    pictures = ramp(lambda c: c**2, 1e-4)
    pictures[5].valid[:8] = False
    pictures[5].value[:8] = 0.0
    np.testing.assert_allclose(projector.measure(CODES, pictures).linear(CODES), CODES**2, atol=1e-3)


FLAT = Radiance(np.full((2, 2), 0.1), np.full((2, 2), 1e-6), np.full((2, 2), True))
DARK = Radiance(np.zeros((2, 2)), np.full((2, 2), np.inf), np.full((2, 2), False))


@pytest.mark.parametrize(
    ("codes", "pictures", "error", "part"),
    [
        ([0.0, 0.5], [FLAT, FLAT], InputError, "codes is"),
        ([0.0, 1.0], [FLAT], InputError, "pictures holds 1 .* 2"),
        ([0.0, 1.0], [FLAT, FLAT.value], InputTypeError, r"pictures\[1\] is a ndarray"),
        ([0.0, 1.0], [FLAT, FLAT], InputError, "pictures are no brighter"),
        ([0.0, 1.0], [FLAT, DARK], InputError, "pictures have no pixel"),
    ],
)
def test_pictures_without_a_response_are_refused(codes, pictures, error, part):
    with pytest.raises(error, match=part):
        projector.measure(codes, pictures)
