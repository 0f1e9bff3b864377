# SPDX-License-Identifier: BSD-3-Clause
"""What a plan says is what a scan takes, and "auto" takes what gives the better columns."""

from __future__ import annotations

import json

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import VirtualRig
from ltcl.acquisition.radiometry import NoiseModel
from ltcl.acquisition.scanning import Hadamard, Light, Pixels, plan, plans
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


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("ambient", [0.0, 0.05])
def test_the_error_of_a_picture_is_that_of_rows(camera: str, ambient: float) -> None:
    """Rows with their own light in one batch, photographed with that noise and decoded; p in [0, 1]."""
    noise, exposures = CAMERAS[camera], (0.5, 8.0)
    found = plans(GRID, exposures, noise, Light(0.5, 0.2, ambient))
    rng, weak = np.random.default_rng(1), 0.2 / 256
    for code, name in ((Pixels(1), "pixel"), (Hadamard(), "hadamard")):
        S, squares = code.patterns(code.size).astype(float), []
        for own in (0.5, 0.0):
            x = np.full((code.size, 1000), weak)
            x[0] += own
            L = S @ x
            seen = [(t, (L + ambient) * t) for t in exposures]
            told = [(v < noise.saturation) * t**2 / noise.variance(v) for t, v in seen]
            variance = 1.0 / np.sum(told, axis=0)
            y = L + rng.standard_normal(L.shape) * np.sqrt(variance)
            decoded, _ = code.decode(y, variance, np.zeros(1000))
            squares.append(np.mean(np.square(decoded[: code.size] - x)))
        # What white tells of a row is taken from each entry by its variance, as `balance.rows` does.
        v = np.repeat(squares, [code.size, 256 - code.size])
        errors = rng.standard_normal((20000, 256)) * np.sqrt(v)
        errors -= errors.sum(axis=1, keepdims=True) * v / v.sum()
        off = np.std(np.sum(errors * rng.random((20000, 256)), axis=1)) / 0.35  # (d + g) / 2 on average
        assert found[name].error == pytest.approx(np.hypot(off, plan._REST), rel=0.06)


def test_auto_weighs_the_noise() -> None:
    dark = Light(0.5, 0.2, 0.0)
    took = {name: choose(plans(GRID, (1.0,), noise, dark))[0] for name, noise in CAMERAS.items()}
    assert (took["photons"], took["reading"], took["rounding"]) == ("pixel", "hadamard", "hadamard")
    assert choose(plans((64, 64), (0.5, 8.0)))[0] == "adaptive"
    assert MANY < 64 * 64
    bright = Light(0.5, 0.2, 0.3)  # of which only the shot noise is left
    assert choose(plans(GRID, (0.5, 1.0), CAMERAS["photons"], bright))[0] == "hadamard"
    assert choose(plans((16, 32), (0.5, 8.0), CAMERAS["both"], Light(0.5, 0.2, 0.01)))[0] == "adaptive"


@pytest.mark.parametrize(("gain", "read", "ambient"), [(20000.0, 0.0005, 0.0), (1000.0, 0.003, 0.3)])
def test_auto_takes_what_gives_the_better_picture(gain: float, read: float, ambient: float) -> None:
    """T p of a dihedral, scanned in all three ways: none is far better than the one that auto takes."""
    truth = ltcl.scenes.dihedral(8, albedo=0.6).transport()
    p, white = np.random.default_rng(9).random(truth.grid), np.ones(truth.grid)
    off = {}
    for strategy in ("pixel", "hadamard", "adaptive", "auto"):
        rig = VirtualRig(truth, truth.grid, bits=12, gain=gain, read=read, ambient=ambient)
        T = ltcl.acquire(rig, geometry="aligned", strategy=strategy)
        unit = np.vdot(T @ white, truth @ white) / np.vdot(T @ white, T @ white)
        off[strategy] = np.linalg.norm(unit * (T @ p) - truth @ p) / np.linalg.norm(truth @ p)
    assert off["auto"] <= 1.5 * min(off.values())


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
    assert found["pixel"].error == found["hadamard"].error == 1.0  # and JSON holds it
    assert choose(found)[0] in ("pixel", "adaptive")
