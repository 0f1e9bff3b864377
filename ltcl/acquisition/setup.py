# SPDX-License-Identifier: BSD-3-Clause
"""`Setup`: the calibration of a store, for pictures on the pixels of its transport.

With p the light of a pattern in [0, 1], x the codes that the projector is fed and a the ambient light,

    x = g^-1(p)                 for each channel, on the projector's own pixels
    picture = T p + a           in linear sensor values a second

T is for light relative to white less black: a includes what a black projector sends.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.calibration import PREFIX, Calibration
from ltcl.acquisition.radiometry import Radiance
from ltcl.acquisition.scanning.cells import Blocks
from ltcl.errors import InputError
from ltcl.store import BlockStore
from ltcl.transport import Transport

_VALID = 0.5  # of the camera pixels that see a projector pixel: with less its value is unknown


@dataclass(frozen=True, eq=False)
class Setup:
    """A measured set-up of projector, scene and camera.

    Attributes
    ----------
    calibration : Calibration
    blocks : Blocks
        Of projector pixels: the pixels of the transport.

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
    >>> setup.relative_error(rig, T)[0] < 0.02
    True
    """

    calibration: Calibration
    blocks: Blocks

    @classmethod
    def of(cls, store: str | os.PathLike[str] | BlockStore) -> Setup:
        """That of a store made by `ltcl.acquire`; FileError where it has no calibration, or is damaged."""
        scan = store if isinstance(store, BlockStore) else BlockStore.open(store)
        calibration, facts = Calibration.of(scan), scan.attributes
        side = facts["settings"]["block"] if facts.get("strategy") == "block" else 1
        return cls(calibration, Blocks(calibration.resampling.grid, side))

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
        """Light under a black projector, (h, w[, 3]) in the units of T; 0 where it is unknown."""
        return self._resample(self.calibration.ambient)

    @property
    def white(self) -> np.ndarray:
        """What a white pattern adds to that, (h, w[, 3]): as bright as the scene can be."""
        return self._resample(self.calibration.white)

    def codes(self, pattern: Any) -> np.ndarray:
        """Codes of the projector for a pattern of light: float32 in [0, 1], on the projector's pixels.

        Parameters
        ----------
        pattern : (h, w) or (h, w, 3)
            Linear light, 1 for white; clipped to [0, 1].

        Raises
        ------
        InputError
            Another shape.
        """
        light = np.clip(self._colours("pattern", pattern), 0.0, 1.0)
        return self.blocks.enlarged(self.calibration.projector.codes(light))

    def light(self, codes: Any) -> np.ndarray:
        """Light of codes (h, w) or (h, w, 3) in [0, 1], relative to white; InputError for another shape."""
        return self.calibration.projector.linear(self._colours("codes", codes))

    def relative_error(self, rig: Any, T: Transport, patterns: int = 4) -> tuple[float, ...]:
        """||s T p - c|| / ||c|| of each channel, against what a known scene shows under new patterns.

        Patterns p of 0 and 1 are the same in codes and in light. c is the scene without noise under p less
        that under black. The unit of light of a camera is unknown: s = <T p, c> / ||T p||^2 is free.

        Parameters
        ----------
        rig : VirtualRig
            The scene, best without its camera_map; else its pictures are resampled from the camera's pixels.
        T : Transport
            As measured.
        patterns : int
            Each with about half of the pixels on.
        """
        rng, aligned, seen = np.random.default_rng(0), rig.camera_grid == rig.projector_grid, ~T.masked
        dark, ours, theirs = rig.radiance(np.zeros(self.blocks.pixels)), [], []
        for _ in range(patterns):
            p = (rng.random(T.grid) < 0.5).astype(np.float32)
            c = rig.radiance(self.blocks.enlarged(p)) - dark
            c = self._mean(c if aligned else self.calibration.resampling.apply(c))
            light = p if T.channels == 1 else np.repeat(p[..., None], 3, axis=-1)
            ours.append(np.asarray(T @ light, np.float64).reshape(-1, T.channels)[seen])
            theirs.append(c.astype(np.float64).reshape(-1, T.channels)[seen])
        x, y = np.concatenate(ours), np.concatenate(theirs)
        scale = (x * y).sum(axis=0) / np.maximum((x * x).sum(axis=0), np.finfo(float).tiny)
        return tuple((np.linalg.norm(scale * x - y, axis=0) / np.linalg.norm(y, axis=0)).tolist())

    def _colours(self, name: str, picture: Any) -> np.ndarray:
        """A checked picture of as many channels as the projector has."""
        values = checks.finite(name, checks.real(name, picture)).astype(np.float32)
        checks.shape(name, values, self.grid, (*self.grid, 3))
        if values.ndim == 2 and self.calibration.projector.channels == 3:
            return np.repeat(values[..., None], 3, axis=-1)
        return values

    def _resample(self, light: Radiance) -> np.ndarray:
        R = self.calibration.resampling
        weight = R.apply(light.valid.astype(np.float32))
        value = R.apply(np.where(light.valid, light.value, 0.0))
        return self._mean(np.where(weight >= _VALID, value / np.maximum(weight, _VALID), 0.0))

    def _mean(self, picture: np.ndarray) -> np.ndarray:
        """Means of a picture on the projector's pixels over the pixels of the transport."""
        return (self.blocks.sum(picture) / self.blocks.sum(np.ones_like(picture))).astype(np.float32)


def has_calibration(store: str | os.PathLike[str]) -> bool:
    """Whether there is a store that `ltcl.acquire` made.

    >>> has_calibration("nowhere.zarr")
    False
    """
    if not os.path.isdir(store):
        return False
    try:
        scan = BlockStore.open(store)
    except InputError:  # whoever loads it says what is wrong
        return False
    return any(name.startswith(PREFIX) for name in scan.extras) and "strategy" in scan.attributes
