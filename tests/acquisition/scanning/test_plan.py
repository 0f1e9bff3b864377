# SPDX-License-Identifier: BSD-3-Clause
"""What a plan says is what a scan takes, and "auto" takes what gives the better columns."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ltcl.acquisition.radiometry import NoiseModel
from ltcl.acquisition.scanning import Hadamard, Light, Pixels, plans
from ltcl.acquisition.scanning.plan import MANY, choose, duration

GRID = (16, 16)
CAMERAS = {
    "photons": NoiseModel(2000.0, 0.0),
    "reading": NoiseModel(1e6, 0.01),
    "rounding": NoiseModel(1e6, 1e-5, levels=64),
    "both": NoiseModel(10000.0, 0.002),
}


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("ambient", [0.0, 0.05])
def test_signal_over_noise_is_that_of_columns(camera: str, ambient: float) -> None:
    """Weak entries of a batch, photographed with that noise and decoded."""
    noise, exposures = CAMERAS[camera], (0.5, 8.0)
    light = Light(0.5, 0.2, ambient)
    found = plans(GRID, exposures, noise, light)
    rng, weak = np.random.default_rng(0), 0.2 / 256
    for code, name in ((Pixels(), "pixel"), (Hadamard(), "hadamard")):
        S = code.patterns(code.size).astype(float)
        L = S @ np.full((code.size, 2000), weak)
        precision = np.sum([t**2 / noise.variance((L + ambient) * t) for t in exposures], axis=0)
        y = L + rng.standard_normal(L.shape) / np.sqrt(precision)
        x, _ = code.decode(y, 1.0 / precision, np.zeros(2000))
        assert found[name].snr_indirect == pytest.approx(weak / np.std(x - weak), rel=0.06)


def test_auto_weighs_the_noise() -> None:
    dark = Light(0.5, 0.2, 0.0)
    took = {name: choose(plans(GRID, (0.5, 8.0), noise, dark))[0] for name, noise in CAMERAS.items()}
    assert (took["photons"], took["reading"], took["rounding"]) == ("pixel", "hadamard", "hadamard")
    assert choose(plans((64, 64), (0.5, 8.0)))[0] == "adaptive"
    assert MANY < 64 * 64
    bright = Light(0.5, 0.2, 0.05)  # of which only the shot noise is left
    assert choose(plans(GRID, (0.5, 8.0), CAMERAS["photons"], bright))[0] == "hadamard"


def test_photographs_time_and_disk() -> None:
    found = plans(GRID, (0.5, 8.0), block=4, overhead=0.25)
    assert {name: one.patterns for name, one in found.items() if name != "adaptive"} == {
        "pixel": 256 + 4,
        "block": 16 + 2,
        "hadamard": 4 * 63 + 7,
    }
    for one in found.values():
        assert one.photographs == 2 * one.patterns
        assert one.seconds == pytest.approx(one.patterns * (8.5 + 2 * 0.25))
    assert found["block"].grid == (4, 4)
    assert found["pixel"].disk == 2 * 12 * 256**2


def test_text_and_json() -> None:
    one = plans((48, 64), (0.5, 8.0))["hadamard"]
    told = json.loads(one.to_json())
    assert (told["strategy"], told["grid"], told["photographs"]) == ("hadamard", [48, 64], one.photographs)
    assert f"{one.photographs} photographs" in str(one)
    assert "48 x 64" in str(one)
    assert [duration(s) for s in (3.0, 600.0, 7260.0)] == ["3 s", "10 min", "2 h 1 min"]


def test_what_saturates_has_no_signal() -> None:
    found = plans(GRID, (8.0,), NoiseModel(), Light(direct=0.5))
    assert found["pixel"].snr_direct == 0.0
    assert found["pixel"].snr_indirect > 0.0
