# SPDX-License-Identifier: BSD-3-Clause
"""A corner that Mitsuba renders, from a camera half a wall beside the projector: acquired, then compensated.

Walls of unlike albedo. The acquired T is compared with pictures of the same scene that nothing scanned,
rendered from the projector's own place, where camera and projector pixels are the same: walls are diffuse,
and so are as bright from there. Pixels with all neighbours well seen count; at the outline of the walls a
projector pixel is partly dark.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import scipy.ndimage

import ltcl
from _coefficients import relative
from ltcl.acquisition import Calibration, MitsubaRig, Report, acquire
from ltcl.device import Device

ALBEDO = [(0.8, 0.8, 0.8), (0.4, 0.4, 0.4)]
SIZE, BASELINE, FINE = 3.5, 0.5, 512  # camera pixels to one of the projector's; of walls; paths of the truth


@dataclass(frozen=True)
class Loop:
    """Errors of T p over held patterns, and pictures of the camera (H, W), linear, 1 is the brightest."""

    errors: np.ndarray
    photographs: int
    decibels: tuple[float, float]
    before: np.ndarray
    after: np.ndarray
    desired: np.ndarray
    pattern: np.ndarray


def loop(n: int, samples: int, patterns: np.ndarray, device: Device) -> Loop:
    """Acquire a corner of 3 n / 4 x n pixels, and compensate a picture on it."""
    grid = patterns.shape[1:]
    camera = (round(SIZE * grid[0]), round(SIZE * n))
    common: dict[str, Any] = {"channels": 1, "albedo": ALBEDO}
    place = {"camera_grid": camera, "baseline": BASELINE}
    rig = MitsubaRig("dihedral", grid, samples=samples, bits=12, **place, **common)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "T.zarr"
        T = acquire(rig, strategy="pixel", store=path, device=device)
        found = Calibration.of(path)
        linear = {"projector_response": "linear", "sensitivity": rig.describe()["sensitivity"]}
        truth = MitsubaRig("dihedral", grid, samples=FINE, seed=9, **linear, **common)
        inner = scipy.ndimage.binary_erosion(found.resampling.coverage > 0.8, np.ones((3, 3)))
        unit = _unit(T, truth, inner)
        errors = [relative(unit * np.asarray(T @ p)[inner], truth.radiance(p)[inner]) for p in patterns]
        photographs = Report.of(path).photographs
        return Loop(np.array(errors), photographs, *_compensated(T, rig, found, truth, inner))


def _unit(T: ltcl.Transport, truth: MitsubaRig, inner: np.ndarray) -> float:
    white = np.ones(T.grid, np.float32)
    ours, theirs = np.asarray(T @ white, np.float64)[inner], truth.radiance(white)[inner]
    return float(ours @ theirs / (ours @ ours))


def _compensated(
    T: ltcl.Transport, rig: MitsubaRig, found: Calibration, truth: MitsubaRig, inner: np.ndarray
) -> tuple[tuple[float, float], np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Peak signal over noise before and after, and the pictures."""
    h, w = T.grid
    y, x = np.mgrid[:h, :w] / w
    desired = 0.55 + 0.45 * np.sin(19 * np.hypot(x - 0.5, y - 0.37))
    white = np.asarray(T @ np.ones(T.grid, np.float32), np.float64)
    level = 0.7 * np.quantile(white[inner], 0.05)
    pattern = ltcl.compensate(T, (level * desired).astype(np.float32), rtol=1e-3).pattern
    pattern = np.clip(np.asarray(pattern, np.float64), 0.0, 1.0)
    plain = desired * level / np.median(white[inner])
    shown = [truth.radiance(p) for p in (plain, pattern)]
    views = [rig.radiance(found.projector.codes(p)) for p in (plain, pattern)]
    top = max(float(np.quantile(view, 0.995)) for view in views)
    before, after = (view / top for view in views)
    decibels = (_decibels(shown[0], desired, inner), _decibels(shown[1], desired, inner))
    return decibels, before, after, desired, pattern


def _decibels(shown: np.ndarray, desired: np.ndarray, where: np.ndarray) -> float:
    """Peak signal over noise at the best scale."""
    a, b = shown[where], desired[where]
    return float(10 * np.log10(b.max() ** 2 / np.mean((a * (a @ b) / (a @ a) - b) ** 2)))
