# SPDX-License-Identifier: BSD-3-Clause
"""Patches and opaque boxes as the kernels of form factors and visibility read them.

Kernels compute in float32, so lengths are counted from the middle of the scene in parts of its size: what
they return has no unit, or is turned back by the caller. Boxes are shrunk by a hair, so that light which
leaves a face of a box, or runs along it, is not blocked by that very box.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Array, Device
from ltcl.errors import InputError, InputTypeError
from ltcl.scenes.patches import Patches

_HAIR = 1e-5  # of the scene's size: above the rounding of coordinates, far below a patch


@dataclass(frozen=True)
class Frame:
    """Where the scene is, and the largest of its three extents."""

    middle: np.ndarray
    size: float

    @classmethod
    def of(cls, patches: Patches) -> Frame:
        """The frame of the box, along the axes, that holds all patches."""
        half = (np.abs(patches.right) + np.abs(patches.down)) / 2
        low, high = (patches.centre - half).min(axis=0), (patches.centre + half).max(axis=0)
        return cls((low + high) / 2, float((high - low).max()))

    def patches(self, patches: Patches) -> Patches:
        """The same patches, counted in this frame."""
        centre = (patches.centre - self.middle) / self.size
        return Patches(centre, patches.right / self.size, patches.down / self.size)

    def blocks(self, blocks: np.ndarray) -> np.ndarray:
        """Centre and half sides of boxes (B, 2, 3) in this frame, shrunk by a hair: (B, 6)."""
        low, high = ((blocks[:, end] - self.middle) / self.size for end in (0, 1))
        half = (high - low) / 2
        return np.concatenate([(low + high) / 2, half - np.minimum(_HAIR, half / 2)], axis=1)


def check_patches(patches: Any) -> Patches:
    """Return `patches` if they are some, finite and each with an area.

    Examples
    --------
    >>> point = np.zeros((1, 3))
    >>> check_patches(Patches(point, point, point))
    Traceback (most recent call last):
    ltcl.errors.InputError: patches has 1 without area, the first at 0; edges must span one
    """
    if not isinstance(patches, Patches):
        raise InputTypeError(
            f"patches is a {type(patches).__name__}; it must be ltcl.scenes.Patches, see ltcl.scenes.cut"
        )
    count = len(patches)
    if count < 1:
        raise InputError("patches are 0; there must be at least 1")
    for name in ("centre", "right", "down"):
        value = checks.real(f"patches.{name}", getattr(patches, name))
        checks.finite(f"patches.{name}", checks.shape(f"patches.{name}", value, (count, 3)))
    flat = np.flatnonzero(patches.area == 0)
    if len(flat):
        raise InputError(f"patches has {len(flat)} without area, the first at {flat[0]}; edges must span one")
    return patches


def check_blocks(blocks: Any) -> np.ndarray:
    """Return `blocks` as (B, 2, 3) float64, low and high corners of boxes; None is no box.

    Examples
    --------
    >>> check_blocks([[(0, 0, 0), (1, 1, 0)]])
    Traceback (most recent call last):
    ltcl.errors.InputError: blocks has a box from [0. 0. 0.] to [1. 1. 0.]; the first must be below
    """
    if blocks is None:
        return np.zeros((0, 2, 3))
    value = checks.finite("blocks", checks.real("blocks", blocks)).astype(np.float64)
    if value.size == 0:
        return np.zeros((0, 2, 3))
    if value.ndim != 3 or value.shape[1:] != (2, 3):
        raise InputError(f"blocks has shape {value.shape}; it must be (B, 2, 3), two corners of each box")
    bad = np.flatnonzero((value[:, 0] >= value[:, 1]).any(axis=1))
    if len(bad):
        low, high = value[bad[0]]
        raise InputError(f"blocks has a box from {low} to {high}; the first must be below")
    return value


def lanes(device: Device) -> int:
    """Neighbouring patches that one work-item handles together."""
    return 8 if device.is_cpu else 1


def padded(device: Device, rows: np.ndarray) -> Array:
    """Rows (m, N) on the device, with zeros behind each up to whole stretches of lanes."""
    more = -rows.shape[1] % lanes(device)
    return device.upload(np.pad(rows, ((0, 0), (0, more))))


def upload_blocks(device: Device, frame: Frame, blocks: np.ndarray) -> Array:
    """Boxes as kernels read them; where there are none, one that is never looked at: no buffer is empty."""
    return device.upload(frame.blocks(blocks) if len(blocks) else np.zeros((1, 6)))
