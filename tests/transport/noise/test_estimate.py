# SPDX-License-Identifier: BSD-3-Clause
"""Noise from T alone where light is not smooth, errors are few photons or shared, or T is empty."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.ndimage

import ltcl
from ltcl.transport.noise import Noise

from .measured import noise_of, truth

CLOSE = 1.3

Change = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def off_diagonal(shape: tuple[int, ...]) -> np.ndarray:
    return ~np.eye(*shape, dtype=bool)


def unchanged(T: np.ndarray, random: np.random.Generator) -> np.ndarray:
    return T


def dead_entries(T: np.ndarray, random: np.random.Generator) -> np.ndarray:
    is_dead = (random.random(T.shape) < 0.02) & off_diagonal(T.shape)
    return np.where(is_dead, 0.0, T)


def small_shadows(T: np.ndarray, random: np.random.Generator) -> np.ndarray:
    is_dark = random.random(T.shape) < 0.02
    return np.where((is_dark | is_dark.T) & off_diagonal(T.shape), 0.0, T)


def camera_texture(T: np.ndarray, random: np.random.Generator) -> np.ndarray:
    return T * random.uniform(0.3, 0.9, len(T))[:, None]


def paint(T: np.ndarray, random: np.random.Generator) -> np.ndarray:
    albedo = random.uniform(0.3, 0.9, len(T))
    return albedo[:, None] * T * albedo


def is_close(noise: Noise, exact: Noise, T: np.ndarray) -> float:
    """Share of the entries off the diagonal whose deviation is within a factor of 1.3."""
    ratio = np.sqrt(noise.variance(T) / exact.variance(T))[off_diagonal(T.shape)]
    return float(np.mean(np.abs(np.log(np.maximum(ratio, 1e-9))) < np.log(CLOSE)))


@pytest.mark.parametrize("change", [dead_entries, small_shadows, camera_texture, paint])
@pytest.mark.parametrize(("scene", "level"), [("box", 1e-3), ("painted", 3e-4), ("occluded", 1e-3)])
def test_light_that_is_not_smooth_is_no_noise(scene: str, level: float, change: Change) -> None:
    random = np.random.default_rng(7)
    T = truth(scene)
    exact = noise_of(T, level)
    light = change(T.to_numpy(), random)
    measured = light + np.sqrt(exact.variance(light)) * random.standard_normal(light.shape)
    noise = ltcl.Transport(measured, T.grid).noise
    assert is_close(noise, exact, light) > 0.9


@pytest.mark.parametrize("scene", ["occluded", "painted", "box"])
@pytest.mark.parametrize("paths", [0.5, 2.0, 20.0])
def test_few_paths_an_entry_are_photon_noise(scene: str, paths: float) -> None:
    """As of a path tracer: entries may be 0, and the weight of a path depends on the column."""
    random = np.random.default_rng(3)
    T = truth(scene)
    light = T.to_numpy().astype(np.float64)
    np.fill_diagonal(light, 0.0)
    x = np.arange(len(light)) % T.grid[1] / T.grid[1]
    weight = np.exp(np.cos(2.0 * np.pi * x)) * np.median(light[light > 0.0]) / paths
    measured = random.poisson(light / weight) * weight
    np.fill_diagonal(measured, np.diag(T.to_numpy()))
    noise = ltcl.Transport(measured, T.grid).noise
    np.fill_diagonal(light, np.diag(T.to_numpy()))
    exact = Noise(
        photons=np.array([weight.mean()]),
        floor=np.zeros(1),
        rows=np.ones((1, len(light))),
        columns=weight[None] / weight.mean(),
        white=np.full((1, len(light)), np.inf),
    )
    is_lit = off_diagonal(light.shape) & (light > 0.1 * np.median(light))
    ratio = np.sqrt(noise.variance(light) / exact.variance(light))[is_lit]
    assert np.mean(np.abs(np.log(ratio)) < np.log(CLOSE)) > 0.9


WINDOW: Any = (2, 2, 1)
SHARED = {
    "mean of 2 x 2 pixels": lambda e: 2.0 * scipy.ndimage.uniform_filter(e, WINDOW),
    "blurred": lambda e: scipy.ndimage.gaussian_filter(e, (0.7, 0.7, 0.0)) * 2.49,
}


@pytest.mark.slow
@pytest.mark.parametrize("filtered", SHARED.values(), ids=SHARED.keys())
@pytest.mark.parametrize(("side", "enlarged"), [(12, 1), (8, 3)])
def test_errors_that_camera_pixels_share_are_not_underrated(
    filtered: Callable[[np.ndarray], np.ndarray], side: int, enlarged: int, tmp_path: Path
) -> None:
    random = np.random.default_rng(1)
    scene = ltcl.scenes.dihedral(side, albedo=0.7)
    h, w = scene.grid
    light = scene.transport().to_numpy().reshape(h, w, -1)
    light = light.repeat(enlarged, axis=0).repeat(enlarged, axis=1)
    errors = 1e-4 * filtered(random.standard_normal(light.shape))
    camera_grid = (enlarged * h, enlarged * w)
    T = ltcl.Transport((light + errors).reshape(-1, h * w), (h, w), camera_grid=camera_grid)
    assert T.noise.source == "estimated"
    assert 1.0 / CLOSE < T.noise.floor[0] / errors.std() < CLOSE
    assert T.noise.neighbours[0] == 0.0
    c = ltcl.compensate(T, T @ np.full(T.grid, 0.5))
    assert np.all(np.isfinite(c.std.pattern))
    path = tmp_path / "T.npz"
    ltcl.save(path, T)
    command = [sys.executable, "-m", "ltcl", "info", str(path)]
    assert subprocess.run(command, capture_output=True, check=False).returncode == 0


def blurred_wall(side: int, reach: int, random: np.random.Generator | None) -> np.ndarray:
    """A flat wall without noise: direct light that reaches some neighbours, too."""
    y, x = np.divmod(np.arange(side**2), side)
    step = np.maximum(np.abs(y[:, None] - y), np.abs(x[:, None] - x))
    strength = np.full(step.shape, 0.02)
    if random is not None:
        strength = 0.04 * random.random(step.shape)
    return 0.6 * np.eye(side**2) + strength * ((step > 0) & (step <= reach))


@pytest.mark.parametrize("side", [16, 20])
@pytest.mark.parametrize("reach", [0, 1, 2])
@pytest.mark.parametrize("is_random", [False, True])
def test_a_wall_without_bounces_does_not_show_its_noise(
    side: int, reach: int, is_random: bool
) -> None:
    M = blurred_wall(side, reach, np.random.default_rng(0) if is_random else None)
    T = ltcl.Transport(M, (side, side))
    assert T.noise.source == "unknown"
    assert np.all(T.noise.variance(M) < 1e-12)
    assert not ltcl.analyze(T).verdict.text.startswith("Good")


def test_unknown_noise_is_kept_in_files(tmp_path: Path) -> None:
    T = ltcl.Transport(blurred_wall(16, 1, None), (16, 16))
    given = ltcl.Transport(T.to_numpy(), T.grid, noise=T.noise)
    ltcl.save(tmp_path / "T.npz", given)
    assert ltcl.load(tmp_path / "T.npz").noise.source == "unknown"


@pytest.mark.rare
def test_errors_of_few_pixels_do_not_seem_to_cancel() -> None:
    """Row sums of a small T may have little detail by chance."""
    exact = truth("box", 6)
    noise = noise_of(exact, 3e-3)
    entries = exact.to_numpy()
    shares = []
    for seed in range(60):
        E = np.sqrt(noise.variance(entries)) * np.random.default_rng(seed).standard_normal(
            exact.shape
        )
        shares.append(ltcl.Transport(entries + E, exact.grid).noise.neighbours[0])
    assert np.count_nonzero(shares) <= 1
