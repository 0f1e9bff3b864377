# SPDX-License-Identifier: BSD-3-Clause
"""`Calibration`: what `calibrate` has measured, as arrays in a store; `Setup`: it on the pixels of T.

With light p of a pattern in [0, 1], codes x that the projector is fed, its response g and ambient
light a,

    x = g^-1(p)                 for each channel, on the projector's own pixels
    picture = T p + a           in linear sensor values a second

T is for light relative to white less black: a includes what a black projector sends.
"""

from __future__ import annotations

import os
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.acquisition.anchor import Anchor
from ltcl.acquisition.geometry import Resampling
from ltcl.acquisition.geometry.blocks import Blocks
from ltcl.acquisition.geometry.sharpness import Sharpness
from ltcl.acquisition.radiometry import NoiseModel, Radiance, Response
from ltcl.errors import FileError
from ltcl.store import BlockStore
from ltcl.transport.transport import Transport

PREFIX = "calibration."  # of the names of the extra arrays that a calibration is kept in
_VALID = 0.5  # of the camera pixels that see a projector pixel: with less its value is unknown


@dataclass(frozen=True, repr=False, eq=False)
class Calibration:
    """What is known of a set-up.

    `exposures` in seconds, ascending; `offset`, the camera's linear value without light; `ambient`,
    `white`, (H, W[, 3]), what a black projector shows and a white one adds; `mixing`, (3, 3), None
    of one channel; `resampling` to the projector's pixels; `sharpness`, None of an aligned camera;
    `anchor`, None of older stores.
    """

    exposures: tuple[float, ...]
    response: Response
    noise: NoiseModel
    offset: np.ndarray
    ambient: Radiance
    white: Radiance
    projector: Response
    mixing: np.ndarray | None
    resampling: Resampling
    sharpness: Sharpness | None = None
    anchor: Anchor | None = None

    @property
    def light(self) -> np.ndarray:
        """What each channel of T answers to when all of the projector's are at full code, (channels,)."""
        return np.ones(1) if self.mixing is None else self.mixing.sum(axis=1)

    @classmethod
    def of(cls, store: str | os.PathLike[str] | BlockStore) -> Calibration:
        """That of a store made by `ltcl.acquire`; FileError where it has none, or is damaged."""
        scan = store if isinstance(store, BlockStore) else BlockStore.open(store)
        names = [name.removeprefix(PREFIX) for name in scan.extras if name.startswith(PREFIX)]
        if not names:
            raise FileError(f"{scan.path}: holds no calibration; ltcl.acquire writes one")
        if "resampling.doubtful" not in names:
            raise FileError(
                f"{scan.path}: its calibration is of an earlier ltcl; it must be acquired again"
            )
        arrays = {name: np.array(scan.extra(PREFIX + name)) for name in names}

        def group(prefix: str) -> dict[str, Any]:
            return {
                k.removeprefix(prefix): array for k, array in arrays.items() if k.startswith(prefix)
            }

        R, ambient, white, anchor = map(group, ("resampling.", "ambient.", "white.", "anchor."))
        anchor.pop("shift", None)  # of earlier versions
        for light in (ambient, white):  # of earlier versions: 0 where it is not valid
            light["variance"] = np.where(light["valid"], light["variance"], np.float32(np.inf))
        (h, w), (H, W) = R["coverage"].shape, R["camera_grid"].tolist()
        weights = scipy.sparse.csr_array(
            (R["data"], R["indices"], R["indptr"]), shape=(h * w, H * W)
        )
        *sensor, levels = arrays["noise"].tolist()
        y, x, width = arrays.get("sharpness", np.zeros(3)).tolist()
        return cls(
            tuple(arrays["exposures"].tolist()),
            Response(arrays["response"]),
            NoiseModel(*sensor, levels=int(levels)),
            arrays["offset"],
            Radiance(**ambient),
            Radiance(**white),
            Response(arrays["projector"]),
            arrays.get("mixing"),
            Resampling(weights, R["coverage"], (h, w), (H, W), R["doubtful"]),
            Sharpness((y, x), width) if "sharpness" in arrays else None,
            Anchor(**anchor) if anchor else None,
        )

    def write(self, store: BlockStore) -> None:
        """Commit it to a store, as extra arrays."""
        R = self.resampling
        arrays = {
            "exposures": np.array(self.exposures),
            "response": self.response.values,
            "noise": np.array(astuple(self.noise), np.float64),
            "offset": self.offset,
            "projector": self.projector.values,
            "resampling.coverage": R.coverage,
            "resampling.camera_grid": np.array(R.camera_grid),
            "resampling.doubtful": np.zeros(R.grid, bool) if R.doubtful is None else R.doubtful,
        }
        arrays |= {
            f"resampling.{name}": getattr(R.weights, name) for name in ("data", "indices", "indptr")
        }
        if self.sharpness is not None:
            arrays["sharpness"] = np.hstack(astuple(self.sharpness))
        if self.mixing is not None:
            arrays["mixing"] = self.mixing
        for group in ("ambient", "white", "anchor"):
            if (record := getattr(self, group)) is not None:
                arrays |= {f"{group}.{field}": array for field, array in vars(record).items()}
        for name, array in arrays.items():
            store.extra(PREFIX + name, array)


@dataclass(frozen=True, eq=False)
class Setup:
    """A calibration on the pixels of T, which are `blocks` of projector pixels.

    Examples
    --------
    >>> import tempfile, ltcl
    >>> from ltcl.acquisition import VirtualRig
    >>> store = f"{tempfile.mkdtemp()}/T.zarr"
    >>> T = ltcl.acquire(
    ...     VirtualRig(np.eye(64) / 2, (8, 8), ambient=0.1), geometry="aligned", store=store
    ... )
    >>> Setup.of(store).codes(np.full(T.grid, 0.214)).mean().round(
    ...     1
    ... )  # sRGB, as this rig has by default
    np.float32(0.5)
    """

    calibration: Calibration
    blocks: Blocks

    @classmethod
    def of(cls, store: str | os.PathLike[str] | BlockStore) -> Setup:
        """That of a store made by `ltcl.acquire`; FileError as of `Calibration.of`."""
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
        return len(self.calibration.offset)

    @property
    def ambient(self) -> np.ndarray:
        """Light under a black projector, (h, w[, 3]) in the units of T; 0 where it is unknown."""
        R, light = self.calibration.resampling, self.calibration.ambient
        weight, value = R.apply(light.valid.astype(np.float32)), R.apply(light.value * light.valid)
        return self._mean(np.where(weight >= _VALID, value / np.maximum(weight, _VALID), 0.0))

    def codes(self, pattern: Any) -> np.ndarray:
        """Codes, float32 on the projector's pixels, for light (h, w[, 3]), clipped to [0, 1], 1 for white."""
        light = np.clip(self._colours("pattern", pattern), 0.0, 1.0)
        return self.blocks.enlarged(self.calibration.projector.codes(light))

    def light(self, codes: Any) -> np.ndarray:
        """Light of codes (h, w[, 3]) in [0, 1], relative to white."""
        return self.calibration.projector.linear(self._colours("codes", codes))

    def relative_error(self, rig: Any, T: Transport) -> tuple[float, ...]:
        """||s T p - c|| / ||c|| of each channel for random p of 0 and 1, s = <T p, c> / ||T p||^2.

        c is what `rig`, a `VirtualRig`, shows under p less black; the camera's unit of light is
        unknown.
        """
        patterns = (np.random.default_rng(0).random((4, *T.grid)) < 0.5).astype(np.float32)
        pictures = [rig.radiance(self.blocks.enlarged(p)) for p in (0 * patterns[0], *patterns)]
        if rig.camera_grid != rig.projector_grid:
            pictures = [self.calibration.resampling.apply(picture) for picture in pictures]
        light = patterns if T.channels == 1 else np.repeat(patterns[..., None], 3, axis=-1)
        sides = [T @ p for p in light], [self._mean(c - pictures[0]) for c in pictures[1:]]
        x, y = (
            np.reshape(side, (4, -1, T.channels))[:, ~T.masked].astype(np.float64) for side in sides
        )
        scale = (x * y).sum(axis=(0, 1)) / np.maximum(
            (x * x).sum(axis=(0, 1)), np.finfo(float).tiny
        )
        error = np.sqrt(((scale * x - y) ** 2).sum(axis=(0, 1)) / (y * y).sum(axis=(0, 1)))
        return tuple(error.tolist())

    def _colours(self, name: str, picture: Any) -> np.ndarray:
        """A checked picture of as many channels as the projector has."""
        values = checks.finite(name, checks.real(name, picture)).astype(np.float32)
        checks.shape(name, values, self.grid, (*self.grid, 3))
        if values.ndim == 2 and self.calibration.projector.channels == 3:
            return np.repeat(values[..., None], 3, axis=-1)
        return values

    def _mean(self, picture: np.ndarray) -> np.ndarray:
        return (self.blocks.sum(picture) / self.blocks.sum(np.ones_like(picture))).astype(
            np.float32
        )
