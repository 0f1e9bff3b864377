# SPDX-License-Identifier: BSD-3-Clause
"""Deviations, denoising and `rtol="noise"` of path-traced transports, judged by independent measurements.

Mitsuba traces (`_traced`) a corner, a box, and a box with blocks: two measurements, and as truth the mean of
eight more, whose own errors are taken off all ratios. T is judged with the noise that it tells itself, and
with that of both measurements. Deviations over errors are root mean squares over pixels, under white.
Denoised and compressed: errors over those before, of ten patterns of each kind and of bounces of one of each.
Last, what no measurement mends: the bounces of one view, by its `first_bounce`, against those traced.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import _figures as figures
import _traced
import ltcl
from _figures import Claim
from _harness import options
from denoise import QUANTITIES, patterns

sys.path.append(str(Path(__file__).resolve().parents[1]))
from tests.noise.measured import measure, noise_of, truth

GRID, PATHS = (32, 32), 2560  # a camera pixel: as many an entry of T as in compression.py
OTHERS = 8  # measurements that are the truth together
OWN = 1.0 / (1 + OTHERS)  # share of the truth's own errors in the variance of those against it
PARTS = ("direct", "bounce 1", "bounce 2", "bounce 3", "pattern", "appearance")
ACCURATE: dict[str, Any] = {"rtol": 1e-5}


def measurements(scene: str, smoke: bool) -> tuple[Sequence[ltcl.Transport], dict[str, float]]:
    """Two and the truth; and how far its bounces are from those traced. Simulated for --smoke."""
    if smoke:
        T = truth("corner", 6)
        return [*(measure(T, noise_of(T, 1e-3), seed, known=False) for seed in (1, 2)), T], {}
    pair = [_traced.trace(scene, GRID, PATHS, seed).sum(axis=0) for seed in (1, 2)]
    mean = sum(_traced.trace(scene, GRID, PATHS, 3 + k).astype(np.float64) for k in range(OTHERS)) / OTHERS
    traced, off = mean.sum(axis=2).reshape(-1, *GRID), {}
    for first in ("diagonal", "exact"):
        T = ltcl.Transport(mean.sum(axis=0), GRID, first_bounce=first)
        b = ltcl.separate(T, T @ np.ones(GRID), 3, **ACCURATE)
        off[first] = float((norms([b.direct, *b.bounces] - traced[:4]) / norms(traced[:1])).max())
    return [ltcl.Transport(T, GRID) for T in (*pair, mean.sum(axis=0))], off


def norms(arrays: Any) -> np.ndarray:
    """Of each one."""
    return np.array([np.linalg.norm(each) for each in arrays])


def deviations(T: ltcl.Transport, true: ltcl.Transport) -> np.ndarray:
    """`.std` over errors of `PARTS`, under white."""
    white = true @ np.ones(true.grid)
    b, exact = (ltcl.separate(A, white, 3, **ACCURATE) for A in (T, true))
    c = ltcl.compensate(T, white, bounds=(-99.0, 99.0), **ACCURATE)
    errors = [b.direct - exact.direct, *b.bounces - exact.bounces, c.pattern - 1.0]
    errors.append(c.appearance - true @ c.pattern)
    return norms([b.std.direct, *b.std.bounces, c.std.pattern, c.std.appearance]) / norms(errors)


def errors(T: ltcl.Transport, true: ltcl.Transport) -> np.ndarray:
    """Relative ones of `QUANTITIES`: T p of ten patterns of each kind; bounces of pictures of one of each."""
    kinds = patterns(T.grid)
    image = true @ np.stack([kind[0] for kind in kinds])
    ours, exact = ([*(A @ kind for kind in kinds), *ltcl.separate(A, image, 3).bounces] for A in (T, true))
    return norms(a - b for a, b in zip(ours, exact, strict=True)) / norms(exact)


def main() -> None:
    """Judge each scene, or say why not."""
    given = options(__doc__ or "")
    if why := "" if given.smoke else _traced.unavailable():
        raise SystemExit(f"not measured: {why}")
    logging.getLogger("ltcl").setLevel(logging.ERROR)  # of T that is noisy
    facts: dict[str, Any] = {"path-traced": "not measured: --smoke"} if given.smoke else {}
    claims, half = list[Claim](), list[bool]()
    for scene in ["simulated"] if given.smoke else _traced.TRACED:
        (first, second, true), facts[f"{scene}: bounces of one view, off"] = measurements(scene, given.smoke)
        raw = errors(first, true)
        facts[f"{scene}: errors"] = ", ".join(f"{n} {x:.2%}" for n, x in zip(QUANTITIES, raw, strict=True))
        for way, noise in {"T alone": None, "two measurements": second}.items():
            T, case = ltcl.Transport(first.to_numpy(), first.grid, noise=noise), f"{scene}, noise by {way}"
            C, D = ltcl.compress(T, "noise"), ltcl.denoise(T)
            squares = np.array([errors(A, true) / raw for A in (D, C)]) ** 2
            left, kept = np.sqrt(np.maximum(squares - OWN, 0.0) / (1.0 - OWN))
            half += list(left <= 0.5)
            facts[f"{case}: bytes a row"] = C.compression.channels[0].nbytes / len(T.first_bounce)
            for text, names, values, least, most in (
                ("deviations over errors", PARTS, deviations(T, true) / (1.0 - OWN) ** 0.5, 0.75, 1.33),
                ("denoised", QUANTITIES, left, 0.0, 1.0),
                ("compressed", QUANTITIES[:3], kept[:3], 0.0, 1.1),
            ):
                listed = ", ".join(f"{name} {x:.2f}" for name, x in zip(names, values, strict=True))
                holds = bool(((least <= values) & (values <= most)).all())
                claims.append(Claim(f"{case}: {text}", listed, f"{least:g} to {most:g}", holds))
    claims.append(Claim("denoised: at most half is left", f"{sum(half)} of {len(half)}", "all", all(half)))
    figures.conclude(given, "Path-traced transports", [] if given.smoke else claims, facts, Figure)


if __name__ == "__main__":
    main()
