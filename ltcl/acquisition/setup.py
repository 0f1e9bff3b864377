# SPDX-License-Identifier: BSD-3-Clause
"""`Setup`: what the calibration in a store means for pictures on the pixels of its transport.

With p the light of a pattern, in [0, 1], x the codes that the projector is fed and a the ambient light,

    x = g^-1(p)                 of each channel, on the projector's own pixels
    picture = T p + a           in linear sensor value a second

where T is for light relative to white less black: a holds what a black projector sends as well.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.calibration import PREFIX, Calibration
from ltcl.acquisition.radiometry import Radiance
from ltcl.acquisition.scanning.block import Blocks
from ltcl.errors import InputError
from ltcl.store import BlockStore

_SEEN = 0.5  # of what a pixel is seen by: less of it valid tells nothing


@dataclass(frozen=True, eq=False)
class Setup:
    """A set-up that was measured, as the user of its transport needs it.

    Attributes
    ----------
    calibration : Calibration
    blocks : Blocks
        Of projector pixels, that the transport's pixels are.

    Examples
    --------
    >>> import tempfile, ltcl
    >>> from ltcl.acquisition import VirtualRig
    >>> rig, store = VirtualRig(np.eye(64) / 2, (8, 8), bits=12, ambient=0.1), f"{tempfile.mkdtemp()}/T.zarr"
    >>> T = ltcl.acquire(rig, geometry="aligned", strategy="pixel", store=store)
    >>> setup = Setup.of(store)
    >>> setup.codes(np.full(T.grid, 0.214)).mean().round(2)  # sRGB, as this rig has by default
    np.float32(0.5)
    >>> setup.ambient.shape
    (8, 8)
    """

    calibration: Calibration
    blocks: Blocks

    @classmethod
    def of(cls, store: str | os.PathLike[str] | BlockStore) -> Setup:
        """That of a store which `ltcl.acquire` made, or of the folder of one.

        Raises
        ------
        FileError
            It holds no calibration, or is damaged.
        """
        found = store if isinstance(store, BlockStore) else BlockStore.open(store)
        told, facts = Calibration.of(found), found.attributes
        side = facts["settings"]["block"] if facts.get("strategy") == "block" else 1
        return cls(told, Blocks(told.resampling.grid, side))

    @property
    def grid(self) -> tuple[int, int]:
        """(h, w) of the transport."""
        return self.blocks.grid

    @property
    def channels(self) -> int:
        """1 or 3."""
        return 1 if self.calibration.white.value.ndim == 2 else 3

    @property
    def ambient(self) -> np.ndarray:
        """What the camera sees under a black projector, (h, w[, 3]) in the units of T.

        That is the background that no pattern takes away; 0 where it is not told.
        """
        return self._on_grid(self.calibration.ambient)

    @property
    def white(self) -> np.ndarray:
        """What a white pattern adds to that, (h, w[, 3]): as bright as the scene can be."""
        return self._on_grid(self.calibration.white)

    def codes(self, pattern: Any) -> np.ndarray:
        """What the projector is fed for a pattern of light: float32 in [0, 1], on the projector's pixels.

        Parameters
        ----------
        pattern : (h, w) or (h, w, 3)
            Of linear light, 1 for white; what is beyond [0, 1] is clipped.

        Raises
        ------
        InputError
            Another shape.
        """
        light = checks.finite("pattern", checks.real("pattern", pattern)).astype(np.float32)
        checks.shape("pattern", light, self.grid, (*self.grid, 3))
        fed = self.calibration.projector.codes(np.clip(self._of_each_channel(light), 0.0, 1.0))
        return self.blocks.enlarged(fed)

    def light(self, codes: Any) -> np.ndarray:
        """The light of codes (h, w) or (h, w, 3) in [0, 1] that the projector is fed, relative to its white.

        Raises
        ------
        InputError
            Another shape.
        """
        fed = checks.finite("codes", checks.real("codes", codes)).astype(np.float32)
        checks.shape("codes", fed, self.grid, (*self.grid, 3))
        return self.calibration.projector.linear(self._of_each_channel(fed))

    def _of_each_channel(self, picture: np.ndarray) -> np.ndarray:
        if picture.ndim == 2 and self.calibration.projector.channels == 3:
            return np.repeat(picture[..., None], 3, axis=-1)
        return picture

    def resampled(self, picture: Any) -> np.ndarray:
        """A picture on the camera's pixels, (H, W[, 3]), as it is on those of the transport, (h, w[, 3])."""
        return self.mean(self.calibration.resampling.apply(picture))

    def _on_grid(self, light: Radiance) -> np.ndarray:
        R = self.calibration.resampling
        weight = R.apply(light.valid.astype(np.float32))
        value = R.apply(np.where(light.valid, light.value, 0.0))
        return self.mean(np.where(weight >= _SEEN, value / np.maximum(weight, _SEEN), 0.0))

    def mean(self, picture: np.ndarray) -> np.ndarray:
        """A picture on the projector's pixels, (h, w[, 3]), as its means over those of the transport."""
        if self.blocks.side == 1:
            return picture.astype(np.float32)
        count = self.blocks.sum(np.ones_like(picture))
        return (self.blocks.sum(picture) / count).astype(np.float32)


def has_calibration(store: str | os.PathLike[str]) -> bool:
    """Whether there is a store which `ltcl.acquire` made.

    >>> has_calibration("nowhere.zarr")
    False
    """
    if not os.path.isdir(store):
        return False
    try:
        found = BlockStore.open(store)
    except InputError:  # whoever loads it says what is wrong
        return False
    return any(name.startswith(PREFIX) for name in found.extras) and "strategy" in found.attributes
