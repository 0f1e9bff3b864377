# SPDX-License-Identifier: BSD-3-Clause
"""Forecasts of bounces and pictures, and noise in reports: as large as errors of scans, and closed forms."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import Report, VirtualRig, acquire, forecast_bounces, forecast_picture
from ltcl.acquisition.radiometry import Response
from ltcl.acquisition.scanning.pictures import Seen
from ltcl.errors import FileError, InputError
from ltcl.store import BlockStore

from .helpers import corner, dense, rig

GRID = (4, 8)
LINE = Response(np.array([[-0.004 / 0.996, 1.0]]))
NOISY: dict[str, Any] = {"read": 0.003, "gain": 2000.0, "bits": 12, "response": "linear"}
PATTERNS = np.stack([np.linspace(0.2, 1.0, 32), np.random.default_rng(1).random(32), np.ones(32)])


def bounces(T: np.ndarray, image: np.ndarray, count: int) -> np.ndarray:
    """b_0, b_1, ... (eq. 27) in float64, with the diagonal of T for its first bounce."""
    F, left, terms = np.diag(T), image.ravel().astype(np.float64), []
    for _ in range(count + 1):
        terms.append(F * np.linalg.solve(T, left))
        left = left - terms[-1]
    return np.array(terms)


def rms(values: Any, axis: Any = None) -> Any:
    return np.sqrt(np.mean(np.square(values), axis=axis))


@cache
def scans(strategy: str) -> list[tuple[Path, np.ndarray]]:
    """Stores and transports of eight scans of a corner; every entry is measured."""
    options: dict[str, Any] = {"strategy": strategy, "response": LINE, "sigmas": 0.0, "threshold": 1e-6}
    paths = [Path(mkdtemp()) / "T.zarr" for _ in range(8)]
    return [
        (path, dense(acquire(rig(4, seed=seed, **NOISY), geometry="aligned", store=path, **options)))
        for seed, path in enumerate(paths)
    ]


@pytest.mark.parametrize("strategy", ["pixel", "hadamard", "adaptive"])
def test_scans_deviate_as_was_forecast(strategy: str) -> None:
    """95 % of the pixels within two standard deviations, and the same root mean square; row sums as white."""
    truth, ratios, pictures = corner(4), [], []
    image = (truth @ PATTERNS[0]).reshape(GRID)
    for seed, (path, T) in enumerate(scans(strategy)):
        forecast = forecast_bounces(path, image, draws=32, seed=seed)
        deviations = np.concatenate([forecast.direct[None], forecast.bounces]).reshape(4, -1)
        ratios.append((bounces(T, image, 3) - bounces(truth, image, 3)) / deviations)
        np.testing.assert_allclose(forecast.rms, rms(deviations, 1), rtol=1e-6)
        expected = forecast_picture(path, PATTERNS.reshape(-1, *GRID)).reshape(3, -1)
        white = Seen.of(BlockStore.open(path)).white.variance[0]
        np.testing.assert_allclose(expected[2], np.sqrt(white), rtol=1e-3)  # in closed form
        pictures.append((PATTERNS @ (T - truth).T) / expected)
    # Eight scans of 32 pixels whose errors go together, and deviations of 32 draws.
    within = np.mean(np.abs(ratios) < 2.0, axis=(0, 2))
    assert ((within > 0.9) & (within < 0.99)).all(), within
    for ratio in (rms(ratios, (0, 2)), rms(pictures, (0, 2))):
        assert ((ratio > 0.8) & (ratio < 1.25)).all(), ratio


@pytest.mark.parametrize("strategy", ["pixel", "hadamard", "adaptive"])
def test_noise_in_a_report_is_that_of_many_scans(strategy: str) -> None:
    """Medians of the spread of first bounces and row sums over scans, relative to their mean."""
    paths, transports = zip(*scans(strategy), strict=True)
    reports, stack = [Report.of(path) for path in paths], np.array(transports)
    both = {"noise_direct": stack.diagonal(axis1=1, axis2=2), "noise_sum": stack.sum(axis=2)}
    for name, values in both.items():
        spread = np.median(values.std(axis=0, ddof=1) / values.mean(axis=0))
        assert np.median([getattr(report, name) for report in reports]) == pytest.approx(spread, rel=0.25)


@pytest.mark.parametrize("strategy", ["pixel", "adaptive"])
def test_colours_mix_and_have_forecasts_of_their_own(tmp_path: Path, strategy: str) -> None:
    M = np.array([[0.9, 0.15, 0.0], [0.05, 0.8, 0.1], [0.0, 0.2, 0.9]])
    colours = [corner(4, albedo) for albedo in (0.7, 0.5, 0.3)]
    camera, path = VirtualRig(colours, GRID, mixing=M, bits=12, ambient=0.01), tmp_path / "T.zarr"
    T = acquire(camera, geometry="aligned", strategy=strategy, store=path, threshold=1e-4)
    image = np.stack([(A @ np.ones(32)).reshape(GRID) for A in colours], axis=-1)
    forecast, separation = forecast_bounces(path, image, 2), ltcl.separate(T, image, bounces=2, rtol=1e-5)
    assert forecast.bounces.shape == (2, *GRID, 3)
    for c in range(3):
        error = separation.bounces[0, ..., c] - bounces(colours[c], image[..., c], 2)[1].reshape(GRID)
        assert 0.5 < rms(error) / rms(forecast.bounces[0, ..., c]) < 2.0
    p = np.random.default_rng(0).random((*GRID, 3))
    seen = np.asarray(T @ p, np.float64).reshape(-1, 3)
    truth = np.einsum("cij,cd,jd->ic", colours, M, p.reshape(-1, 3))
    difference = seen * (np.sum(seen * truth, axis=0) / np.sum(seen**2, axis=0)) - truth
    assert (np.linalg.norm(difference, axis=0) < 0.02 * np.linalg.norm(truth, axis=0)).all()
    white = forecast_picture(path, np.stack([np.ones(GRID), np.zeros(GRID)]))
    assert white.shape == (2, *GRID, 3)
    assert (white[0] > 0).all()
    assert (white[1] == 0).all()


def test_blocks_and_refusals(tmp_path: Path) -> None:
    path = tmp_path / "T.zarr"
    acquire(rig(4), geometry="aligned", strategy="block", block=2, store=path)
    forecast = forecast_bounces(path, np.ones((2, 4)), 0)
    assert (forecast.direct.shape, forecast.bounces.shape, forecast.rms.shape) == ((2, 4), (0, 2, 4), (1,))
    for image, options, part in (
        (np.ones((3, 3)), {}, r"image.*\(3, 3\)"),
        (np.ones((2, 4)), {"draws": 0}, "draws.*0"),
        (np.ones((2, 4)), {"bounces": -1}, "bounces.*-1"),
    ):
        with pytest.raises(InputError, match=part):
            forecast_bounces(path, image, **options)
    with pytest.raises(InputError, match="pattern"):
        forecast_picture(path, np.ones((2, 2)))
    ltcl.save(tmp_path / "other.zarr", ltcl.Transport(np.eye(32), GRID))
    unfinished = BlockStore.create(tmp_path / "unfinished.zarr", shape=(32, 32), grid=GRID)
    for other in (tmp_path / "other.zarr", unfinished):
        with pytest.raises(FileError, match="finished scan"):
            forecast_picture(other, np.ones(GRID))
