# SPDX-License-Identifier: BSD-3-Clause
"""Standard deviations of patterns and bounces beside errors, and their cost.

Five scenes are measured 200 times at each of three levels of noise: a floor of 1e-4, 1e-3 and 1e-2
of the median first bounce, and as much photon noise at that light. The pattern of a picture, not
clipped, and its bounces 0 to 3 are compared with those of the T without noise, in float64. Of the
errors 68 % should be within one standard deviation, 95 % within two. Cost: `std` over the task it
belongs to, in seconds.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import _figures as figures
import ltcl
from _figures import Claim
from _harness import parse_options, seconds
from ltcl import Transport

sys.path.append(str(Path(__file__).resolve().parents[1]))
from tests.transport.noise.measured import SCENES, measure, noise_of, truth

LEVELS = (1e-4, 1e-3, 1e-2)
REPETITIONS = 200
# Pixels along a wall of the corner whose costs are timed.
COST_SIZE = 32
NAMES = ("pattern", "bounce 0", "bounce 1", "bounce 2", "bounce 3")
# Shares of errors within one and two deviations, and by how much they may differ.
SHARES = (0.68, 0.95)
SHARE_TOLERANCES = (0.05, 0.03)
# Largest ratio of the seconds of `std` to the seconds of its task.
COST_TARGET = 5.0

Shares = dict[tuple[str, float], np.ndarray]


def exact_results(T: np.ndarray, image: np.ndarray) -> np.ndarray:
    """T^-1 l, b_0, b_1, b_2, b_3 (eq. 27) in float64, (5, N)."""
    F = np.diag(T)
    results: list[np.ndarray] = [np.linalg.solve(T, image)]
    remaining = image
    for _ in NAMES[1:]:
        bounce = F * np.linalg.solve(T, remaining)
        remaining = remaining - bounce
        results.append(bounce)
    return np.array(results)


def coverage(scene: str, level: float, repetitions: int) -> np.ndarray:
    """Shares of errors within one and two deviations, (5, 2)."""
    T = truth(scene)
    y, x = np.mgrid[: T.grid[0], : T.grid[1]] / max(T.grid)
    waves = np.sin(7 * x + 4 * y)
    image = (T @ (0.5 + 0.3 * waves)).astype(np.float64)
    exact = exact_results(T.to_numpy(), image.ravel())
    noise = noise_of(T, level, photons=1.0)
    ratios = []
    for seed in range(repetitions):
        measured = measure(T, noise, seed)
        compensation = ltcl.compensate(measured, image, bounds=(-99.0, 99.0), rtol=1e-4)
        separation = ltcl.separate(measured, image, 3, rtol=1e-4)
        results = join_results(compensation, separation)
        deviations = join_results(compensation.std, separation.std)
        ratios.append(np.abs(results - exact) / deviations)
    within_one = np.mean(np.array(ratios) < 1, axis=(0, 2))
    within_two = np.mean(np.array(ratios) < 2, axis=(0, 2))
    return np.stack([within_one, within_two], axis=1)


def join_results(compensation: Any, separation: Any) -> np.ndarray:
    """A pattern and bounces, or their deviations, (5, N)."""
    parts = [compensation.pattern, separation.direct, *separation.bounces]
    return np.stack(parts).reshape(len(NAMES), -1)


def costs(n: int, smoke: bool) -> dict[str, float]:
    """Seconds of `std` over those of its task, for one picture and for eight."""
    exact = truth("corner", n)
    T = measure(exact, noise_of(exact, 1e-3, photons=1.0), 0)
    light = np.random.default_rng(0).uniform(0.3, 0.7, (8, *T.grid))
    repeats = 1 if smoke else 7
    one = cost_ratios(T, "one picture", T @ light[0], repeats)
    return one | cost_ratios(T, "eight pictures", T @ light, repeats)


def cost_ratios(T: Transport, name: str, image: np.ndarray, repeats: int) -> dict[str, float]:
    tasks: dict[str, Callable[[], Any]] = {
        "separate": lambda: ltcl.separate(T, image, 3),
        "compensate": lambda: ltcl.compensate(T, image),
        "compensate, clipped": lambda: ltcl.compensate(T, 1.5 * image),
    }
    actions = dict(tasks)
    for task, run in tasks.items():
        actions[f"{task}, std"] = partial(run_with_std, run)
    spent = seconds(actions, repeats=repeats)
    ratios = {}
    for task in tasks:
        ratios[f"{task}, {name}"] = spent[f"{task}, std"] / spent[task] - 1.0
    return ratios


def run_with_std(run: Callable[[], Any]) -> Any:
    return run().std


def claims(shares: Shares, ratios: dict[str, float]) -> list[Claim]:
    """Claims about each quantity over all scenes and levels, and about cost."""
    listed = []
    for quantity in range(len(NAMES)):
        for deviations in (1, 2):
            listed.append(share_claim(shares, quantity, deviations))
    for name, ratio in ratios.items():
        text = f"{name}: std over the task"
        limit = f"at most {COST_TARGET:g}"
        listed.append(Claim(text, f"{ratio:.1f}", limit, ratio <= COST_TARGET))
    return listed


def share_claim(shares: Shares, quantity: int, deviations: int) -> Claim:
    """The share of errors of one quantity within one or two deviations."""
    expected = SHARES[deviations - 1]
    tolerance = SHARE_TOLERANCES[deviations - 1]
    values = {case: table[quantity, deviations - 1] for case, table in shares.items()}
    case_shares = np.array(list(values.values()))
    scene, level = max(values, key=lambda case: abs(values[case] - expected))
    measured = (
        f"{case_shares.mean():.1%}; {case_shares.min():.1%} to {case_shares.max():.1%}, "
        f"worst {scene}, {level:g}"
    )
    plural = "s" if deviations > 1 else ""
    text = f"{NAMES[quantity]}: errors within {deviations} standard deviation{plural}"
    limits = f"{expected:.0%} +- {tolerance:.0%} in all cases"
    is_within = np.abs(case_shares - expected) <= tolerance
    return Claim(text, measured, limits, bool(is_within.all()))


def main() -> None:
    """Measure, and conclude; the few repetitions of --smoke only show that it runs."""
    options = parse_options(__doc__)
    # Glossy scenes warn each time.
    logging.getLogger("ltcl").setLevel(logging.ERROR)
    scenes = SCENES
    repetitions = REPETITIONS
    cost_size = COST_SIZE
    if options.smoke:
        scenes = SCENES[:1]
        repetitions = 2
        cost_size = 6
    shares: Shares = {}
    for scene in scenes:
        for level in LEVELS:
            shares[scene, level] = coverage(scene, level, repetitions)
    listed = claims(shares, costs(cost_size, options.smoke))
    pixels = max(truth(scene).shape[1] for scene in scenes)
    facts: dict[str, Any] = {"repetitions": repetitions, "pixels": pixels}
    for (scene, level), table in shares.items():
        cells = ", ".join(f"{one:.1%} {two:.1%}" for one, two in table)
        facts[f"{scene}, {level:g}: within 1 and 2"] = cells
    if options.smoke:
        listed = []
    figures.conclude(options, "Uncertainty, pixel by pixel", listed, facts, Figure)


if __name__ == "__main__":
    main()
