# SPDX-License-Identifier: BSD-3-Clause
from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.radiometry import ProjectorResponse, Radiance, projector
from ltcl.errors import InputError, InputTypeError
from tests.acquisition.radiometry.cameras import CURVES, corner

CODES = np.linspace(0, 1, 33)


def ramp(decode, sigma: float, seed: int = 0, scale: float = 1.0) -> list[Radiance]:
    """Pictures of uniform codes on a scene with ambient light, with noise."""
    rng, ambient, share = np.random.default_rng(seed), 0.05 * corner(64), scale * corner(64)[::-1]
    clean = [ambient + decode(c) * share for c in CODES]
    ones = np.ones(share.shape)
    return [Radiance(part + rng.normal(0, sigma, ones.shape), sigma**2 * ones, ones > 0) for part in clean]


@pytest.mark.parametrize("curve", CURVES)
def test_the_projectors_curve_is_found(curve):
    decode = CURVES[curve][1]
    found = projector.measure(CODES, ramp(decode, 0.005))
    codes = np.linspace(0, 1, 500)
    np.testing.assert_allclose(found.linear(codes), decode(codes), atol=2e-3)
    np.testing.assert_allclose(found.linear(found.codes(codes)), codes, atol=1e-5)
    assert isinstance(found, ProjectorResponse)


def test_noise_in_black_and_white_is_no_bias():
    """Noise as large as the light itself: the product of two noisy pictures would be far off."""
    found = [
        projector.measure(CODES, ramp(lambda c: c, 0.1, seed, 0.3)).linear(np.array([0.25, 0.5, 0.75]))
        for seed in range(12)
    ]
    error = np.std(found, axis=0) / np.sqrt(len(found))
    assert np.all(np.abs(np.mean(found, axis=0) - [0.25, 0.5, 0.75]) < 4 * error)
    assert error.max() < 0.02


def test_each_channel_has_a_curve():
    names = ("srgb", "linear", "film")
    found = projector.measure(CODES, [ramp(CURVES[name][1], 0.002) for name in names])
    codes = np.linspace(0, 1, 50)
    wanted = np.stack([CURVES[name][1](codes) for name in names], axis=-1)
    np.testing.assert_allclose(found.linear(np.stack([codes] * 3, axis=-1)), wanted, atol=2e-3)


def test_a_colour_that_the_channel_does_not_light_says_nothing_of_it():
    """Next to no variance is told of such a colour; what is there of noise must not outweigh the others."""
    seen = np.full((4, 4, 3), True)
    light, variance, _ = np.broadcast_arrays([-2e-4, 0.3, 0.6], [1e-12, 3e-5, 6e-5], seen)
    pictures = [Radiance(c * light, variance, seen) for c in CODES]
    np.testing.assert_allclose(projector.measure(CODES, pictures).linear(CODES), CODES, atol=0.01)


def test_invalid_pixels_do_not_count():
    pictures = ramp(lambda c: c**2, 1e-4)
    pictures[5].valid[:8] = False
    pictures[5].value[:8] = 0.0
    found = projector.measure(CODES, pictures)
    np.testing.assert_allclose(found.linear(CODES), CODES**2, atol=1e-3)


FLAT = Radiance(np.full((2, 2), 0.1), np.full((2, 2), 1e-6), np.full((2, 2), True))
DARK = Radiance(np.zeros((2, 2)), np.full((2, 2), np.inf), np.full((2, 2), False))


@pytest.mark.parametrize(
    ("codes", "pictures", "error", "part"),
    [
        ([0.0, 0.5], [FLAT, FLAT], InputError, "from 0 to 1"),
        ([0.0, 1.0], [FLAT], InputError, r"1 picture\(s\) for 2 codes"),
        ([0.0, 1.0], [FLAT, FLAT.value], InputTypeError, r"pictures\[1\] is a ndarray"),
        ([0.0, 1.0], [FLAT, FLAT], InputError, "no brighter"),
        ([0.0, 1.0], [FLAT, DARK], InputError, "no pixel that is valid"),
    ],
)
def test_what_tells_no_response_is_refused(codes, pictures, error, part):
    with pytest.raises(error, match=part):
        projector.measure(codes, pictures)
