# SPDX-License-Identifier: BSD-3-Clause
"""The derivative of T p in the pattern p: T itself, whose adjoint is T^T.

The pattern lies in rows of pixels, frames and colours, the product in columns. A grey pattern
lights all channels of a T in colour; its derivative is the sum of theirs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ltcl import checks
from ltcl.interop.linear_map import Derivative, LinearMap
from ltcl.transport import frames as layout

if TYPE_CHECKING:
    from ltcl.transport.transport import Transport


class Relighting(Derivative):
    """The derivative of ``T @ pattern``."""

    def __init__(self, T: Transport, pattern: Any) -> None:
        self.source = pattern
        self._T = T
        self._layout = layout.find_layout("pattern", self.shape, T.grid, T.channels)
        self.out_shape = self._layout.shape(T.camera_grid)

    def linear_map(self, state: np.ndarray | None) -> LinearMap:
        """T, which has no state."""
        return LinearMap(
            shape=self.shape,
            out_shape=self.out_shape,
            forward=self._pictures,
            adjoint=self._patterns,
        )

    def _pictures(self, patterns: np.ndarray) -> np.ndarray:
        T = self._T
        # Where JAX traces the call, numbers are seen here at first.
        checks.finite("pattern", patterns)
        frames = self._layout.stacked(len(patterns))
        columns = frames.columns(patterns, T.shape[1], T.channels)
        return frames.pack(T.multiply(columns), T.camera_grid)

    def _patterns(self, pictures: np.ndarray) -> np.ndarray:
        T = self._T
        frames = self._layout.stacked(len(pictures))
        columns = frames.columns(pictures, T.shape[0], T.channels)
        patterns = frames.pack(T.multiply(columns, transpose=True), T.grid)
        return add_colours(patterns, len(pictures), self.shape)


def add_colours(pictures: np.ndarray, count: int, shape: tuple[int, ...]) -> np.ndarray:
    """Pictures as `count` of that shape; the sum of three colours where it has but one."""
    size = count * int(np.prod(shape))
    if pictures.size == size:
        return pictures.reshape(count, *shape)
    return pictures.sum(axis=-1).reshape(count, *shape)
