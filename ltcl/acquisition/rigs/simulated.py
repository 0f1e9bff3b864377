# SPDX-License-Identifier: BSD-3-Clause
"""`SimulatedRig`: projector curve and camera sensor around a scene whose light is computed.

Codes x (h, w[, 3]) in [0, 1], channels c and d, projector curve g with light b at code 0:

    p_d  = b + (1 - b) g_d(x_d)              light of the projector
    L_c                                      radiance on the camera's pixels, from a subclass
    v    = max(sensitivity seconds L, 0)     linear value; 1 fills a pixel of E electrons
    n    = Poisson(E v) / E + Normal(0, r)   photons, and read noise r
    c    = o + (1 - o) f(min(n, 1))          offset o and camera curve f; -f(-n) for n < 0
    code = round(c F)                        in [0, F], F = 2^bits - 1; c for a float camera

or F the white level of a camera that is full below its largest code.
"""

from __future__ import annotations

import abc
import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np

from ltcl import checks
from ltcl.acquisition.rig import as_codes, as_exposures, shot_key
from ltcl.errors import InputError
from ltcl.images import from_srgb, to_srgb

Function = Callable[[np.ndarray], np.ndarray]

# Exponent and middle of film: c = (1 + m) l^g / (l^g + m), a logistic in log l (Hurter and
# Driffield).
FILM_EXPONENT = 1.2
FILM_MIDDLE = 0.25**FILM_EXPONENT

# Linear values far beyond saturation change nothing; Poisson draws end at about 2^63.
MAX_LINEAR = 1e6


class Curve(NamedTuple):
    """A response curve from 0 to 0 and from 1 to 1."""

    encode: Function  # light to code of a camera
    decode: Function  # code to light of a projector


def _film_code(light: np.ndarray) -> np.ndarray:
    power = light**FILM_EXPONENT
    return (1 + FILM_MIDDLE) * power / (power + FILM_MIDDLE)


def _film_light(code: np.ndarray) -> np.ndarray:
    return (FILM_MIDDLE * code / (1 + FILM_MIDDLE - code)) ** (1 / FILM_EXPONENT)


CURVES: dict[str, Curve] = {
    "linear": Curve(np.array, np.array),
    "srgb": Curve(to_srgb, from_srgb),
    "film": Curve(_film_code, _film_light),
    "gamma2.2": Curve(lambda light: light ** (1 / 2.2), lambda code: code**2.2),
}


@dataclass(frozen=True)
class Sensor:
    """Camera and projector of a simulated rig.

    Parameters
    ----------
    response : "linear", "srgb", "gamma2.2" or "film", or three of these
        Curve of the camera, from light to code.
    projector_response : as response
        Curve of the projector, from code to light.
    bits : int or "float"
        8 gives uint8, 9 to 16 uint16, "float" float32.
    white_level : float, optional
        Code of a full pixel; None for the largest code, or 1 of floats.
    black : float
        Offset of the codes, of full scale.
    projector_black : float
        Light at code 0, of full white.
    gain : float, optional
        Electrons at full scale; None for no photon noise.
    read : float
        Standard deviation of the read noise, of full scale.
    exposures : sequence of float, optional
        Seconds that the camera offers; None for any.
    seed : int
        Random seed of the noise.

    Raises
    ------
    InputError
        A value is out of its range.
    """

    response: Any = "srgb"
    projector_response: Any = "srgb"
    bits: int | str = 8
    white_level: float | None = None
    black: float = 0.004
    projector_black: float = 0.0
    gain: float | None = 10000.0
    read: float = 0.0005
    exposures: Any = None
    seed: int = 0

    def __post_init__(self) -> None:
        is_whole = type(self.bits) is int and self.bits in range(8, 17)
        if self.bits != "float" and not is_whole:
            raise InputError(f'bits is {self.bits!r}; it must be 8 to 16, or "float"')
        if self.white_level is not None:
            most = (1 << int(self.bits)) - 1 if is_whole else np.inf
            checks.number("white_level", self.white_level, above=0.0, most=most)
        for name in ("black", "projector_black", "read"):
            checks.number(name, getattr(self, name), least=0.0, below=1.0)
        if self.gain is not None:
            checks.number("gain", self.gain, least=1.0, most=1e9)
        checks.count("seed", self.seed, least=0)


class SimulatedRig(abc.ABC):
    """A projector and a camera whose light comes from `_radiance(codes)` of a subclass.

    Noise depends on seed, codes, seconds and the number of equal shots before, so that a run can
    resume. A subclass sets `sensitivity`, and `_facts` for `describe`.
    """

    sensitivity = 1.0

    def __init__(
        self, projector_grid: tuple[int, int], channels: int, sensor: dict[str, Any]
    ) -> None:
        self.sensor = Sensor(**sensor)
        self.projector_grid = projector_grid
        self.channels = channels
        self.exposures = as_exposures("exposures", self.sensor.exposures)
        self.bits: int | None = None
        if isinstance(self.sensor.bits, int):
            self.bits = self.sensor.bits
        self.white_level = self.sensor.white_level
        camera = _curves("response", self.sensor.response, channels)
        projector = _curves("projector_response", self.sensor.projector_response, channels)
        self._encoders = [curve.encode for curve in camera]
        self._decoders = [curve.decode for curve in projector]
        self._facts: dict[str, Any] = {}
        self._repeats: Counter[str] = Counter()
        # Codes and radiance of the last photograph, as a bracket repeats its codes.
        self._last: tuple[np.ndarray, np.ndarray] | None = None

    @abc.abstractmethod
    def _radiance(self, codes: np.ndarray) -> np.ndarray:
        """L under checked codes, float64, (H, W) or (H, W, 3)."""

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        """Photograph codes (h, w[, 3]) in [0, 1]: uint8, uint16 or float32, (H, W[, 3]).

        Any exposure is possible, also if `exposures` offers others.
        """
        codes = as_codes(codes, self.projector_grid, self.channels)
        checks.number("seconds", seconds, above=0.0)
        value = self.sensitivity * seconds * self.radiance(codes)
        noise = self._noise_stream(codes, seconds)
        value = self._add_noise(np.maximum(value, 0.0), noise)
        black = self.sensor.black
        encoded = _apply(self._encoders, np.minimum(value, 1.0))
        code = black + (1.0 - black) * encoded
        if self.bits is None:
            full = 1.0 if self.white_level is None else self.white_level
            return (code * full).astype(np.float32)
        full = (1 << self.bits) - 1 if self.white_level is None else self.white_level
        dtype = np.uint8 if self.bits == 8 else np.uint16
        return np.rint(np.clip(code, 0.0, 1.0) * full).astype(dtype)

    def recall(self, codes: Any, seconds: float, image: np.ndarray) -> None:
        """Skip the noise of a photograph that was taken in an earlier session."""
        codes = as_codes(codes, self.projector_grid, self.channels)
        self._noise_stream(codes, seconds)

    def radiance(self, codes: Any) -> np.ndarray:
        """L without a sensor, to compare photographs with: float64, (H, W) or (H, W, 3)."""
        codes = as_codes(codes, self.projector_grid, self.channels)
        if self._last is None or not np.array_equal(self._last[0], codes):
            self._last = (codes.copy(), self._radiance(codes))
        _, radiance = self._last
        return radiance.copy()

    def describe(self) -> dict[str, Any]:
        """The rig as plain JSON."""
        sensor = asdict(self.sensor)
        del sensor["exposures"]
        return {
            **self._facts,
            "projector_grid": self.projector_grid,
            "channels": self.channels,
            **sensor,
            "sensitivity": self.sensitivity,
        }

    def _light(self, codes: np.ndarray) -> np.ndarray:
        """p: float64, (h, w) or (h, w, 3), of the projector's channels."""
        light = codes.astype(np.float64)
        if self.channels == 3 and light.ndim == 2:
            light = light[..., None].repeat(3, axis=-1)
        black = self.sensor.projector_black
        return black + (1.0 - black) * _apply(self._decoders, light)

    def _add_noise(self, value: np.ndarray, noise: np.random.Generator) -> np.ndarray:
        gain = self.sensor.gain
        if gain is not None:
            value = noise.poisson(gain * np.minimum(value, MAX_LINEAR)) / gain
        return value + noise.normal(0.0, self.sensor.read, value.shape)

    def _noise_stream(self, codes: np.ndarray, seconds: float) -> np.random.Generator:
        """The counter-based stream (Philox) of the next photograph of `codes` for `seconds`."""
        shot = shot_key(codes, seconds)
        text = f"{self.sensor.seed} {self._repeats[shot]}"
        self._repeats[shot] += 1
        content = bytes.fromhex(shot) + text.encode()
        digest = hashlib.blake2b(content, digest_size=16).digest()
        key = int.from_bytes(digest, "little")
        return np.random.Generator(np.random.Philox(key=key))


def _curves(argument: str, value: Any, channels: int) -> list[Curve]:
    """Curves by name, one for each channel."""
    names = value
    if not isinstance(value, (list, tuple)):
        names = [value] * channels
    if len(names) != channels:
        raise InputError(f"{argument} has {len(names)} curves; it must be one curve, or {channels}")
    for name in names:
        checks.one_of(argument, name, CURVES)
    return [CURVES[name] for name in names]


def _apply(functions: Sequence[Function], value: np.ndarray) -> np.ndarray:
    """Apply the function of each channel, odd about 0."""
    planes = np.abs(value).reshape(*value.shape[:2], -1)
    applied = np.empty_like(planes)
    for c, function in enumerate(functions):
        applied[..., c] = function(planes[..., c])
    return np.copysign(applied.reshape(value.shape), value)
