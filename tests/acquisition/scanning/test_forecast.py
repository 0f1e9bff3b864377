# SPDX-License-Identifier: BSD-3-Clause
"""Forecasts of bounces and pictures, and noise in reports: as large as errors of scans, and closed forms."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import Report, VirtualRig, acquire, camera_map, forecast_bounces, forecast_picture
from ltcl.acquisition.radiometry import Response
from ltcl.acquisition.scanning.pictures import Seen
from ltcl.errors import FileError, InputError
from ltcl.store import BlockStore

from .helpers import corner, dense, relative_error, rig, unseen_patterns

random = np.random.default_rng()
GRID = (4, 8)
LINE = Response(np.array([[-0.004 / 0.996, 1.0]]))


def bounces(T: np.ndarray, image: np.ndarray, count: int) -> np.ndarray:
    """b_0, b_1, ... (eq. 27) in float64, with the diagonal of T for its first bounce."""
    F, left, terms = np.diag(T), image.ravel().astype(np.float64), []
    for _ in range(count + 1):
        terms.append(F * np.linalg.solve(T, left))
        left = left - terms[-1]
    return np.array(terms)


def rms(values: Any, axis: Any = None) -> Any:
    return np.sqrt(np.mean(np.square(values), axis=axis))


@pytest.fixture(scope="session", params=["pixel", "hadamard", "adaptive"])
def scans(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], Any]:
    """Stores and transports (8, N, N) of eight scans of a corner; every entry is measured."""
    paths = [tmp_path_factory.mktemp("scan") / "T.zarr" for _ in range(8)]
    options = {"strategy": request.param, "response": LINE, "sigmas": 0.0, "threshold": 1e-6}
    transports = []
    for seed, path in enumerate(paths):
        camera = rig(4, seed=seed, read=0.003, gain=2000.0, response="linear")
        transports.append(dense(acquire(camera, geometry="aligned", store=path, **options)))
    return paths, np.array(transports)


def test_scans_deviate_as_was_forecast(scans: Any) -> None:
    """95 % of the pixels within two standard deviations, and the same root mean square; row sums as white."""
    patterns = np.stack([np.linspace(0.2, 1.0, 32), random.random(32), np.ones(32)])
    truth, ratios, pictures = corner(4), [], []
    image = (truth @ patterns[0]).reshape(GRID)
    for path, T in zip(*scans, strict=True):
        forecast = forecast_bounces(path, image, draws=32)
        deviations = np.concatenate([forecast.direct[None], forecast.bounces]).reshape(4, -1)
        ratios.append((bounces(T, image, 3) - bounces(truth, image, 3)) / deviations)
        np.testing.assert_allclose(forecast.rms, rms(deviations, 1), rtol=1e-6)
        expected = forecast_picture(path, patterns.reshape(-1, *GRID)).reshape(3, -1)
        white = Seen.of(BlockStore.open(path)).white.variance[0]
        np.testing.assert_allclose(expected[2], np.sqrt(white), rtol=1e-3)  # in closed form
        pictures.append((patterns @ (T - truth).T) / expected)
    # Eight scans of 32 pixels whose errors go together, and deviations of 32 draws.
    within = np.mean(np.abs(ratios) < 2.0, axis=(0, 2))
    assert ((within > 0.9) & (within < 0.99)).all(), within
    for ratio in (rms(ratios, (0, 2)), rms(pictures, (0, 2))):
        assert ((ratio > 0.8) & (ratio < 1.25)).all(), ratio


def test_noise_in_a_report_is_that_of_many_scans(scans: Any) -> None:
    """Medians of the spread of first bounces and row sums over scans, relative to their mean."""
    reports, stack = [Report.of(path) for path in scans[0]], scans[1]
    both = {"noise_direct": stack.diagonal(axis1=1, axis2=2), "noise_sum": stack.sum(axis=2)}
    for name, values in both.items():
        spread = np.median(values.std(axis=0, ddof=1) / values.mean(axis=0))
        assert np.median([getattr(report, name) for report in reports]) == pytest.approx(spread, rel=0.25)


@pytest.mark.parametrize("strategy", ["pixel", "adaptive"])
def test_colours_that_mix_have_forecasts_of_their_own(tmp_path: Path, strategy: str) -> None:
    M = np.array([[0.9, 0.15, 0.0], [0.05, 0.8, 0.1], [0.0, 0.2, 0.9]])
    colours = [corner(4, albedo) for albedo in (0.7, 0.5, 0.3)]
    camera, path = VirtualRig(colours, GRID, mixing=M, bits=12, ambient=0.01), tmp_path / "T.zarr"
    T = acquire(camera, geometry="aligned", strategy=strategy, store=path, threshold=1e-4)
    image = np.stack([(A @ np.ones(32)).reshape(GRID) for A in colours], axis=-1)
    forecast, separation = forecast_bounces(path, image, 2), ltcl.separate(T, image, bounces=2, rtol=1e-5)
    for c in range(3):
        error = separation.bounces[0, ..., c] - bounces(colours[c], image[..., c], 2)[1].reshape(GRID)
        assert 0.5 < rms(error) / rms(forecast.bounces[0, ..., c]) < 2.0
    white = forecast_picture(path, np.stack([np.ones(GRID), np.zeros(GRID)]))
    assert white.shape == (2, *GRID, 3)
    assert (white[0] > 0).all()
    assert (white[1] == 0).all()


def test_a_sharp_camera_has_a_small_forecast(tmp_path: Path) -> None:
    """Before a bright corner, whose light from wall to wall looks like blur in stripes of Gray code."""
    grid, size, path = (8, 16), (36, 68), tmp_path / "T.zarr"
    view = camera_map(lambda u, v: (u / 4 - 0.4, v / 4 - 0.3), size, grid)
    camera = rig(8, camera_grid=size, camera_map=view, response="linear")
    T, P = acquire(camera, strategy="adaptive", store=path, response=LINE), unseen_patterns(grid).T
    seen, pictures = ~T.masked, (forecast_picture(path, P.reshape(-1, *grid)), T @ P.reshape(-1, *grid))
    forecast, shown = (np.linalg.norm(x.reshape(6, -1)[:, seen], axis=1) for x in pictures)
    error = relative_error(dense(T)[seen], corner()[seen], grid)
    assert 0.5 * error < np.max(forecast / shown) < 2.0 * error < 0.02


def test_blocks_and_refusals(tmp_path: Path) -> None:
    path = tmp_path / "T.zarr"
    T = acquire(rig(4), geometry="aligned", strategy="block", block=2, store=path)
    truth = corner(4).reshape(2, 2, 4, 2, 2, 2, 4, 2).sum(axis=(5, 7)).mean(axis=(1, 3)).reshape(8, 8)
    assert relative_error(dense(T), truth, (2, 4)) < 0.01
    forecast = forecast_bounces(path, np.ones((2, 4)), 0)
    assert (forecast.direct.shape, forecast.bounces.shape, forecast.rms.shape) == ((2, 4), (0, 2, 4), (1,))
    for options in ({"image": np.ones((3, 3))}, {"draws": 0}, {"bounces": -1}):
        with pytest.raises(InputError, match=next(iter(options))):
            forecast_bounces(path, **{"image": np.ones((2, 4)), **options})
    with pytest.raises(InputError, match=r"pattern.*\(2, 2\)"):
        forecast_picture(path, np.ones((2, 2)))
    ltcl.save(tmp_path / "other.zarr", ltcl.Transport(np.eye(32), GRID))
    BlockStore.create(tmp_path / "unfinished.zarr", shape=(32, 32), grid=GRID)
    for name in ("other.zarr", "unfinished.zarr"):
        with pytest.raises(FileError, match=f"{name}.*finished scan"):
            forecast_picture(tmp_path / name, np.ones(GRID))
