# SPDX-License-Identifier: BSD-3-Clause
"""The picture that the demo wants to see: a sunset, in just as much mist as the corner makes necessary.

No projector can make a place darker than the light that bounces into it from the rest of the picture. With
x = S^-1 picture and y = S^-1 mist, (N,) a channel, a target picture + b mist asks for the direct light
x + b y; cutting off where that is negative changes what is seen by S min(x + b y, 0). The smallest b for
which this stays below one percent is found by bisection, a product a step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltcl import scenes
from ltcl.scenes import Scene
from ltcl.solvers import solve
from ltcl.transport import Transport

_LOST = 0.01  # of the target, what the projector's black may cost
_COLOUR = (1.00, 0.80, 0.65)  # of the mist, lit by the sun
_OUTSIDE, _RADIUS = 0.3, 0.35  # share of the mist far from the corner; where it has thinned out, in heights
_SUN = (0.64, 0.43)  # its place in `scenes.landscape`, in widths and heights


@dataclass(frozen=True)
class Target:
    """`picture` (h, w, 3) on the walls, the share of `mist` in it, the `brightest` light it asks for."""

    picture: np.ndarray
    mist: float
    brightest: float


def reachable(scene: Scene, T: Transport, rtol: float) -> Target:
    """A sunset that looks flat to the viewer of `scene` and asks for (almost) no negative light."""
    image = _sunset()
    sides = [scene.sample(part) for part in (image, _mist(*image.shape[:2]) * (1.0 - image))]
    columns = np.stack(sides, axis=-1).reshape(-1, 3, 2).transpose(1, 0, 2).astype(np.float64)  # (3, N, 2)
    light = [solve(S, b, rtol=rtol).x.astype(np.float64) for S, b in zip(T.systems, columns, strict=True)]
    low, high = 0.0, 1.0
    for _ in range(10):
        b = (low + high) / 2
        low, high = (low, b) if _lost(T, columns, light, b) < _LOST else (b, high)
    pattern = T.to_light([x @ (1.0, high) for x in _columns(light)])
    picture = sides[0] + np.float32(high) * sides[1]
    return Target(picture, high, max(float(part.max()) for part in pattern))


def _columns(light: list[np.ndarray]) -> list[np.ndarray]:
    """(N, 2) as (N, 1, 2), so that mixing the last axis leaves one column."""
    return [x[:, None, :] for x in light]


def _lost(T: Transport, columns: np.ndarray, light: list[np.ndarray], b: float) -> float:
    """``||S min(x + b y, 0)|| / ||picture + b mist||`` over all colours."""
    lost = [np.asarray(S @ np.minimum(x @ (1.0, b), 0.0)) for S, x in zip(T.systems, light, strict=True)]
    return float(np.linalg.norm(np.stack(lost)) / np.linalg.norm(columns @ (1.0, b)))


def _sunset(height: int = 900) -> np.ndarray:
    """A square piece of `scenes.landscape` with the sun in its middle column."""
    wide = scenes.landscape(height, round(1.6 * height))
    left = round(_SUN[0] * wide.shape[1] - 0.5 * height)
    return wide[:, left : left + height]


def _mist(height: int, width: int) -> np.ndarray:
    """Mist (h, w, 3): thickest in the middle, where the walls meet and most light comes back."""
    x, y = ((np.arange(n) + 0.5) / n - 0.5 for n in (width, height))
    radius = np.hypot(x[None, :], y[:, None])[..., None]
    return (_OUTSIDE + (1 - _OUTSIDE) * np.exp(-((radius / _RADIUS) ** 2))) * np.array(_COLOUR)
