# SPDX-License-Identifier: BSD-3-Clause
"""What a plan says is what a scan takes, and "auto" takes what gives the better picture."""

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
CAMERAS = {
    "photons": NoiseModel(2000.0, 0.0),
    "reading": NoiseModel(1e6, 0.01),
    "rounding": NoiseModel(1e6, 1e-5, levels=64),
    "both": NoiseModel(10000.0, 0.002),
}


@pytest.mark.parametrize(("strategy", "code"), [("pixel", Pixels(1)), ("hadamard", Hadamard())])
@pytest.mark.parametrize("camera", CAMERAS)
def test_errors_are_those_of_decoded_photographs(strategy: str, code: Any, camera: str) -> None:
    """T p of rows with their own light in one batch, random p in [0, 1]; row sums are known from white."""
    noise, v = CAMERAS[camera], np.zeros(256)
    for own in (0.0, 0.5):
        x = np.full((code.size, 2000), 0.2 / 256)
        x[0] += own
        L = code.patterns(code.size).astype(float) @ x
        values = [(t, (L + 0.05) * t) for t in (0.5, 8.0)]
        spread = 1.0 / np.sum(
            [(y < noise.saturation) * t**2 / noise.variance(y) for t, y in values], axis=0
        )
        y = L + random.standard_normal(L.shape) * np.sqrt(spread)
        error = code.decode(y, spread, np.zeros(2000))[0][: code.size] - x
        v[: code.size if own else None] = np.mean(np.square(error))
    errors = random.standard_normal((20000, 256)) * np.sqrt(v)
    errors -= errors.sum(axis=1, keepdims=True) * v / v.sum()
    relative = (
        np.std(np.sum(errors * random.random((20000, 256)), axis=1)) / 0.35
    )  # (d + g) / 2 on average
    plan = plans(GRID, (0.5, 8.0), noise, Light(0.5, 0.2, 0.05))[strategy]
    assert plan.error == pytest.approx(np.hypot(relative, 0.002), rel=0.06)


@pytest.mark.parametrize(
    ("camera", "grid", "exposures", "ambient", "strategy"),
    [
        ("photons", GRID, (1.0,), 0.0, "pixel"),
        ("reading", GRID, (1.0,), 0.0, "hadamard"),
        (
            "photons",
            GRID,
            (0.5, 1.0),
            0.3,
            "hadamard",
        ),  # of the ambient light only shot noise is left
        ("both", (16, 32), (0.5, 8.0), 0.01, "adaptive"),
        ("both", (64, 64), (0.5, 8.0), 0.01, "adaptive"),
    ],
)
def test_auto_weighs_the_noise(
    camera: str, grid: Any, exposures: Any, ambient: float, strategy: str
) -> None:
    assert choose(plans(grid, exposures, CAMERAS[camera], Light(0.5, 0.2, ambient)))[0] == strategy


def test_auto_takes_what_gives_the_better_picture() -> None:
    """T p of a dihedral, scanned in all three ways: none is far better than the one that auto takes."""
    error = {}
    for strategy in ("pixel", "hadamard", "adaptive", "auto"):
        T = ltcl.acquire(
            rig(gain=1000.0, read=0.003, ambient=0.3), geometry="aligned", strategy=strategy
        )
        error[strategy] = relative_error(dense(T), corner(), T.grid)
    assert error["auto"] <= 1.5 * min(error.values())


@pytest.mark.parametrize("strategy", ["pixel", "hadamard", "block"])
@pytest.mark.parametrize("by_hand", [True, False])
def test_photographs_are_all_counted(by_hand: bool, strategy: str) -> None:
    """Of the calibration and after each batch, too: by hand, and of an aligned camera in colour."""
    grid, size = (8, 16), (32, 64)
    seen = {"camera_grid": size, "camera_map": camera_map(lambda u, v: (u / 4, v / 4), size, grid)}
    camera = Unplugged(corner(), grid, **seen) if by_hand else Unplugged([corner()] * 3, grid)
    camera.keeps_photographs = by_hand
    geometry, channels = ("graycode", 1) if by_hand else ("aligned", 3)
    ltcl.acquire(camera, geometry=geometry, strategy=strategy, exposures=[0.1, 3.0])
    count = expected_photographs(grid, channels=channels, aligned=not by_hand, by_hand=by_hand)
    plan = plans(grid, (0.1, 3.0), channels=channels, calibration=count)[strategy]
    assert plan.photographs == pytest.approx(camera.count, rel=0.02)


def test_time_disk_and_saturation() -> None:
    strategies = plans(GRID, (0.5, 8.0), block=4, overhead=0.25)
    pixel, block = strategies["pixel"], strategies["block"]
    assert pixel.photographs - block.photographs == 2 * (260 - 18) + 4 - 2
    assert pixel.seconds - block.seconds == pytest.approx(
        (260 - 18) * (8.5 + 2 * 0.25) + 2 * (0.5 + 0.25)
    )
    assert (block.grid, pixel.disk) == ((4, 4), 2 * 12 * 256**2)
    saturated = plans(GRID, (8.0,), NoiseModel(), Light(direct=0.5))
    assert saturated["pixel"].error == saturated["hadamard"].error == 1.0  # no signal
