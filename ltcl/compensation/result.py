# SPDX-License-Identifier: BSD-3-Clause
"""What a compensation returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltcl.exact import itself
from ltcl.solvers import Bounded, Solution


@dataclass(frozen=True, repr=False, eq=False)
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
        Fraction of pattern values that are at a bound and would lower the error beyond it; masked pixels do
        not count.
    target : array
        gain * desired.
    out_of_reach : array
        target - appearance where the projector's limits keep the scene too dark (positive) or too bright
        (negative). 0 where nothing is clipped; else 0 where a solve's tolerance explains it: where weight *
        abs(target - appearance) is at most 3 times what ``max(rtol ||W target||, atol)`` of this frame and
        colour makes in the root mean square. So it is 0 where the weight is.
    error : float
        ``||W (appearance - target)|| / ||W target||`` of all frames and colours together, with the T that was
        given, or `exact` where that was: what `transport_error` tells of that T is not in it.
    gap : float
        What the error is above the least that the bounds allow, at most: no pattern within them has an error
        below error - gap. A bound that was computed for this result.
    frame_errors, frame_clipped : (frames,) float64
        `error` and `clipped` of each frame by itself; of a single picture, one value.
    solution : Solution or tuple of 3
        What the light would be without bounds, one per channel of the transport; of a T without S, `limited`.
    limited : tuple of Bounded
        The solves within the bounds; empty where the bounds cost nothing. Their products are those of the
        search for a gain, too.
    transport_error : float
        ``.error`` of that T: what a compressed one may be off by itself, 0 of others. The scene may look that
        much farther from the target, in relation to T pattern.
    """

    pattern: np.ndarray
    appearance: np.ndarray
    gain: float
    clipped: float
    target: np.ndarray
    out_of_reach: np.ndarray
    error: float
    gap: float
    frame_errors: np.ndarray
    frame_clipped: np.ndarray
    solution: Solution | tuple[Solution, ...]
    limited: tuple[Bounded, ...]
    transport_error: float = 0.0

    def __repr__(self) -> str:
        shape = " x ".join(map(str, self.pattern.shape))
        off = f"off by {self.error:.2%}{itself(self.transport_error)}"
        return f"<ltcl Compensation {shape}, {off}, {self.clipped:.2%} clipped>"
