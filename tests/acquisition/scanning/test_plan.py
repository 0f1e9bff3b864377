# SPDX-License-Identifier: BSD-3-Clause
"""What a plan says is what a scan takes, and "auto" takes what gives the better picture."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import VirtualRig, camera_map
from ltcl.acquisition.calibrate import photographs
from ltcl.acquisition.radiometry import NoiseModel
from ltcl.acquisition.scanning import Hadamard, Light, Pixels, plans
from ltcl.acquisition.scanning.plan import choose

from .helpers import corner

random = np.random.default_rng(0)
GRID = (16, 16)
CAMERAS = {
    "photons": NoiseModel(2000.0, 0.0),
    "reading": NoiseModel(1e6, 0.01),
    "rounding": NoiseModel(1e6, 1e-5, levels=64),
    "both": NoiseModel(10000.0, 0.002),
}
CODES = {"pixel": Pixels(1), "hadamard": Hadamard()}


def decoded(code: Any, x: np.ndarray, noise: NoiseModel, ambient: float) -> np.ndarray:
    """Entries x (pixels, samples) of a batch, photographed for 0.5 and 8 s with that noise and decoded."""
    L = code.patterns(code.size).astype(float) @ x
    values = [(t, (L + ambient) * t) for t in (0.5, 8.0)]
    variance = 1.0 / np.sum([(v < noise.saturation) * t**2 / noise.variance(v) for t, v in values], axis=0)
    y = L + random.standard_normal(L.shape) * np.sqrt(variance)
    return code.decode(y, variance, np.zeros(x.shape[1]))[0][: code.size]


@pytest.mark.parametrize("strategy", CODES)
@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("ambient", [0.0, 0.05])
def test_errors_are_those_of_decoded_photographs(strategy: str, camera: str, ambient: float) -> None:
    """Signal over noise of weak entries, and T p of rows with their own light in one batch, p in [0, 1]."""
    code, weak, squares = CODES[strategy], 0.2 / 256, []
    plan = plans(GRID, (0.5, 8.0), CAMERAS[camera], Light(0.5, 0.2, ambient))[strategy]
    for own in (0.5, 0.0):
        x = np.full((code.size, 2000), weak)
        x[0] += own
        squares.append(np.mean(np.square(decoded(code, x, CAMERAS[camera], ambient) - x)))
    assert plan.snr_indirect == pytest.approx(weak / np.sqrt(squares[1]), rel=0.06)
    # Row sums are known from white: the noisiest entries are corrected most.
    v = np.repeat(squares, [code.size, 256 - code.size])
    errors = random.standard_normal((20000, 256)) * np.sqrt(v)
    errors -= errors.sum(axis=1, keepdims=True) * v / v.sum()
    relative = np.std(np.sum(errors * random.random((20000, 256)), axis=1)) / 0.35  # (d + g) / 2 on average
    assert plan.error == pytest.approx(np.hypot(relative, 0.002), rel=0.06)


@pytest.mark.parametrize(
    ("camera", "grid", "exposures", "ambient", "strategy"),
    [
        ("photons", GRID, (1.0,), 0.0, "pixel"),
        ("reading", GRID, (1.0,), 0.0, "hadamard"),
        ("rounding", GRID, (1.0,), 0.0, "hadamard"),
        ("photons", GRID, (0.5, 1.0), 0.3, "hadamard"),  # of the ambient light only shot noise is left
        ("both", (16, 32), (0.5, 8.0), 0.01, "adaptive"),
        ("both", (64, 64), (0.5, 8.0), 0.01, "adaptive"),
    ],
)
def test_auto_weighs_the_noise(camera: str, grid: Any, exposures: Any, ambient: float, strategy: str) -> None:
    assert choose(plans(grid, exposures, CAMERAS[camera], Light(0.5, 0.2, ambient)))[0] == strategy


@pytest.mark.parametrize(("gain", "read", "ambient"), [(20000.0, 0.0005, 0.0), (1000.0, 0.003, 0.3)])
def test_auto_takes_what_gives_the_better_picture(gain: float, read: float, ambient: float) -> None:
    """T p of a dihedral, scanned in all three ways: none is far better than the one that auto takes."""
    truth = ltcl.scenes.dihedral(8, albedo=0.6).transport()
    p, white = random.random(truth.grid), np.ones(truth.grid)
    error = {}
    for strategy in ("pixel", "hadamard", "adaptive", "auto"):
        rig = VirtualRig(truth, truth.grid, bits=12, gain=gain, read=read, ambient=ambient)
        T = ltcl.acquire(rig, geometry="aligned", strategy=strategy)
        unit = np.vdot(T @ white, truth @ white) / np.vdot(T @ white, T @ white)
        error[strategy] = np.linalg.norm(unit * (T @ p) - truth @ p) / np.linalg.norm(truth @ p)
    assert error["auto"] <= 1.5 * min(error.values())


@pytest.mark.parametrize("geometry", ["aligned", "graycode"])
@pytest.mark.parametrize(("n", "channels"), [(4, 1), (8, 1), (8, 3)])
def test_photographs_are_counted_with_those_of_the_calibration(geometry: str, n: int, channels: int) -> None:
    class Counting(VirtualRig):
        count = 0

        def photograph(self, codes: Any, seconds: float) -> np.ndarray:
            self.count += 1
            return super().photograph(codes, seconds)

    T, camera = [corner(n)] * channels if channels == 3 else corner(n), (4 * n, 8 * n)
    seen = {"camera_grid": camera, "camera_map": camera_map(lambda u, v: (u / 4, v / 4), camera, (n, 2 * n))}
    rig = Counting(T, (n, 2 * n), bits=12, ambient=0.01, **(seen if geometry == "graycode" else {}))
    ltcl.acquire(rig, geometry=geometry, strategy="pixel", exposures=[0.1, 3.0])
    count = photographs((n, 2 * n), channels=channels, aligned=geometry == "aligned")
    plan = plans((n, 2 * n), (0.1, 3.0), channels=channels, calibration=count)["pixel"]
    assert plan.photographs == plan.calibration + 2 * plan.patterns
    assert plan.photographs == pytest.approx(rig.count, rel=0.1)


def test_patterns_time_and_disk() -> None:
    made = plans(GRID, (0.5, 8.0), block=4, overhead=0.25)
    patterns = {name: plan.patterns for name, plan in made.items() if name != "adaptive"}
    assert patterns == {"pixel": 256 + 4, "block": 16 + 2, "hadamard": 4 * 63 + 7}
    more = made["pixel"].patterns - made["block"].patterns
    assert made["pixel"].seconds - made["block"].seconds == pytest.approx(more * (8.5 + 2 * 0.25))
    assert made["block"].grid == (4, 4)
    assert made["pixel"].disk == 2 * 12 * 256**2
    assert f"{made['pixel'].photographs} photographs" in str(made["pixel"])


def test_a_scene_that_saturates_has_no_signal() -> None:
    found = plans(GRID, (8.0,), NoiseModel(), Light(direct=0.5))
    assert found["pixel"].snr_direct == 0.0
    assert found["pixel"].snr_indirect > 0.0
    assert found["pixel"].error == found["hadamard"].error == 1.0
    assert choose(found)[0] in ("pixel", "adaptive")
