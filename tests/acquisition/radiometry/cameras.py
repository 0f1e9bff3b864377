# SPDX-License-Identifier: BSD-3-Clause
"""Cameras whose every constant is known: light in, codes out, and the exact way back."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from ltcl.acquisition.radiometry import NoiseModel, Response
from ltcl.images import from_srgb, to_srgb

Curve = Callable[[np.ndarray], np.ndarray]

# Film: light^G / (light^G + M^G).
FILM_EXPONENT = 1.2
FILM_MIDDLE = 0.25**FILM_EXPONENT

# Light to code and code to light, both of [0, 1].
CURVES: dict[str, tuple[Curve, Curve]] = {
    "linear": (lambda x: x, lambda c: c),
    "srgb": (to_srgb, from_srgb),
    "gamma2.2": (lambda x: x ** (1 / 2.2), lambda c: c**2.2),
    "film": (
        lambda x: (1 + FILM_MIDDLE) * x**FILM_EXPONENT / (x**FILM_EXPONENT + FILM_MIDDLE),
        lambda c: (FILM_MIDDLE * c / (1 + FILM_MIDDLE - c)) ** (1 / FILM_EXPONENT),
    ),
}


@dataclass(frozen=True)
class Camera:
    """Poisson and read noise of linear light, a curve above a black offset, and rounding."""

    curve: str = "srgb"
    levels: int = 256
    electrons: float = 10000.0
    read: float = 0.001
    black: float = 0.004

    def codes(self, light: np.ndarray) -> np.ndarray:
        """Codes of linear values without noise, in [0, 1]; odd below 0."""
        encode = CURVES[self.curve][0]
        return self.black + (1 - self.black) * np.copysign(
            encode(np.minimum(np.abs(light), 1.0)), light
        )

    def light(self, codes: np.ndarray) -> np.ndarray:
        """The exact response."""
        code = (codes - self.black) / (1 - self.black)
        return np.copysign(CURVES[self.curve][1](np.abs(code)), code)

    def shoot(self, radiance: np.ndarray, seconds: float, rng: np.random.Generator) -> np.ndarray:
        light = rng.poisson(radiance * seconds * self.electrons) / self.electrons
        codes = self.codes(light + rng.normal(0, self.read, radiance.shape))
        if not self.levels:
            return codes
        codes = np.clip(codes, 0, 1)
        return np.rint(codes * (self.levels - 1)).astype(
            np.uint8 if self.levels == 256 else np.uint16
        )

    def bracket(
        self, radiance: np.ndarray, seconds: Iterable[float], rng: np.random.Generator
    ) -> list[np.ndarray]:
        """A photograph at each exposure."""
        return [self.shoot(radiance, t, rng) for t in seconds]

    @property
    def response(self) -> Response:
        return Response(self.light(np.linspace(0, 1, 16385)))

    @property
    def noise(self) -> NoiseModel:
        return NoiseModel(self.electrons, self.read, 0.0, 0.96, self.levels)


def shoot_channels(
    cameras: list[Camera], radiance: np.ndarray, seconds: list[float]
) -> list[np.ndarray]:
    """Photographs (H, W, 3) whose channels have a camera each."""
    random = np.random.default_rng()
    channels = [camera.bracket(radiance, seconds, random) for camera in cameras]
    return list(np.stack(channels, axis=-1))


def corner(n: int = 256) -> np.ndarray:
    """Radiance (n, n) with smooth gradients, from 0.002 to 0.95."""
    y, x = np.mgrid[:n, :n] / n
    return 0.002 + 0.948 * (0.5 + 0.5 * np.sin(5 * x + 2 * y)) * np.exp(-3 * y)
