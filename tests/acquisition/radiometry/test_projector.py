# SPDX-License-Identifier: BSD-3-Clause
"""Curves and colours of projectors against those that made the pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ltcl.acquisition.radiometry import Radiance, colour_response, mixing, projector_response
from ltcl.errors import InputError
from tests.acquisition.radiometry.cameras import CURVES, corner

CODES = np.linspace(0, 1, 33)
random = np.random.default_rng()


def ramp(decode, sigma: float, scale: float = 1.0) -> list[Radiance]:
    """Pictures of uniform codes on a scene with ambient light, with noise."""
    ambient = 0.05 * corner(64)
    share = scale * corner(64)[::-1]
    ones = np.ones(share.shape)
    pictures = []
    for c in CODES:
        noise = random.normal(0, sigma, ones.shape)
        light = ambient + decode(c) * share
        pictures.append(Radiance(light + noise, sigma**2 * ones, ones > 0))
    return pictures


@pytest.mark.parametrize("curves", [["linear"], ["gamma2.2"], ["srgb", "linear", "film"]])
def test_the_projectors_curve_is_estimated_of_each_channel(curves):
    codes = np.linspace(0, 1, 500)
    decodes = [CURVES[curve][1] for curve in curves]
    ramps = [ramp(decode, 0.005) for decode in decodes]
    invalid = ramps[0][5]  # its rows must not count
    invalid.valid[:8] = False
    invalid.value[:8] = 0.0
    response = projector_response(CODES, ramps)
    light = np.stack([decode(codes) for decode in decodes], axis=-1)
    same = np.stack([codes] * len(curves), axis=-1)
    np.testing.assert_allclose(response.linear(same), light, atol=2e-3)
    np.testing.assert_allclose(response.linear(response.codes(same)), same, atol=1e-5)


def test_noise_in_black_and_white_is_no_bias():
    """Noise as large as the light itself: the product of two noisy pictures would be far off."""
    at = np.array([0.25, 0.5, 0.75])
    light = [projector_response(CODES, [ramp(lambda c: c, 0.1, 0.3)]).linear(at) for _ in range(12)]
    error = np.std(light, axis=0) / np.sqrt(len(light))
    assert np.all(np.abs(np.mean(light, axis=0) - at) < 4 * error)
    assert error.max() < 0.03


def test_a_colour_that_the_channel_does_not_light_does_not_decide():
    """Such a colour has next to no variance; its noise must not outweigh the others."""
    valid = np.full((4, 4, 3), True)
    light, variance, _ = np.broadcast_arrays([-2e-4, 0.3, 0.6], [1e-12, 3e-5, 6e-5], valid)
    pictures = [Radiance(c * light, variance, valid) for c in CODES]
    np.testing.assert_allclose(
        projector_response(CODES, [pictures]).linear(CODES), CODES, atol=0.01
    )


def test_curves_of_three_channels_are_told_apart_in_pictures_of_all_at_once() -> None:
    """Each has its own curve, and colours mix; noise is a hundredth of white."""
    M = np.array([[1.0, 0.2, 0.0], [0.1, 1.0, 0.1], [0.0, 0.3, 1.0]])
    decodes = [CURVES[curve][1] for curve in ("srgb", "linear", "film")]
    albedo = corner(64)[..., None] * (0.9, 0.6, 0.3)
    valid = np.full(albedo.shape, True)
    sigma = 0.005

    def picture(light) -> Radiance:
        noise = random.normal(0, sigma, albedo.shape)
        return Radiance(0.02 + albedo * (M @ light) + noise, sigma**2 + 0 * albedo, valid)

    pictures = []
    for code in CODES[1:-1]:
        pictures.append(picture(np.array([decode(code) for decode in decodes])))
    colours = [picture(light) for light in np.eye(3)]
    response = colour_response(CODES, pictures, colours, picture(np.zeros(3)))
    codes = np.linspace(0, 1, 500)
    expected = np.stack([decode(codes) for decode in decodes], axis=-1)
    np.testing.assert_allclose(response.linear(np.stack([codes] * 3, -1)), expected, atol=5e-3)


FLAT = Radiance(np.full((2, 2), 0.1), np.full((2, 2), 1e-6), np.full((2, 2), True))
DARK = Radiance(np.zeros((2, 2)), np.full((2, 2), np.inf), np.full((2, 2), False))


@pytest.mark.parametrize(
    ("codes", "pictures", "message"),
    [
        ([0.0, 0.5], [FLAT, FLAT], "codes is"),
        ([0.0, 1.0], [FLAT], r"channels\[0\] holds 1 .* 2"),
        ([0.0, 1.0], [FLAT, FLAT], r"channels\[0\] are no brighter"),
        ([0.0, 1.0], [FLAT, DARK], r"channels\[0\] have no pixel"),
    ],
)
def test_pictures_without_a_response_are_refused(codes, pictures, message):
    with pytest.raises(InputError, match=message):
        projector_response(codes, [pictures])


LIT = [Radiance(FLAT.value + 0.5 * k, FLAT.variance, FLAT.valid) for k in range(3)]


@pytest.mark.parametrize(
    ("codes", "pictures", "colours", "message"),
    [
        ([0.0, 0.5], [], LIT, "codes is"),
        ([0.0, 0.5, 1.0], [], LIT, "pictures holds 0"),
        ([0.0, 0.5, 1.0], [FLAT], LIT[:2], "colours 2"),
        ([0.0, 0.5, 1.0], [DARK], LIT, "no value that is valid"),
        ([0.0, 0.5, 1.0], [FLAT], LIT, r"colours\[0\] is no brighter"),
        ([0.0, 0.5, 1.0], [FLAT], [LIT[1], LIT[1], LIT[2]], "are alike"),
    ],
)
def test_pictures_without_three_responses_are_refused(codes, pictures, colours, message):
    with pytest.raises(InputError, match=message):
        colour_response(codes, pictures, colours, FLAT)


M = np.array([[1.0, 0.3, 0.02], [0.1, 1.0, 0.2], [0.01, 0.15, 1.0]])
# T in each channel.
WALL = np.stack([corner(64), 0.5 * corner(64)[::-1], 0.8 * corner(64).T], axis=-1)
BLACK = Radiance(np.zeros(WALL.shape), np.zeros(WALL.shape), np.full(WALL.shape, True))


def lit(sigma: float, M: np.ndarray = M, ambient: float = 0.0) -> list[Radiance]:
    variance = np.full(WALL.shape, sigma**2)
    valid = np.full(WALL.shape, True)
    pictures = []
    for d in range(3):
        noise = random.normal(0, sigma, WALL.shape)
        pictures.append(Radiance(ambient + WALL * M[:, d] + noise, variance, valid))
    return pictures


def test_the_mixing_of_a_set_up_is_estimated_without_bias_less_black():
    black = replace(BLACK, value=BLACK.value + 0.3)
    estimates = [mixing(lit(0.2, ambient=0.3), black) for _ in range(16)]
    error = np.std(estimates, axis=0) / 4
    bias = np.abs(np.mean(estimates, axis=0) - M)
    assert np.all(bias[error > 0] < 4 * error[error > 0])
    assert error.max() < 0.015
    np.testing.assert_array_equal(np.diagonal(estimates[0]), 1.0)


def test_mixings_are_refused_from_a_condition_number_of_a_million():
    """[[1, 1 - d], [1 - d, 1]] has the condition number (2 - d) / d."""
    for condition in (0.9e6, 1.1e6):
        nearly = np.eye(3)
        nearly[0, 1] = nearly[1, 0] = 1.0 - 2.0 / (condition + 1.0)
        pictures = lit(0.0, nearly)
        if condition < 1e6:
            np.testing.assert_allclose(mixing(pictures, BLACK), nearly, atol=1e-12)
    with pytest.raises(InputError, match=r"condition number 1\.1e\+06"):
        mixing(pictures, BLACK)


def test_pictures_without_a_mixing_are_refused():
    good = lit(1e-3)
    dark = replace(good[0], value=0 * WALL)
    unknown = replace(good[0], valid=np.zeros(WALL.shape, bool))
    grey = replace(good[0], value=WALL[..., 0])
    for pictures, message in (
        (good[:2], "lit holds 2"),
        ([dark, dark, dark], r"lit\[0\]"),
        ([good[0], grey, good[2]], r"lit\[1\] has shape \(64, 64\)"),
        ([unknown, *good[1:]], "lit have no pixel"),
    ):
        with pytest.raises(InputError, match=message):
            mixing(pictures, BLACK)
