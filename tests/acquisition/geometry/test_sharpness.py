# SPDX-License-Identifier: BSD-3-Clause
"""Blur that is measured from stripes against blur that was put before the camera; and what comes of it."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.ndimage
import scipy.sparse

from ltcl.acquisition import (
    Calibration,
    Report,
    Setup,
    VirtualRig,
    acquire,
    camera_map,
    forecast_picture,
    measuring,
)
from ltcl.acquisition.geometry import Correspondence, GrayCode, Resampling
from ltcl.acquisition.geometry.sharpness import Sharpness, leak
from ltcl.acquisition.radiometry import Response
from ltcl.acquisition.rig import Shots
from ltcl.errors import AcquisitionError, FileError
from ltcl.store import BlockStore

from ..scanning.helpers import corner

GRID = (8, 16)
LINE = Response(np.array([[-0.004 / 0.996, 1.0]]))


def shown(codes: np.ndarray, q: tuple[float, float]) -> np.ndarray:
    """Of a picture, with a part q of each pixel's light from its neighbours along y and x."""
    for axis, part in enumerate(q):
        kernel = np.array([part / 2, 1 - part, part / 2])
        codes = scipy.ndimage.convolve1d(codes, kernel, axis=axis, mode="nearest")
    return codes


@pytest.mark.parametrize("q", [(0.0, 0.0), (0.1, 0.3), (0.45, 0.02)])
@pytest.mark.parametrize("grid", [(8, 16), (32, 40)])
@pytest.mark.parametrize("narrow", [False, True])
def test_leaks_are_measured(q: tuple[float, float], grid: tuple[int, int], narrow: bool) -> None:
    """With noise and with light from elsewhere, which is even; of walls that are not."""
    rng = np.random.default_rng(3)
    albedo = rng.uniform(0.3, 0.9, grid)
    taken = [
        (codes, albedo * (shown(codes, q) + 0.2 * codes.mean()) + 0.003 * rng.normal(size=grid))
        for codes in GrayCode(grid, narrow).patterns()
    ]
    found = leak(Resampling.aligned(grid), [(a.astype(np.float32), b.astype(np.float32)) for a, b in taken])
    assert found is not None
    np.testing.assert_allclose(found, q, atol=0.02)


def test_too_few_patterns_tell_nothing() -> None:
    taken = [(codes, codes) for codes in GrayCode((8, 8)).patterns()]
    assert leak(Resampling.aligned((8, 8)), taken[:8]) is None
    assert leak(Resampling.aligned((8, 8)), ()) is None


@pytest.mark.parametrize("q", [(0.1, 0.1), (0.2, 0.3), (0.4, 0.0)])
def test_pictures_of_noise_are_off_by_that(q: tuple[float, float]) -> None:
    p = np.random.default_rng(0).random((200, 200))
    wrong = np.linalg.norm(shown(p, q) - p) / np.linalg.norm(p)
    assert Sharpness(q, 0.2).blur == pytest.approx(wrong, rel=0.15)


def view(size: float, blur: float = 0.0) -> tuple[scipy.sparse.csr_array, tuple[int, int]]:
    """A camera of `size` pixels to one of the projector's, slightly turned, and out of focus."""
    (h, w), (H, W) = GRID, (round(1.15 * size * n) for n in GRID)

    def place(u: Any, v: Any) -> tuple[Any, Any]:
        a, b = (u - W / 2) / size, (v - H / 2) / size
        return a + 0.06 * b + w / 2 - 0.4, b - 0.06 * a + h / 2 - 0.6

    C = camera_map(place, (H, W), GRID)
    if blur:
        one = C.toarray().reshape(H, W, -1)
        C = scipy.sparse.csr_array(scipy.ndimage.gaussian_filter(one, (blur, blur, 0)).reshape(H * W, -1))
    return C, (H, W)


def camera(size: float, blur: float = 0.0, T: Any = None, **options: Any) -> VirtualRig:
    C, grid = view(size, blur)
    told = {"bits": 12, "response": "linear", "ambient": 0.01, **options}
    return VirtualRig(corner() if T is None else T, GRID, camera_grid=grid, camera_map=C, **told)


def wrong(made: Calibration, C: Any) -> float:
    """How far pictures of noise are off on the projector's grid, after one scale."""
    R = made.resampling
    seen = R.seen.ravel()
    P = np.random.default_rng(7).random((GRID[0] * GRID[1], 6))
    ours, theirs = (R.weights @ (C @ (corner() @ P)))[seen], (corner() @ P)[seen]
    scale = np.vdot(ours, theirs) / np.vdot(ours, ours)
    return float(np.linalg.norm(scale * ours - theirs) / np.linalg.norm(theirs))


@pytest.mark.parametrize(("size", "blur"), [(3.5, 0.0), (1.4, 0.0), (3.5, 0.9), (2.5, 0.9)])
def test_what_is_told_is_how_far_pictures_are_off(size: float, blur: float, caplog: Any) -> None:
    """Sharp, coarse, out of focus; and there is a warning of each that is bad, none of the first.

    Uneven light passes for a q of up to 0.02, which blurs by 2 %.
    """
    with caplog.at_level(logging.WARNING):
        found = measuring.measure(Shots(camera(size, blur)), response=LINE)
    assert found.sharpness is not None
    truth = wrong(found, view(size, blur)[0])
    assert 0.6 * truth < found.sharpness.blur < 1.6 * truth + 0.02
    assert ("fine detail are off" in caplog.text) == (truth > 0.02)


def test_a_hopeless_camera_is_refused_before_the_scan() -> None:
    with pytest.raises(AcquisitionError, match=r"does not tell the projector's pixels apart: .* closer"):
        acquire(camera(0.95), strategy="pixel", response=LINE)


def test_a_map_that_was_given_tells_as_well() -> None:
    """Camera pixels half a pixel aside mix two of the projector's along each axis."""
    y, x = np.mgrid[: GRID[0], : GRID[1]] * 1.0
    half = Correspondence(x - 0.5, y - 0.5, np.ones(GRID), np.ones(GRID, bool), GRID)
    with pytest.raises(AcquisitionError, match="does not tell"):
        Sharpness.of(half, Resampling.of(half)).check()


def test_it_is_kept_told_and_forecast(tmp_path: Path) -> None:
    """Out of focus: the store has it, the report says it, and forecasts are as large as the error."""
    made, path = camera(3.0, 1.0), tmp_path / "T.zarr"
    T = acquire(made, strategy="hadamard", store=path, response=LINE)
    kept = Calibration.of(path).sharpness
    assert kept is not None
    told = Report.of(path)
    assert (told.sharpness, told.blur) == (kept.own, kept.blur)
    assert f"{kept.own:.0%} of a pixel is its own light" in str(told)
    assert Setup.of(path).calibration.resampling.doubtful is not None
    p = np.random.default_rng(2).random(GRID)
    seen, truth = np.asarray(T @ p).ravel()[~T.masked], (corner() @ p.ravel())[~T.masked]
    scale = (seen @ truth) / (seen @ seen)
    off = np.linalg.norm(scale * seen - truth) / np.linalg.norm(truth)
    forecast = forecast_picture(path, p, draws=4).ravel()[~T.masked]
    assert off > 0.05
    assert 0.5 * off < np.linalg.norm(forecast) / np.linalg.norm(seen) < 1.5 * off


def test_a_dark_patch_beside_bright_walls_is_masked_where_nothing_tells_it(tmp_path: Path) -> None:
    """Gray code does not decode in it: pixels at its rim were made of camera pixels of the bright walls."""
    albedo = np.random.default_rng(3).uniform(0.3, 0.9, GRID)
    albedo[2:6, 3:7] = 0.02
    rho = albedo.ravel()
    part = corner() / 0.6 - np.eye(len(rho))  # light between walls, of rows of albedo 0.6
    T = rho[:, None] * (np.eye(len(rho)) + part * rho)
    made, path = camera(3.7, T=T, response="srgb"), tmp_path / "T.zarr"
    found = acquire(made, strategy="hadamard", store=path)
    R, told = Calibration.of(path).resampling, Report.of(path)
    assert R.doubtful is not None
    patch = np.zeros(GRID, bool)
    patch[2:6, 3:7] = True
    assert R.doubtful.any()
    assert not R.doubtful[~patch].any()
    assert told.doubtful == R.doubtful.mean()
    assert f"{told.doubtful:.2%} too dark" in str(told)
    assert found.masked[R.doubtful.ravel()].all()
    seen = ~found.masked
    white = np.asarray(found @ np.ones(GRID), np.float64).ravel()[seen]
    wanted = T.sum(axis=1)[seen]
    scale = (white @ wanted) / (white @ white)
    assert (scale * white > 0.5 * wanted).all()
    rows = np.asarray(found @ np.eye(len(rho), dtype=np.float32).reshape(-1, *GRID)).reshape(len(rho), -1)
    assert scale * rows.min() > -0.005 * wanted.max()


def test_plain_walls_are_not_doubted() -> None:
    for size in (2.5, 3.7):
        found = measuring.measure(Shots(camera(size)), response=LINE).resampling
        assert found.doubtful is not None
        assert not found.doubtful.any()


def test_a_store_of_an_earlier_ltcl_is_named(tmp_path: Path) -> None:
    path = tmp_path / "T.zarr"
    acquire(VirtualRig(0.5 * np.eye(32), (4, 8), bits=12), geometry="aligned", strategy="pixel", store=path)
    assert Calibration.of(path).sharpness is None
    assert "sharpness not told" in str(Report.of(path))

    class Earlier(BlockStore):
        @property
        def extras(self) -> Any:
            return [name for name in super().extras if not name.endswith("doubtful")]

    with pytest.raises(FileError, match="earlier ltcl"):
        Calibration.of(Earlier.open(path))
