# SPDX-License-Identifier: BSD-3-Clause
"""A box lower <= x <= upper on a device: the kernels of `bounded.cl`.

Numbers of each column come back as (k,) float64, added up on the host from at most 64 slices.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ltcl.device import Array, Device
from ltcl.device.kernels import Kernel

_SLICES = 64  # as of a dot product


class Look(NamedTuple):
    """Of a point: its Frank-Wolfe gap, and inner products of z, the free part of -g."""

    gap: np.ndarray
    zz: np.ndarray
    zh: np.ndarray
    zd: np.ndarray


class Direction(NamedTuple):
    """Of a direction d: slope g.d, square d.d, and how many times d the point may go."""

    slope: np.ndarray
    square: np.ndarray
    room: np.ndarray


@dataclass(frozen=True)
class Box:
    """Bounds (N,) that all columns share."""

    lower: Array
    upper: Array

    @property
    def device(self) -> Device:
        """Where it lies."""
        return self.lower.device

    def look(self, x: Array, g: Array, d: Array, h: Array) -> Look:
        """What certifies `x`, where the gradient is `g`, and what the next direction needs."""
        sums = self._reduced("bounded_look", 4, x, (self.lower, self.upper, x, g, d, h))
        return Look(*np.moveaxis(sums.sum(axis=0), -1, 0))

    def direction(self, alpha: np.ndarray, beta: np.ndarray, x: Array, g: Array, d: Array) -> Direction:
        """d = clip(x + alpha (z + beta d)) - x with (k,) coefficients."""
        ab = self.device.upload(np.stack([alpha, beta]).astype(np.float32))
        found = self._reduced("bounded_direction", 3, x, (ab, self.lower, self.upper, x, g, d))
        slope, square = found[..., 0].sum(axis=0), found[..., 1].sum(axis=0)
        share = found[..., 2].max(axis=0)
        with np.errstate(divide="ignore"):
            return Direction(slope, square, np.maximum(1.0 / share, 1.0))

    def move(self, step: np.ndarray, d: Array, x: Array) -> None:
        """x = clip(x + step d) with (k,) steps."""
        kernel = self.device.kernel("bounded", "bounded_move")
        steps = self.device.upload(np.asarray(step, np.float32))
        group = min(256, kernel.largest_group())
        kernel(x.size, group, x.size, x.columns, steps, self.lower, self.upper, d, x)

    def _reduced(self, name: str, numbers: int, x: Array, arguments: tuple[Array, ...]) -> np.ndarray:
        """What each slice of the rows leaves, (slices, k, numbers) float64."""
        kernel: Kernel = self.device.kernel("bounded", name)
        rows, k = x.shape[0], x.columns
        group = min(64 if self.device.is_cpu else 256, kernel.largest_group())
        slices = min(_SLICES, max(1, -(-rows // group)))
        out = self.device.empty((slices, k, numbers))
        kernel((slices * group, k), (group, 1), rows, k, *arguments, out, self.device.local(group))
        return out.get().astype(np.float64)
