# SPDX-License-Identifier: BSD-3-Clause
"""The exposures chosen, judged by photographs taken with them."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from ltcl.acquisition.radiometry import bracket, calibrate, choose, merge
from ltcl.errors import InputError
from tests.acquisition.radiometry.cameras import Camera, corner

CAMERA = Camera("srgb", 4096, black=0.02)


def shoot(light: np.ndarray, seconds, seed: int = 0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [CAMERA.shoot(light, t, rng) for t in seconds]


@pytest.mark.parametrize("scale", [1.0, 10.0, 100.0])
def test_the_wanted_ratio_is_reached_over_the_scene(scale):
    light = scale * corner(128)
    probes = [0.01 / scale, 0.2 / scale, 4.0 / scale]
    found = choose(shoot(light, probes), probes, CAMERA.response, CAMERA.noise, snr=50)
    assert list(found) == sorted(set(found))
    assert len(found) <= 8
    merged = merge(shoot(light, found, 1), found, CAMERA.response, CAMERA.noise)
    assert merged.valid.all()
    ratio = merged.value / np.sqrt(merged.variance)
    assert np.mean(ratio > 45) > 0.97
    wide = choose(shoot(light, probes), probes, CAMERA.response, CAMERA.noise, snr=20)
    assert len(wide) < len(found)  # no more than it takes


def test_the_camera_s_own_exposures_are_taken():
    offered = [2.0**k for k in range(-10, 4)]
    probes = [2.0**-4, 1.0]
    found = choose(shoot(corner(), probes), probes, CAMERA.response, CAMERA.noise, exposures=offered, most=3)
    assert set(found) <= set(offered)
    assert len(found) <= 3


def test_a_ratio_out_of_reach_is_told(caplog):
    with caplog.at_level(logging.WARNING):
        found = choose(shoot(corner(), [0.5]), [0.5], CAMERA.response, CAMERA.noise, snr=1e4)
    assert 1 <= len(found) <= 8
    assert "not 1e+04" in caplog.text


def test_a_probe_that_saturates_asks_for_shorter_exposures(caplog):
    light = corner() * 10
    with caplog.at_level(logging.WARNING):
        found = choose(shoot(light, [0.5]), [0.5], CAMERA.response, CAMERA.noise)
    assert "a shorter probe would tell" in caplog.text
    assert found[0] < 0.5 / 8


@pytest.mark.parametrize(
    ("probe", "options", "part"),
    [
        (np.zeros((4, 4)), {}, "black or saturated at every pixel"),
        (np.ones((4, 4)), {}, "black or saturated at every pixel"),
        (np.full((4, 4), 0.5), {"most": 9}, "most is 9"),
        (np.full((4, 4), 0.5), {"snr": 0}, "snr is 0"),
        (np.full((4, 4), 0.5), {"exposures": []}, "exposures is"),
        (np.full((4, 4), 0.5), {"exposures": [0.0, 1.0]}, "exposures is"),
    ],
)
def test_what_tells_no_exposures_is_refused(probe, options, part):
    with pytest.raises(InputError, match=part):
        choose([probe], [1.0], **options)


def test_a_bracket_tells_a_response_where_powers_of_four_do_not():
    """Errors of the response at the ends of a wobble that powers of one ratio cannot see."""
    used = np.linspace(0.02, 0.9, 200)
    errors = []
    for seconds in (bracket(0.1, 1.6, 4), (0.1, 0.4, 1.6)):
        found = calibrate(shoot(corner(), seconds), seconds, levels=4096).linear(CAMERA.codes(used)) / used
        errors.append(np.std(found) / np.mean(found))
    assert errors[0] < 0.005
    assert errors[0] < errors[1]
    steps = np.diff(np.log(bracket(0.01, 10.0, 6)))
    assert np.ptp(steps) > 0.1
    with pytest.raises(InputError, match=r"longest is 1\.0; it must be a finite number above 2"):
        bracket(2.0, 1.0)
