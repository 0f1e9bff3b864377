# SPDX-License-Identifier: BSD-3-Clause
"""The boxes of figures 4 to 6, their light in float64, and ways to take the bounces out of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import ltcl
from _coefficients import relative_error
from ltcl.scenes import Scene, box
from ltcl.scenes.camera import SceneCamera
from ltcl.solvers import Solution, Status

NEUTRAL, FLOOR = (1, 2, 3, 5), 2  # walls, in the order of `box`: the first is red, the fifth green
ALBEDO = (
    (0.49, 0.06, 0.06),
    *(3 * (grey,) for grey in (0.45, 0.49, 0.42)),
    (0.06, 0.49, 0.06),
    3 * (0.47,),
)
LIGHT = (1.0, 0.8, 0.5, 1.0, 1.0, 0.8)  # on each wall
RTOL = 1e-2  # residual at which a solve counts as done


def coloured_box(n: int) -> tuple[Scene, np.ndarray]:
    """The closed box, n x n patches a wall, and its direct light l_d, (3, N)."""
    scene = from_the_front(box(n, sides=6, albedo=ALBEDO))
    return scene, scene.albedo * np.broadcast_to(np.array(LIGHT)[:, None], (n, 6, n)).reshape(-1)


def from_the_front(scene: Scene) -> Scene:
    """The scene seen through its sixth wall, the red one on the left and the green one on the right."""
    return replace(scene, viewer=SceneCamera(eye=(2.36, 0.5, 0.52), target=(0, 0.5, 0.52)))


def bounce(scene: Scene, light: np.ndarray) -> np.ndarray:
    """A l of (channels, N) in float64: one bounce further (eq. 4)."""
    return scene.albedo * (light @ scene.form_factors.T)


def all_bounces(scene: Scene, l_d: np.ndarray) -> np.ndarray:
    """l_out = (I - A)^-1 l_d of (channels, N) in float64 (eq. 5)."""
    system = np.eye(l_d.shape[-1]) - scene.albedo[:, :, None] * scene.form_factors
    return np.linalg.solve(system, l_d[..., None])[..., 0]


def terms(systems: Sequence[Any], l_out: np.ndarray, count: int) -> np.ndarray:
    """Terms (-R)^k l_out for k = 0 .. count, (count + 1, channels, N), by products with S = I + R."""
    found = [l_out]
    for _ in range(count):
        found.append(found[-1] - np.stack([S @ l for S, l in zip(systems, found[-1], strict=True)]))
    return np.stack(found)


def light_room(
    room: Scene, lamp: Any, device: ltcl.Device
) -> tuple[Scene, np.ndarray, Any, np.ndarray]:
    """A room from the front, its direct light under a lamp (channels, N), S of each channel, the picture."""
    scene = from_the_front(room)
    l_d = scene.albedo * scene.irradiance(lamp).reshape(-1)
    return scene, l_d, scene.transport(scene.first_bounce, device).systems, all_bounces(scene, l_d)


@dataclass(frozen=True)
class Race:
    """A box undone by the paper's iteration (Jacobi, eq. 20) and by Chebyshev's; `error` is the latter's."""

    name: str
    rho: float
    jacobi: Solution
    chebyshev: Solution
    error: float

    def steps(self) -> float:
        """Jacobi iterations until the residual is below 1 %; infinite where it never is."""
        return next((k for k, value in enumerate(self.jacobi.residuals) if value <= RTOL), math.inf)

    @property
    def diverged(self) -> bool:
        """Whether Jacobi did."""
        return self.jacobi.status is Status.DIVERGED

    @property
    def outcome(self) -> str:
        """How Jacobi ended."""
        end = "diverges" if self.diverged else f"1 % in {self.steps()} iterations"
        return f"rho(R) = {self.rho:.3f}, {end}"


def race(name: str, n: int, sides: int, albedo: float, device: ltcl.Device) -> Race:
    """Undo the bounces in a box under light that is constant on each wall."""
    scene = box(n, sides=sides, albedo=albedo)
    l_d = albedo * np.broadcast_to(np.array(LIGHT[:sides])[:, None], (n, sides, n)).reshape(-1)
    (S,) = scene.transport(first_bounce=scene.first_bounce, device=device).systems
    (l_out,) = all_bounces(scene, l_d[None])
    jacobi, chebyshev = (
        ltcl.solve(S, l_out, m, rtol=1e-5, throw=False) for m in ("jacobi", "chebyshev")
    )
    rho_a = albedo * float(np.linalg.eigvalsh(scene.form_factors)[-1])
    return Race(name, rho_a / (1 - rho_a), jacobi, chebyshev, relative_error(chebyshev.x, l_d))
