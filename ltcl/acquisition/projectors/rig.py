# SPDX-License-Identifier: BSD-3-Clause
"""`WarpedRig`: a rig that takes patterns on the pixels of T, which its projector shows warped."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from ltcl.acquisition.projectors.warp import Warp
from ltcl.acquisition.rig import Rig
from ltcl.transport.fingerprint import fingerprint


class WarpedRig:
    """A projector on the pixels of T; the camera, and all else, is that of `rig`.

    Examples
    --------
    >>> from ltcl.acquisition import VirtualRig
    >>> rig = VirtualRig(np.eye(4), (2, 2), response="linear", gain=None, read=0.0, black=0.0)
    >>> warped = WarpedRig(rig, Warp(np.array([[0, 0], [1, 1]]), (2, 1)))
    >>> warped.projector_grid, warped.photograph(np.array([[0.0], [1.0]]), 0.5).tolist()
    ((2, 1), [[0, 0], [128, 128]])
    """

    def __init__(self, rig: Rig, warp: Warp) -> None:
        self.rig = rig
        self.warp = warp
        self.projector_grid = warp.grid
        self.channels = rig.channels

    @property
    def lit(self) -> np.ndarray:
        """Pixels of T that the projector lights, (h, w) bool; others see what bounces."""
        return self.warp.lit

    def __getattr__(self, name: str) -> Any:
        """Members that not every rig has are those of the rig."""
        if name == "rig":
            # Not made yet, as when it is unpickled.
            raise AttributeError(name)
        return getattr(self.rig, name)

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        """A photograph of a pattern on the pixels of T."""
        return self.rig.photograph(self.warp.enlarged(codes), seconds)

    def prepare(self, shots: Iterable[tuple[np.ndarray, float]]) -> None:
        """Announce patterns to a rig that lists them."""
        prepare = getattr(self.rig, "prepare", None)
        if prepare is not None:
            prepare([(self.warp.enlarged(codes), seconds) for codes, seconds in shots])

    def recall(self, codes: np.ndarray, seconds: float, image: np.ndarray) -> None:
        """Hand a photograph of an earlier session to a rig that wants it."""
        recall = getattr(self.rig, "recall", None)
        if recall is not None:
            recall(self.warp.enlarged(codes), seconds, image)

    def radiance(self, codes: np.ndarray) -> np.ndarray:
        """The picture of a pattern in the camera of a simulated rig, without noise."""
        radiance: Any = self.rig
        return radiance.radiance(self.warp.enlarged(codes))

    def describe(self) -> dict[str, Any]:
        """The rig, and the warp."""
        rig: dict[str, Any] = {"kind": type(self.rig).__name__}
        describe = getattr(self.rig, "describe", None)
        if describe is not None:
            rig = describe()
        return {**rig, "warp": fingerprint(self.warp.places)}
