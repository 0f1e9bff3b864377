# SPDX-License-Identifier: BSD-3-Clause
"""Boxes of figures 4 to 6, their light in float64, and ways to take the bounces out of it."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import ltcl
from _coefficients import relative_error
from ltcl.scenes import Scene, box
from ltcl.scenes.camera import SceneCamera
from ltcl.solvers import Solution, Status

# Walls, in the order of `box`: the first is red, the fifth green.
NEUTRAL = (1, 2, 3, 5)
FLOOR = 2
ALBEDO = (
    (0.49, 0.06, 0.06),
    (0.45, 0.45, 0.45),
    (0.49, 0.49, 0.49),
    (0.42, 0.42, 0.42),
    (0.06, 0.49, 0.06),
    (0.47, 0.47, 0.47),
)
# Light on each wall.
LIGHT = (1.0, 0.8, 0.5, 1.0, 1.0, 0.8)
# Residual at which a solve counts as done.
RTOL = 1e-2


def coloured_box(n: int) -> tuple[Scene, np.ndarray]:
    """Return the closed box, n x n patches a wall, and its direct light l_d, (3, N)."""
    scene = from_the_front(box(n, sides=6, albedo=ALBEDO))
    return scene, scene.albedo * light_on_walls(n, 6)


def light_on_walls(n: int, sides: int) -> np.ndarray:
    """Light on the patches of a box, (N,), constant on each wall."""
    levels = np.array(LIGHT[:sides])
    return np.broadcast_to(levels[:, None], (n, sides, n)).reshape(-1)


def from_the_front(scene: Scene) -> Scene:
    """Return the scene seen through its sixth wall, the red one left and the green one right."""
    return replace(scene, viewer=SceneCamera(eye=(2.36, 0.5, 0.52), target=(0, 0.5, 0.52)))


def bounce(scene: Scene, light: np.ndarray) -> np.ndarray:
    """Return A l of (channels, N) in float64: one bounce further (eq. 4)."""
    return scene.albedo * (light @ scene.form_factors.T)


def all_bounces(scene: Scene, l_d: np.ndarray) -> np.ndarray:
    """Return l_out = (I - A)^-1 l_d of (channels, N) in float64 (eq. 5)."""
    bounced = scene.albedo[:, :, None] * scene.form_factors
    system = np.eye(l_d.shape[-1]) - bounced
    return np.linalg.solve(system, l_d[..., None])[..., 0]


def terms(systems: Sequence[Any], l_out: np.ndarray, count: int) -> np.ndarray:
    """Return terms (-R)^k l_out for k = 0 .. count, (count + 1, channels, N).

    -R l = l - S l, by a product with S = I + R in each channel.
    """
    powers = [l_out]
    for _ in range(count):
        power = powers[-1]
        products = list(map(operator.matmul, systems, power))
        powers.append(power - np.stack(products))
    return np.stack(powers)


def light_room(
    room: Scene, lamp: Any, device: ltcl.Device
) -> tuple[Scene, np.ndarray, Any, np.ndarray]:
    """Light a room by a lamp, and see it from the front.

    Returns the scene, its direct light (channels, N), S of each channel, and the picture.
    """
    scene = from_the_front(room)
    l_d = scene.albedo * scene.irradiance(lamp).reshape(-1)
    transport = scene.transport(scene.first_bounce, device)
    return scene, l_d, transport.systems, all_bounces(scene, l_d)


@dataclass(frozen=True, kw_only=True)
class Race:
    """The paper's iteration (Jacobi, eq. 20) beside Chebyshev's, on the bounces in a box.

    `error` is that of Chebyshev's solution.
    """

    name: str
    rho: float
    jacobi: Solution
    chebyshev: Solution
    error: float

    def steps(self) -> float:
        """Jacobi iterations until the residual is below 1 %; infinite if it never is."""
        for step, residual in enumerate(self.jacobi.residuals):
            if residual <= RTOL:
                return step
        return math.inf

    @property
    def diverged(self) -> bool:
        """Whether Jacobi diverged."""
        return self.jacobi.status is Status.DIVERGED

    @property
    def outcome(self) -> str:
        """End of Jacobi's iterations, in words."""
        end = f"1 % in {self.steps()} iterations"
        if self.diverged:
            end = "diverges"
        return f"rho(R) = {self.rho:.3f}, {end}"


def race(name: str, n: int, sides: int, albedo: float, device: ltcl.Device) -> Race:
    """Undo the bounces in a box under light that is constant on each wall."""
    scene = box(n, sides=sides, albedo=albedo)
    l_d = albedo * light_on_walls(n, sides)
    F = scene.first_bounce
    transport = scene.transport(first_bounce=F, device=device)
    (S,) = transport.systems
    (l_out,) = all_bounces(scene, l_d[None])
    jacobi = ltcl.solve(S, l_out, "jacobi", rtol=1e-5, throw=False)
    chebyshev = ltcl.solve(S, l_out, "chebyshev", rtol=1e-5, throw=False)
    rho_a = albedo * float(np.linalg.eigvalsh(scene.form_factors)[-1])
    return Race(
        name=name,
        rho=rho_a / (1 - rho_a),
        jacobi=jacobi,
        chebyshev=chebyshev,
        error=relative_error(chebyshev.x, l_d),
    )
