# SPDX-License-Identifier: BSD-3-Clause
"""What a report says of a scan, against what was put before the camera: every figure of it."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl import diagnostics
from ltcl.acquisition import Calibration, Correspondence, Report, VirtualRig, acquire
from ltcl.acquisition.radiometry import Response
from ltcl.acquisition.scanning.cells import Cells
from ltcl.store import BlockStore

from .helpers import corner, dense, rig

GRID = (4, 8)
LINE = Response(np.array([[-0.004 / 0.996, 1.0]]))
STRATEGIES = ("pixel", "hadamard", "adaptive")


def scanned(path: Path, T: Any, strategy: str, **options: Any) -> Report:
    """The report of a linear camera of 12 bits."""
    told = {k: options.pop(k) for k in ("sigmas", "threshold", "exposures") if k in options}
    made = VirtualRig(T, GRID, **{"bits": 12, "response": "linear", "ambient": 0.01, **options})
    acquire(made, geometry="aligned", strategy=strategy, store=path, response=LINE, **told)
    return Report.of(path)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_noise_is_that_of_many_scans(tmp_path: Path, strategy: str) -> None:
    """Medians of the spread of first bounces and row sums over scans, relative to their mean."""
    stacks, told, line = [], [], Response(np.array([[-0.02 / 0.98, 1.0]]))
    noisy: dict[str, Any] = {"read": 0.003, "gain": 2000.0, "black": 0.02, "response": "linear"}
    given: dict[str, Any] = {"strategy": strategy, "response": line, "sigmas": 0.0, "threshold": 1e-6}
    for seed in range(12):
        path = tmp_path / f"{seed}.zarr"
        stacks.append(dense(acquire(rig(4, seed=seed, **noisy), geometry="aligned", store=path, **given)))
        told.append(Report.of(path))
    stack = np.array(stacks)
    both = {"noise_direct": stack.diagonal(axis1=1, axis2=2), "noise_sum": stack.sum(axis=2)}
    for name, values in both.items():
        spread = float(np.median(values.std(axis=0, ddof=1) / values.mean(axis=0)))
        said = float(np.median([getattr(one, name) for one in told]))
        # Entries go together, of which a report knows but the sum of variances: it may say more, not less.
        assert 0.75 * spread < said < (1.5 if name == "noise_direct" else 2.5) * spread, name


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_a_reciprocal_scene_has_a_defect_that_noise_explains(tmp_path: Path, strategy: str) -> None:
    """As that of the true transport with noise of the same size; and less with less noise."""
    all_of_it: dict[str, Any] = {"sigmas": 0.0, "threshold": 1e-5}
    loud, calm = (
        scanned(tmp_path / f"{gain}.zarr", corner(4), strategy, gain=gain, read=read, **all_of_it)
        for gain, read in ((300.0, 0.004), (3e6, 1e-5))
    )
    assert calm.defect < 0.05 < 2 * loud.defect
    assert calm.defect < 0.5 * loud.defect
    if strategy == "adaptive":
        return
    store = BlockStore.open(tmp_path / "300.0.zarr")
    V = np.concatenate([_variance(store.block(0, b, "rows")) for b in range(store.layout.blocks())])
    rng = np.random.default_rng(0)
    drawn = [corner(4) + np.sqrt(V) * rng.normal(size=V.shape) for _ in range(10)]
    expected = np.median([diagnostics.reciprocity_defect(T, np.diag(T)) for T in drawn])
    assert 0.5 * expected < loud.defect < 1.5 * expected


def _variance(block: Any) -> np.ndarray:
    parts = (block.variance, block.matrix.indices, block.matrix.indptr)
    return scipy.sparse.csr_array(parts, shape=block.matrix.shape).toarray()


@cache
def one_way() -> np.ndarray:
    """A corner in which, of every two pixels, one gets nine times as much from the other as it gives."""
    tilt = np.triu(np.sign(np.random.default_rng(1).normal(size=(32, 32))), 1)
    return corner(4) * (1.0 + 0.8 * (tilt - tilt.T))


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_light_that_goes_one_way_is_seen_in_the_defect(tmp_path: Path, strategy: str) -> None:
    T = one_way()
    told = scanned(tmp_path / "T.zarr", T, strategy, gain=3e6, read=1e-5, sigmas=0.0, threshold=1e-5)
    truth = diagnostics.reciprocity_defect(T, np.diag(T))
    assert truth > 0.5
    assert told.defect == pytest.approx(truth, rel=0.1)


def test_saturated_pixels_are_counted(tmp_path: Path) -> None:
    """Three pixels too bright for every exposure: of the camera's pixels under white, and no others."""
    T = 0.02 * np.eye(32)
    T[[5, 17, 30], [5, 17, 30]] = 5.0
    rig = VirtualRig(T, GRID, bits=12, response="linear", exposures=[4.0, 8.0])
    acquire(rig, geometry="aligned", strategy="pixel", store=tmp_path / "T.zarr", response=LINE, sigmas=0.0)
    report = Report.of(tmp_path / "T.zarr")
    assert report.saturated == report.masked == 3 / 32
    assert report.coverage == 1.0
    assert 3 / 32**2 <= report.unknown < 0.2  # their own entries, and those of the sums of their batches


def test_coverage_is_what_the_camera_sees(tmp_path: Path) -> None:
    """A camera whose pixels see the left five columns of eight, and reach a little further."""
    five = scipy.sparse.csr_array(scipy.sparse.eye_array(8))[:5]
    C = scipy.sparse.csr_array(scipy.sparse.kron(scipy.sparse.eye_array(4), five))
    made = VirtualRig(0.5 * np.eye(32), GRID, camera_grid=(4, 5), camera_map=C, bits=12)
    y, x = np.mgrid[:4, :5]
    seen = Correspondence(x, y, np.ones((4, 5)), np.ones((4, 5), bool), GRID)
    acquire(made, geometry=seen, strategy="pixel", store=tmp_path / "T.zarr")
    told = Report.of(tmp_path / "T.zarr")
    reach = Calibration.of(tmp_path / "T.zarr").resampling.coverage
    assert (reach[:, :5] > 0.5).all()
    assert (reach[:, 5] < 0.5).all()
    assert (reach[:, 6:] == 0.0).all()
    assert told.coverage == np.mean(reach > 0.0)
    assert told.masked >= 2 / 8


def test_conflicts_of_each_level_are_those_of_the_pixels_that_ask(tmp_path: Path) -> None:
    """Cells of one colour are active at no camera pixel twice; no fewer colours than a pixel has cells.

    Every pixel sees itself, and the last column sees everything: it is active in all cells, and needs each of
    them in a colour of its own.
    """
    T = 0.5 * np.eye(64)
    T[7::8] = 0.2
    made, path = VirtualRig(T, (8, 8), bits=12, response="linear"), tmp_path / "T.zarr"
    acquire(made, geometry="aligned", strategy="adaptive", store=path, response=LINE)
    told, cells = Report.of(path), Cells((8, 8))
    for one in told.levels:
        rows, columns = cells.sizes[one["level"]]
        assert one["cells"] == one["colours"] == rows * columns
        assert one["patterns"] == 4 * one["colours"]
        # 8 pixels see all cells; the 56 others the one that they are in.
        assert one["entries"] == 8 * rows * columns + 56
    assert told.patterns == sum(one["patterns"] for one in told.levels)
    assert "in 16 group(s) without conflict" in str(told)


def test_entries_are_those_of_the_store(tmp_path: Path) -> None:
    path = tmp_path / "T.zarr"
    T = acquire(rig(4), geometry="aligned", strategy="pixel", store=path)
    told = Report.of(path)
    assert told.entries == ltcl.load(path).matrices[0].nnz == np.count_nonzero(dense(T))
    assert told.photographs == told.patterns * len(Calibration.of(path).exposures)
