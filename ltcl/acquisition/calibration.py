# SPDX-License-Identifier: BSD-3-Clause
"""What is known of a set-up once it has been measured (`calibrate`): plain arrays in a store, and back."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
import scipy.sparse

from ltcl.acquisition.anchor import Anchor
from ltcl.acquisition.geometry import Resampling
from ltcl.acquisition.geometry.sharpness import Sharpness
from ltcl.acquisition.radiometry import NoiseModel, ProjectorResponse, Radiance, Response
from ltcl.errors import FileError
from ltcl.store import BlockStore

PREFIX = "calibration."
"""Of the names of the extra arrays that a calibration is kept in."""
_SENSOR = ("electrons", "read", "black", "saturation", "levels")


@dataclass(frozen=True, repr=False, eq=False)
class Calibration:
    """Result of `calibrate.measure`.

    Attributes
    ----------
    exposures : tuple of float
        Seconds of the photographs of each pattern, ascending.
    response, noise : Response, NoiseModel
        Of the camera.
    offset : (channels,)
        Linear value without light.
    ambient, white : Radiance, (H, W[, 3])
        Under a black projector, and what a white one adds to that.
    projector : ProjectorResponse
    mixing : (3, 3) or None
        Of the projector's colours, where there are three channels.
    resampling : Resampling
        From the camera's pixels to the projector's.
    sharpness : Sharpness, optional
        Of the camera on these; None of one that is aligned.
    anchor : Anchor, optional
        What the pattern of blocks showed; None of older stores, whose batches are not compared with it.
    """

    exposures: tuple[float, ...]
    response: Response
    noise: NoiseModel
    offset: np.ndarray
    ambient: Radiance
    white: Radiance
    projector: ProjectorResponse
    mixing: np.ndarray | None
    resampling: Resampling
    sharpness: Sharpness | None = None
    anchor: Anchor | None = None

    @property
    def light(self) -> np.ndarray:
        """What each channel of T answers to when all of the projector's are at full code, (channels,)."""
        return np.ones(1) if self.mixing is None else self.mixing.sum(axis=1)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Plain arrays by name, all finite, of which `from_arrays` makes the same again."""
        R = self.resampling
        found = {
            "exposures": np.array(self.exposures),
            "response": self.response.values,
            "noise": np.array([getattr(self.noise, name) for name in _SENSOR], np.float64),
            "offset": self.offset,
            "projector": self.projector.values,
            "resampling.data": R.weights.data,
            "resampling.indices": R.weights.indices,
            "resampling.indptr": R.weights.indptr,
            "resampling.coverage": R.coverage,
            "resampling.camera_grid": np.array(R.camera_grid),
            "resampling.doubtful": np.zeros(R.grid, bool) if R.doubtful is None else R.doubtful,
        }
        if self.sharpness is not None:
            found["sharpness"] = np.array([*self.sharpness.leak, self.sharpness.width])
        if self.mixing is not None:
            found["mixing"] = self.mixing
        if self.anchor is not None:
            found |= {f"anchor.{name}": part for name, part in vars(self.anchor).items()}
        for name, picture in (("ambient", self.ambient), ("white", self.white)):
            found[f"{name}.value"], found[f"{name}.valid"] = picture.value, picture.valid
            found[f"{name}.variance"] = np.where(picture.valid, picture.variance, np.float32(0.0))
        return found

    @classmethod
    def of(cls, store: str | os.PathLike[str] | BlockStore) -> Calibration:
        """That of a store which `ltcl.acquire` made, or of the folder of one.

        `Calibration.of(path).projector.codes(pattern)` is what the projector is fed for a pattern of linear
        light, such as `ltcl.compensate` finds.

        Raises
        ------
        FileError
            There is none, or it is damaged.
        """
        found = store if isinstance(store, BlockStore) else BlockStore.open(store)
        names = [name for name in found.extras if name.startswith(PREFIX)]
        if not names:
            raise FileError(f"{found.path}: holds no calibration; ltcl.acquire writes one")
        if PREFIX + "resampling.doubtful" not in names:
            raise FileError(f"{found.path}: its calibration is of an earlier ltcl; it must be acquired again")
        return cls.from_arrays({name.removeprefix(PREFIX): found.extra(name) for name in names})

    def write(self, store: BlockStore) -> None:
        """Commit it to a store, as extra arrays."""
        for name, array in self.to_arrays().items():
            store.extra(PREFIX + name, array)

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> Calibration:
        """The calibration that `to_arrays` was called of."""
        *sensor, levels = np.asarray(arrays["noise"]).tolist()
        grid, camera = arrays["resampling.coverage"].shape, arrays["resampling.camera_grid"].tolist()
        parts = tuple(np.array(arrays[f"resampling.{name}"]) for name in ("data", "indices", "indptr"))
        weights = scipy.sparse.csr_array(parts, shape=(grid[0] * grid[1], camera[0] * camera[1]))
        coverage, doubtful = (np.array(arrays[f"resampling.{name}"]) for name in ("coverage", "doubtful"))
        *leak, width = np.asarray(arrays.get("sharpness", (0.0, 0.0, 0.0))).tolist()
        return cls(
            tuple(np.asarray(arrays["exposures"]).tolist()),
            Response(np.array(arrays["response"])),
            NoiseModel(*sensor, levels=int(levels)),
            np.array(arrays["offset"]),
            _radiance(arrays, "ambient"),
            _radiance(arrays, "white"),
            ProjectorResponse(np.array(arrays["projector"])),
            np.array(arrays["mixing"]) if "mixing" in arrays else None,
            Resampling(weights, coverage, (grid[0], grid[1]), (camera[0], camera[1]), doubtful),
            Sharpness((leak[0], leak[1]), width) if "sharpness" in arrays else None,
            _anchor(arrays) if "anchor.value" in arrays else None,
        )


def _anchor(arrays: Mapping[str, np.ndarray]) -> Anchor:
    return Anchor(**{field.name: np.array(arrays[f"anchor.{field.name}"]) for field in fields(Anchor)})


def _radiance(arrays: Mapping[str, np.ndarray], name: str) -> Radiance:
    value, valid = np.array(arrays[f"{name}.value"]), np.array(arrays[f"{name}.valid"])
    variance = np.where(valid, np.asarray(arrays[f"{name}.variance"]), np.float32(np.inf))
    return Radiance(value, variance, valid)
