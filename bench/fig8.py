# SPDX-License-Identifier: BSD-3-Clause
"""Figure 8: Monte Carlo inversion at N = 5120, plain and with final gather.

A box of five walls, 32 x 32 patches each, under a lamp. Claims of the paper: variance falls as one
over the samples; 30 samples a pixel, noisy by themselves, suffice with one exact product at the
end. Walks score at every step, where the paper's score where they end (eq. 26). Errors are those
against the true direct light.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.stats
from matplotlib.figure import Figure

import _boxes as boxes
import _figures as figures
import ltcl
from _figures import Claim
from _harness import parse_options
from ltcl.scenes import Scene, box

ALBEDO, LAMP, FEW, MANY = 0.4, (0.85, 0.75, 0.8), 30, 1000
COUNTS, SEEDS = np.array([8, 16, 32, 64, 128, 256, 512]), 12
KINDS: dict[str, dict[str, Any]] = {"plain": {}, "final gather": {"gather": True}}


@dataclass(frozen=True)
class Inversion:
    """S, the picture l_out and the direct light l_d it comes from."""

    scene: Scene
    S: Any
    l_out: np.ndarray
    l_d: np.ndarray

    def error(self, l: np.ndarray) -> float:
        """Relative to the direct light."""
        return float(np.linalg.norm(l - self.l_d) / np.linalg.norm(self.l_d))

    def run(self, samples: int, seed: int, kind: str) -> np.ndarray:
        """An estimate of the direct light."""
        return ltcl.solve(
            self.S, self.l_out, "monte_carlo", samples=samples, seed=seed, **KINDS[kind]
        ).x


def invert(n: int, device: ltcl.Device) -> Inversion:
    """The box under its lamp, n x n patches a wall."""
    scene, (l_d,), (S,), (l_out,) = boxes.light_room(box(n, sides=5, albedo=ALBEDO), LAMP, device)
    return Inversion(scene, S, l_out, l_d)


def measure(found: Inversion, seeds: int = SEEDS) -> dict[str, np.ndarray]:
    """Errors by kind, (COUNTS, seeds)."""
    samples = [(int(count), seed) for count in COUNTS for seed in range(seeds)]
    errors = {k: [found.error(found.run(*each, k)) for each in samples] for k in KINDS}
    return {kind: np.reshape(values, (len(COUNTS), seeds)) for kind, values in errors.items()}


def claims(found: Inversion, errors: dict[str, np.ndarray]) -> list[Claim]:
    plain, gathered = (found.error(found.run(FEW, 0, kind)) for kind in ("plain", "final gather"))
    many, due = found.error(found.run(MANY, 0, "plain")), (FEW / MANY) ** 0.5
    samples = np.repeat(np.log(COUNTS), SEEDS)
    fit: Any = scipy.stats.linregress(samples, 2 * np.log(errors["plain"].ravel()))
    value, half = fit.slope, fit.stderr * scipy.stats.t.ppf(0.995, len(samples) - 2)
    variance, slopes = "variance falls as one over the samples", f"slope {value:.3f} +- {half:.3f}"
    gather = f"{FEW} samples a pixel suffice with final gather"
    few = f"error {gathered:.1%}, without {plain:.0%}"
    more = f"error {many:.1%} of {MANY} samples, {plain:.0%} of {FEW}"
    accurate, is_due = f"{due:.2f} times, within a tenth", abs(many / plain / due - 1) <= 0.1
    return [
        Claim(variance, slopes, "-1 within 99 % confidence", abs(value + 1) <= half),
        Claim(
            gather, few, "at most 5%, a tenth of that without", gathered <= min(0.05, plain / 10)
        ),
        Claim("more samples make it more accurate", more, accurate, is_due),
    ]


def draw(found: Inversion, errors: dict[str, np.ndarray]) -> Figure:
    figure = figures.page(
        640,
        f"Figure 8: {len(found.l_d)} pixels inverted by random walks",
        "Each pixel by walks of its own; then one exact product, which smooths their noise away.",
    )
    gain, images = 0.9 / np.quantile(found.l_out, 0.98), [("the picture", found.l_out)]
    for samples, kind in ((FEW, "plain"), (FEW, "final gather"), (MANY, "plain")):
        label = f"{samples}, {kind}" if KINDS[kind] else f"{samples} samples"
        images.append((label, found.run(samples, 0, kind)))
    views = []
    for label, light in (*images, (r"direct light $l_d$", found.l_d)):
        view = figures.light(found.scene, light.reshape(found.scene.grid), gain)
        views.append((view, label, f"error {found.error(light):.2g}"))
    figures.pictures(figure, 110, views, gap=20)
    axes = figures.graph(
        figure, (85, 360, 860, 210), "Variance", "samples a pixel", "squared error"
    )
    for (kind, values), colour in zip(errors.items(), ("#5cc8ff", "#ffb347"), strict=True):
        axes.loglog(COUNTS, (values**2).mean(axis=1), color=colour, lw=2, label=kind)
    axes.set_xticks(COUNTS, [str(count) for count in COUNTS])
    axes.minorticks_off()
    axes.legend(frameon=False, labelcolor="linecolor", fontsize=10)
    return figure


def main() -> None:
    given = parse_options(__doc__ or "")
    found = invert(6 if given.smoke else 32, given.device)
    errors = measure(found)
    facts = {"pixels": len(found.l_d), "albedo": ALBEDO, "samples": COUNTS.tolist()}
    for kind, values in errors.items():
        facts[f"relative error, {kind}"] = np.round(values.mean(axis=1), 5).tolist()
    listed = claims(found, errors)
    figures.conclude(given, "Figure 8: Monte Carlo", listed, facts, lambda: draw(found, errors))


if __name__ == "__main__":
    main()
