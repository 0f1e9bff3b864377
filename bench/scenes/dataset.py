# SPDX-License-Identifier: BSD-3-Clause
"""The files of a scene: two measurements of T by bounces, and photographs of patterns that T never saw.

README.md tells the format. A traced scene comes of Mitsuba; a simulated one, for machines without
LLVM, of ltcl's form factors: T_k = A^k F, each measurement with noise of its own.
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
SIZE, PATHS, SAMPLES = (
    64,
    2560,
    10_000,
)  # pixels; paths a camera pixel of the first T, of a photograph
_BETTER = 4  # times the paths: the second measurement, which judges
_NOISE = 1e-3  # of what is simulated


def patterns(grid: tuple[int, int], channels: int) -> np.ndarray:
    """Those of `PATTERNS`, (K, h, w), in colour (K, h, w, 3) with each channel shifted by a third of w.

    The brightest light is 0.8, so that a method's noise does not leave the projector's range there.
    """
    (h, w), (y, x) = grid, np.indices(grid)
    page = np.zeros(grid, np.uint8)
    for line in range(10, h + 8, 11):
        cv2.putText(
            page, "light bounces"[line % 5 :], (1, line), cv2.FONT_HERSHEY_PLAIN, 0.7, (255,)
        )
    pixels = [
        (y == row) & (x == column) for row, column in ((h // 4, w // 4), (h // 2, w // 2 + 1))
    ]
    smooth = 0.5 + 0.4 * np.sin(7 * x / w + 4 * y / h)
    photograph = cv2.resize(
        scenes.landscape(480, 480).mean(axis=2), (w, h), interpolation=cv2.INTER_AREA
    )
    boards = (x * 8 // w + y * 8 // h) % 2, x % 2
    values = np.stack([np.ones(grid), smooth, photograph, page / 255, *boards, *pixels])
    values = (0.8 * values).astype(np.float32)
    if channels == 1:
        return values
    return np.stack([np.roll(values, c * w // 3, axis=-1) for c in range(3)], axis=-1)


def relight(T: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Pictures of patterns p, (K, h, w) or (K, h, w, 3), by T, (N, N) or (3, N, N), or by its diagonal."""
    columns = np.moveaxis(p.reshape(len(p), p.shape[1] * p.shape[2], -1), -1, 0)  # (channels, K, N)
    if T.size == columns[:, 0].size:
        lit = columns * T.reshape(len(columns), 1, -1)
    else:
        lit = columns @ T.reshape(len(columns), *T.shape[-2:]).swapaxes(1, 2)
    return np.moveaxis(lit, 0, -1).reshape(p.shape)


@dataclass(frozen=True)
class Scene:
    """The files of one scene."""

    folder: Path

    @property
    def facts(self) -> dict[str, Any]:
        """How it was made."""
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
        """Bounces 0 to 3 of the photographs by the second measurement, and their variance where it is."""
        p = self.photographs["patterns"]
        true = self.bounces("second", p).astype(np.float64)
        return true, (self.bounces("first", p) - true) ** 2 / (1 + _BETTER)

    def bounces(self, measurement: str, p: np.ndarray) -> np.ndarray:
        """Bounces 0 to 3 of the light of patterns p, (K, 4, h, w) or (K, 4, h, w, 3), as traced."""
        with np.load(self.folder / f"{measurement}_bounces.npz", allow_pickle=False) as file:
            return np.stack([relight(file[f"bounce_{k}"], p) for k in range(4)], axis=1)


def found(data: Path) -> dict[str, Scene]:
    """The scenes in a folder by their names."""
    return {name: Scene(data / name) for name in NAMES if (data / name / "scene.json").exists()}


def trace(
    folder: Path, name: str, size: int = SIZE, paths: int = PATHS, samples: int = SAMPLES
) -> None:
    """A scene of `tracing.TRACED`, with Mitsuba, size x size pixels."""
    start, grid, traced = time.process_time(), (size, size), tracing.TRACED[name]
    p = patterns(grid, traced.channels)
    facts: dict[str, Any] = {"about": traced.about, "origin": f"Mitsuba {tracing.version()}"}
    facts |= {"paths": [paths, _BETTER * paths], "samples": samples, "seeds": [1, 2, 3]}
    for measurement, count, seed in zip(("first", "second"), facts["paths"], (1, 2), strict=True):
        _write(folder, measurement, grid, tracing.trace(name, grid, count, seed))
    _conclude(folder, p, tracing.photographs(name, p, samples, 3), facts, start)


def simulate(folder: Path, name: str, size: int = 6) -> None:
    """A scene of `SIMULATED`, of walls of size x size pixels."""
    start, scene = time.process_time(), SIMULATED[name](size)
    p, n = patterns(scene.grid, scene.channels), scene.albedo.shape[1]
    A, bounces = scene.albedo[:, :, None] * scene.form_factors, [np.eye(n) * scene.albedo[:, None]]
    for _ in range(3):
        bounces.append(A @ bounces[-1])
    exact = np.stack([*bounces, np.stack(scene.matrices()) - np.sum(bounces, axis=0)])
    exact = exact.reshape(5, *A.shape[scene.channels == 1 :])
    for seed, measurement in enumerate(("first", "second"), 1):
        noise = _NOISE / seed * np.random.default_rng(seed).standard_normal(exact.shape)
        noise[0] = 0.0  # paths that end at once have none
        _write(folder, measurement, scene.grid, (exact * (1.0 + noise)).astype(np.float32))
    facts = {"about": scene.name, "origin": "form factors of ltcl", "noise": [_NOISE, _NOISE / 2]}
    _conclude(folder, p, relight(exact.sum(axis=0), p), facts, start)


def _write(folder: Path, measurement: str, grid: tuple[int, int], bounces: np.ndarray) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    np.savez(folder / f"{measurement}.npz", T=bounces.sum(axis=0), grid=grid)
    direct = np.diagonal(bounces[0], axis1=-2, axis2=-1)
    others = {f"bounce_{k}": bounces[k] for k in (1, 2, 3)}
    np.savez_compressed(folder / f"{measurement}_bounces.npz", bounce_0=direct, **others)


def _conclude(
    folder: Path, p: np.ndarray, photographs: np.ndarray, facts: dict[str, Any], start: float
) -> None:
    """Photographs and facts; these come last, so that a folder with them is whole."""
    pictures = {"patterns": p, "photographs": photographs.astype(np.float32)}
    np.savez(folder / "photographs.npz", names=PATTERNS, **pictures)
    facts |= {"grid": p.shape[1:3], "channels": 1 if p.ndim == 3 else 3}
    facts["CPU seconds"] = time.process_time() - start
    (folder / "scene.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
