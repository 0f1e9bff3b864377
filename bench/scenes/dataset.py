# SPDX-License-Identifier: BSD-3-Clause
"""The files of a scene: two measurements of T by bounces, and photographs of other patterns.

Photographs are of patterns that T never saw. README.md describes the format. A traced scene comes
from Mitsuba; a simulated one, for machines without LLVM, from ltcl's form factors: T_k = A^k F,
each measurement with noise of its own.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ltcl import scenes
from scenes import tracing

NAMES = ("corner", "coloured", "blocks", "glossy", "closed")
SIMULATED = {
    "corner": lambda n: scenes.dihedral(n, albedo=0.7),
    "coloured": lambda n: scenes.trihedral(n, albedo=tracing.TRACED["coloured"].albedo),
}
PATTERNS = ("white", "smooth", "landscape", "text", "checkerboard", "stripes", "pixel", "pixel 2")
# Brightest light of a pattern, so that a method's noise does not leave the projector's range there.
PATTERN_MAX = 0.8
# Pixels along a side, paths a camera pixel of the first T, and samples of a photograph.
SIZE = 64
PATHS = 2560
SAMPLES = 10_000
# Paths of the second measurement, which judges, over paths of the first.
SECOND_PATH_RATIO = 4
# Bounces of the files, direct light included; T has all.
FILE_BOUNCES = 4
# Relative noise of simulated entries.
SIMULATED_NOISE = 1e-3


def patterns(grid: tuple[int, int], channels: int) -> np.ndarray:
    """The light of `PATTERNS`, (K, h, w), in colour (K, h, w, 3).

    Each channel is shifted by a third of w.
    """
    h, w = grid
    y, x = np.indices(grid)
    lights = [
        np.ones(grid),
        0.5 + 0.4 * np.sin(7 * x / w + 4 * y / h),
        photograph_pattern(grid),
        text_pattern(grid),
        (x * 8 // w + y * 8 // h) % 2,
        x % 2,
        (y == h // 4) & (x == w // 4),
        (y == h // 2) & (x == w // 2 + 1),
    ]
    values = (PATTERN_MAX * np.stack(lights)).astype(np.float32)
    if channels == 1:
        return values
    shifted = [np.roll(values, channel * w // 3, axis=-1) for channel in range(3)]
    return np.stack(shifted, axis=-1)


def photograph_pattern(grid: tuple[int, int]) -> np.ndarray:
    """A landscape, (h, w) in [0, 1]."""
    h, w = grid
    picture = scenes.landscape(480, 480).mean(axis=2)
    return cv2.resize(picture, (w, h), interpolation=cv2.INTER_AREA)


def text_pattern(grid: tuple[int, int]) -> np.ndarray:
    """Lines of text, (h, w) in [0, 1]."""
    page = np.zeros(grid, np.uint8)
    for baseline in range(10, grid[0] + 8, 11):
        text = "light bounces"[baseline % 5 :]
        cv2.putText(page, text, (1, baseline), cv2.FONT_HERSHEY_PLAIN, 0.7, (255,))
    return page / 255


def relight(T: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Pictures of patterns p, (K, h, w[, 3]), by T, ([3,] N, N), or by its diagonal."""
    pixels = p.shape[1] * p.shape[2]
    # (channels, K, N)
    light = np.moveaxis(p.reshape(len(p), pixels, -1), -1, 0)
    channels = len(light)
    if T.size == channels * pixels:
        lit = light * T.reshape(channels, 1, pixels)
    else:
        lit = light @ T.reshape(channels, pixels, pixels).swapaxes(1, 2)
    return np.moveaxis(lit, 0, -1).reshape(p.shape)


@dataclass(frozen=True)
class Scene:
    """The files of one scene."""

    folder: Path

    @property
    def facts(self) -> dict[str, Any]:
        """Origin of the scene, and the settings it was made with."""
        return json.loads((self.folder / "scene.json").read_text(encoding="utf-8"))

    @cached_property
    def photographs(self) -> dict[str, np.ndarray]:
        """`names`, `patterns` and `photographs`."""
        with np.load(self.folder / "photographs.npz", allow_pickle=False) as file:
            return dict(file)

    @cached_property
    def second(self) -> np.ndarray:
        """T of the second measurement."""
        with np.load(self.folder / "second.npz", allow_pickle=False) as file:
            return file["T"]

    @cached_property
    def truth(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounces 0 to 3 of the photographs by the second measurement, and their variance.

        The first measurement has SECOND_PATH_RATIO times the variance of the second, so that their
        difference has 1 + SECOND_PATH_RATIO times it.
        """
        p = self.photographs["patterns"]
        true = self.bounces("second", p).astype(np.float64)
        difference = self.bounces("first", p) - true
        return true, difference**2 / (1 + SECOND_PATH_RATIO)

    def bounces(self, measurement: str, p: np.ndarray) -> np.ndarray:
        """Bounces 0 to 3 of the light of patterns p, (K, 4, h, w) or (K, 4, h, w, 3), as traced."""
        with np.load(self.folder / f"{measurement}_bounces.npz", allow_pickle=False) as file:
            pictures = [relight(file[f"bounce_{k}"], p) for k in range(FILE_BOUNCES)]
        return np.stack(pictures, axis=1)


def find_scenes(data: Path) -> dict[str, Scene]:
    """The scenes in a folder by their names."""
    scenes_by_name = {}
    for name in NAMES:
        folder = data / name
        if (folder / "scene.json").exists():
            scenes_by_name[name] = Scene(folder)
    return scenes_by_name


def trace(
    folder: Path, name: str, size: int = SIZE, paths: int = PATHS, samples: int = SAMPLES
) -> None:
    """Make a scene of `tracing.TRACED`, with Mitsuba, size x size pixels."""
    start = time.process_time()
    grid = (size, size)
    traced = tracing.TRACED[name]
    p = patterns(grid, traced.channels)
    second_paths = SECOND_PATH_RATIO * paths
    _write_measurement(folder, "first", grid, tracing.trace(name, grid, paths, 1))
    _write_measurement(folder, "second", grid, tracing.trace(name, grid, second_paths, 2))
    _write_photographs(folder, p, tracing.photographs(name, p, samples, 3))
    facts = {
        "about": traced.about,
        "origin": f"Mitsuba {tracing.version()}",
        "paths": [paths, second_paths],
        "samples": samples,
        "seeds": [1, 2, 3],
    }
    _write_facts(folder, p, facts, start)


def simulate(folder: Path, name: str, size: int = 6) -> None:
    """Make a scene of `SIMULATED`, with walls of size x size pixels."""
    start = time.process_time()
    scene = SIMULATED[name](size)
    p = patterns(scene.grid, scene.channels)
    exact = exact_bounces(scene)
    for seed, measurement in enumerate(("first", "second"), 1):
        random = np.random.default_rng(seed)
        noise = SIMULATED_NOISE / seed * random.standard_normal(exact.shape)
        # Paths that end at once have no noise.
        noise[0] = 0.0
        noisy = exact * (1.0 + noise)
        _write_measurement(folder, measurement, scene.grid, noisy.astype(np.float32))
    _write_photographs(folder, p, relight(exact.sum(axis=0), p))
    facts = {
        "about": scene.name,
        "origin": "form factors of ltcl",
        "noise": [SIMULATED_NOISE, SIMULATED_NOISE / 2],
    }
    _write_facts(folder, p, facts, start)


def exact_bounces(scene: scenes.Scene) -> np.ndarray:
    """T by bounces 0 to 3 and all further ones, (5, N, N), in colour (5, 3, N, N)."""
    A = scene.albedo[:, :, None] * scene.form_factors
    bounces = [np.eye(A.shape[-1]) * scene.albedo[:, None]]
    for _ in range(FILE_BOUNCES - 1):
        bounces.append(A @ bounces[-1])
    further = np.stack(scene.matrices()) - np.sum(bounces, axis=0)
    exact = np.stack([*bounces, further])
    return exact[:, 0] if scene.channels == 1 else exact


def _write_measurement(
    folder: Path, measurement: str, grid: tuple[int, int], bounces: np.ndarray
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / f"{measurement}.npz", T=bounces.sum(axis=0), grid=grid)
    direct = np.diagonal(bounces[0], axis1=-2, axis2=-1)
    others = {f"bounce_{k}": bounces[k] for k in range(1, FILE_BOUNCES)}
    np.savez_compressed(folder / f"{measurement}_bounces.npz", bounce_0=direct, **others)


def _write_photographs(folder: Path, p: np.ndarray, photographs: np.ndarray) -> None:
    pictures = photographs.astype(np.float32)
    np.savez(folder / "photographs.npz", names=PATTERNS, patterns=p, photographs=pictures)


def _write_facts(folder: Path, p: np.ndarray, facts: dict[str, Any], start: float) -> None:
    """Write the facts last, so that a folder with them is whole."""
    facts = facts | {
        "grid": p.shape[1:3],
        "channels": 1 if p.ndim == 3 else 3,
        "CPU seconds": time.process_time() - start,
    }
    (folder / "scene.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
