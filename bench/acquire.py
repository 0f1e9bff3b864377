# SPDX-License-Identifier: BSD-3-Clause
"""A transport measured from photographs alone, beside the true one: how far off, and what it costs.

A corner of 64 x 64 projector pixels, each wall 64 x 32, of which the exact transport is known. A virtual
camera photographs it: a response that nothing tells the software, a black offset of 0.4 %, ambient light,
photon and read noise, 8 or 12 bits. Then the measured T is used, and compared in the camera's own unit of
light (its last code; nothing else fixes it): T p for patterns that no scan has seen, and a picture that T
compensates. The adaptive scan has to need a fifth of the photographs of one pixel at a time at most. A plot
shows photographs against the number of pixels.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

import _figures as figures
import ltcl
from _figures import Claim
from _harness import options
from ltcl.acquisition import Report, VirtualRig, acquire
from ltcl.acquisition.scanning import plans
from ltcl.device import Device

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ALBEDO = 0.6
CAMERAS = {"srgb, 8 bits": ("srgb", 8), "film, 12 bits": ("film", 12)}
STRATEGIES = ("adaptive", "hadamard", "pixel")


@dataclass(frozen=True)
class Found:
    """One acquisition."""

    camera: str
    strategy: str
    photographs: int
    held: float
    sums: float
    decibels: float
    seconds: float


def corner(n: int) -> np.ndarray:
    """T of two walls of n x n / 2 pixels, from exact form factors of squares put together in pairs."""
    G = np.asarray(ltcl.scenes.dihedral(n).form_factors, np.float64)
    pairs = G.reshape(n, n, 2, n, n, 2).sum(axis=5).mean(axis=2).reshape(n * n, n * n)
    return ALBEDO * np.linalg.inv(np.eye(n * n) - ALBEDO * pairs)


def held(n: int) -> np.ndarray:
    """Noise, stripes and smooth patterns, (N, 6)."""
    rng = np.random.default_rng(11)
    y, x = np.mgrid[:n, :n] / n
    parts = [rng.random((n, n)) for _ in range(2)]
    parts += [
        np.sin(60 * x + 20 * y) > 0,
        x * (1 - y),
        0.5 + 0.5 * np.sin(9 * x),
        (x - 0.3) ** 2 + y**2 < 0.1,
    ]
    return np.stack([np.asarray(part, np.float64) for part in parts]).reshape(6, -1).T


def measured(truth: np.ndarray, camera: str, strategy: str, device: Device) -> Found:
    """Acquire and compare."""
    n, (response, bits) = round(len(truth) ** 0.5), CAMERAS[camera]
    rig = VirtualRig(truth, (n, n), response=response, bits=bits, ambient=0.01, seed=2)
    with TemporaryDirectory() as folder:
        path, start = Path(folder) / "T.zarr", time.perf_counter()
        T = acquire(rig, geometry="aligned", strategy=strategy, store=path, device=device)
        seconds = time.perf_counter() - start
        report = Report.of(path)
        P = held(n)
        seen = np.asarray(T @ P.T.reshape(-1, n, n), np.float64).reshape(P.shape[1], -1).T
        ours = np.asarray(T @ np.ones((n, n)), np.float64).ravel()
        theirs = truth.sum(axis=1)
        unit = float(ours @ theirs / (ours @ ours))
        wanted = truth @ P
        errors = np.linalg.norm(unit * seen - wanted, axis=0) / np.linalg.norm(wanted, axis=0)
        sums = float(np.max(np.abs(unit * ours / theirs - 1)))
        return Found(
            camera,
            strategy,
            report.photographs,
            float(errors.max()),
            sums,
            compensated(T, truth, unit),
            seconds,
        )


def compensated(T: ltcl.Transport, truth: np.ndarray, unit: float) -> float:
    """Peak signal over noise of a compensated picture under the true transport."""
    y, x = np.mgrid[: T.grid[0], : T.grid[1]] / T.grid[0]
    desired = 0.25 + 0.1 * np.sin(7 * x + 4 * y)
    pattern = ltcl.compensate(T, (desired / unit).astype(np.float32), rtol=1e-3).pattern
    shown = truth @ np.asarray(pattern, np.float64).ravel()
    return float(10 * np.log10(desired.max() ** 2 / np.mean((shown - desired.ravel()) ** 2)))


def claims(found: list[Found]) -> list[Claim]:
    """What has to hold."""
    cost = {one.strategy: one.photographs for one in found}
    listed = [
        Claim(
            "an adaptive scan takes a fifth of the photographs of one pixel at a time",
            f"{cost['adaptive']} of {cost['pixel']}",
            "at most 1 / 5",
            5 * cost["adaptive"] <= cost["pixel"],
        )
    ]
    for one in found:
        if one.strategy == "adaptive":
            text = f"{one.strategy}, {one.camera}: the row sum that is furthest off"
            listed.append(Claim(text, f"{one.sums:.2%}", "at most 2 %", one.sums <= 0.02))
        name = f"{one.strategy}, {one.camera}"
        listed += [
            Claim(f"{name}: T p of held patterns", f"{one.held:.2%}", "at most 2 %", one.held <= 0.02),
            Claim(f"{name}: compensated", f"{one.decibels:.1f} dB", "at least 30 dB", one.decibels >= 30),
        ]
    return listed


def draw() -> Figure:
    """Photographs against pixels, as the plans have it."""
    figure = figures.page(
        430, "Photographs of a scan", "Of each strategy, by its plan, two exposures a pattern."
    )
    axes = figures.graph(figure, (80, 130, 860, 230), "", "pixels", "photographs")
    sides = [16, 32, 64, 128, 256]
    for strategy, name in (("adaptive", "adaptive, at most"), ("pixel", "one at a time, or S-matrices")):
        counts = [plans((n, n), (0.5, 8.0))[strategy].photographs for n in sides]
        axes.plot([n * n for n in sides], counts, marker="o", label=name)
    axes.set_xscale("log")
    axes.legend(frameon=False, labelcolor=figures.FAINT)
    return figure


def main() -> None:
    """Run the bench."""
    given = options(__doc__ or "")
    truth = corner(16 if given.smoke else 64)
    found = [
        measured(truth, camera, strategy, given.device)
        for camera in (list(CAMERAS)[:1] if given.smoke else CAMERAS)
        for strategy in STRATEGIES
    ]
    facts: dict[str, Any] = {"pixels": len(truth)}
    for one in found:
        facts[f"{one.strategy}, {one.camera}, seconds"] = one.seconds
        facts[f"{one.strategy}, {one.camera}, photographs"] = one.photographs
        facts[f"{one.strategy}, {one.camera}, row sum furthest off"] = one.sums
    listed = claims(found)
    if given.smoke:  # so few pixels show that it runs, not how few photographs a larger one takes
        listed = listed[1:]
    figures.conclude(given, "A transport from photographs", listed, facts, draw)


if __name__ == "__main__":
    main()
