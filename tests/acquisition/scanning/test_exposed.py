# SPDX-License-Identifier: BSD-3-Clause
"""Exposures of several patterns are told from those of one, whatever the noise."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import Shots, VirtualRig
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.measuring import measure
from ltcl.acquisition.scanning.exposed import Contradiction, check, contradiction
from ltcl.errors import AcquisitionError

CAMERAS: dict[str, dict[str, Any]] = {
    "12 bits": {"bits": 12},
    "8 bits": {"bits": 8, "response": "srgb"},
    "few electrons": {"bits": 12, "gain": 300.0, "read": 0.01},
    "bright room": {"bits": 12, "ambient": 0.1},
}


@cache
def known(camera: str) -> tuple[VirtualRig, Calibration]:
    made = VirtualRig(0.5 * np.eye(32), (4, 8), **{"ambient": 0.01, **CAMERAS[camera]})
    return made, measure(Shots(made), geometry="aligned", frames=4)


def taken(camera: str, patterns: list[np.ndarray]) -> Contradiction:
    """Photographs at the exposures of the scan, each of a pattern; they are said to be of the first."""
    made, told = known(camera)
    shots = Shots(made)
    times = zip(patterns, told.exposures, strict=True)
    return contradiction([shots.photograph(part, t) for part, t in times], told, patterns[0])


def lit(seed: int, many: bool) -> np.ndarray:
    found = np.zeros((4, 8), np.float32)
    found.flat[np.random.default_rng(seed).permutation(32)[: 16 if many else 1]] = 1.0
    return found


@pytest.mark.parametrize("many", [True, False])
@pytest.mark.parametrize("camera", CAMERAS)
def test_exposures_of_one_pattern_do_not_contradict(camera: str, many: bool) -> None:
    count = len(known(camera)[1].exposures)
    for seed in range(60):
        pixels, told = taken(camera, [lit(seed, many)] * count)
        assert pixels == 0
        assert told == (16 if many else 1)


@pytest.mark.parametrize("camera", CAMERAS)
def test_exposures_of_two_patterns_do(camera: str) -> None:
    """Of a scene without bounces, which would saturate the longest of both."""
    count = len(known(camera)[1].exposures)
    for seed in range(20):
        first = lit(seed, True)
        for k in range(1, count - (camera == "few electrons")):  # the longest needs less noise
            others = [first] * k + [1.0 - first] * (count - k)
            assert taken(camera, others) == (16, 16)


def test_what_is_refused_and_what_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    good, bad, single = Contradiction(1, 9), Contradiction(5, 9), Contradiction(1, 1)
    check([good] * 3, str)
    check([Contradiction(0, 0)], str)
    assert not caplog.records
    check([good, single, good], "photographs of {}".format)
    (record,) = caplog.records
    assert record.getMessage().startswith("photographs of 1: light does not rise as the seconds do: are they")
    with pytest.raises(
        AcquisitionError, match=r"^2: light does not rise as the seconds do; photographs must"
    ):
        check([good, good, bad], str)
    with pytest.raises(
        AcquisitionError, match=r"^0: light does not rise as the seconds do, nor in 1 more of"
    ):
        check([single, good, single], str)
