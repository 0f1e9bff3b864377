# SPDX-License-Identifier: BSD-3-Clause
"""A plan predicts what a scan takes, and "auto" chooses the strategy with the better picture."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import camera_map
from ltcl.acquisition.calibrate import expected_photographs
from ltcl.acquisition.radiometry import NoiseModel
from ltcl.acquisition.scanning import Hadamard, Light, Pixels, plans
from ltcl.acquisition.scanning.plan import choose

from ..stopping import Unplugged
from .helpers import corner, dense, relative_error, rig

random = np.random.default_rng(0)
GRID = (16, 16)
PIXELS = 256
CAMERAS = {
    "photons": NoiseModel(2000.0, 0.0),
    "reading": NoiseModel(1e6, 0.01),
    "rounding": NoiseModel(1e6, 1e-5, levels=64),
    "both": NoiseModel(10000.0, 0.002),
}


def decoded_variance(code: Any, noise: NoiseModel, own_light: float) -> float:
    """Variance of decoded entries of many rows, one batch at two exposures, in ambient light."""
    rows = 2000
    x = np.full((code.size, rows), 0.2 / PIXELS)
    x[0] += own_light
    light = code.patterns(code.size).astype(float) @ x
    precision = np.zeros_like(light)
    for seconds in (0.5, 8.0):
        value = (light + 0.05) * seconds
        is_valid = value < noise.saturation
        precision += is_valid * seconds**2 / noise.variance(value)
    variance = 1.0 / precision
    y = light + random.standard_normal(light.shape) * np.sqrt(variance)
    decoded, _ = code.decode(y, variance, np.zeros(rows))
    return float(np.mean(np.square(decoded[: code.size] - x)))


@pytest.mark.parametrize(("strategy", "code"), [("pixel", Pixels(1)), ("hadamard", Hadamard())])
@pytest.mark.parametrize("camera", CAMERAS)
def test_errors_are_those_of_decoded_photographs(strategy: str, code: Any, camera: str) -> None:
    """T p with random p in [0, 1] of rows with their own light in one batch, and known sums."""
    noise = CAMERAS[camera]
    v = np.full(PIXELS, decoded_variance(code, noise, 0.0))
    v[: code.size] = decoded_variance(code, noise, 0.5)
    errors = random.standard_normal((20000, PIXELS)) * np.sqrt(v)
    errors -= errors.sum(axis=1, keepdims=True) * v / v.sum()
    error_of_picture = np.sum(errors * random.random((20000, PIXELS)), axis=1)
    relative = np.std(error_of_picture) / 0.35  # (d + g) / 2 on average
    plan = plans(GRID, (0.5, 8.0), noise, Light(0.5, 0.2, 0.05))[strategy]
    assert plan.error == pytest.approx(np.hypot(relative, 0.002), rel=0.06)


@pytest.mark.parametrize(
    ("camera", "grid", "exposures", "ambient", "strategy"),
    [
        ("photons", GRID, (1.0,), 0.0, "pixel"),
        ("reading", GRID, (1.0,), 0.0, "hadamard"),
        # Only the shot noise of the ambient light is left of it.
        ("photons", GRID, (0.5, 1.0), 0.3, "hadamard"),
        ("both", (16, 32), (0.5, 8.0), 0.01, "adaptive"),
        ("both", (64, 64), (0.5, 8.0), 0.01, "sketch"),
    ],
)
def test_auto_weighs_the_noise(
    camera: str, grid: Any, exposures: Any, ambient: float, strategy: str
) -> None:
    candidates = plans(grid, exposures, CAMERAS[camera], Light(0.5, 0.2, ambient))
    chosen, _ = choose(candidates)
    assert chosen == strategy


@pytest.mark.rare
def test_auto_chooses_the_better_picture() -> None:
    """T p of a dihedral, scanned with every strategy: none is far better than that of auto."""
    error = {}
    for strategy in ("pixel", "hadamard", "adaptive", "auto"):
        camera = rig(gain=1000.0, read=0.003, ambient=0.3)
        T = ltcl.acquire(camera, geometry="aligned", strategy=strategy)
        error[strategy] = relative_error(dense(T), corner(), T.grid)
    assert error["auto"] <= 1.5 * min(error.values())


@pytest.mark.rare
@pytest.mark.parametrize(
    "strategy",
    [
        "hadamard",
        pytest.param("pixel", marks=pytest.mark.slow),
        pytest.param("block", marks=pytest.mark.slow),
    ],
)
def test_photographs_by_hand_are_all_counted(strategy: str) -> None:
    """Photographs of the calibration and after each batch are counted too."""
    grid = (8, 16)
    size = (32, 64)
    view = camera_map(lambda u, v: (u / 4, v / 4), size, grid)
    camera = Unplugged(corner(), grid, camera_grid=size, camera_map=view)
    camera.keeps_photographs = True
    ltcl.acquire(camera, strategy=strategy, exposures=[0.1, 3.0])
    count = expected_photographs(grid, by_hand=True)
    plan = plans(grid, (0.1, 3.0), calibration=count)[strategy]
    assert plan.photographs == pytest.approx(camera.count, rel=0.02)


@pytest.mark.rare
@pytest.mark.parametrize("strategy", ["pixel", "hadamard", "block"])
def test_photographs_of_an_aligned_camera_in_colour_are_all_counted(strategy: str) -> None:
    grid = (8, 16)
    camera = Unplugged([corner()] * 3, grid)
    ltcl.acquire(camera, geometry="aligned", strategy=strategy, exposures=[0.1, 3.0])
    count = expected_photographs(grid, channels=3, aligned=True)
    plan = plans(grid, (0.1, 3.0), channels=3, calibration=count)[strategy]
    assert plan.photographs == pytest.approx(camera.count, rel=0.02)


def test_time_disk_and_saturation() -> None:
    strategies = plans(GRID, (0.5, 8.0), block=4, overhead=0.25)
    pixel = strategies["pixel"]
    block = strategies["block"]
    patterns = 260 - 18
    batches = 4 - 2
    assert pixel.photographs - block.photographs == 2 * patterns + batches
    seconds = patterns * (8.5 + 2 * 0.25) + batches * (0.5 + 0.25)
    assert pixel.seconds - block.seconds == pytest.approx(seconds)
    assert block.grid == (4, 4)
    assert pixel.disk == 2 * 12 * PIXELS**2
    saturated = plans(GRID, (8.0,), NoiseModel(), Light(direct=0.5))
    assert saturated["pixel"].error == 1.0
    assert saturated["hadamard"].error == 1.0


def test_computing_takes_its_time_by_megapixel() -> None:
    for plan in plans(GRID, (0.5, 8.0), megapixels=45.0, pace=0.2).values():
        assert plan.computing == pytest.approx(plan.photographs * 9.0)
    assert plans(GRID, (0.5, 8.0), pace=0.2)["pixel"].computing is None
