# SPDX-License-Identifier: BSD-3-Clause
"""The noise of scans: deviations and figures of reports match the errors of many scans."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import Report, acquire

from ..stopping import LINEAR_RESPONSE
from .helpers import corner, dense, rig

GRID = (4, 8)
SCANS = 8


def bounces(T: np.ndarray, image: np.ndarray, count: int) -> np.ndarray:
    """b_0, b_1, ... (eq. 27) in float64, with the diagonal of T as its first bounce."""
    F = np.diag(T)
    remaining = image.ravel().astype(np.float64)
    terms = []
    for _ in range(count + 1):
        terms.append(F * np.linalg.solve(T, remaining))
        remaining = remaining - terms[-1]
    return np.array(terms)


@pytest.fixture(
    scope="session",
    params=[
        "pixel",
        pytest.param("hadamard", marks=pytest.mark.slow),
        pytest.param("adaptive", marks=pytest.mark.slow),
    ],
)
def scans(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[list[Path], np.ndarray]:
    """Stores and transports (8, N, N) of eight scans of a corner; every entry is measured."""
    paths = []
    transports = []
    for seed in range(SCANS):
        path = tmp_path_factory.mktemp("scan") / "T.zarr"
        camera = rig(4, seed=seed, read=0.003, gain=2000.0, response="linear")
        T = acquire(
            camera,
            geometry="aligned",
            store=path,
            strategy=request.param,
            response=LINEAR_RESPONSE,
            sigmas=0.0,
            threshold=1e-6,
        )
        paths.append(path)
        transports.append(dense(T))
    return paths, np.array(transports)


@pytest.mark.rare
def test_scans_deviate_by_their_noise(scans: Any) -> None:
    """More than 90 % of the pixels are within two deviations, and errors are not far smaller."""
    paths, _ = scans
    truth = corner(4)
    image = (truth @ np.linspace(0.2, 1.0, 32)).reshape(GRID)
    expected = bounces(truth, image, 3)
    ratios = []
    for path in paths:
        T = ltcl.load(path)
        assert T.noise.source == "acquired"
        std = ltcl.separate(T, image, 3).std
        deviations = np.concatenate([std.direct[None], std.bounces]).reshape(4, -1)
        ratios.append((bounces(T.to_numpy(), image, 3) - expected) / deviations)
    # Eight scans of 32 pixels whose errors go together.
    within = np.mean(np.abs(ratios) < 2.0, axis=(0, 2))
    ratio = np.sqrt(np.mean(np.square(ratios), axis=(0, 2)))
    assert (within > 0.9).all(), within
    assert ((ratio > 0.4) & (ratio < 1.25)).all(), ratio


@pytest.mark.rare
def test_noise_in_a_report_is_that_of_many_scans(scans: Any) -> None:
    """It is the median spread of first bounces and row sums over scans, relative to their mean."""
    paths, transports = scans
    reports = [Report.of(path) for path in paths]
    noise_direct = np.median([report.noise_direct for report in reports])
    noise_sum = np.median([report.noise_sum for report in reports])
    first_bounces = transports.diagonal(axis1=1, axis2=2)
    assert noise_direct == pytest.approx(relative_spread(first_bounces), rel=0.25)
    assert noise_sum == pytest.approx(relative_spread(transports.sum(axis=2)), rel=0.25)


def relative_spread(values: np.ndarray) -> float:
    """Median of the standard deviation over scans (scans, N), relative to the mean."""
    return float(np.median(values.std(axis=0, ddof=1) / values.mean(axis=0)))
