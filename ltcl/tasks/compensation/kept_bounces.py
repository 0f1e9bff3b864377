# SPDX-License-Identifier: BSD-3-Clause
"""The light of bounces of one frame, which stands for that of the frames after it.

Direct light is x = S^-1 b = b + e for the light b to add: e takes off what bounces. It is smooth,
and changes less from frame to frame than b. A frame in between takes the e of an earlier b', and

    S (b + e') = b + R (b - b'),

so that its error is the light that bounces of the change since then; there is none in a still film.
As e is linear in b = gain * light - background, it is kept without the share of the background, and
scaled by the gain.
"""

from __future__ import annotations

from ltcl.device import Array, vectors
from ltcl.device.kernels import Queued, in_order


class KeptBounces:
    """The light of bounces of every n-th frame.

    Parameters
    ----------
    every : int
        n, from one frame whose bounces are computed to the next.
    target, direct : Array
        b and x of the last frame.
    background : Array, optional
        e of the background alone.

    Attributes
    ----------
    light : Array
        e + `background` of the frame that was kept, in proportion to its gain.
    background : Array, optional
    """

    def __init__(self, every: int, target: Array, direct: Array, background: Array | None) -> None:
        self._every = every
        self.light = direct.like()
        self.background = background
        launches: list[Queued] = [vectors.bind_axpby(1.0, direct, -1.0, target, self.light)]
        if background is not None:
            launches.append(vectors.bind_axpby(1.0, background, 1.0, self.light, self.light))
        self._keep = in_order(launches)
        self._gain = 1.0
        self._age = every

    @property
    def are_due(self) -> bool:
        """True if the bounces of the next frame are to be computed."""
        return self._age >= self._every

    def keep(self, gain: float) -> None:
        """Queue the launches that keep the bounces of the last frame, which has this gain."""
        self._keep()
        self._gain = gain
        self._age = 1

    def reuse(self, gain: float) -> float:
        """The factor of `light` in a frame in between, which has this gain."""
        self._age += 1
        return gain / self._gain

    def forget(self) -> None:
        """Let the bounces of the next frame be computed."""
        self._age = self._every
