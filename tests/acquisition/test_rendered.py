# SPDX-License-Identifier: BSD-3-Clause
"""A corner that Mitsuba renders, from a camera beside the projector: photographs in, compensation out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.ndimage

import ltcl
from ltcl.acquisition import Calibration, MitsubaRig, Report, acquire, mitsuba_scene

from .scanning.helpers import held

pytest.importorskip("mitsuba", reason='mitsuba is not installed: pip install "ltcl[rig]"')

GRID, CAMERA = (9, 12), (32, 42)
COMMON: dict[str, Any] = {"channels": 1, "variant": "scalar_rgb"}


def test_a_rendered_corner_is_acquired_and_compensated(tmp_path: Path) -> None:
    """T p against renders from the projector's own place: diffuse walls are as bright from there."""
    walls = [(0.8, 0.8, 0.8), (0.4, 0.4, 0.4)]
    scene = mitsuba_scene("dihedral", GRID, walls, camera_grid=CAMERA, baseline=0.5)
    rig = MitsubaRig(scene, GRID, samples=24, bits=12, **COMMON)
    T = acquire(rig, strategy="pixel", store=tmp_path / "T.zarr")
    linear = {"projector_response": "linear", "sensitivity": rig.describe()["sensitivity"]}
    truth = MitsubaRig(mitsuba_scene("dihedral", GRID, walls), GRID, samples=512, seed=9, **linear, **COMMON)
    told = Calibration.of(tmp_path / "T.zarr").resampling
    assert Report.of(tmp_path / "T.zarr").coverage == told.seen.mean()
    white = np.asarray(T @ np.ones(GRID, np.float32), np.float64)
    dark = truth.radiance(np.ones(GRID)) < 1e-6  # above and below the edge, which is further away
    assert dark.any()
    assert told.coverage[dark].max() < 0.25, told.coverage[dark]
    # At the outline of the walls a projector pixel is partly dark: those with all neighbours in view count.
    inner = np.asarray(scipy.ndimage.binary_erosion(told.coverage > 0.8, np.ones((3, 3))), bool)
    assert inner.sum() > 30
    lit = truth.radiance(np.ones(GRID))[inner]
    unit = (white[inner] @ lit) / (white[inner] @ white[inner])
    for p in held(GRID).T.reshape(-1, *GRID):
        wanted = truth.radiance(p)[inner]
        assert np.linalg.norm(unit * np.asarray(T @ p)[inner] - wanted) < 0.05 * np.linalg.norm(wanted)

    y, x = np.mgrid[: GRID[0], : GRID[1]] / 12
    desired = 0.7 + 0.3 * np.sin(8 * x + 5 * y)
    level = 0.6 * np.quantile(white[inner], 0.05)
    pattern = ltcl.compensate(T, (level * desired).astype(np.float32), rtol=1e-3).pattern
    decibels = []
    for sent in (0.3 * desired, np.clip(np.asarray(pattern, np.float64), 0, 1)):
        shown, wanted = truth.radiance(sent)[inner], desired[inner]
        off = shown * (shown @ wanted) / (shown @ shown) - wanted
        decibels.append(10 * np.log10(wanted.max() ** 2 / np.mean(off**2)))
    assert decibels[1] > max(26, decibels[0] + 10), decibels
