# SPDX-License-Identifier: BSD-3-Clause
"""What the demo computes: a corner of three bright, differently coloured walls, lit in three ways.

In red all three walls are so bright that rho(R) > 1: there the paper's iteration diverges, and Chebyshev
with the free bounds does not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import scenes
from ltcl.analysis import Analysis, analyze
from ltcl.compensation import Compensation, compensate
from ltcl.demo import target
from ltcl.demo.target import Target
from ltcl.scenes import Scene
from ltcl.separation import Separation, separate
from ltcl.solvers import Solution, auto, solve
from ltcl.transport import Transport

ALBEDO = ((0.97, 0.25, 0.15), (0.96, 0.80, 0.30), (0.97, 0.45, 0.80))
"""Red, green, blue of the left wall, the right wall and the floor."""

COLOURS = ("red", "green", "blue")
STEPS = ("the room", "its light transport", "the target", "compensation", "bounces", "convergence")
RTOL = 1e-3
BOUNCES = 4
_RACE_RTOL, _RACE_LENGTH = 1e-5, 60  # far enough to see where each method goes


@dataclass(frozen=True)
class Look:
    """What the room looks like under one pattern, and how well that can pass for the target.

    `exposure` is the brightness at which it comes closest; `error` is what is left,
    ``||exposure * seen - target|| / ||target||``.
    """

    seen: np.ndarray
    exposure: float
    error: float


@dataclass(frozen=True)
class Experiment:
    """All results. Pictures are linear, (h, w, 3) on the walls' grid; `worst` is the channel of `race`."""

    scene: Scene
    T: Transport
    analysis: Analysis
    target: Target
    compensation: Compensation
    uncompensated: Look
    colours_only: Look
    compensated: Look
    separation: Separation
    bounce_errors: tuple[float, ...]
    worst: int
    race: dict[str, Solution]


def compute(size: int, device: Any, begin: Callable[[str], object]) -> Experiment:
    """Run everything; `begin` is called with each of `STEPS`."""
    steps = iter(STEPS)
    begin(next(steps))
    scene = scenes.box(size, sides=3, albedo=ALBEDO)
    begin(next(steps))
    T = scene.transport(first_bounce=scene.first_bounce, device=device)
    analysed = analyze(T, rtol=RTOL)
    begin(next(steps))
    wanted = target.reachable(scene, T, RTOL)
    begin(next(steps))
    # What the demo is about, also where so few pixels would make "auto" factorize.
    method = "chebyshev" if T.shape[0] <= auto.SMALL else "auto"
    compensation = compensate(T, wanted.picture, gain=1.0 / wanted.brightest, method=method, rtol=RTOL)
    uncompensated = _look(T @ wanted.picture, wanted.picture)
    begin(next(steps))
    separation = separate(T, uncompensated.seen, BOUNCES, rtol=RTOL)
    begin(next(steps))
    worst = int(np.argmax([channel.spectral_radius for channel in analysed.channels]))
    return Experiment(
        scene=scene,
        T=T,
        analysis=analysed,
        target=wanted,
        compensation=compensation,
        uncompensated=uncompensated,
        colours_only=_look(_bounced(T, wanted.picture), wanted.picture),
        compensated=_look(compensation.appearance, wanted.picture),
        separation=separation,
        bounce_errors=_bounce_errors(scene, wanted.picture, separation),
        worst=worst,
        race=_race(T, worst, wanted.picture),
    )


def _look(seen: np.ndarray, wanted: np.ndarray) -> Look:
    exposure = float(np.vdot(seen, wanted) / np.vdot(seen, seen))
    return Look(seen, exposure, float(np.linalg.norm(exposure * seen - wanted) / np.linalg.norm(wanted)))


def _bounced(T: Transport, wanted: np.ndarray) -> np.ndarray:
    """What is seen when the walls' colours are undone but no bounces: T F^-1 target = S target."""
    columns = wanted.reshape(-1, 3).T
    seen = [np.asarray(S @ column) for S, column in zip(T.systems, columns, strict=True)]
    return np.stack(seen, axis=-1).reshape(wanted.shape)


def _bounce_errors(scene: Scene, pattern: np.ndarray, separation: Separation) -> tuple[float, ...]:
    """Relative error of each bounce against A^k F pattern, made of the scene's own form factors."""
    errors, truth = [], scene.albedo * pattern.reshape(-1, 3).T
    for found in (separation.direct, *separation.bounces):
        difference = found.reshape(-1, 3).T - truth
        errors.append(float(np.linalg.norm(difference) / np.linalg.norm(truth)))
        truth = scene.albedo * (truth @ scene.form_factors.T)
    return tuple(errors)


def _race(T: Transport, channel: int, wanted: np.ndarray) -> dict[str, Solution]:
    """Every method on the channel with the strongest interreflection; one that fails is shown, too."""
    S, b = T.systems[channel], wanted.reshape(-1, 3)[:, channel]
    return {
        method: solve(S, b, method, rtol=_RACE_RTOL, maxiter=_RACE_LENGTH, throw=False)
        for method in ("chebyshev", "jacobi", "neumann", "direct")
    }
