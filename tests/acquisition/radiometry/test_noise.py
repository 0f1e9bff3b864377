# SPDX-License-Identifier: BSD-3-Clause
"""Noise models and levels of black against cameras whose noise is known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.acquisition.radiometry import NoiseModel, Response, black_level, estimate, merge
from ltcl.errors import InputError
from tests.acquisition.radiometry.cameras import Camera, corner

random = np.random.default_rng()


def burst(camera: Camera, light: np.ndarray, seconds: float, count: int) -> list[np.ndarray]:
    """Photographs repeated without any change."""
    return camera.bracket(light, [seconds] * count, random)


def test_the_variance_is_photons_reading_and_rounding():
    model = NoiseModel(1000.0, 0.01, levels=11)
    light = np.array([-0.1, 0.0, 0.5])
    np.testing.assert_allclose(
        model.variance(light, 2.0), light.clip(0) / 1000 + 1e-4 + 2.0**2 * 0.1**2 / 12
    )
    np.testing.assert_allclose(NoiseModel(1000.0, 0.01).variance(0.5), 6e-4)


@pytest.mark.parametrize(
    ("curve", "levels", "read"),
    [("linear", 65536, 0.004), ("linear", 0, 0.004), ("film", 4096, 0.004), ("srgb", 256, 0.008)],
)
def test_photon_transfer_estimates_electrons_and_read_noise(curve, levels, read):
    """Half a million degrees of freedom: a standard error of about half a percent."""
    camera = Camera(curve, levels, 4000.0, read, black=0.05)
    bursts = [burst(camera, corner(), t, 5) for t in (0.05, 1.0)]
    model = estimate(bursts, response=camera.response, levels=levels or None)
    assert model.electrons == pytest.approx(4000.0, rel=0.03)
    assert model.read == pytest.approx(read, rel=0.03)
    assert model.levels == levels


@pytest.mark.parametrize("black", [0.0, 0.004, 0.01])
@pytest.mark.parametrize(
    ("read", "electrons"), [(0.0005, 10000.0), (0.003, 2000.0), (0.01, 1000.0)]
)
def test_read_noise_is_estimated_where_black_is_clipped_or_rounded_to_one_code(
    black, read, electrons
):
    """Eight bits: 0.13, 0.77 and 2.6 codes of it, with black at 0, 1.02 and 2.55 codes.

    Rounding of 0.13 codes next to the border of two codes makes electrons 16 % too many (measured,
    20 seeds).
    """
    camera = Camera("linear", 256, electrons, read, black)
    ramp = np.broadcast_to(np.linspace(0, 1, 64) ** 2.2 * 0.6, (64, 64))
    bursts = [burst(camera, light, 1.0, 6) for light in (ramp, 0 * ramp, 0 * ramp)]
    model = estimate(bursts, response=camera.response, levels=256)
    assert model.electrons == pytest.approx(electrons, rel=0.24)
    assert abs(model.read - read) < max(0.5 * read, 0.29 / 255)  # what rounding alone adds


def test_a_scene_that_moves_between_repeated_photographs_is_not_noise():
    """Edges of a few pixels: were they noise, nothing that moves would deviate from it any more."""
    camera = Camera("linear", 4096, 10000.0, 0.002, black=0.05)
    light = np.where(np.arange(96) // 24 % 2, 0.7, 0.1) * np.linspace(0.8, 1.0, 64)[:, None]
    moved = np.roll(light, 1, axis=1)
    burst = [camera.shoot(light, 1.0, random), camera.shoot(moved, 1.0, random)]
    model = estimate([burst], response=camera.response, levels=4096)
    assert model.electrons == pytest.approx(10000.0, rel=0.2)


@pytest.mark.parametrize("levels", [4096, 0])
def test_pixels_that_are_clipped_at_either_end_do_not_count(levels):
    camera = Camera("linear", levels, read=5e-4, black=0.0)
    light = np.geomspace(1e-3, 8, 9600).reshape(80, 120)
    bursts = [list(np.clip(burst(camera, light, t, 6), 0, None)) for t in (0.05, 0.3, 0.0)]
    model = estimate(bursts, levels=levels or None)
    assert model.electrons == pytest.approx(10000.0, rel=0.03)
    assert model.read == pytest.approx(5e-4, rel=0.1)


def test_codes_that_never_change_hide_a_fifth_of_one_at_most():
    """A scene of three even parts without any noise that the codes show."""
    shots = [np.repeat(np.array([3, 90, 200], np.uint8), 100).reshape(15, 20)] * 4
    assert 0 < estimate([shots]).read * 255 <= 0.2


@pytest.mark.parametrize(
    ("bursts", "part"),
    [
        ([], "bursts"),
        ([[np.zeros((4, 4))]], r"bursts\[0\] holds one"),
        ([np.full((2, 4, 4), 255, np.uint8)], "bursts have no pixels"),
        ([np.zeros((2, 4, 4), np.uint8)], "bursts have no pixels"),
        ([[np.zeros((4, 4)), np.zeros((4, 5))]], r"bursts\[0\]\[1\] has shape"),
    ],
)
def test_bursts_without_noise_are_refused(bursts, part):
    with pytest.raises(InputError, match=part):
        estimate(bursts)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("electrons", 0.0),
        ("read", -1.0),
        ("saturation", 1.5),
        ("saturation", -1e-3),
        ("levels", -1),
    ],
)
def test_bad_models_are_refused(name, value):
    with pytest.raises(InputError, match=name):
        NoiseModel(**{name: value})


SECONDS = [0.25, 0.5, 1.0, 1.0, 1.0, 1.0]
MODEL = NoiseModel(10000.0, 0.001)
LINE = Response.identity()


def shots(ambient: np.ndarray, offset: Any) -> list[np.ndarray]:
    photographs = []
    for t in SECONDS:
        light = random.poisson(ambient * t * MODEL.electrons) / MODEL.electrons
        photographs.append(offset + light + random.normal(0, MODEL.read, light.shape))
    return photographs


def test_the_level_of_each_channel_is_separated_from_ambient_light_without_bias():
    offset = np.array([0.002, 0.01, 0.03])
    ambient = 0.05 * np.stack([corner(64)] * 3, axis=-1) * [1.0, 0.5, 0.1]
    levels = [black_level(shots(ambient, offset), SECONDS, LINE, MODEL) for _ in range(16)]
    error = np.std(levels, axis=0)
    assert error.max() < 1e-4
    assert np.all(np.abs(np.mean(levels, axis=0) - offset) < 4 * error / 4)


def test_the_projectors_light_is_the_difference():
    """Offset and ambient light cancel in the difference."""
    ambient = 0.05 * corner(100)
    light = 0.5 * corner(100)[::-1]
    black = black_level(shots(ambient, 0.02), SECONDS, LINE, MODEL)
    dark = merge(shots(ambient, 0.02), SECONDS, noise=MODEL, black=black)
    bright = merge(shots(ambient + light, 0.02), SECONDS, noise=MODEL, black=black)
    lit = bright - dark
    z = (lit.value - light) / np.sqrt(lit.variance)
    assert abs(z.mean()) < 0.06
    assert z.std() == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(
    ("images", "seconds", "part"),
    [
        (np.zeros((2, 4, 4)), [1.0, 1.0], "seconds"),
        (np.ones((2, 4, 4)), [1.0, 2.0], "images .* saturated"),
        ([], [], "images"),
    ],
)
def test_photographs_without_an_offset_are_refused(images, seconds, part):
    with pytest.raises(InputError, match=part):
        black_level(images, seconds, LINE, MODEL)
