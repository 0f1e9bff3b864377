# SPDX-License-Identifier: BSD-3-Clause
"""The noise model against cameras whose noise is known."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.radiometry import NoiseModel, Response, estimate
from ltcl.errors import InputError
from tests.acquisition.radiometry.cameras import Camera, corner

random = np.random.default_rng()


def test_the_variance_is_photons_reading_and_rounding():
    model, light = NoiseModel(1000.0, 0.01, levels=11), np.array([-0.1, 0.0, 0.5])
    np.testing.assert_allclose(model.variance(light, 2.0), light.clip(0) / 1000 + 1e-4 + 2.0**2 * 0.1**2 / 12)
    np.testing.assert_allclose(NoiseModel(1000.0, 0.01).variance(0.5), 6e-4)


@pytest.mark.parametrize(
    ("curve", "levels", "read"),
    [
        ("linear", 65536, 0.004),
        ("linear", 0, 0.004),
        ("srgb", 4096, 0.004),
        ("film", 4096, 0.004),
        ("srgb", 256, 0.008),
    ],
)
def test_photon_transfer_estimates_electrons_and_read_noise(curve, levels, read):
    """Half a million degrees of freedom: a standard error of about half a percent."""
    camera = Camera(curve, levels, 4000.0, read, black=0.05)
    bursts = [[camera.shoot(corner(), t, random) for _ in range(5)] for t in (0.05, 1.0)]
    model = estimate(bursts, response=camera.response, levels=levels or None)
    assert model.electrons == pytest.approx(4000.0, rel=0.03)
    assert model.read == pytest.approx(read, rel=0.03)
    assert model.levels == levels


def test_clipped_pixels_do_not_count():
    """A scene of which a third is saturated and a third black gives the model of the rest."""
    camera = Camera("linear", 4096, 4000.0, 0.004, black=0.02)
    light = np.repeat(np.array([0.0, 0.3, 5.0]), 30000).reshape(300, 300)
    light[100:200] *= np.linspace(0.05, 2.0, 300)
    burst = [camera.shoot(light, 1.0, random) for _ in range(4)]
    model = estimate([burst], response=camera.response, levels=4096)
    assert model.electrons == pytest.approx(4000.0, rel=0.05)


@pytest.mark.parametrize("n", [16, 64])
@pytest.mark.parametrize("black", [0.0, 0.004, 0.01])
@pytest.mark.parametrize(("read", "electrons"), [(0.0005, 10000.0), (0.003, 2000.0), (0.01, 1000.0)])
def test_read_noise_is_estimated_where_black_is_clipped_or_rounded_to_one_code(n, black, read, electrons):
    """Eight bits: 0.13, 0.77 and 2.6 codes of it, with black at 0, 1.02 and 2.55 codes."""
    camera = Camera("linear", 256, electrons, read, black)
    ramp = np.broadcast_to(np.linspace(0, 1, n) ** 2.2 * 0.6, (n, n))
    bursts = [[camera.shoot(light, 1.0, random) for _ in range(6)] for light in (ramp, 0 * ramp, 0 * ramp)]
    model = estimate(bursts, response=camera.response, levels=256)
    assert model.electrons == pytest.approx(electrons, rel=0.2)
    assert abs(model.read - read) < max(0.5 * read, 0.25 / 255)  # rounding alone adds 0.29 codes


@pytest.mark.parametrize("levels", [4096, 0])
@pytest.mark.parametrize("offset", [0.0, 0.004])
def test_noise_that_is_clipped_before_an_offset_is_added_does_not_count(levels, offset):
    light = np.geomspace(1e-3, 2, 9600).reshape(80, 120)

    def shoot(value):
        value = random.poisson(value * 1e4) / 1e4 + random.normal(0, 5e-4, value.shape)
        code = offset + (1 - offset) * np.clip(value, 0, 1)
        return np.rint(code * (levels - 1)).astype(np.uint16) if levels else code

    bursts = [[shoot(light * t) for _ in range(6)] for t in (0.05, 0.3, 0.0)]
    response = Response((np.linspace(0, 1, 16385) - offset) / (1 - offset))
    model = estimate(bursts, response=response, levels=levels or None)
    assert model.electrons == pytest.approx(10000.0, rel=0.03)
    assert model.read == pytest.approx(5e-4, rel=0.1)


def test_codes_that_never_change_hide_a_fifth_of_one_at_most():
    """A scene of three even parts without any noise that the codes show."""
    shots = [np.repeat(np.array([3, 90, 200], np.uint8), 100).reshape(15, 20)] * 4
    assert 0 < estimate([shots]).read * 255 <= 0.2


def test_a_response_that_is_flat_in_the_dark_gives_no_warnings():
    flat = Response(np.maximum(np.linspace(-0.1, 1.0, 12), 0.0))
    light = np.tile(np.linspace(0.0, 200.0, 64), (64, 1))
    shots = [np.rint(random.normal(light, 2.0)).clip(0, 255).astype(np.uint8) for _ in range(6)]
    with np.errstate(all="raise"):
        model = estimate([shots], response=flat)
    assert 0 < model.read < 0.02
    assert model.electrons > 1000


def test_few_pixels_of_one_brightness_bound_the_read_noise_by_all_their_noise():
    """Four pixels give no slope; 3 codes is the deviation that they have."""
    model = estimate([[np.rint(random.normal(100, 3, (2, 2))).astype(np.uint8) for _ in range(8)]])
    assert model.read * 255 < 6


@pytest.mark.parametrize(
    ("bursts", "part"),
    [
        ([], "bursts is empty"),
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
    ("options", "name"),
    [
        ({"electrons": 0.0}, "electrons"),
        ({"read": -1.0}, "read"),
        ({"saturation": 1.5}, "saturation"),
        ({"black": 0.97}, "saturation"),
        ({"levels": -1}, "levels"),
    ],
)
def test_bad_models_are_refused(options, name):
    with pytest.raises(InputError, match=name):
        NoiseModel(**options)
