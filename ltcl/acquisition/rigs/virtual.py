# SPDX-License-Identifier: BSD-3-Clause
"""`VirtualRig`: photographs of a scene whose light transport T is known; `SimulatedRig`: their sensor.

Codes x (h, w[, 3]) in [0, 1], N = h w projector pixels, channels c and d, projector curve g with
light b at code 0, ambient light a (M,), and C (H W, M): what camera pixels see of the M pixels of
T.

    p_d = b + (1 - b) g_d(x_d)              light of the projector
    q_c = sum_d mixing[c, d] p_d            light that channel c of T answers to, (N,)
    L_c = C (T_c q_c + a_c)                 radiance on the camera's pixels
    v   = max(sensitivity seconds L, 0)     linear value; 1 fills a pixel of E electrons
    n   = Poisson(E v) / E + Normal(0, r)   photons, and read noise r
    c   = o + (1 - o) f(min(n, 1))          offset o and camera curve f, where n < 0 as -f(-n)
    code = round(c (2^bits - 1))            in [0, 2^bits - 1]; or c itself of a float camera

The unit of light is that of T: rows that sum to 1 give 1 per second under white. The only blur is
that of C.
"""

from __future__ import annotations

import hashlib
import itertools
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.acquisition.rig import as_codes, as_exposures, shot_key
from ltcl.errors import InputError
from ltcl.images import from_srgb, to_srgb
from ltcl.transport.fingerprint import fingerprint
from ltcl.transport.matrices import check_matrices, check_mixing

Curve = Callable[[np.ndarray], np.ndarray]
Place = Callable[[np.ndarray, np.ndarray], tuple[Any, Any]]
_G, _M = (
    1.2,
    0.25**1.2,
)  # film: c = (1 + m^g) l^g / (l^g + m^g), a logistic in log l (Hurter and Driffield)
# Light to code of a camera, and code to light of a projector, by name; 0 to 0 and 1 to 1.
CURVES: dict[str, tuple[Curve, Curve]] = {
    "linear": (np.array, np.array),
    "srgb": (to_srgb, from_srgb),
    "film": (
        lambda x: (1 + _M) * x**_G / (x**_G + _M),
        lambda c: (_M * c / (1 + _M - c)) ** (1 / _G),
    ),
    "gamma2.2": (lambda light: light ** (1 / 2.2), lambda code: code**2.2),
}


@dataclass(frozen=True)
class Sensor:
    """Camera and projector of a simulated rig.

    `response` and `projector_response` are "linear", "srgb", "gamma2.2" or "film", or three of
    these. `bits` 8 gives uint8, 9 to 16 uint16, "float" float32. `black` is the offset of the
    codes, of full scale, `projector_black` the light at code 0, of full white. `gain` are electrons
    at full scale, None for no photon noise; `read`, of full scale, the deviation of the read noise;
    `exposures` seconds, None for any.
    """

    response: Any = "srgb"
    projector_response: Any = "srgb"
    bits: int | str = 8
    black: float = 0.004
    projector_black: float = 0.0
    gain: float | None = 10000.0
    read: float = 0.0005
    exposures: Any = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.bits != "float" and (type(self.bits) is not int or self.bits not in range(8, 17)):
            raise InputError(f'bits is {self.bits!r}; it must be 8 to 16, or "float"')
        for name in ("black", "projector_black", "read"):
            checks.number(name, getattr(self, name), least=0.0, below=1.0)
        if self.gain is not None:
            checks.number("gain", self.gain, least=1.0, most=1e9)
        checks.count("seed", self.seed, least=0)


class SimulatedRig:
    """A projector and a camera whose light comes from `_radiance(codes)` of a subclass.

    Noise depends on seed, codes, seconds and the number of equal shots before, so that a run can
    resume.
    """

    sensitivity = 1.0
    _radiance: Callable[[np.ndarray], np.ndarray]

    def __init__(
        self, projector_grid: tuple[int, int], channels: int, sensor: dict[str, Any]
    ) -> None:
        self.sensor = Sensor(**sensor)
        self.projector_grid, self.channels = projector_grid, channels
        self.exposures = as_exposures("exposures", self.sensor.exposures)
        self.bits = None if isinstance(self.sensor.bits, str) else self.sensor.bits
        self._camera = _curves("response", self.sensor.response, channels)
        self._projector = _curves("projector_response", self.sensor.projector_response, channels)
        self._facts: dict[str, Any] = {}  # of the subclass
        self._repeats: Counter[str] = Counter()
        self._last: tuple[np.ndarray, np.ndarray] | None = None  # a bracket repeats its codes

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        """What the camera gives for codes (h, w[, 3]) in [0, 1]: uint8, uint16 or float32, (H, W[, 3])."""
        codes = as_codes(codes, self.projector_grid, self.channels)
        checks.number("seconds", seconds, above=0.0)  # any, also where a camera would offer others
        value = np.maximum(self.sensitivity * seconds * self.radiance(codes), 0.0)
        noise, sensor = self._noise(codes, seconds), self.sensor
        if (
            sensor.gain is not None
        ):  # far beyond saturation nothing changes; Poisson draws end at about 2^63
            value = noise.poisson(sensor.gain * np.minimum(value, 1e6)) / sensor.gain
        value = value + noise.normal(0.0, sensor.read, value.shape)
        code = sensor.black + (1.0 - sensor.black) * _apply(self._camera, 0, np.minimum(value, 1.0))
        if self.bits is None:
            return code.astype(np.float32)
        largest = (1 << self.bits) - 1
        return np.rint(np.clip(code, 0.0, 1.0) * largest).astype(
            np.uint8 if largest == 255 else np.uint16
        )

    def recall(self, codes: Any, seconds: float, image: np.ndarray) -> None:
        """Skip the noise of a photograph that was taken in an earlier session."""
        self._noise(as_codes(codes, self.projector_grid, self.channels), seconds)

    def radiance(self, codes: Any) -> np.ndarray:
        """L without a sensor, to compare photographs with: float64, (H, W) or (H, W, 3)."""
        codes = as_codes(codes, self.projector_grid, self.channels)
        if self._last is None or not np.array_equal(self._last[0], codes):
            self._last = codes.copy(), self._radiance(codes)
        return self._last[1].copy()

    def describe(self) -> dict[str, Any]:
        """What makes the photographs, as plain JSON."""
        sensor = {name: value for name, value in asdict(self.sensor).items() if name != "exposures"}
        shape = {"projector_grid": self.projector_grid, "channels": self.channels}
        return self._facts | shape | sensor | {"sensitivity": self.sensitivity}

    def _light(self, codes: np.ndarray) -> np.ndarray:
        """p: float64, (h, w) or (h, w, 3), of the projector's channels."""
        light = codes.astype(np.float64)
        if self.channels == 3 and light.ndim == 2:
            light = light[..., None].repeat(3, axis=-1)
        black = self.sensor.projector_black
        return black + (1.0 - black) * _apply(self._projector, 1, light)

    def _noise(self, codes: np.ndarray, seconds: float) -> np.random.Generator:
        """The counter-based stream (Philox) of the next photograph of `codes` for `seconds`."""
        shot = shot_key(codes, seconds)
        text = bytes.fromhex(shot) + f"{self.sensor.seed} {self._repeats[shot]}".encode()
        self._repeats[shot] += 1
        key = int.from_bytes(hashlib.blake2b(text, digest_size=16).digest(), "little")
        return np.random.Generator(np.random.Philox(key=key))


def _curves(argument: str, value: Any, channels: int) -> list[tuple[Curve, Curve]]:
    names = list(value) if isinstance(value, (list, tuple)) else [value] * channels
    if len(names) != channels:
        raise InputError(f"{argument} has {len(names)} curves; it must be one curve, or {channels}")
    return [CURVES[checks.one_of(argument, name, CURVES)] for name in names]


def _apply(curves: list[tuple[Curve, Curve]], direction: int, value: np.ndarray) -> np.ndarray:
    """The curve of each channel, to codes (0) or to light (1), odd about 0."""
    planes = np.abs(value).reshape(*value.shape[:2], -1)
    applied = [curve[direction](planes[..., c]) for c, curve in enumerate(curves)]
    return np.copysign(np.stack(applied, axis=-1).reshape(value.shape), value)


class VirtualRig(SimulatedRig):
    """A projector and a camera around a known T.

    Parameters
    ----------
    T : (M, N) array, scipy.sparse matrix, LinearOperator, a sequence of 3, or a Transport, with its
    mixing
    grid, camera_grid : (h, w), (H, W)
        Of the projector, N = h w; of the photographs, needed where that is another.
    camera_map, mixing : (H W, M) matrix, (3, 3), optional
        C, such as `camera_map` makes it, without it M = H W and C = I; of the projector's colours.
    ambient, sensitivity : float, (channels,), (M,) or (M, channels); float
        a: radiance without the projector; linear value for radiance 1 in one second.
    **sensor : of `ltcl.acquisition.rigs.virtual.Sensor`

    Examples
    --------
    >>> T = np.array([[0.5, 0.1], [0.1, 0.5]])
    >>> rig = VirtualRig(T, grid=(1, 2), response="linear", gain=None, read=0.0, black=0.0)
    >>> rig.photograph(np.array([[1.0, 0.0]]), seconds=1.0)
    array([[128,  26]], dtype=uint8)
    """

    def __init__(
        self,
        T: Any,
        grid: tuple[int, int],
        *,
        camera_grid: tuple[int, int] | None = None,
        camera_map: Any = None,
        mixing: Any = None,
        ambient: Any = 0.0,
        sensitivity: float = 1.0,
        **sensor: Any,
    ) -> None:
        if getattr(T, "blocks", None) is not None:
            raise InputError(
                "T has blocks between colours; it must have one matrix a channel, and a mixing"
            )
        matrices = check_matrices(getattr(T, "matrices", T), "T")
        self._T = [A.astype(np.float32) if A.dtype.kind in "iub" else A for A in matrices]
        rows, columns = self._T[0].shape
        super().__init__(checks.grid("grid", grid, columns), len(self._T), sensor)
        maps = [] if camera_map is None else check_matrices(camera_map, "camera_map")
        (pixels, width), self._map = (maps[0].shape, maps[0]) if maps else ((rows, rows), None)
        if len(maps) > 1 or width != rows:
            shape = f"{len(maps)} x {(pixels, width)}"
            raise InputError(
                f"camera_map has shape {shape}; it must be 1 x (H W, {rows}), the rows of T"
            )
        self.camera_grid = checks.grid(
            "camera_grid", grid if camera_grid is None else camera_grid, pixels
        )
        mixing = getattr(T, "mixing", None) if mixing is None else mixing
        self._mixing = (
            None if mixing is None else check_mixing(mixing, self.channels, has_blocks=False)
        )
        a = checks.finite("ambient", checks.real("ambient", ambient)).astype(np.float64)
        checks.shape("ambient", a, (), (self.channels,), (rows,), (rows, self.channels))
        if a.min() < 0:
            raise InputError(f"ambient is as low as {a.min():g}; light is never negative")
        self.ambient = a[:, None] if a.shape == (rows,) != (self.channels,) else np.atleast_2d(a)
        self.sensitivity = checks.number("sensitivity", sensitivity, above=0.0)
        mapped = None if self._map is None else fingerprint(self._map)
        digests = {"transport": fingerprint(*self._T), "ambient": fingerprint(self.ambient)}
        self._facts = {"kind": "virtual", "digests": digests | {"camera_map": mapped}}
        self._facts |= {
            "camera_grid": self.camera_grid,
            "ambient": self.ambient.mean(axis=0).tolist(),
        }
        self._facts["mixing"] = None if self._mixing is None else self._mixing.tolist()

    def _radiance(self, codes: np.ndarray) -> np.ndarray:
        p = self._light(codes)
        q = (p if self._mixing is None else p @ self._mixing.T).reshape(-1, self.channels)
        L = (
            np.stack([T @ q[:, c].astype(T.dtype) for c, T in enumerate(self._T)], axis=-1)
            + self.ambient
        )
        L = L if self._map is None else self._map @ L
        return L.reshape(self.camera_grid if self.channels == 1 else (*self.camera_grid, 3))


def camera_map(
    place: Place, camera_grid: tuple[int, int], grid: tuple[int, int], *, points: int = 12
) -> scipy.sparse.csr_array:
    """C for `VirtualRig`: the part of the rays through camera pixel m that end in projector pixel n.

    C is (H W, h w), float64. place(u, v) gives column and row of the projector (x, y) that the ray
    through column u and row v of the camera hits, arrays of one shape, centres of pixels at
    integers; NaN or a place outside the grid for nothing lit. Of `points` rays a side, entries are
    good to about 1 / points^1.5.

    >>> camera_map(lambda u, v: (2 * u + 0.5, v), (1, 2), (1, 4)).toarray()  # twice as coarse
    array([[0.5, 0.5, 0. , 0. ],
           [0. , 0. , 0.5, 0.5]])
    """
    (H, W), (h, w) = checks.grid("camera_grid", camera_grid), checks.grid("grid", grid)
    k = checks.count("points", points)
    v, u = np.mgrid[:H, :W].astype(np.float64)
    offsets = (np.arange(k) + 0.5) / k - 0.5
    C = scipy.sparse.csr_array((H * W, h * w))
    for dv, du in itertools.product(offsets, offsets):
        x, y, _ = np.broadcast_arrays(*place(u + du, v + dv), u)
        column, row = np.floor(x + 0.5).ravel(), np.floor(y + 0.5).ravel()
        hit = np.flatnonzero(
            (column >= 0) & (column < w) & (row >= 0) & (row < h)
        )  # NaN is nowhere
        n = (row[hit] * w + column[hit]).astype(np.int64)
        C = C + scipy.sparse.csr_array((np.ones(len(hit)), (hit, n)), shape=C.shape)
    return scipy.sparse.csr_array(C / k**2)
