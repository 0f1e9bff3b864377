# SPDX-License-Identifier: BSD-3-Clause
"""Deviations, denoising and `rtol="noise"` of path-traced transports, judged by independent measurements.

Mitsuba traces (`scenes.tracing`) a corner, a box, and a box with blocks ten times each. Twice, one
is judged by the mean of eight others, whose own errors are taken off all ratios; with the noise
that T tells itself, and with that of the tenth. Deviations over errors: root mean squares over
pixels, under white. Errors denoised and compressed, over those before: of ten patterns of each
kind, and of bounces of one of each. Also, what no measurement mends: the bounces of one view, by
its `first_bounce`, against those traced.
"""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import _figures as figures
import ltcl
from _figures import Claim
from _harness import parse_options
from denoise import QUANTITIES, patterns
from scenes import tracing

sys.path.append(str(Path(__file__).resolve().parents[1]))
from tests.transport.noise.measured import measure, noise_of, truth

GRID, PATHS, SEEDS, JUDGED = (
    (32, 32),
    2560,
    10,
    2,
)  # as many paths an entry of T as in compression.py
OWN = 1.0 / (SEEDS - 1)  # share of the truth's own errors in the variance of those against it
PARTS = ("direct", "bounce 1", "bounce 2", "bounce 3", "pattern", "appearance")
LIMITS: dict[str, Any] = {
    "deviations over errors": (PARTS, 0.75, 1.33),
    "denoised": (QUANTITIES, 0.0, 1.0),
    "compressed": (QUANTITIES[:3], 0.0, 1.1),
}


def measurements(scene: str, smoke: bool) -> tuple[list[ltcl.Transport], dict[str, float]]:
    """All, and how far the bounces of their mean are from those traced; simulated ones for --smoke."""
    if smoke:
        T = truth("corner", 6)
        return [measure(T, noise_of(T, 1e-3), seed, known=False) for seed in range(4)], {}
    traced = [tracing.trace(scene, GRID, PATHS, seed) for seed in range(1, SEEDS + 1)]
    mean, off = np.mean(traced, axis=0, dtype=np.float64), {}
    white = mean.sum(axis=2).reshape(-1, *GRID)
    for first in ("diagonal", "exact"):
        T = ltcl.Transport(mean.sum(axis=0), GRID, first_bounce=first)
        b = ltcl.separate(T, T @ np.ones(GRID), 3, rtol=1e-5)
        off[first] = float((norms([b.direct, *b.bounces] - white[:4]) / norms(white[:1])).max())
    return [ltcl.Transport(T.sum(axis=0), GRID) for T in traced], off


def norms(arrays: Any) -> np.ndarray:
    """Of each one."""
    return np.array([np.linalg.norm(each) for each in arrays])


def deviations(T: ltcl.Transport, true: ltcl.Transport) -> np.ndarray:
    """`.std` over errors of `PARTS`, under white."""
    white = true @ np.ones(true.grid)
    b, exact = (ltcl.separate(A, white, 3, rtol=1e-5) for A in (T, true))
    c = ltcl.compensate(T, white, bounds=(-99.0, 99.0), rtol=1e-5)
    shown, F = c.appearance - true @ c.pattern, b.direct - exact.direct
    errors = [F, *b.bounces - exact.bounces, c.pattern - 1.0, shown]
    return norms([b.std.direct, *b.std.bounces, c.std.pattern, c.std.appearance]) / norms(errors)


def errors(T: ltcl.Transport, true: ltcl.Transport) -> np.ndarray:
    """Relative ones of `QUANTITIES`: T p of ten patterns of each kind; bounces of pictures of one of each."""
    kinds = patterns(T.grid)
    image = true @ np.stack([kind[0] for kind in kinds])
    ours, exact = (
        [*(A @ kind for kind in kinds), *ltcl.separate(A, image, 3).bounces] for A in (T, true)
    )
    return norms(a - b for a, b in zip(ours, exact, strict=True)) / norms(exact)


def judge(T: ltcl.Transport, true: ltcl.Transport) -> tuple[Any, ...]:
    """Values of `LIMITS`, relative errors of T, and bytes a row."""
    C, raw = ltcl.compress(T, "noise"), errors(T, true)
    squares = np.array([errors(A, true) / raw for A in (ltcl.denoise(T), C)]) ** 2
    left, kept = np.sqrt(np.maximum(squares - OWN, 0.0) / (1.0 - OWN))
    row = C.compression.channels[0].nbytes / len(T.first_bounce)
    return deviations(T, true) / (1.0 - OWN) ** 0.5, left, kept[:3], raw, row


def main() -> None:
    """Judge each scene, or say why not."""
    given = parse_options(__doc__ or "")
    if why := "" if given.smoke else tracing.unavailable():
        raise SystemExit(f"not measured: {why}")
    logging.getLogger("ltcl").setLevel(logging.ERROR)  # of T that is noisy
    facts: dict[str, Any] = {"path-traced": "not measured: --smoke"} if given.smoke else {}
    claims, half = list[Claim](), list[bool]()
    for scene in ["simulated"] if given.smoke else ("corner", "box", "blocks"):
        measured, facts[f"{scene}: bounces of one view, off"] = measurements(scene, given.smoke)
        found: dict[str, list[Any]] = {"noise by T alone": [], "noise by two measurements": []}
        for k in range(JUDGED):
            first, second, *others = measured[k:] + measured[:k]
            true = ltcl.Transport(np.mean([T.to_numpy() for T in others], axis=0), first.grid)
            for noise, values in zip((None, second), found.values(), strict=True):
                values.append(
                    judge(ltcl.Transport(first.to_numpy(), first.grid, noise=noise), true)
                )
        for way, values in found.items():
            *columns, raw, rows = (np.array(each) for each in zip(*values, strict=True))
            errors_of_T = zip(QUANTITIES, raw.max(axis=0), strict=True)
            facts[f"{scene}: relative errors"] = ", ".join(
                f"{name} {x:.2%}" for name, x in errors_of_T
            )
            facts[f"{scene}, {way}: bytes a row"] = float(rows.max())
            half += list((columns[1] <= 0.5).ravel())
            for (text, (names, least, most)), x in zip(LIMITS.items(), columns, strict=True):
                cells = zip(names, x.min(axis=0), x.max(axis=0), strict=True)
                listed = ", ".join(f"{name} {low:.2f} to {high:.2f}" for name, low, high in cells)
                holds = bool(((least <= x) & (x <= most)).all())
                claims.append(
                    Claim(f"{scene}, {way}: {text}", listed, f"{least:g} to {most:g}", holds)
                )
    claims.append(
        Claim("denoised: at most half is left", f"{sum(half)} of {len(half)}", "all", all(half))
    )
    figures.conclude(given, "Path-traced transports", [] if given.smoke else claims, facts, Figure)


if __name__ == "__main__":
    main()
