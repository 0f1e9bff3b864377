# SPDX-License-Identifier: BSD-3-Clause
"""What a compensation returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltcl.solvers import Bounded, Solution


@dataclass(frozen=True, repr=False)
class Compensation:
    """Result of `ltcl.compensate`. Pictures are linear, float32, of the frames and colours of `desired`.

    Attributes
    ----------
    pattern : array
        Linear projector light within the bounds, on the projector's grid; 0 at masked pixels.
    appearance : array
        T pattern + background: what the camera will see, on its grid.
    gain : float
        The target was gain * desired.
    clipped : float
        Fraction of pattern values that a bound keeps from going beyond it.
    target : array
        gain * desired.
    out_of_reach : array
        target - appearance, 0 where that is within the solve's tolerance of the brightest target: where the
        projector's limits keep the scene too dark (positive) or too bright (negative).
    error : float
        ``||W (appearance - target)|| / ||W target||`` of all frames and colours together.
    gap : float
        What the error is above the least that the bounds allow, at most: a bound that was computed for this
        result. Relative to gain * desired - background, of the worst frame and colour.
    solution : Solution or tuple of 3
        What the light would be without bounds, one per channel of the transport; of a T without S, `limited`.
    limited : tuple of Bounded
        The solves within the bounds; empty where the bounds cost nothing. Their products are those of the
        search for a gain, too.
    """

    pattern: np.ndarray
    appearance: np.ndarray
    gain: float
    clipped: float
    target: np.ndarray
    out_of_reach: np.ndarray
    error: float
    gap: float
    solution: Solution | tuple[Solution, ...]
    limited: tuple[Bounded, ...]

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.pattern.shape))
        return f"<ltcl Compensation {shape}, off by {self.error:.2%}, {self.clipped:.2%} clipped>"
