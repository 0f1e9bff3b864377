# SPDX-License-Identifier: BSD-3-Clause
"""The noise model against cameras whose noise is known."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.radiometry import NoiseModel, estimate
from ltcl.errors import InputError
from tests.acquisition.radiometry.cameras import Camera, corner


def test_the_variance_is_photons_reading_and_rounding():
    model = NoiseModel(1000.0, 0.01, levels=11)
    wanted = np.array([-0.1, 0.0, 0.5]).clip(0) / 1000 + 1e-4 + 2.0**2 * 0.1**2 / 12
    np.testing.assert_allclose(model.variance(np.array([-0.1, 0.0, 0.5]), 2.0), wanted)
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
def test_photon_transfer_finds_electrons_and_read_noise(curve, levels, read):
    """Half a million degrees of freedom: a standard error of about half a percent."""
    camera, rng = Camera(curve, levels, 4000.0, read, black=0.05), np.random.default_rng(0)
    bursts = [[camera.shoot(corner(), t, rng) for _ in range(5)] for t in (0.05, 1.0)]
    found = estimate(bursts, response=camera.response, levels=levels or None)
    assert found.electrons == pytest.approx(4000.0, rel=0.03)
    assert found.read == pytest.approx(read, rel=0.03)
    assert found.levels == levels


def test_black_is_no_light():
    rng = np.random.default_rng(1)
    light = np.linspace(0, 0.7, 40000).reshape(200, 200)
    shots = [0.1 + rng.poisson(light * 2000) / 2000 + rng.normal(0, 0.005, light.shape) for _ in range(4)]
    found = estimate([shots], black=0.1)
    assert found.electrons == pytest.approx(2000.0, rel=0.05)
    assert found.read == pytest.approx(0.005, rel=0.05)


def test_clipped_pixels_do_not_count():
    """A scene of which a third is saturated and a third black gives the model of the rest."""
    camera, rng = Camera("linear", 4096, 4000.0, 0.004, black=0.02), np.random.default_rng(2)
    light = np.repeat(np.array([0.0, 0.3, 5.0]), 30000).reshape(300, 300)
    light[100:200] *= np.linspace(0.05, 2.0, 300)
    found = estimate(
        [[camera.shoot(light, 1.0, rng) for _ in range(4)]], response=camera.response, levels=4096
    )
    assert found.electrons == pytest.approx(4000.0, rel=0.05)


@pytest.mark.parametrize(
    ("bursts", "part"),
    [
        ([], "bursts is empty"),
        ([[np.zeros((4, 4))]], r"bursts\[0\] holds one photograph"),
        ([np.full((2, 4, 4), 255, np.uint8)], "no pixels between black and saturation"),
        ([np.zeros((2, 4, 4), np.uint8)], "no pixels between black and saturation"),
        ([[np.zeros((4, 4)), np.zeros((4, 5))]], r"bursts\[0\]\[1\] has shape"),
    ],
)
def test_what_tells_no_noise_is_refused(bursts, part):
    with pytest.raises(InputError, match=part):
        estimate(bursts)


@pytest.mark.parametrize(
    "options", [{"electrons": 0.0}, {"read": -1.0}, {"saturation": 1.5}, {"black": 0.97}, {"levels": -1}]
)
def test_what_is_no_model_is_refused(options):
    with pytest.raises(InputError, match=next(iter(options)) if "black" not in options else "saturation"):
        NoiseModel(**options)
