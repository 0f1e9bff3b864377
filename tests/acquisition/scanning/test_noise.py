# SPDX-License-Identifier: BSD-3-Clause
"""The noise of scans: deviations of bounces and figures of reports are as large as errors of many scans."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import Report, acquire
from ltcl.acquisition.radiometry import Response

from .helpers import corner, dense, rig

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
def scans(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[list[Path], Any]:
    """Stores and transports (8, N, N) of eight scans of a corner; every entry is measured."""
    paths = [tmp_path_factory.mktemp("scan") / "T.zarr" for _ in range(8)]
    options = {"strategy": request.param, "response": LINE, "sigmas": 0.0, "threshold": 1e-6}
    transports = []
    for seed, path in enumerate(paths):
        camera = rig(4, seed=seed, read=0.003, gain=2000.0, response="linear")
        transports.append(dense(acquire(camera, geometry="aligned", store=path, **options)))
    return paths, np.array(transports)


def test_scans_deviate_as_their_noise_says(scans: Any) -> None:
    """95 % of the pixels within two standard deviations at least, and errors not far smaller than these."""
    light, truth, ratios = np.linspace(0.2, 1.0, 32), corner(4), []
    image = (truth @ light).reshape(GRID)
    for path in scans[0]:
        T = ltcl.load(path)
        assert T.noise.source == "acquired"
        std = ltcl.separate(T, image, 3).std
        deviations = np.concatenate([std.direct[None], std.bounces]).reshape(4, -1)
        ratios.append((bounces(T.to_numpy(), image, 3) - bounces(truth, image, 3)) / deviations)
    # Eight scans of 32 pixels whose errors go together.
    within, ratio = np.mean(np.abs(ratios) < 2.0, axis=(0, 2)), rms(ratios, (0, 2))
    assert (within > 0.9).all(), within
    assert ((ratio > 0.4) & (ratio < 1.25)).all(), ratio


def test_noise_in_a_report_is_that_of_many_scans(scans: Any) -> None:
    """Medians of the spread of first bounces and row sums over scans, relative to their mean."""
    reports, stack = [Report.of(path) for path in scans[0]], scans[1]
    both = {"noise_direct": stack.diagonal(axis1=1, axis2=2), "noise_sum": stack.sum(axis=2)}
    for name, values in both.items():
        spread = np.median(values.std(axis=0, ddof=1) / values.mean(axis=0))
        assert np.median([getattr(report, name) for report in reports]) == pytest.approx(
            spread, rel=0.25
        )
