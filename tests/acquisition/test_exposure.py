# SPDX-License-Identifier: BSD-3-Clause
"""Exposures: those a camera has, one that is bright for white, a bracket, those of a scan."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import Shots, VirtualRig, exposure
from ltcl.acquisition.radiometry import calibrate
from ltcl.errors import InputError

from .radiometry.cameras import Camera
from .radiometry.cameras import corner as scene
from .scanning.helpers import corner, rig

OFFERED = (0.01, 0.05, 0.2, 0.5, 2.0, 6.0)


@pytest.mark.parametrize(
    ("offered", "seconds", "nearest"),
    [
        (OFFERED, 0.06, 0.05),
        (OFFERED, 0.11, 0.2),
        (OFFERED, 99.0, 6.0),
        (None, 0.06, 0.06),
        (None, 99.0, 30.0),
    ],
)
def test_the_nearest_exposure_has_the_nearest_ratio(offered: Any, seconds: float, nearest: float) -> None:
    assert exposure.nearest(offered, seconds) == nearest


@pytest.mark.parametrize(("response", "bits"), [("srgb", 8), ("film", 12), ("linear", 16)])
@pytest.mark.parametrize("sensitivity", [0.02, 1.0, 300.0])
def test_white_is_bright_but_not_saturated(response: str, bits: int, sensitivity: float) -> None:
    made = rig(response=response, bits=bits, sensitivity=sensitivity)
    seconds = exposure.bright_white(Shots(made), (8, 16))
    level = seconds * sensitivity * corner().sum(axis=1).max()
    assert 0.05 < level < 0.95 or seconds in (1e-4, 30.0)


def test_a_bracket_determines_a_response_where_powers_of_four_do_not() -> None:
    """Errors of the response at the ends of a wobble that powers of one ratio cannot show."""
    camera, used, errors = Camera("srgb", 4096, black=0.02), np.linspace(0.02, 0.9, 200), []
    for seconds in (exposure.bracket(0.1, 1.6, 4), (0.1, 0.4, 1.6)):
        random = np.random.default_rng(0)
        response = calibrate([camera.shoot(scene(), t, random) for t in seconds], seconds, levels=4096)
        relative = response.linear(camera.codes(used)) / used
        errors.append(np.std(relative) / np.mean(relative))
    assert errors[0] < 0.005
    assert errors[0] < errors[1]
    with pytest.raises(InputError, match=r"longest is 1\.0.*2"):
        exposure.bracket(2.0, 1.0)


@pytest.mark.parametrize(("by_hand", "count"), [(False, 3), (True, 2)])
def test_a_scan_has_the_exposure_of_white_and_the_longest(by_hand: bool, count: int) -> None:
    made: Any = rig()
    made.keeps_photographs = by_hand
    times = exposure.for_scan(Shots(made), 0.5, 8.0)
    assert (len(times), times[0], times[-1]) == (count, 0.5, 8.0)


def test_hot_pixels_are_filled_from_the_pixel_before() -> None:
    hot = np.zeros((5, 8), bool)
    hot[0, 0] = hot[2, 3] = True
    image = np.arange(40.0).reshape(5, 8)
    filled = exposure.fill_hot_pixels(image, hot)
    assert (filled[0, 0], filled[2, 3]) == (1.0, image[2, 2])
    np.testing.assert_array_equal(filled[~hot], image[~hot])
    np.testing.assert_array_equal(exposure.hot_pixels(np.where(hot, 1.0, 0.01)), hot)
    assert not exposure.hot_pixels(np.ones((5, 8))).any()  # it is the exposure that is too long


@pytest.mark.parametrize(("offered", "seconds"), [(None, 40.0), (None, 1e-5), ([0.1, 1.0], 0.5)])
def test_exposures_that_a_rig_does_not_have_are_refused(offered: Any, seconds: float) -> None:
    shots = Shots(VirtualRig(np.eye(4), (2, 2), exposures=offered))
    exposure.check_offered(shots, [0.1])
    with pytest.raises(InputError, match=f"exposures has {seconds:g} s"):
        exposure.check_offered(shots, [0.1, seconds])
