# SPDX-License-Identifier: BSD-3-Clause
"""The noise model against cameras whose noise is known."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.radiometry import NoiseModel, Response, estimate
from ltcl.acquisition.radiometry.noise import _undone
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


@pytest.mark.parametrize("n", [16, 64])
@pytest.mark.parametrize("black", [0.0, 0.004, 0.01])
@pytest.mark.parametrize(("read", "electrons"), [(0.0005, 10000.0), (0.003, 2000.0), (0.01, 1000.0)])
def test_read_noise_is_found_where_black_frames_are_clipped_or_rounded_to_one_code(n, black, read, electrons):
    """Eight bits: 0.13, 0.77 and 2.6 codes of it, with black at 0, 1.02 and 2.55 codes."""
    camera, rng = Camera("linear", 256, electrons, read, black), np.random.default_rng(0)
    ramp = np.broadcast_to(np.linspace(0, 1, n) ** 2.2 * 0.6, (n, n))
    bursts = [[camera.shoot(light, 1.0, rng) for _ in range(6)] for light in (ramp, 0 * ramp, 0 * ramp)]
    found = estimate(bursts, response=camera.response, levels=256)
    assert found.electrons == pytest.approx(electrons, rel=0.2)
    assert 0.5 * read < found.read < 1.5 * read


@pytest.mark.parametrize("levels", [4096, 16384, 0])
@pytest.mark.parametrize("offset", [0.0, 0.004])
def test_noise_that_is_clipped_before_an_offset_is_added_does_not_count(levels, offset):
    rng = np.random.default_rng(4)
    light = np.geomspace(1e-3, 2, 9600).reshape(80, 120)

    def shoot(value):
        value = rng.poisson(value * 1e4) / 1e4 + rng.normal(0, 5e-4, value.shape)
        code = offset + (1 - offset) * np.clip(value, 0, 1)
        return np.rint(code * (levels - 1)).astype(np.uint16) if levels else code

    bursts = [[shoot(light * t) for _ in range(6)] for t in (0.05, 0.3, 0.0)]
    response = Response((np.linspace(0, 1, 16385) - offset) / (1 - offset))
    found = estimate(bursts, response=response, levels=levels or None)
    assert found.electrons == pytest.approx(10000.0, rel=0.03)
    assert found.read == pytest.approx(5e-4, rel=0.1)


def test_codes_that_never_change_hide_a_fifth_of_one_at_most():
    """A scene of three even parts without any noise that the codes show."""
    shots = [np.repeat(np.array([3, 90, 200], np.uint8), 100).reshape(15, 20)] * 4
    assert 0 < estimate([shots]).read * 255 <= 0.2


def test_a_response_that_is_flat_in_the_dark_tells_noise_without_warnings():
    rng = np.random.default_rng(4)
    flat = Response(np.maximum(np.linspace(-0.1, 1.0, 12), 0.0))
    light = np.tile(np.linspace(0.0, 200.0, 64), (64, 1))
    shots = [np.rint(light + rng.normal(0, 2.0, light.shape)).clip(0, 255).astype(np.uint8) for _ in range(6)]
    with np.errstate(all="raise"):
        found = estimate([shots], response=flat)
    assert 0 < found.read < 0.02
    assert found.electrons > 1000


def test_few_pixels_of_one_brightness_bound_the_read_noise_by_all_their_noise():
    """Four pixels tell no slope; 3 codes is the deviation that they have."""
    rng = np.random.default_rng(0)
    found = estimate([[np.rint(rng.normal(100, 3, (2, 2))).astype(np.uint8) for _ in range(8)]])
    assert found.read * 255 < 6


def test_what_rounding_leaves_of_a_variance_is_undone():
    """V(s) against normal values about means that lie anywhere between two codes."""
    rng = np.random.default_rng(3)
    means = rng.uniform(0, 10, 40000)
    for s in (0.1, 0.25, 0.6, 3.0):
        codes = np.rint(means + rng.normal(0, s, (6, means.size)))
        assert _undone(np.array([codes.var(axis=0, ddof=1).mean()]))[0] == pytest.approx(s, rel=0.02)


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
