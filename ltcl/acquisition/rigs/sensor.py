# SPDX-License-Identifier: BSD-3-Clause
"""A camera's sensor: light in, codes with noise out.

A linear value v of 1 fills a pixel. With E electrons at full scale, read noise r, offset b and curve f:

    n = Poisson(E v) / E + Normal(0, r)     photons, then the amplifier; E = None: n = v + Normal(0, r)
    s = min(n, 1)                           a full pixel holds no more
    c = b + (1 - b) f(s)                    for s < 0, where f has no meaning, f(s) = -f(-s)
    code = round(c (2^bits - 1)), in [0, 2^bits - 1]       or c itself of a float camera

The variance of n is v / E + r^2. At 0 light the code is b on average, as long as b is above the noise of c.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.rigs.curves import Curve
from ltcl.errors import InputError


@dataclass(frozen=True)
class Sensor:
    """The constants of a sensor.

    Parameters
    ----------
    curves : tuple of 1 or 3 functions
        From linear value in [0, 1] to code in [0, 1], per channel.
    bits : int or "float"
        8 gives uint8, 9 to 16 uint16, "float" float32 without levels.
    black : float
        Offset b of the codes, of full scale.
    electrons : float or None
        E at full scale; None: no photon noise.
    read : float
        Standard deviation r, of full scale.

    Raises
    ------
    InputError
        One of them is out of range.

    Examples
    --------
    >>> sensor = Sensor((np.sqrt,), bits=8, black=0.0, electrons=None, read=0.0)
    >>> sensor.expose(np.array([[0.0, 0.25, 3.0]]), np.random.default_rng(1))
    array([[  0, 128, 255]], dtype=uint8)
    """

    curves: tuple[Curve, ...]
    bits: int | str
    black: float
    electrons: float | None
    read: float

    def __post_init__(self) -> None:
        if self.bits != "float" and (type(self.bits) is not int or self.bits not in range(8, 17)):
            raise InputError(f'bits is {self.bits!r}; it must be 8 to 16, or "float"')
        checks.number("black", self.black, least=0.0, below=1.0)
        checks.number("read", self.read, least=0.0, below=1.0)
        if self.electrons is not None:
            checks.number("gain", self.electrons, least=1.0, most=1e9)

    def expose(self, value: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Codes of the linear values (H, W) or (H, W, 3), none negative; noise comes from `rng`."""
        filled = np.minimum(self._noisy(np.asarray(value, np.float64), rng), 1.0)
        return self._quantised(self.black + (1.0 - self.black) * self._curved(filled))

    def _noisy(self, value: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        if self.electrons is not None:
            # Far past full the pixel is full either way, and Poisson draws end at about 2^63.
            value = rng.poisson(self.electrons * np.minimum(value, 1e6)) / self.electrons
        return value + rng.normal(0.0, self.read, value.shape) if self.read else value

    def _curved(self, value: np.ndarray) -> np.ndarray:
        size = np.abs(value)
        if size.ndim == 2:
            return np.copysign(self.curves[0](size), value)
        parts = [curve(size[..., c]) for c, curve in enumerate(self.curves)]
        return np.copysign(np.stack(parts, axis=-1), value)

    def _quantised(self, code: np.ndarray) -> np.ndarray:
        if not isinstance(self.bits, int):
            return code.astype(np.float32)
        most = (1 << self.bits) - 1
        kind: Any = np.uint8 if self.bits == 8 else np.uint16
        return np.rint(np.clip(code, 0.0, 1.0) * most).astype(kind)
