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

ALBEDO = 0.4
LAMP = (0.85, 0.75, 0.8)
# Samples a pixel of the pictures; samples and seeds of the curves.
FEW = 30
MANY = 1000
COUNTS = np.array([8, 16, 32, 64, 128, 256, 512])
SEEDS = 12
KINDS: dict[str, dict[str, Any]] = {"plain": {}, "final gather": {"gather": True}}


@dataclass(frozen=True, kw_only=True)
class Inversion:
    """S, the picture l_out and the direct light l_d it comes from."""

    scene: Scene
    S: Any
    l_out: np.ndarray
    l_d: np.ndarray

    def error(self, l: np.ndarray) -> float:
        """Error relative to the direct light."""
        return float(np.linalg.norm(l - self.l_d) / np.linalg.norm(self.l_d))

    def run(self, samples: int, seed: int, kind: str) -> np.ndarray:
        """An estimate of the direct light."""
        settings = {"samples": samples, "seed": seed, **KINDS[kind]}
        return ltcl.solve(self.S, self.l_out, "monte_carlo", **settings).x


def invert(n: int, device: ltcl.Device) -> Inversion:
    """The box under its lamp, n x n patches a wall."""
    room = box(n, sides=5, albedo=ALBEDO)
    scene, (l_d,), (S,), (l_out,) = boxes.light_room(room, LAMP, device)
    return Inversion(scene=scene, S=S, l_out=l_out, l_d=l_d)


def measure(inversion: Inversion, seeds: int = SEEDS) -> dict[str, np.ndarray]:
    """Errors by kind, (COUNTS, seeds)."""
    errors = {}
    for kind in KINDS:
        errors[kind] = np.zeros((len(COUNTS), seeds))
        for row, seed in np.ndindex(errors[kind].shape):
            estimate = inversion.run(int(COUNTS[row]), seed, kind)
            errors[kind][row, seed] = inversion.error(estimate)
    return errors


def claims(inversion: Inversion, errors: dict[str, np.ndarray]) -> list[Claim]:
    plain = inversion.error(inversion.run(FEW, 0, "plain"))
    gathered = inversion.error(inversion.run(FEW, 0, "final gather"))
    many = inversion.error(inversion.run(MANY, 0, "plain"))
    expected = (FEW / MANY) ** 0.5
    return [
        variance_claim(errors["plain"]),
        Claim(
            f"{FEW} samples a pixel suffice with final gather",
            f"error {gathered:.1%}, without {plain:.0%}",
            "at most 5%, a tenth of that without",
            gathered <= min(0.05, plain / 10),
        ),
        Claim(
            "more samples make it more accurate",
            f"error {many:.1%} of {MANY} samples, {plain:.0%} of {FEW}",
            f"{expected:.2f} times, within a tenth",
            abs(many / plain / expected - 1) <= 0.1,
        ),
    ]


def variance_claim(errors: np.ndarray) -> Claim:
    """The slope of the log of the squared error over the log of samples is -1."""
    samples = np.repeat(np.log(COUNTS), SEEDS)
    fit: Any = scipy.stats.linregress(samples, 2 * np.log(errors.ravel()))
    quantile = scipy.stats.t.ppf(0.995, len(samples) - 2)
    half_width = fit.stderr * quantile
    return Claim(
        "variance falls as one over the samples",
        f"slope {fit.slope:.3f} +- {half_width:.3f}",
        "-1 within 99 % confidence",
        abs(fit.slope + 1) <= half_width,
    )


def draw(inversion: Inversion, errors: dict[str, np.ndarray]) -> Figure:
    figure = figures.page(
        640,
        f"Figure 8: {len(inversion.l_d)} pixels inverted by random walks",
        "Each pixel by walks of its own; then one exact product, which smooths their noise away.",
    )
    draw_estimates(figure, inversion)
    box = (85, 360, 860, 210)
    axes = figures.graph(figure, box, "Variance", "samples a pixel", "squared error")
    for (kind, values), colour in zip(errors.items(), ("#5cc8ff", "#ffb347"), strict=True):
        axes.loglog(COUNTS, (values**2).mean(axis=1), color=colour, lw=2, label=kind)
    axes.set_xticks(COUNTS, [str(count) for count in COUNTS])
    axes.minorticks_off()
    figures.legend(axes)
    return figure


def draw_estimates(figure: Figure, inversion: Inversion) -> None:
    """The picture, three estimates of the direct light, and the truth."""
    lights = {
        "the picture": inversion.l_out,
        f"{FEW} samples": inversion.run(FEW, 0, "plain"),
        f"{FEW}, final gather": inversion.run(FEW, 0, "final gather"),
        f"{MANY} samples": inversion.run(MANY, 0, "plain"),
        r"direct light $l_d$": inversion.l_d,
    }
    gain = 0.9 / np.quantile(inversion.l_out, 0.98)
    views = []
    for label, light in lights.items():
        image = figures.light(inversion.scene, light.reshape(inversion.scene.grid), gain)
        views.append((image, label, f"error {inversion.error(light):.2g}"))
    figures.pictures(figure, 110, views, gap=20)


def main() -> None:
    options = parse_options(__doc__)
    inversion = invert(6 if options.smoke else 32, options.device)
    errors = measure(inversion)
    facts = {"pixels": len(inversion.l_d), "albedo": ALBEDO, "samples": COUNTS.tolist()}
    for kind, values in errors.items():
        facts[f"relative error, {kind}"] = np.round(values.mean(axis=1), 5).tolist()
    listed = claims(inversion, errors)
    title = "Figure 8: Monte Carlo"
    figures.conclude(options, title, listed, facts, lambda: draw(inversion, errors))


if __name__ == "__main__":
    main()
