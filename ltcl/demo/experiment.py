# SPDX-License-Identifier: BSD-3-Clause
"""The demo's experiment: a corner of three bright, differently coloured walls, lit in three ways.

Each patch of the walls has 8 x 8 pixels. Light bounces between patches, and is interpolated
between their middles (`ltcl.scenes.RefinedScene`): T has no more numbers than that of the patches.

In red all three walls are so bright that rho(R) > 1: there the paper's iteration diverges, and
Chebyshev with the free bounds does not. The target is a sunset in just as much mist as the corner
makes necessary: no projector can make a place darker than the light that bounces into it from the
rest of the picture. With x = S^-1 picture and y = S^-1 mist, (N,) a channel, a target picture + b
mist asks for the direct light x + b y; cutting off where that is negative changes what is seen by
S min(x + b y, 0). The smallest b for which this stays below one percent is found by bisection,
with a product a step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ltcl import scenes
from ltcl.scenes import RefinedScene
from ltcl.scenes.landscape import SUN
from ltcl.solvers import Solution, solve
from ltcl.tasks.analysis import Analysis, analyze
from ltcl.tasks.compensation import Compensation, compensate
from ltcl.tasks.separation import Separation, separate
from ltcl.transport.transport import Transport

ALBEDO = ((0.97, 0.25, 0.15), (0.96, 0.80, 0.30), (0.97, 0.45, 0.80))
"""Red, green, blue of the left wall, the right wall and the floor."""

COLOURS = ("red", "green", "blue")
# Pixels along a patch.
DETAIL = 8
COMPENSATION_STEPS = ("the room", "its light transport", "the target", "compensation")
STEPS_AFTER_IT = ("analysis", "bounces", "convergence")
RTOL = 1e-3
# It needs no measured speeds of the device and few kernels, all of which have to be compiled before
# the first picture.
FIRST_METHOD = "gmres"
BOUNCES = 4
# Each bounce inherits the errors of those before it.
BOUNCE_RTOL = 1e-4
# The race of methods goes on until one can see where each of them goes.
RACE_METHODS = ("chebyshev", "gmres", "jacobi", "neumann")
RACE_RTOL = 1e-5
RACE_LENGTH = 60
# Share of the target that the projector's black may cost.
MAX_LOSS = 0.01
BISECTION_STEPS = 10
# Mist: its colour, lit by the sun; its share far from the corner; where it thins out, in heights.
MIST_COLOUR = (1.00, 0.80, 0.65)
MIST_OUTSIDE = 0.3
MIST_RADIUS = 0.35
VIEW_HEIGHT = 640
PANORAMA_WIDTH = 1024


@dataclass(frozen=True, kw_only=True)
class Look:
    """Scene under one pattern.

    At `exposure` it comes closest to the target, to the relative `error`.
    """

    seen: np.ndarray
    exposure: float
    error: float


@dataclass(frozen=True, kw_only=True)
class CompensatedCorner:
    """The corner before and after compensation: pictures are linear, (h, w, 3), on its walls."""

    scene: RefinedScene
    T: Transport
    target: np.ndarray
    mist: float
    compensation: Compensation
    looks: dict[str, Look]


@dataclass(frozen=True, kw_only=True)
class Experiment:
    """All results: the compensated `corner`, and its light taken apart.

    `worst` is the channel of `race`.
    """

    corner: CompensatedCorner
    analysis: Analysis
    bounces: list[np.ndarray]
    bounce_errors: list[float]
    worst: int
    race: dict[str, Solution]


class Target(NamedTuple):
    """Picture (h, w, 3), its share of mist, and the brightest projector light it asks for."""

    picture: np.ndarray
    mist: float
    brightest: float


def compensate_corner(size: int, device: Any, begin: Callable[[str], object]) -> CompensatedCorner:
    """Compensate a picture; `begin` is called with each of `COMPENSATION_STEPS`."""
    room, transport, target_step, compensation_step = COMPENSATION_STEPS
    begin(room)
    scene = scenes.refine(scenes.box(size, sides=3, albedo=ALBEDO), DETAIL)
    begin(transport)
    T = scene.transport(device)

    begin(target_step)
    target = reachable_target(scene, T)

    begin(compensation_step)
    gain = 1.0 / target.brightest
    compensation = compensate(T, target.picture, gain=gain, method=FIRST_METHOD, rtol=RTOL)
    columns = target.picture.reshape(-1, 3).T
    # Where the walls' colours are undone but no bounces, T F^-1 target = S target is seen.
    undone = [np.asarray(S @ column) for S, column in zip(T.systems, columns, strict=True)]
    pictures = {
        "uncompensated": T @ target.picture,
        "colours_only": np.stack(undone, axis=-1).reshape(target.picture.shape),
        "compensated": compensation.appearance,
    }
    return CompensatedCorner(
        scene=scene,
        T=T,
        target=target.picture,
        mist=target.mist,
        compensation=compensation,
        looks={name: look_at(seen, target.picture) for name, seen in pictures.items()},
    )


def take_apart(corner: CompensatedCorner, begin: Callable[[str], object]) -> Experiment:
    """Explain the corner's light; `begin` is called with each of `STEPS_AFTER_IT`."""
    analysis_step, bounces_step, convergence = STEPS_AFTER_IT
    T = corner.T
    begin(analysis_step)
    analysis = analyze(T, rtol=RTOL)

    begin(bounces_step)
    uncompensated = corner.looks["uncompensated"].seen
    separation = separate(T, uncompensated, BOUNCES, rtol=BOUNCE_RTOL)

    begin(convergence)
    radii = [channel.spectral_radius for channel in analysis.channels]
    worst = int(np.argmax(radii))
    race = {}
    for name in RACE_METHODS:  # a method that fails is shown, too
        race[name] = solve(
            T.systems[worst],
            corner.target[..., worst].ravel(),
            name,
            rtol=RACE_RTOL,
            maxiter=RACE_LENGTH,
            throw=False,
        )
    return Experiment(
        corner=corner,
        analysis=analysis,
        bounces=[separation.direct, *separation.bounces],
        bounce_errors=bounce_errors(corner.scene, corner.target, separation),
        worst=worst,
        race=race,
    )


def look_at(seen: np.ndarray, target: np.ndarray) -> Look:
    """Compare what is seen with the target, at the exposure where it comes closest."""
    exposure = float(np.vdot(seen, target) / np.vdot(seen, seen))
    difference = np.linalg.norm(exposure * seen - target)
    error = float(difference / np.linalg.norm(target))
    return Look(seen=seen, exposure=exposure, error=error)


def bounce_errors(scene: RefinedScene, pattern: np.ndarray, separation: Separation) -> list[float]:
    """Relative error of each bounce against A^k F pattern, by the form factors of the scene.

    It is computed in float64 on the host, without T.
    """
    errors = []
    truth = scene.albedo * pattern.reshape(-1, 3).T
    for bounce in (separation.direct, *separation.bounces):
        difference = np.linalg.norm(bounce.reshape(-1, 3).T - truth)
        errors.append(float(difference / np.linalg.norm(truth)))
        truth = np.stack([A @ light for A, light in zip(scene.bounces, truth, strict=True)])
    return errors


def reachable_target(scene: RefinedScene, T: Transport) -> Target:
    """A sunset that looks flat to the viewer, in as little mist as the projector can do with."""
    sunset, mist = (scene.sample(picture) for picture in sunset_and_mist())
    parts = np.stack([sunset, mist], axis=-1).reshape(-1, 3, 2)
    columns = parts.transpose(1, 0, 2).astype(np.float64)  # (3, N, 2)
    light = []
    for S, pictures in zip(T.systems, columns, strict=True):
        # One by one: kernels for two at once would be compiled for this alone.
        solutions = [solve(S, picture, FIRST_METHOD, rtol=RTOL).x for picture in pictures.T]
        light.append(np.stack(solutions, axis=-1).astype(np.float64))

    too_little = 0.0
    enough = 1.0
    for _ in range(BISECTION_STEPS):
        share = (too_little + enough) / 2
        loss = lost_light(T, light, share)
        if loss < MAX_LOSS * np.linalg.norm(columns @ (1.0, share)):
            enough = share
        else:
            too_little = share

    brightest = []
    for x, F in zip(light, T.first_bounce, strict=True):
        pattern = x @ (1.0, enough) / F
        brightest.append(float(pattern.max()))
    picture = sunset + np.float32(enough) * mist
    return Target(picture, enough, max(brightest))


def lost_light(T: Transport, light: list[np.ndarray], share: float) -> float:
    """Norm of what is seen less where direct light (N, 2), of picture and mist, is cut off at 0."""
    lost = []
    for S, x in zip(T.systems, light, strict=True):
        cut_off = np.minimum(x @ (1.0, share), 0.0)
        lost.append(np.asarray(S @ cut_off))
    return float(np.linalg.norm(np.stack(lost)))


def sunset_and_mist() -> tuple[np.ndarray, np.ndarray]:
    """Two square pictures, as the viewer is to see them; the sun is in the middle column."""
    panorama = scenes.landscape(VIEW_HEIGHT, PANORAMA_WIDTH)
    left = round(SUN[0] * PANORAMA_WIDTH - VIEW_HEIGHT / 2)
    sunset = panorama[:, left : left + VIEW_HEIGHT]
    place = (np.arange(VIEW_HEIGHT) + 0.5) / VIEW_HEIGHT - 0.5
    squared_distance = place**2 + place[:, None] ** 2
    # Thickest in the middle, where the walls meet and most light comes back.
    thickness = np.exp(-squared_distance / MIST_RADIUS**2)[..., None]
    density = MIST_OUTSIDE + (1 - MIST_OUTSIDE) * thickness
    mist = density * np.array(MIST_COLOUR) * (1.0 - sunset)
    return sunset, mist
