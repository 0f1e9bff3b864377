# SPDX-License-Identifier: BSD-3-Clause
"""Blur measured from stripes against the true blur, and its effects on a scan."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.ndimage
import scipy.sparse

from ltcl.acquisition import Calibration, Report, VirtualRig, acquire, camera_map
from ltcl.acquisition.calibrate import measure as calibrate
from ltcl.acquisition.geometry import Correspondence, GrayCode, Resampling, Sharpness
from ltcl.acquisition.radiometry import Response
from ltcl.acquisition.rig import Shots
from ltcl.errors import AcquisitionError

from ..scanning.helpers import corner
from .scenes import places, turned

GRID = (8, 16)
random = np.random.default_rng()
MAP = places(*turned(GRID, 0.95, 0.06, (0.1, -0.1), 1.15))
LINE = Response(np.array([[-0.004 / 0.996, 1.0]]))


def shown(codes: np.ndarray, q: tuple[float, float]) -> np.ndarray:
    """A picture with a part q of each pixel's light from its neighbours along y and x."""
    for axis, leak in enumerate(q):
        kernel = np.array([leak / 2, 1 - leak, leak / 2])
        codes = scipy.ndimage.convolve1d(codes, kernel, axis=axis, mode="nearest")
    return codes


@pytest.mark.parametrize("q", [(0.0, 0.0), (0.1, 0.3), (0.45, 0.02), (0.2, 0.2)])
@pytest.mark.parametrize("grid", [(8, 16), (32, 40)])
def test_blur_is_measured_and_the_error_of_pictures_of_noise(
    q: tuple[float, float], grid: tuple[int, int]
) -> None:
    """There is noise, and even light from elsewhere; the walls are not even."""
    albedo = random.uniform(0.3, 0.9, grid)
    light = [
        albedo * (shown(codes, q) + 0.2 * codes.mean()) + 0.003 * random.normal(size=grid)
        for codes in GrayCode(grid).patterns()
    ]
    sharpness = Sharpness.of(Correspondence.aligned(grid), Resampling.aligned(grid), light)
    np.testing.assert_allclose(sharpness.leak, q, atol=0.02)
    p = random.random((200, 200))
    wrong = np.linalg.norm(shown(p, q) - p) / np.linalg.norm(p)
    assert Sharpness(q, 0.0).blur == pytest.approx(wrong, rel=0.05)


def view(size: float, blur: float = 0.0) -> tuple[scipy.sparse.csr_array, tuple[int, int]]:
    """The map of a camera of `size` pixels to one of the projector's, turned and out of focus."""
    place, (H, W) = turned(GRID, size, 0.06, (0.1, -0.1), 1.15)
    C = camera_map(place, (H, W), GRID).toarray().reshape(H, W, -1)
    C = scipy.ndimage.gaussian_filter(C, (blur, blur, 0)).reshape(H * W, -1)
    return scipy.sparse.csr_array(C), (H, W)


def camera(size: float, blur: float = 0.0, T: Any = None, **options: Any) -> VirtualRig:
    C, grid = view(size, blur)
    options = {"bits": 12, "response": "linear", "ambient": 0.01, **options}
    return VirtualRig(corner() if T is None else T, GRID, camera_grid=grid, camera_map=C, **options)


@pytest.mark.parametrize(
    ("size", "blur"), [(3.7, 0.0), (2.5, 0.0), (1.4, 0.0), (3.5, 0.9), (2.5, 0.9)], ids=str
)
def test_reported_blur_is_the_error_of_pictures(size: float, blur: float, caplog: Any) -> None:
    """Sharp twice, coarse, out of focus; a warning of each that is bad; no plain wall is doubtful.

    Uneven light passes for a q of up to 0.02, which blurs by 2 %.
    """
    with caplog.at_level(logging.WARNING):
        calibration = calibrate(Shots(camera(size, blur)), response=LINE)
    R = calibration.resampling
    P = random.random((GRID[0] * GRID[1], 6))
    exact = corner() @ P
    seen = R.seen.ravel()
    C, _ = view(size, blur)
    ours = (R.weights @ (C @ exact))[seen]
    theirs = exact[seen]
    scale = np.vdot(ours, theirs) / np.vdot(ours, ours)
    truth = np.linalg.norm(scale * ours - theirs) / np.linalg.norm(theirs)
    assert calibration.sharpness is not None
    assert 0.6 * truth < calibration.sharpness.blur < 1.6 * truth + 0.02
    assert ("camera pixels are" in caplog.text) == (truth > 0.02)
    assert R.doubtful is not None
    assert not R.doubtful.any()


@pytest.mark.parametrize("geometry", ["graycode", Correspondence(*MAP, MAP[0] > -1, GRID)])
def test_a_hopeless_camera_is_refused_before_the_scan(geometry: Any) -> None:
    """The blur is measured, or follows from the size of camera pixels if a map is passed."""
    with pytest.raises(AcquisitionError, match=r"camera pixels are .* closer"):
        acquire(camera(0.95), strategy="pixel", response=LINE, geometry=geometry)


@pytest.mark.parametrize(
    ("leak", "width", "closer", "focus"),
    [(0.35, 0.9, True, False), (0.4, 0.3, False, True), (0.7, 0.9, True, True)],
)
def test_advice_is_what_can_help(
    leak: float, width: float, closer: bool, focus: bool, caplog: Any
) -> None:
    """Fine camera pixels need no closer camera; coarse ones alone blur as much without focus."""
    sharpness = Sharpness((leak, leak), width)
    try:
        sharpness.check()
        text = caplog.text
    except AcquisitionError as error:
        text = str(error)
    assert ("closer" in text, "focus" in text) == (closer, focus)


@pytest.mark.rare
def test_it_is_stored_and_reported(tmp_path: Path) -> None:
    """Out of focus: the store has it, and the report says it."""
    path = tmp_path / "T.zarr"
    T = acquire(camera(3.0, 1.0), strategy="hadamard", store=path, response=LINE)
    stored = Calibration.of(path).sharpness
    report = Report.of(path)
    assert stored is not None
    assert (report.sharpness, report.blur) == (stored.own, stored.blur)
    p = random.random(GRID)
    seen = np.asarray(T @ p).ravel()[~T.masked]
    truth = (corner() @ p.ravel())[~T.masked]
    scale = (seen @ truth) / (seen @ seen)
    error = np.linalg.norm(scale * seen - truth) / np.linalg.norm(truth)
    assert error > 0.05


@pytest.mark.slow
def test_a_dark_patch_in_bright_walls_is_masked_where_it_is_not_resolved(tmp_path: Path) -> None:
    """Few camera pixels there are decoded: pixels at its rim would show the bright walls."""
    albedo = np.full(GRID, 0.8)
    patch = np.zeros(GRID, bool)
    patch[2:6, 3:7] = True
    albedo[patch] = 0.015
    rho = albedo.ravel()
    between = corner() / 0.6 - np.eye(len(rho))  # light between walls, of rows of albedo 0.6
    truth = rho[:, None] * (np.eye(len(rho)) + between * rho)
    path = tmp_path / "T.zarr"
    T = acquire(camera(2.5, T=truth, response="srgb"), strategy="hadamard", store=path)
    doubtful = Calibration.of(path).resampling.doubtful
    assert doubtful is not None
    assert doubtful.any()
    assert not doubtful[~patch].any()
    assert Report.of(path).doubtful == doubtful.mean()
    assert T.masked[doubtful.ravel()].all()
    seen = ~T.masked
    white = np.asarray(T @ np.ones(GRID), np.float64).ravel()[seen]
    exact = truth.sum(axis=1)[seen]
    scale = (white @ exact) / (white @ white)
    assert (scale * white > 0.5 * exact).all()
    rows = np.asarray(T @ np.eye(len(rho), dtype=np.float32).reshape(-1, *GRID))
    # Errors of the map at bright walls: up to 0.012.
    assert scale * rows.min() > -0.013 * exact.max()
