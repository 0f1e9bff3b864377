# SPDX-License-Identifier: BSD-3-Clause
"""Forecasts of bounces and pictures: as far off as scans are, over many of them, and as formulas say."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import Calibration, VirtualRig, acquire, forecast_bounces, forecast_picture
from ltcl.acquisition.radiometry import Response
from ltcl.acquisition.scanning import Pixels, forecast
from ltcl.errors import FileError, InputError
from ltcl.store import BlockStore

from .helpers import corner, rig

GRID = (4, 8)
LINE = Response(np.array([[-0.004 / 0.996, 1.0]]))
NOISY: dict[str, Any] = {"read": 0.003, "gain": 2000.0, "bits": 12, "response": "linear"}
SEEDS = 8


def bounces(T: np.ndarray, image: np.ndarray, count: int) -> np.ndarray:
    """b_0, b_1, ... (eq. 27) in float64, with the diagonal of T for its first bounce."""
    F, left, found = np.diag(T), image.ravel().astype(np.float64), []
    for _ in range(count + 1):
        found.append(F * np.linalg.solve(T, left))
        left = left - found[-1]
    return np.array(found)


def measured(T: ltcl.Transport) -> np.ndarray:
    """T as it is in memory or in cells, float64."""
    n = T.grid[0] * T.grid[1]
    return np.asarray(T @ np.eye(n, dtype=np.float32).reshape(n, *T.grid), np.float64).reshape(n, n).T


@pytest.mark.parametrize("strategy", ["pixel", "hadamard", "adaptive"])
def test_scans_are_as_far_off_as_was_forecast(tmp_path: Path, strategy: str) -> None:
    """Of many scans: 95 % of the pixels within two standard deviations, and the same root mean square."""
    truth, errors, told = corner(4), [], []
    pattern = np.linspace(0.2, 1.0, 32).reshape(GRID)
    image = (truth @ pattern.ravel()).reshape(GRID)
    wanted, picture = bounces(truth, image, 3), truth @ pattern.ravel()
    seen = []
    for seed in range(SEEDS):
        path = tmp_path / f"{seed}.zarr"
        T = acquire(
            rig(4, seed=seed, **NOISY), geometry="aligned", strategy=strategy, store=path, response=LINE,
            sigmas=0.0, threshold=1e-6,
        )  # fmt: skip
        errors.append(bounces(measured(T), image, 3) - wanted)
        forecast = forecast_bounces(path, image, draws=32, seed=seed)
        told.append(np.concatenate([forecast.direct[None], forecast.bounces]).reshape(4, -1))
        expected = forecast_picture(path, pattern, draws=32, seed=seed).ravel()
        seen.append((np.asarray(T @ pattern, np.float64).ravel() - picture) / expected)
    ratio = np.array(errors) / np.array(told)
    # Eight scans of 32 pixels whose errors go together, and deviations of 32 draws.
    within = np.mean(np.abs(ratio) < 2.0, axis=(0, 2))
    assert ((within > 0.91) & (within < 0.99)).all(), within
    rms = np.sqrt(np.mean(ratio**2, axis=(0, 2)))
    assert ((rms > 0.8) & (rms < 1.25)).all(), rms
    assert 0.8 < np.sqrt(np.mean(np.square(seen))) < 1.25


@pytest.mark.parametrize("strategy", ["pixel", "hadamard", "adaptive"])
def test_first_order_is_as_the_dense_difference(tmp_path: Path, strategy: str) -> None:
    """Each draw is E: bounces of T + E, computed anew, are as far off as the formula has it."""
    path, truth = tmp_path / "T.zarr", corner(4)
    T = measured(acquire(rig(4), geometry="aligned", strategy=strategy, store=path, sigmas=0.0))
    image = (truth @ np.linspace(1.0, 0.5, 32)).reshape(GRID)
    (drawn,) = forecast.draw_errors(BlockStore.open(path), [np.eye(32)], draws=40, seed=3)
    np.testing.assert_allclose(drawn.diagonal, np.diagonal(drawn.product, axis1=1, axis2=2), atol=1e-6)
    was = bounces(T, image, 2)
    dense = np.array([bounces(T + E, image, 2) - was for E in drawn.product])
    deviation = np.sqrt(np.mean(dense**2, axis=(0, 2)))
    np.testing.assert_allclose(forecast_bounces(path, image, 2, draws=400).rms, deviation, rtol=0.12)


def test_of_a_diagonal_transport_the_forecast_is_in_closed_form(tmp_path: Path) -> None:
    """Its one lit entry in a row, by all that is drawn at random: two batches of 16 + 1, ambient, white."""
    path, made = tmp_path / "T.zarr", VirtualRig(0.5 * np.eye(32), GRID, **NOISY)
    given: dict[str, Any] = {"exposures": [1.0], "response": LINE, "sigmas": 0.0}
    acquire(made, geometry="aligned", strategy="pixel", store=path, **given)
    x = forecast_picture(path, np.eye(32)[0].reshape(GRID), draws=2000).ravel()[0]
    store = BlockStore.open(path)
    # The lit pixel is dark in all pictures but its own, the sum of its batch, and white.
    light = np.zeros((2, 17, 1))
    light[0, [0, 16]] = store.read(0, 0).toarray()[0, 0]
    seen = forecast.SimulatedCamera.of(store)
    noise = Calibration.of(path).noise
    v = noise.variance(light + Calibration.of(path).ambient.value[0, 0])
    np.testing.assert_allclose(seen.variance(np.array([0.5]), 0)[0], noise.variance(0.5), rtol=1e-2)
    a, u = seen.ambient[0, :1], seen.white.variance[0, 0]
    s = np.concatenate([_decoded(part, part, a)[1] for part in v])[:, 0]
    unit = np.eye(34).reshape(34, 2, 17, 1)
    gain = np.array([[_decoded(y, n, a)[0] for y, n in zip(e, v, strict=True)] for e in unit]).reshape(34, 32)
    dark = -np.concatenate([_decoded(np.ones((17, 1)), n, a)[0] for n in v])[:, 0]
    part = s[0] / (s.sum() + u)
    variance = np.sum((gain[:, 0] - part * gain.sum(axis=1)) ** 2 * v.ravel())
    variance += (dark[0] + part * (-1.0 - dark.sum())) ** 2 * a[0] + part**2 * (u - a[0])
    assert x**2 == pytest.approx(variance, rel=0.12)


def _decoded(value: np.ndarray, variance: np.ndarray, ambient: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return Pixels(16).decode(value, variance, ambient)


@pytest.mark.parametrize("strategy", ["pixel", "adaptive"])
def test_colours_have_their_own(tmp_path: Path, strategy: str) -> None:
    M = np.array([[0.9, 0.15, 0.0], [0.05, 0.8, 0.1], [0.0, 0.2, 0.9]])
    colours = [corner(4, albedo) for albedo in (0.7, 0.5, 0.3)]
    made, path = VirtualRig(colours, GRID, mixing=M, bits=12, ambient=0.01), tmp_path / "T.zarr"
    T = acquire(made, geometry="aligned", strategy=strategy, store=path, threshold=1e-4)
    image = np.stack([(A @ np.ones(32)).reshape(GRID) for A in colours], axis=-1)
    forecast, found = forecast_bounces(path, image, 2), ltcl.separate(T, image, bounces=2, rtol=1e-5)
    assert forecast.bounces.shape == (2, *GRID, 3)
    for c in range(3):
        error = found.bounces[0, ..., c] - bounces(colours[c], image[..., c], 2)[1].reshape(GRID)
        assert 0.5 < np.sqrt(np.mean(error**2) / np.mean(forecast.bounces[0, ..., c] ** 2)) < 2.0
    white = forecast_picture(path, np.ones(GRID))
    assert white.shape == (*GRID, 3)
    assert (white > 0).all()


def test_blocks_and_refusals(tmp_path: Path) -> None:
    path = tmp_path / "T.zarr"
    acquire(rig(4), geometry="aligned", strategy="block", block=2, store=path)
    forecast = forecast_bounces(path, np.ones((2, 4)), 0)
    assert (forecast.direct.shape, forecast.bounces.shape, forecast.rms.shape) == ((2, 4), (0, 2, 4), (1,))
    cases: tuple[tuple[Any, dict[str, Any], str], ...] = (
        ((np.ones((3, 3)),), {}, r"image .*\(3, 3\)"),
        ((np.ones((2, 4)),), {"draws": 0}, "draws is 0"),
        ((np.ones((2, 4)), -1), {}, "bounces is -1"),
    )
    for arguments, options, message in cases:
        with pytest.raises(InputError, match=message):
            forecast_bounces(path, *arguments, **options)
    with pytest.raises(InputError, match="pattern"):
        forecast_picture(path, np.ones((2, 2)))
    ltcl.save(tmp_path / "other.zarr", ltcl.Transport(np.eye(32), GRID))
    unfinished = BlockStore.create(tmp_path / "unfinished.zarr", shape=(32, 32), grid=GRID)
    for other in (tmp_path / "other.zarr", unfinished):
        with pytest.raises(FileError, match="finished scan"):
            forecast_picture(other, np.ones(GRID))
