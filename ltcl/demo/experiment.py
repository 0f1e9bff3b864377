# SPDX-License-Identifier: BSD-3-Clause
"""What the demo computes: a corner of three bright, differently coloured walls, lit in three ways.

In red all three walls are so bright that rho(R) > 1: there the paper's iteration diverges, and
Chebyshev with the free bounds does not. The target is a sunset in just as much mist as the corner
makes necessary: no projector can make a place darker than the light that bounces into it from the
rest of the picture. With x = S^-1 picture and y = S^-1 mist, (N,) a channel, a target picture + b
mist asks for the direct light x + b y; cutting off where that is negative changes what is seen by S
min(x + b y, 0). The smallest b for which this stays below one percent is found by bisection, a
product a step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import scenes
from ltcl.scenes import Scene
from ltcl.scenes.landscape import SUN
from ltcl.solvers import Solution, auto, solve
from ltcl.tasks.analysis import Analysis, analyze
from ltcl.tasks.compensation import Compensation, compensate
from ltcl.tasks.separation import Separation, separate
from ltcl.transport.transport import Transport

ALBEDO = ((0.97, 0.25, 0.15), (0.96, 0.80, 0.30), (0.97, 0.45, 0.80))
"""Red, green, blue of the left wall, the right wall and the floor."""

COLOURS = ("red", "green", "blue")
STEPS = ("the room", "its light transport", "the target", "compensation", "bounces", "convergence")
RTOL = 1e-3
_BOUNCES = 4
_RACE_RTOL, _RACE_LENGTH = 1e-5, 60  # far enough to see where each method goes
_LOST = 0.01  # of the target, what the projector's black may cost
_MIST = (1.00, 0.80, 0.65)  # its colour, lit by the sun
_OUTSIDE, _RADIUS = (
    0.3,
    0.35,
)  # share of the mist far from the corner; where it has thinned out, in heights


@dataclass(frozen=True)
class Look:
    """What is seen under one pattern; at `exposure` it comes closest to the target, with relative `error`."""

    seen: np.ndarray
    exposure: float
    error: float


@dataclass(frozen=True)
class Experiment:
    """All results. Pictures are linear, (h, w, 3) on the walls' grid; `worst` is the channel of `race`."""

    scene: Scene
    T: Transport
    analysis: Analysis
    target: np.ndarray
    mist: float
    compensation: Compensation
    looks: dict[str, Look]
    bounces: list[np.ndarray]
    bounce_errors: list[float]
    worst: int
    race: dict[str, Solution]


def compute(size: int, device: Any, begin: Callable[[str], object]) -> Experiment:
    """Run everything; `begin` is called with each of `STEPS`."""
    steps = iter(STEPS)
    begin(next(steps))
    scene = scenes.box(size, sides=3, albedo=ALBEDO)
    begin(next(steps))
    T = scene.transport(first_bounce=scene.first_bounce, device=device)
    analysis = analyze(T, rtol=RTOL)
    begin(next(steps))
    target, mist, brightest = _reachable(scene, T)
    begin(next(steps))
    # What the demo is about, also where so few pixels would make "auto" factorize.
    method = "chebyshev" if T.shape[0] <= auto.SMALL else "auto"
    compensation = compensate(T, target, gain=1.0 / brightest, method=method, rtol=RTOL)
    channels = list(zip(T.systems, target.reshape(-1, 3).T, strict=True))
    # Where the walls' colours are undone but no bounces, T F^-1 target = S target is seen.
    colours_only = np.stack([np.asarray(S @ b) for S, b in channels], axis=-1).reshape(target.shape)
    pictures = {
        "uncompensated": T @ target,
        "colours_only": colours_only,
        "compensated": compensation.appearance,
    }
    begin(next(steps))
    separation = separate(T, pictures["uncompensated"], _BOUNCES, rtol=RTOL)
    begin(next(steps))
    worst = int(np.argmax([channel.spectral_radius for channel in analysis.channels]))
    S, b = channels[worst]
    return Experiment(
        scene=scene,
        T=T,
        analysis=analysis,
        target=target,
        mist=mist,
        compensation=compensation,
        looks={name: _look(seen, target) for name, seen in pictures.items()},
        bounces=[separation.direct, *separation.bounces],
        bounce_errors=_bounce_errors(scene, target, separation),
        worst=worst,
        race={  # a method that fails is shown, too
            name: solve(S, b, name, rtol=_RACE_RTOL, maxiter=_RACE_LENGTH, throw=False)
            for name in ("chebyshev", "jacobi", "neumann", "direct")
        },
    )


def _look(seen: np.ndarray, target: np.ndarray) -> Look:
    exposure = float(np.vdot(seen, target) / np.vdot(seen, seen))
    return Look(
        seen, exposure, float(np.linalg.norm(exposure * seen - target) / np.linalg.norm(target))
    )


def _bounce_errors(scene: Scene, pattern: np.ndarray, separation: Separation) -> list[float]:
    """Relative error of each bounce against A^k F pattern, made of the scene's own form factors."""
    errors, truth = [], scene.albedo * pattern.reshape(-1, 3).T
    for bounce in (separation.direct, *separation.bounces):
        errors.append(
            float(np.linalg.norm(bounce.reshape(-1, 3).T - truth) / np.linalg.norm(truth))
        )
        truth = scene.albedo * (truth @ scene.form_factors.T)
    return errors


def _reachable(scene: Scene, T: Transport) -> tuple[np.ndarray, float, float]:
    """A sunset that looks flat to the viewer, its share of mist, and the brightest light it asks for."""
    wide = scenes.landscape(640, 1024)
    left = round(SUN[0] * 1024 - 320)  # the sun is in the middle column
    sunset, place = wide[:, left : left + 640], (np.arange(640) + 0.5) / 640 - 0.5
    # Thickest in the middle, where the walls meet and most light comes back.
    thickness = np.exp(-(place**2 + place[:, None] ** 2) / _RADIUS**2)[..., None]
    mist = (_OUTSIDE + (1 - _OUTSIDE) * thickness) * np.array(_MIST) * (1.0 - sunset)
    sides = [scene.sample(picture) for picture in (sunset, mist)]
    columns = (
        np.stack(sides, axis=-1).reshape(-1, 3, 2).transpose(1, 0, 2).astype(np.float64)
    )  # (3, N, 2)
    light = [
        solve(S, b, rtol=RTOL).x.astype(np.float64) for S, b in zip(T.systems, columns, strict=True)
    ]
    low, high = 0.0, 1.0
    for _ in range(10):
        b = (low + high) / 2
        lost = [
            np.asarray(S @ np.minimum(x @ (1.0, b), 0.0))
            for S, x in zip(T.systems, light, strict=True)
        ]
        enough = np.linalg.norm(np.stack(lost)) < _LOST * np.linalg.norm(columns @ (1.0, b))
        low, high = (low, b) if enough else (b, high)
    pattern = [x @ (1.0, high) / F for x, F in zip(light, T.first_bounce, strict=True)]
    return (
        sides[0] + np.float32(high) * sides[1],
        high,
        max(float(colour.max()) for colour in pattern),
    )
