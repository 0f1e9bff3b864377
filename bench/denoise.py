# SPDX-License-Identifier: BSD-3-Clause
"""How much nearer to the truth `ltcl.denoise` brings pictures and bounces, on five scenes that are known.

Noise is a floor, in median first bounces, alone or with photon noise of as much at that light. The bound is
the same shrinkage with the Wiener factors of the true T: what its wavelets can reach at most.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import _figures as figures
import ltcl
from _figures import Claim
from _harness import options
from ltcl import denoising
from ltcl.plots.page import OTHERS

sys.path.append(str(Path(__file__).resolve().parents[1]))
from tests.noise.measured import SCENES, measure, noise_of, truth

LEVELS, GOAL = (1e-4, 1e-3, 1e-2), 0.5
QUANTITIES = ("random", "smooth", "patch", "bounce 1", "bounce 2", "bounce 3")


class Case(NamedTuple):
    """`shares` (3, quantities): relative errors of the raw T; what is left of them, and the bound on that."""

    scene: str
    pixels: int
    level: float
    photons: float
    shares: np.ndarray


def patterns(grid: tuple[int, int]) -> list[np.ndarray]:
    """Ten of each kind, (10, h, w): random binary ones, smooth ones, single patches."""
    (h, w), (y, x), side, random = grid, np.indices(grid), max(grid[0] // 6, 1), np.random.default_rng(0)
    waves = random.uniform(0.0, 2.0 * np.pi, (3, 10, 1, 1))
    top, left = (random.integers(0, size - side + 1, (10, 1, 1)) for size in grid)
    patch = (y >= top) & (y < top + side) & (x >= left) & (x < left + side)
    smooth = 1.0 + np.cos(waves[0] * y / h + waves[1] * x / w + waves[2])
    return [random.integers(0, 2, (10, h, w)).astype(float), smooth, patch.astype(float)]


def oracle(T: ltcl.Transport, exact: np.ndarray) -> ltcl.Transport:
    """T denoised by Wiener factors of the truth."""
    Y, bases = T.to_numpy(), denoising.multiwavelets(T.grid, T.grid)
    problem = denoising.Problem.of(Y, T.noise.variance, T.grid, T.grid)
    pilot = (exact * problem.gauge).astype(np.float32)
    np.fill_diagonal(pilot, np.diag(denoising.shrink(problem, bases, None)[0]))
    entries = problem.restore(denoising.shrink(problem, bases, pilot)[0], Y)
    return ltcl.Transport(entries, T.grid)


def measured(scene: str, n: int, level: float, photons: float) -> Case:
    """One scene at one noise."""
    exact = truth(scene, n)
    kinds, noise = patterns(exact.grid), noise_of(exact, level, photons)
    picture = exact @ np.stack([kinds[0][0], kinds[1][0]])

    def light(T: ltcl.Transport) -> list[np.ndarray]:
        return [T @ kind for kind in kinds] + list(ltcl.separate(T, picture, 3, method="direct").bounces)

    T, true = measure(exact, noise, 0), light(exact)
    lights = [light(some) for some in (T, ltcl.denoise(T), oracle(T, exact.to_numpy()))]
    errors = np.array([[np.linalg.norm(a - b) for a, b in zip(x, true, strict=True)] for x in lights])
    errors[1:] /= errors[0]
    errors[0] /= [np.linalg.norm(b) for b in true]
    return Case(scene, n, level, photons, errors)


def claims(cases: Sequence[Case]) -> list[Claim]:
    """Never worse; at most half, or near the bound."""
    _, left, bound = np.stack([case.shares for case in cases], axis=1)
    far = float((left / bound)[left > GOAL].max(initial=0.0))
    found = [
        Claim("none is worse than before", f"{left.max():.2f} of it", "at most 1", left.max() <= 1.0),
        Claim("others than at most half are near the bound", f"{far:.2f} of it", "at most 1.4", far <= 1.4),
    ]
    for level in LEVELS:
        own = [case.level == level for case in cases]
        few, possible = ((share[own] <= GOAL).sum() for share in (left, bound))
        means = f"means {left[own].mean():.2f} and {bound[own].mean():.2f}"
        shares = f"{few} of {left[own].size}, bound {possible}; {means}"
        differs = "" if level == LEVELS[-1] else "most coefficients of so few pixels stand out of the noise"
        text = f"at most half is left at a noise of {level:g}"
        found.append(Claim(text, shares, "all", few == left[own].size, differs=differs))
    return found


def draw(cases: Sequence[Case]) -> Any:
    """Mean share of the error that is left, over the noise, at the largest size."""
    page = figures.page(470, "ltcl.denoise against the truth", "Dashed: the bound of its wavelets.")
    title, x = f"Errors, {cases[-1].pixels} pixels a side", "noise, in median first bounces"
    axes = figures.graph(page, (80, 130, 880, 270), title, x, "share left", "linear")
    axes.set_xscale("log")
    for scene, colour in zip({case.scene: 0 for case in cases}, OTHERS, strict=False):
        last = [case.shares for case in cases if case.scene == scene][-len(LEVELS) :]
        _, left, bound = np.mean(last, axis=2).T
        axes.plot(LEVELS, left, color=colour, label=scene)
        axes.plot(LEVELS, bound, "--", color=colour)
    axes.legend(frameon=False, labelcolor="linecolor", fontsize=9)
    return page


def main() -> None:
    """Run the bench."""
    given = options(__doc__ or "")
    logging.getLogger("ltcl").setLevel(logging.ERROR)  # of glossy scenes, at each separation
    sizes = [(8, 1.0)] if given.smoke else [(12, 0.0), (12, 1.0), (20, 0.0)]
    some = SCENES[: 1 if given.smoke else None]
    cases = [measured(name, n, level, light) for n, light in sizes for name in some for level in LEVELS]
    names = [f"{c.scene} {c.pixels}, noise {c.level:g}, photons {c.photons:g}" for c in cases]
    rows = [dict(zip(QUANTITIES, case.shares.T.round(5).tolist(), strict=True)) for case in cases]
    facts = dict(zip(names, rows, strict=True))
    figures.conclude(given, "Denoising against the truth", claims(cases), facts, lambda: draw(cases))


if __name__ == "__main__":
    main()
