# SPDX-License-Identifier: BSD-3-Clause
"""`Taking`: photographs of one pattern after the other, as a calibration asks for them."""

from __future__ import annotations

from typing import Any

import numpy as np

from ltcl.acquisition import agreeing, exposing
from ltcl.acquisition.radiometry import NoiseModel, Radiance, Response, merge
from ltcl.acquisition.rig import Shots


class Taking:
    """A rig, photographs of it that agree, and those merged.

    Attributes
    ----------
    shots : Shots
    black, white : (h, w)
        Codes.
    """

    def __init__(self, shots: Shots) -> None:
        self.shots = shots
        self.black = np.zeros(shots.grid, np.float32)
        self.white = np.ones(shots.grid, np.float32)

    def take(self, wanted: list[tuple[np.ndarray, float]]) -> list[np.ndarray]:
        """A photograph of each (codes, seconds), all of them told of before."""
        self.shots.prepare(wanted)
        return [self.shots.photograph(codes, t) for codes, t in wanted]

    def agreeing(
        self,
        wanted: list[tuple[np.ndarray, float]],
        response: Response,
        noise: NoiseModel = agreeing.ROUGH,
        offset: Any = 0.0,
    ) -> list[np.ndarray]:
        """The same, all of one pattern; refused where they contradict each other."""
        images = self.take(wanted)
        self.refuse_unlike(images, [t for _, t in wanted], response, noise, offset)
        return images

    def refuse_unlike(self, images: list[np.ndarray], seconds: list[float], *sensor: Any) -> None:
        """Refuse the latest photographs, all of one pattern, where they contradict each other."""
        last = self.shots.number
        agreeing.refuse_unlike(images, seconds, range(last + 1 - len(images), last + 1), *sensor)

    def merged(
        self,
        codes: np.ndarray,
        seconds: tuple[float, ...],
        response: Response,
        noise: NoiseModel,
        offset: np.ndarray,
        again: int = 1,
    ) -> Radiance:
        """What the camera sees under `codes`, the ambient light still in it."""
        times = [t for t in seconds for _ in range(again)]
        images = self.agreeing([(codes, t) for t in times], response, noise, offset)
        last = self.shots.number
        with exposing.telling(f"photographs {last + 1 - len(images)} to {last}"):
            return merge(images, times, response, noise, levels=self.shots.levels, black=offset)
