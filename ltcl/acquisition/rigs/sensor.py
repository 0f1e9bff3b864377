# SPDX-License-Identifier: BSD-3-Clause
"""What simulated rigs share: response curves, a sensor with noise, and photographs that can be repeated.

Light and codes are in [0, 1]; a curve maps 0 to 0 and 1 to 1. As a camera, light l to code c:

    linear      c = l
    gamma2.2    c = l^(1 / 2.2)
    srgb        IEC 61966-2-1, as in `ltcl.images`
    film        c = (1 + m^g) l^g / (l^g + m^g),  g = 1.2, m = 0.25: a logistic in log l, the S of a
                characteristic curve after Hurter and Driffield

A linear value v of 1 fills a pixel. With E electrons at full scale, read noise r, offset b and curve f:

    n = Poisson(E v) / E + Normal(0, r)     photons, then the amplifier; E = None: n = v + Normal(0, r)
    s = min(n, 1)                           saturation
    c = b + (1 - b) f(s)                    for s < 0, where f is not defined, f(s) = -f(-s)
    code = round(c (2^bits - 1)), in [0, 2^bits - 1]       or c itself of a float camera
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ltcl import checks
from ltcl.acquisition.fingerprint import shot_key
from ltcl.acquisition.rig import as_codes, as_seconds
from ltcl.errors import InputError, InputTypeError
from ltcl.images.srgb import from_srgb, to_srgb

Curve = Callable[[np.ndarray], np.ndarray]
_STEEPNESS, _MIDDLE = 1.2, 0.25
_TOP = 1.0 + _MIDDLE**_STEEPNESS


class CurvePair(NamedTuple):
    """A response curve as a camera has it, and its inverse, as a projector has it."""

    encode: Curve  # light to code
    decode: Curve  # code to light


def _film(light: np.ndarray) -> np.ndarray:
    power = light**_STEEPNESS
    return _TOP * power / (power + _MIDDLE**_STEEPNESS)


def _inverse_film(code: np.ndarray) -> np.ndarray:
    return _MIDDLE * (code / (_TOP - code)) ** (1.0 / _STEEPNESS)


CURVES = {
    "linear": CurvePair(lambda light: light, lambda code: code),
    "srgb": CurvePair(to_srgb, from_srgb),
    "film": CurvePair(_film, _inverse_film),
    "gamma2.2": CurvePair(lambda light: light ** (1 / 2.2), lambda code: code**2.2),
}


class SimulatedRig:
    """A projector and a camera whose light comes from `_radiance(codes)` of a subclass.

        p_d = b + (1 - b) g_d(x_d)                  projector: codes x, response g, light b at code 0
        v = max(sensitivity seconds L, 0)           linear value of the sensor under radiance L

    Noise depends on the seed, the codes, the seconds and the number of earlier photographs of the same, not
    on others: a resumed run gets the same photographs.

    Parameters
    ----------
    response : str, function or 3 of them
        Camera, linear value to code: "linear", "srgb", "gamma2.2", "film", or a function that rises within
        [0, 1] and takes arrays of any shape.
    projector_response : str, function or 3 of them
        Projector, code to light, likewise; "srgb" is the way from codes to light.
    bits : int or "float"
        8 gives uint8, 9 to 16 uint16, "float" float32.
    black : float
        Offset of the codes, of full scale.
    projector_black : float
        b: light at code 0, of full white.
    gain : float or None
        Electrons at full scale; None: no photon noise.
    read : float
        Standard deviation of the read noise, of full scale.
    exposures : sequence of float, optional
        The seconds that this camera offers, ascending; None: any.
    seed : int
    """

    sensitivity = 1.0

    def __init__(
        self,
        projector_grid: tuple[int, int],
        channels: int,
        *,
        response: Any = "srgb",
        projector_response: Any = "srgb",
        bits: int | str = 8,
        black: float = 0.004,
        projector_black: float = 0.0,
        gain: float | None = 10000.0,
        read: float = 0.0005,
        exposures: Any = None,
        seed: int = 0,
    ) -> None:
        if bits != "float" and (type(bits) is not int or bits not in range(8, 17)):
            raise InputError(f'bits is {bits!r}; it must be 8 to 16, or "float"')
        self.projector_grid, self.channels = projector_grid, channels
        self.exposures = None if exposures is None else tuple(exposures)
        self._camera = _curves("response", response, channels, 0)
        self._projector = _curves("projector_response", projector_response, channels, 1)
        self._black = checks.number("black", black, least=0.0, below=1.0)
        self._projector_black = checks.number("projector_black", projector_black, least=0.0, below=1.0)
        self._gain = None if gain is None else checks.number("gain", gain, least=1.0, most=1e9)
        self._read = checks.number("read", read, least=0.0, below=1.0)
        self._seed = checks.count("seed", seed, least=0)
        self._arguments = {
            "bits": bits,
            "response": _name(response),
            "projector_response": _name(projector_response),
        }
        self._repeats: Counter[str] = Counter()
        self._last: tuple[np.ndarray, np.ndarray] | None = None  # brackets repeat their codes

    @property
    def bits(self) -> int | None:
        """Of the codes; None of a float camera."""
        bits = self._arguments["bits"]
        return None if bits == "float" else bits

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        """Codes of the camera after `seconds` of light under `codes`, (h, w) or (h, w, 3) in [0, 1].

        Returns uint8, uint16 or float32, (H, W) or (H, W, 3). InputError for codes of another shape or
        outside [0, 1] and seconds that are not positive; AcquisitionError where a renderer fails.
        """
        codes, seconds = as_codes(codes, self.projector_grid, self.channels), as_seconds(seconds)
        value = np.maximum(self.sensitivity * seconds * self.radiance(codes), 0.0)
        noise = self._noise(codes, seconds)
        if self._gain is not None:
            # Far beyond saturation nothing changes, and Poisson draws end at about 2^63.
            value = noise.poisson(self._gain * np.minimum(value, 1e6)) / self._gain
        if self._read:
            value = value + noise.normal(0.0, self._read, value.shape)
        code = self._black + (1.0 - self._black) * _apply(self._camera, np.minimum(value, 1.0))
        if self.bits is None:
            return code.astype(np.float32)
        largest = (1 << self.bits) - 1
        return np.rint(np.clip(code, 0.0, 1.0) * largest).astype(np.uint8 if largest == 255 else np.uint16)

    def recall(self, codes: Any, seconds: float, image: np.ndarray) -> None:
        """Skip the noise of a photograph that was taken in an earlier session."""
        self._noise(as_codes(codes, self.projector_grid, self.channels), as_seconds(seconds))

    def radiance(self, codes: Any) -> np.ndarray:
        """L without a sensor, to compare photographs with: float64, (H, W) or (H, W, 3)."""
        codes = as_codes(codes, self.projector_grid, self.channels)
        if self._last is None or not np.array_equal(self._last[0], codes):
            self._last = codes.copy(), self._radiance(codes)
        return self._last[1].copy()

    def describe(self) -> dict[str, Any]:
        """What makes the photographs, as plain JSON."""
        return {
            "projector_grid": list(self.projector_grid),
            "channels": self.channels,
            **self._arguments,
            "black": self._black,
            "projector_black": self._projector_black,
            "gain": self._gain,
            "read": self._read,
            "sensitivity": self.sensitivity,
            "seed": self._seed,
        }

    def _radiance(self, codes: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def _light(self, codes: np.ndarray) -> np.ndarray:
        """p: float64, (h, w) or (h, w, 3), of the projector's channels."""
        light = codes.astype(np.float64)
        if self.channels == 3 and light.ndim == 2:
            light = np.repeat(light[..., None], 3, axis=-1)
        return self._projector_black + (1.0 - self._projector_black) * _apply(self._projector, light)

    def _noise(self, codes: np.ndarray, seconds: float) -> np.random.Generator:
        """The counter-based stream (Philox) of the next photograph of `codes` for `seconds`."""
        shot = shot_key(codes, seconds)
        key = hashlib.blake2b(
            bytes.fromhex(shot) + f"{self._seed} {self._repeats[shot]}".encode(), digest_size=16
        )
        self._repeats[shot] += 1
        return np.random.Generator(np.random.Philox(key=int.from_bytes(key.digest(), "little")))


def _apply(curves: tuple[Curve, ...], value: np.ndarray) -> np.ndarray:
    """The curve of each channel, odd about 0."""
    size = np.abs(value)
    if size.ndim == 2:
        return np.copysign(curves[0](size), value)
    return np.copysign(np.stack([curve(size[..., c]) for c, curve in enumerate(curves)], axis=-1), value)


def _curves(name: str, value: Any, channels: int, direction: int) -> tuple[Curve, ...]:
    """The curve of each channel: a name, a function, or three of these."""
    values = list(value) if isinstance(value, (list, tuple)) else [value] * channels
    if len(values) != channels:
        raise InputError(f"{name} has {len(values)} curves; it must be one curve, or {channels}")
    return tuple(_curve(name, each, direction) for each in values)


def _curve(name: str, value: Any, direction: int) -> Any:
    if isinstance(value, str):
        return CURVES[checks.one_of(name, value, CURVES)][direction]
    if not callable(value):
        raise InputTypeError(f"{name} is {value!r}; it must be one of {', '.join(CURVES)}, or a function")
    x = np.linspace(0.0, 1.0, 1025)
    y = checks.finite(f"{name}(x)", checks.real(f"{name}(x)", value(x)))
    checks.shape(f"{name}(x)", y, x.shape)
    if y.min() < 0 or y.max() > 1 or np.any(np.diff(y) < 0):
        raise InputError(f"{name} falls, or spans {y.min():g} to {y.max():g}; it must rise within [0, 1]")
    return value


def _name(value: Any) -> Any:
    """What a curve is called in the records."""
    if isinstance(value, (list, tuple)):
        return [_name(each) for each in value]
    return value if isinstance(value, str) else getattr(value, "__name__", type(value).__name__)
