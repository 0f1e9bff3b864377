# SPDX-License-Identifier: BSD-3-Clause
"""`MapLoss`: the error that static files leave, beside that of ltcl.

Light between walls depends on the picture, which no map or mask can hold. For a landscape t at the
largest gain g that ltcl reaches, the errors ||T p - g t|| / ||g t|| are compared of patterns

    p = s t              maps alone
    p = s t / F          maps, and the direct light F of each pixel undone
    p of ltcl.compensate

each within [0, 1], and the first two with the scale s of the least error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltcl.scenes import landscape
from ltcl.tasks.compensation import compensate
from ltcl.transport.transport import Transport

# The darkest and the brightest light of the landscape.
DARKEST = 0.2
BRIGHTEST = 0.8
# Scales that are tried, from the largest one down.
SCALES = 24
SCALE_FACTOR = 0.9


@dataclass(frozen=True, kw_only=True)
class MapLoss:
    """Relative errors of a landscape on the wall.

    Attributes
    ----------
    maps : float
        With maps alone.
    direct : float
        With the direct light of each pixel undone, too.
    ltcl : float
        With `ltcl.compensate`.
    """

    maps: float
    direct: float
    ltcl: float

    @classmethod
    def measure(cls, T: Transport) -> MapLoss:
        """Compare the three for a square T."""
        height, width = T.camera_grid
        picture = DARKEST + (BRIGHTEST - DARKEST) * landscape(height, width)
        if T.channels == 1:
            picture = picture.mean(axis=-1)
        picture = picture.astype(np.float32)
        compensation = compensate(T, picture, gain="auto")
        is_lit = ~(T.masked | T.unlit)
        target = compensation.gain * picture
        first_bounce = np.atleast_2d(T.first_bounce).T.reshape(picture.shape)
        undone = np.where(first_bounce > 0.0, target / np.maximum(first_bounce, 1e-12), 0.0)
        return cls(
            maps=_least_error(T, picture, target, is_lit),
            direct=_least_error(T, undone, target, is_lit),
            ltcl=_error(compensation.appearance, target, is_lit),
        )


def _least_error(T: Transport, light: np.ndarray, target: np.ndarray, lit: np.ndarray) -> float:
    """The least error of patterns that are `light` times a scale, clipped to [0, 1]."""
    pattern = light / light.max()
    errors = []
    scale = 1.0 / SCALE_FACTOR**4
    for _ in range(SCALES):
        shown = T @ np.clip(scale * pattern, 0.0, 1.0).astype(np.float32)
        errors.append(_error(shown, target, lit))
        scale *= SCALE_FACTOR
    return min(errors)


def _error(shown: np.ndarray, target: np.ndarray, lit: np.ndarray) -> float:
    is_lit = lit.reshape(target.shape[:2])
    difference = (shown - target)[is_lit]
    return float(np.linalg.norm(difference) / np.linalg.norm(target[is_lit]))
