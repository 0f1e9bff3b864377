# SPDX-License-Identifier: BSD-3-Clause
"""`VirtualRig`: photographs of a scene whose light transport T is known, as a real camera would take them.

With codes x (h, w[, 3]) in [0, 1], N = h w projector pixels, and channels c, d:

    p_d = b + (1 - b) g_d(x_d)              projector: response g, light b at code 0; (N,)
    q_c = sum_d mixing[c, d] p_d            the light that channel c of T answers to
    L_c = C (T_c q_c + a_c)                 radiance on the camera's pixels: ambient a (M,), warp C (H W, M)
    v_c = max(sensitivity seconds L_c, 0)   linear sensor value; 1 fills a pixel

and `sensor` makes codes of v: photons, read noise, saturation, response, black offset, levels. Light is
linear throughout; its unit is that of T, so a T whose rows sum to 1 gives 1 per second at full white.
Radiance is even on each pixel of T; C averages it over what each camera pixel covers.
Known limit: no blur, no light that falls on the camera outside T.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from ltcl import checks, layout
from ltcl.acquisition.rig import as_codes, as_seconds
from ltcl.acquisition.rigs import curves
from ltcl.acquisition.rigs.digests import digest
from ltcl.acquisition.rigs.noise import NoiseStreams
from ltcl.acquisition.rigs.sensor import Sensor
from ltcl.errors import InputError

_FEW = 8  # one lit pixel of so many: gathering columns beats the whole product


class VirtualRig:
    """A projector and a camera around a known T.

    Noise depends on the seed, the codes, the seconds and on how often the same were asked for before, not on
    what else was photographed: a run that was stopped and resumed sees the same photographs.

    Parameters
    ----------
    T : (M, N) array, scipy.sparse matrix, LinearOperator, a sequence of 3, or a Transport
        Row-major pixels; where it says less than no light, there is none. A `ltcl.Transport` brings its own
        mixing.
    grid : (h, w)
        Of the projector, N = h w.
    camera_grid : (H, W), optional
        Of the photographs; needed where that is not `grid`.
    camera_map : (H W, M) matrix, optional
        C: what each camera pixel sees of the M pixels of T, by area, such as `camera_map` makes it from a
        function; without it M = H W and C = I.
    response : str, function or 3 of them
        Camera, linear value to code: "linear", "srgb", "gamma2.2", "film" (see `curves`), or a function that
        rises within [0, 1] and takes arrays of any shape.
    projector_response : str, function or 3 of them
        Projector, code to light, likewise; "srgb" is the way from codes to light.
    mixing : (3, 3), optional
        Of the projector's colours.
    bits : int or "float"
        8 gives uint8, 9 to 16 uint16, "float" float32.
    black : float
        Offset of the codes, of full scale.
    projector_black : float
        b: light at code 0, of full white.
    ambient : float, (3,), (M,) or (M, 3)
        a: radiance that is there without the projector; colours of a rig with three channels.
    gain : float or None
        Electrons at full scale; None: no photon noise.
    read : float
        Standard deviation of the read noise, of full scale.
    sensitivity : float
        Linear sensor value for radiance 1 in one second.
    exposures : sequence of float, optional
        The seconds that this camera offers, ascending; None: any.
    seed : int

    Raises
    ------
    InputError, InputTypeError
        Shapes that do not fit, negative ambient light, an unknown curve, a number out of range.

    Examples
    --------
    >>> T = np.array([[0.5, 0.1], [0.1, 0.5]])
    >>> rig = VirtualRig(T, grid=(1, 2), response="linear", gain=None, read=0.0, black=0.0)
    >>> rig.photograph(np.array([[1.0, 0.0]]), seconds=1.0)
    array([[128,  26]], dtype=uint8)
    >>> rig.radiance(np.array([[1.0, 0.0]]))
    array([[0.5, 0.1]])
    """

    def __init__(
        self,
        T: Any,
        grid: tuple[int, int],
        *,
        camera_grid: tuple[int, int] | None = None,
        camera_map: Any = None,
        response: Any = "srgb",
        projector_response: Any = "srgb",
        mixing: Any = None,
        bits: int | str = 8,
        black: float = 0.004,
        projector_black: float = 0.0,
        ambient: Any = 0.0,
        gain: float | None = 10000.0,
        read: float = 0.0005,
        sensitivity: float = 1.0,
        exposures: Any = None,
        seed: int = 0,
    ) -> None:
        self._T = _matrices(T)
        self.channels = len(self._T)
        rows, columns = self._T[0].shape
        self.projector_grid = checks.grid("grid", grid, columns)
        self._map = None if camera_map is None else _camera_map(camera_map, rows)
        self.camera_grid = _camera_grid(camera_grid, rows if self._map is None else self._map.shape[0], grid)
        mixing = getattr(T, "mixing", None) if mixing is None else mixing
        self._mixing = None if mixing is None else layout.mixing(mixing, self.channels, None)
        self._projector = curves.projector(projector_response, self.channels)
        self._sensor = Sensor(curves.camera(response, self.channels), bits, black, gain, read)
        self._projector_black = checks.number("projector_black", projector_black, least=0.0, below=1.0)
        self._ambient = _ambient(ambient, rows, self.channels)
        self._sensitivity = checks.number("sensitivity", sensitivity, above=0.0)
        self.exposures = None if exposures is None else tuple(exposures)
        self._noise = NoiseStreams(seed)
        self._named = {"response": curves.called(response), "projector": curves.called(projector_response)}
        self._last: tuple[np.ndarray, np.ndarray] | None = None  # brackets ask for the same codes again

    @property
    def bits(self) -> int | None:
        """Of the codes; None of a float camera."""
        return self._sensor.bits if isinstance(self._sensor.bits, int) else None

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        """Codes of the camera after `seconds` of light under `codes`, (H, W) or (H, W, 3).

        Parameters
        ----------
        codes : (h, w), or (h, w, 3) of a rig with three channels
            In [0, 1]; (h, w) feeds all channels alike.
        seconds : float
            Of exposure.

        Returns
        -------
        np.ndarray
            uint8, uint16 or float32.

        Raises
        ------
        InputError, InputTypeError
            Codes of another shape or outside [0, 1]; seconds that are not positive.
        """
        codes, seconds = as_codes(codes, self.projector_grid, self.channels), as_seconds(seconds)
        value = self._sensitivity * seconds * self.radiance(codes)
        return self._sensor.expose(np.maximum(value, 0.0), self._noise.of(codes, seconds))

    def recall(self, codes: Any, seconds: float, image: np.ndarray) -> None:
        """Pass over the noise of a photograph that was taken in an earlier session."""
        self._noise.of(as_codes(codes, self.projector_grid, self.channels), as_seconds(seconds))

    def radiance(self, codes: Any) -> np.ndarray:
        """L, without a sensor: float64, (H, W) or (H, W, 3). What the photographs are to be compared with.

        Raises
        ------
        InputError, InputTypeError
            Codes of another shape or outside [0, 1].
        """
        codes = as_codes(codes, self.projector_grid, self.channels)
        if self._last is None or not np.array_equal(self._last[0], codes):
            self._last = codes.copy(), self._radiance(codes)
        return self._last[1].copy()

    def _radiance(self, codes: np.ndarray) -> np.ndarray:
        q = self.light(codes).reshape(-1, self.channels)
        L = np.stack([_product(T, q[:, c]) for c, T in enumerate(self._T)], axis=-1) + self._ambient
        L = L if self._map is None else self._map @ L
        return L.reshape(self.camera_grid if self.channels == 1 else (*self.camera_grid, 3))

    def light(self, codes: Any) -> np.ndarray:
        """The light q that T answers to: float64, (h, w) or (h, w, 3)."""
        codes = as_codes(codes, self.projector_grid, self.channels).astype(np.float64)
        if self.channels == 1:
            return self._lit(0, codes)
        fed = codes if codes.ndim == 3 else codes[..., None].repeat(3, axis=-1)
        p = np.stack([self._lit(d, fed[..., d]) for d in range(3)], axis=-1)
        return p if self._mixing is None else p @ self._mixing.T

    def describe(self) -> dict[str, Any]:
        """What makes the photographs, as plain JSON."""
        sensor = self._sensor
        return {
            "kind": "virtual",
            "projector_grid": list(self.projector_grid),
            "camera_grid": list(self.camera_grid),
            "channels": self.channels,
            "response": self._named["response"],
            "projector_response": self._named["projector"],
            "mixing": None if self._mixing is None else self._mixing.tolist(),
            "bits": sensor.bits,
            "black": sensor.black,
            "projector_black": self._projector_black,
            "ambient": [float(mean) for mean in self._ambient.mean(axis=0)],
            "gain": sensor.electrons,
            "read": sensor.read,
            "sensitivity": self._sensitivity,
            "seed": self._noise.seed,
            "digests": self._digests,
        }

    @cached_property
    def _digests(self) -> dict[str, Any]:
        """Of what is too large for the records."""
        return {
            "transport": [digest(T) for T in self._T],
            "camera_map": None if self._map is None else digest(self._map),
            "ambient": digest(self._ambient),
        }

    def _lit(self, d: int, code: np.ndarray) -> np.ndarray:
        return self._projector_black + (1.0 - self._projector_black) * self._projector[d](code)


def _matrices(T: Any) -> tuple[Any, ...]:
    if getattr(T, "blocks", None) is not None:
        raise InputError("T has blocks between colours; it must have one matrix per channel, and a mixing")
    own = getattr(T, "matrices", None)
    found = layout.matrices(T if own is None else own() if callable(own) else own, "T")
    return tuple(part.astype(np.float32) if part.dtype.kind in "iub" else part for part in found)


def _product(T: Any, q: np.ndarray) -> np.ndarray:
    """T q in the precision of T, which would be copied otherwise; of a dense T only the columns in light."""
    q = q.astype(T.dtype)
    if isinstance(T, np.ndarray):
        lit = np.flatnonzero(q)
        if _FEW * len(lit) < len(q):
            return T[:, lit] @ q[lit]
    return T @ q


def _camera_map(given: Any, rows: int) -> Any:
    C, *others = layout.matrices(given, "camera_map")
    if others or C.shape[1] != rows:
        kind = "three channels" if others else f"shape {C.shape}"
        raise InputError(f"camera_map has {kind}; it must be (H W, M) with M = {rows}, the rows of T")
    return C


def _camera_grid(given: Any, pixels: int, grid: tuple[int, int]) -> tuple[int, int]:
    if given is None and pixels != grid[0] * grid[1]:
        raise InputError(
            f"camera_grid is None, but there are {pixels} camera pixels; it must be their (H, W)"
        )
    return checks.grid("camera_grid", grid if given is None else given, pixels)


def _ambient(given: Any, rows: int, count: int) -> np.ndarray:
    """(M, channels) of radiance, or what broadcasts to it."""
    a = checks.finite("ambient", checks.real("ambient", given)).astype(np.float64)
    allowed = {(): (1, 1), (rows,): (rows, 1), (rows, count): (rows, count)}
    if count == 3:
        allowed[(3,)] = (1, 3)  # colours, even of a T with three rows
    if a.shape not in allowed:
        raise InputError(f"ambient has shape {a.shape}; it must be one of {', '.join(map(str, allowed))}")
    if a.min() < 0:
        raise InputError(f"ambient reaches down to {a.min():g}; light is never negative")
    return a.reshape(allowed[a.shape])
