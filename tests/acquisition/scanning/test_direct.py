# SPDX-License-Identifier: BSD-3-Clause
"""Scans of direct light alone, by fine patterns."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import Report, VirtualRig, acquire, camera_map
from ltcl.acquisition.scanning import direct
from ltcl.acquisition.scanning.plan import plans
from ltcl.errors import MemoryLimitError, ScanRefused
from ltcl.transport.verdict import verdict

from ..stopping import LINEAR_RESPONSE, Unplugged
from .helpers import dense
from .test_sketch import dimmer

GRID = (16, 16)
# Light of a projector pixel on those around it, by a blurred edge.
BLUR = np.outer([0.1, 0.8, 0.1], [0.1, 0.8, 0.1])


def smooth_light(grid: tuple[int, int], share: float) -> np.ndarray:
    """T (N, N) of light that bounces: each row adds up to `share` inside, and is smooth."""
    row, column = np.indices(grid).reshape(2, -1) / max(grid)
    distance = np.hypot(row[:, None] - row, column[:, None] - column)
    light = 1.0 / (0.2 + distance**2)
    return share * light / light.sum(axis=1, keepdims=True)


def blurred(grid: tuple[int, int]) -> np.ndarray:
    """T (N, N) of direct light that reaches the eight pixels around its own."""
    row, column = np.indices(grid).reshape(2, -1)
    down = row[:, None] - row
    across = column[:, None] - column
    is_near = (abs(down) <= 1) & (abs(across) <= 1)
    return np.where(is_near, BLUR[np.clip(down, -1, 1) + 1, np.clip(across, -1, 1) + 1], 0.0)


@pytest.mark.parametrize("grid", [(8, 8), (48, 64), (1, 40)])
def test_every_pixel_is_lit_in_7_of_15_patterns_and_each_pair_near_by_in_3(grid: Any) -> None:
    shown = direct.patterns(grid)
    assert len(shown) == 15
    lit = np.stack(shown)
    np.testing.assert_array_equal(lit.sum(axis=0), 7.0)
    for down, across in ((0, 1), (1, 0), (1, 1), (0, 2), (2, 0), (2, 2), (3, 2)):
        if down < grid[0]:
            here = lit[:, : grid[0] - down, : grid[1] - across]
            there = lit[:, down:, across:]
            np.testing.assert_array_equal((here * there).sum(axis=0), 3.0)


@pytest.mark.parametrize("grid", [(16, 16), (48, 64), (256, 512)])
def test_judges_are_fine_and_no_patterns(grid: tuple[int, int]) -> None:
    shown = {pattern.tobytes() for pattern in direct.patterns(grid)}
    pictures = direct.judges(grid)
    assert len({picture.tobytes() for picture in pictures}) == len(pictures) == 4
    for picture in pictures:
        assert picture.tobytes() not in shown
        regions = picture.reshape(grid[0] // 8, 8, grid[1] // 8, 8).mean(axis=(1, 3))
        assert 0.2 < regions.min() <= regions.max() < 0.8


@pytest.fixture(scope="module")
def scanned(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Truth, direct and smooth, and a scan by a camera of 12 bits with a curve."""
    path = tmp_path_factory.mktemp("direct") / "T.zarr"
    near = 0.4 * blurred(GRID)
    rig = Unplugged(near + smooth_light(GRID, 0.2), GRID, response="film")
    T = acquire(rig, geometry="aligned", strategy="direct", store=path)
    return near, rig, T, Report.of(path), path


def unit(measured: np.ndarray, truth: np.ndarray) -> float:
    """The camera's unit of light, by the direct light of each pixel's own."""
    return float(np.trace(truth) / np.trace(measured))


def test_direct_light_is_found_within_its_deviations(scanned: Any) -> None:
    near, _, T, report, _ = scanned
    measured = dense(T)
    left = unit(measured, near) * measured - near
    error = np.linalg.norm(left) / np.linalg.norm(near)
    assert error < 0.05
    assert report.judged_error < report.judged_bound < 0.06
    is_stored = measured != 0.0
    z2 = left[is_stored] ** 2 / T.noise.variance(measured)[is_stored]
    assert 0.5 < np.sqrt(z2.mean()) < 2.0
    # Nothing of the light that bounces is left beyond the pixels near by.
    assert T.matrices[0].nnz <= np.count_nonzero(near)
    np.testing.assert_allclose(T.first_bounce, T.matrices[0].diagonal(), rtol=1e-6)


def test_what_is_left_out_is_told(scanned: Any) -> None:
    """A third of the light is indirect, by report, text and verdict."""
    near, _, T, report, _ = scanned
    truth = near + smooth_light(GRID, 0.2)
    indirect = np.median(1.0 - near.sum(axis=1) / truth.sum(axis=1))
    assert report.left_out == pytest.approx(indirect, abs=0.02)
    assert f"{report.left_out:.1%}" in str(report)
    assert math.isnan(report.sum_deviation)
    judged = verdict(T, left_out=report.left_out)
    assert judged.causes[0] == "left_out"
    assert judged.compensation is False


def test_photographs_are_few_and_as_planned(scanned: Any) -> None:
    _, rig, _, report, _ = scanned
    assert report.patterns == report.photographs == direct.count_patterns(GRID) == 19
    plan = plans(GRID, (0.5, 8.0), aligned=True)["direct"]
    assert plan.patterns == report.patterns
    assert plan.photographs == pytest.approx(rig.count, abs=3)
    assert plans((64, 64), (0.5, 8.0), aligned=True)["direct"].photographs < 60


@pytest.mark.parametrize(("share", "level"), [(0.0, "INFO"), (0.1, "WARNING")])
def test_the_log_tells_what_is_left_out(
    share: float, level: str, caplog: pytest.LogCaptureFixture
) -> None:
    """A plane wall has no indirect light, of which nobody has to be warned; in memory."""
    caplog.set_level("INFO")
    grid = (8, 8)
    truth = 0.5 * np.eye(64) + smooth_light(grid, share)
    T = acquire(Unplugged(truth, grid), geometry="aligned", strategy="direct")
    [record] = [record for record in caplog.records if "left out" in record.getMessage()]
    assert record.levelname == level
    measured = T.matrices[0].toarray()
    off_diagonal = measured - np.diag(np.diagonal(measured))
    assert np.abs(off_diagonal).sum() < 0.02 * np.trace(measured)


def test_colours_are_mixed_as_in_other_scans() -> None:
    grid = (8, 8)
    mixing = np.array([[0.9, 0.1, 0.0], [0.05, 0.9, 0.05], [0.0, 0.1, 0.9]])
    matrices = [albedo * np.eye(64) + smooth_light(grid, 0.1) for albedo in (0.6, 0.5, 0.4)]
    truth = ltcl.Transport(matrices, grid, mixing=mixing)
    rig = VirtualRig(truth, grid, bits=12, ambient=0.01)
    T = acquire(rig, geometry="aligned", strategy="direct")
    assert T.mixing is not None
    shares = mixing / np.diagonal(mixing)[:, None]
    np.testing.assert_allclose(T.mixing, shares, atol=0.02)
    picture = np.random.default_rng(2).random((*grid, 3))
    direct_light = picture @ mixing.T * (0.6, 0.5, 0.4)
    measured = T @ picture
    # Each channel has its own unit of light.
    scale = (measured * direct_light).sum(axis=(0, 1)) / (measured**2).sum(axis=(0, 1))
    error = np.linalg.norm(scale * measured - direct_light) / np.linalg.norm(direct_light)
    assert error < 0.03


def test_a_camera_of_its_own_pixels(tmp_path: Path) -> None:
    """A person with an oblique camera of three pixels to a side, whose geometry Gray code shows."""
    view = camera_map(lambda u, v: (u / 3, v / 3), (24, 48), (8, 16))
    near = np.diag(0.6 * np.linspace(0.5, 1.0, 128))
    truth = near + smooth_light((8, 16), 0.1)
    rig = Unplugged(truth, (8, 16), camera_grid=(24, 48), camera_map=view)
    rig.keeps_photographs = True
    T = acquire(rig, strategy="direct", store=tmp_path / "T.zarr")
    assert rig.count <= 62
    plan = plans((8, 16), (0.5, 8.0), by_hand=True)["direct"]
    assert plan.photographs == pytest.approx(rig.count, abs=3)
    albedo = np.diagonal(near)
    sums = np.asarray(T.matrices[0].tocsr().sum(axis=1)).ravel()
    scale = (sums @ albedo) / (sums @ sums)
    assert np.linalg.norm(scale * sums - albedo) < 0.03 * np.linalg.norm(albedo)


@pytest.mark.parametrize("grid", [(1, 7), (2, 2), (5, 3)])
def test_small_grids(grid: tuple[int, int]) -> None:
    pixels = math.prod(grid)
    rig = Unplugged(0.5 * np.eye(pixels), grid, response="linear")
    T = acquire(rig, geometry="aligned", strategy="direct", response=LINEAR_RESPONSE)
    assert not T.masked.any()
    np.testing.assert_allclose(T.first_bounce, np.median(T.first_bounce), rtol=0.1)


def test_a_picture_that_all_others_contradict_is_refused(scanned: Any, tmp_path: Path) -> None:
    near, clean, *_ = scanned
    # In the first batch of two.
    wrong = clean.count - 12
    rig = Unplugged(near + smooth_light(GRID, 0.2), GRID)
    rig.fault = lambda codes, image: dimmer(image) if rig.count == wrong else image
    with pytest.raises(ScanRefused, match="contradicts"):
        acquire(rig, geometry="aligned", strategy="direct", store=tmp_path / "T.zarr")


def test_what_memory_does_not_hold_is_refused_before_the_first_photograph() -> None:
    rig = Unplugged(np.eye(4), (2, 2), left=0)
    rig.projector_grid = (1 << 15, 1 << 15)
    with pytest.raises(MemoryLimitError, match="32768 x 32768 pixels"):
        acquire(rig, strategy="direct", geometry="aligned")
