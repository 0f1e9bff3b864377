# SPDX-License-Identifier: BSD-3-Clause
"""Whether standard deviations of patterns and bounces are as large as errors, and what they cost.

Five scenes are measured 200 times at each of three levels of noise: a floor of 1e-4, 1e-3 and 1e-2
of the median first bounce, and as much photon noise at that light. The pattern of a picture, not
clipped, and its bounces 0 to 3 are compared with those of the T without noise, in float64. Of the
errors 68 % should be within one standard deviation, 95 % within two. Cost: `std` over the task it
belongs to, in seconds.
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
from _harness import parse_options, seconds

sys.path.append(str(Path(__file__).resolve().parents[1]))
from tests.transport.noise.measured import SCENES, measure, noise_of, truth

LEVELS = (1e-4, 1e-3, 1e-2)
NAMES = ("pattern", "bounce 0", "bounce 1", "bounce 2", "bounce 3")
WANTED, MOST = (
    (0.68, 0.95),
    (0.05, 0.03),
)  # within one and two deviations; by how much shares may differ
COST = 5.0  # times the task, at most


def exact(T: np.ndarray, image: np.ndarray) -> np.ndarray:
    """T^-1 l, b_0, b_1, b_2, b_3 (eq. 27) in float64, (5, N)."""
    F, left = np.diag(T), image
    terms: list[np.ndarray] = [np.linalg.solve(T, image)]
    for _ in NAMES[1:]:
        terms.append(F * np.linalg.solve(T, left))
        left = left - terms[-1]
    return np.array(terms)


def coverage(scene: str, level: float, repetitions: int) -> np.ndarray:
    """Shares of errors within one and two deviations, (5, 2)."""
    T = truth(scene)
    y, x = np.mgrid[: T.grid[0], : T.grid[1]] / max(T.grid)
    image = (T @ (0.5 + 0.3 * np.sin(7 * x + 4 * y))).astype(np.float64)
    true, noise, ratios = exact(T.to_numpy(), image.ravel()), noise_of(T, level, photons=1.0), []
    for seed in range(repetitions):
        measured = measure(T, noise, seed)
        c = ltcl.compensate(measured, image, bounds=(-99.0, 99.0), rtol=1e-4)
        b = ltcl.separate(measured, image, 3, rtol=1e-4)
        results = np.stack([c.pattern, b.direct, *b.bounces]).reshape(5, -1)
        deviations = np.stack([c.std.pattern, b.std.direct, *b.std.bounces]).reshape(5, -1)
        ratios.append(np.abs(results - true) / deviations)
    return np.stack([np.mean(np.array(ratios) < n, axis=(0, 2)) for n in (1, 2)], axis=1)


def costs(n: int, smoke: bool) -> dict[str, float]:
    """Seconds of `std` over those of its task, for one picture and for eight."""
    T = truth("corner", n)
    T, ratios = measure(T, noise_of(T, 1e-3, photons=1.0), 0), {}
    light = np.random.default_rng(0).uniform(0.3, 0.7, (8, *T.grid))
    for name, image in (("one picture", T @ light[0]), ("eight pictures", T @ light)):
        tasks = {
            "separate": lambda image=image: ltcl.separate(T, image, 3),
            "compensate": lambda image=image: ltcl.compensate(T, image),
            "compensate, clipped": lambda image=image: ltcl.compensate(T, 1.5 * image),
        }
        both = {f"{task}, std": lambda run=run: run().std for task, run in tasks.items()}
        spent = seconds({**tasks, **both}, repeats=1 if smoke else 7)
        ratios |= {f"{task}, {name}": spent[f"{task}, std"] / spent[task] - 1.0 for task in tasks}
    return ratios


def claims(shares: dict[tuple[str, float], np.ndarray], ratios: dict[str, float]) -> list[Claim]:
    """Of each quantity over all scenes and levels, of the worst of these, and of cost."""
    listed, values = [], np.array(list(shares.values()))  # (cases, 5, 2)
    for k, name in enumerate(NAMES):
        for n, (wanted, most) in enumerate(zip(WANTED, MOST, strict=True)):
            each = values[:, k, n]
            worst = max(shares, key=lambda case: abs(shares[case][k, n] - wanted))
            text = f"{each.mean():.1%}; {each.min():.1%} to {each.max():.1%}, worst {worst[0]}, {worst[1]:g}"
            holds = bool((np.abs(each - wanted) <= most).all())
            title = f"{name}: errors within {n + 1} standard deviation{'s' * n}"
            listed.append(Claim(title, text, f"{wanted:.0%} +- {most:.0%} in all cases", holds))
    for name, ratio in ratios.items():
        listed.append(
            Claim(f"{name}: std over the task", f"{ratio:.1f}", f"at most {COST:g}", ratio <= COST)
        )
    return listed


def main() -> None:
    """Measure, and conclude; so few repetitions as of --smoke show that it runs."""
    given = parse_options(__doc__ or "")
    logging.getLogger("ltcl").setLevel(logging.ERROR)  # of glossy scenes, each time
    scenes, repetitions = (SCENES[:1], 2) if given.smoke else (SCENES, 200)
    shares = {(s, level): coverage(s, level, repetitions) for s in scenes for level in LEVELS}
    listed = claims(shares, costs(6 if given.smoke else 32, given.smoke))
    facts: dict[str, Any] = {
        "repetitions": repetitions,
        "pixels": max(truth(s).shape[1] for s in scenes),
    }
    for (scene, level), each in shares.items():
        facts[f"{scene}, {level:g}: within 1 and 2"] = ", ".join(
            f"{a:.1%} {b:.1%}" for a, b in each
        )
    figures.conclude(
        given, "Uncertainty, pixel by pixel", [] if given.smoke else listed, facts, Figure
    )


if __name__ == "__main__":
    main()
