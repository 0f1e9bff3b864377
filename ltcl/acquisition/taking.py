# SPDX-License-Identifier: BSD-3-Clause
"""`Taking`: photographs of one pattern after the other, as a calibration asks for them."""

from __future__ import annotations

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
    ) -> list[np.ndarray]:
        """The same, all of one pattern; refused where they contradict each other."""
        images, last = self.take(wanted), self.shots.number
        numbers = range(last + 1 - len(images), last + 1)
        agreeing.refuse_unlike(images, [t for _, t in wanted], numbers, response, noise)
        return images

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
        images = self.agreeing([(codes, t) for t in times], response, noise)
        last = self.shots.number
        with exposing.telling(f"photographs {last + 1 - len(images)} to {last}"):
            return merge(images, times, response, noise, levels=self.shots.levels, black=offset)
