# SPDX-License-Identifier: BSD-3-Clause
"""A painted picture to show on walls: sunset over mountains and a lake.

Made from noise alone, so nothing is downloaded and any size can be had; seed and aspect ratio decide
the forms, the resolution only their detail. It asks much of a projector on purpose: saturated
blues and oranges, whites, deep blacks and fine detail.

The canvas is painted back to front in display values (gamma 2.2), which is how colours are named, at
higher resolution than wanted, then made linear and averaged down. Lengths are in picture heights.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ltcl import checks
from ltcl.scenes.noise import blend, fractal, look_up, ridged, step

_SHORE = 0.62  # where the far shore lies, from the top
_NEAREST, _FARTHEST, _SLICES = 2.0, 6.5, 420  # of the height field behind it
_TEXTURE = (1280, 1280)
_CANVAS = 1_200_000  # pixels painted at least, unless a side would grow beyond
_SIDE = 4096
_LONGEST = 32766  # pixels along an image that OpenCV can still address

_SKY = np.array(
    [  # height, red, green, blue
        (0.00, 0.03, 0.16, 0.45),
        (0.18, 0.10, 0.36, 0.70),
        (0.32, 0.38, 0.60, 0.80),
        (0.42, 0.93, 0.74, 0.52),
        (0.50, 1.00, 0.62, 0.28),
        (0.62, 0.98, 0.45, 0.20),
    ]
)


@dataclass(frozen=True)
class _Canvas:
    """Source of chance, size in pixels, coordinates x (1, width) and y (height, 1), the sun's place."""

    rng: np.random.Generator
    height: int
    width: int

    @property
    def shape(self) -> tuple[int, int]:
        return self.height, self.width

    @property
    def aspect(self) -> float:
        return self.width / self.height

    @property
    def _reach(self) -> float:
        # Noise is drawn out on panoramas beyond 8:1, or its lattices would outgrow the picture.
        return min(self.aspect, 8.0)

    @property
    def y(self) -> np.ndarray:
        return ((np.arange(self.height, dtype=np.float32) + 0.5) / self.height)[:, None]

    @property
    def x(self) -> np.ndarray:
        return ((np.arange(self.width, dtype=np.float32) + 0.5) / self.height)[None, :]

    @property
    def sun(self) -> tuple[float, float]:
        return 0.64 * self.aspect, 0.43

    def glow(self, radius: float, squeeze: float = 1.0) -> np.ndarray:
        """1 at the sun, falling off like a Gaussian, (height, width); `squeeze` flattens it."""
        return np.exp(-((self.to_sun(squeeze) / radius) ** 2))

    def to_sun(self, squeeze: float = 1.0) -> np.ndarray:
        return np.hypot(self.x - self.sun[0], squeeze * (self.y - self.sun[1]))

    def skyline(self, cells: float, octaves: int) -> np.ndarray:
        """Noise along x, (1, width), with `cells` to a picture height."""
        return fractal(self.rng, (1, self.width), (1, cells * self._reach), octaves)

    def grain(self, cells: float, octaves: int) -> np.ndarray:
        """Noise all over, (height, width)."""
        return fractal(self.rng, self.shape, (cells, cells * self._reach), octaves)

    def below(self, crest: np.ndarray) -> np.ndarray:
        """Coverage of what lies under a line (1, width), one pixel soft."""
        return np.clip((self.y - crest) * self.height + 0.5, 0, 1)


def landscape(h: int, w: int, seed: int = 7) -> np.ndarray:
    """Sunset over mountains and a lake, a colourful target picture made from noise.

    Parameters
    ----------
    h, w : int
        Pixels, up to 32766 each.
    seed : int
        Another seed, another place.

    Returns
    -------
    ndarray, (h, w, 3), float32
        Linear red, green, blue in [0, 1].

    Raises
    ------
    InputError
        If h or w is not a whole number from 1 to 32766, or seed not one of at least 0.

    Examples
    --------
    >>> picture = landscape(48, 64)
    >>> picture.shape, picture.dtype
    ((48, 64, 3), dtype('float32'))
    """
    for name, side in (("h", h), ("w", w)):
        checks.number(name, checks.count(name, side), most=_LONGEST)
    seed = checks.count("seed", seed, least=0)
    # Area averaging from a larger canvas smooths all edges; big pictures are painted as they are.
    zoom = max(1.0, min(np.sqrt(_CANVAS / (h * w)), _SIDE / max(h, w)))
    height, width = round(h * zoom), round(w * zoom)
    canvas = _Canvas(np.random.default_rng(seed), height, width)
    picture = _clouds(canvas, _sky(canvas))
    picture = _mountains(canvas, picture)
    picture = _forest(canvas, picture)
    picture = _lake(canvas, picture)
    picture = _foreground(canvas, picture)
    linear = np.clip(picture, 0, 1) ** np.float32(2.2)
    return np.clip(cv2.resize(linear, (w, h), interpolation=cv2.INTER_AREA), 0, 1)


def _sky(canvas: _Canvas) -> np.ndarray:
    """Blue overhead, gold at the horizon, bright around the sun."""
    column = np.stack([np.interp(canvas.y, _SKY[:, 0], colour) for colour in _SKY.T[1:]], axis=-1)
    sky = blend(column, (1.0, 0.70, 0.25), 0.75 * canvas.glow(0.42, squeeze=1.5))
    sky = blend(sky, (1.0, 0.93, 0.65), 0.9 * canvas.glow(0.13, squeeze=1.5))
    return blend(sky, (1.0, 1.0, 0.96), step(0.042, 0.036, canvas.to_sun()))


def _clouds(canvas: _Canvas, picture: np.ndarray) -> np.ndarray:
    """A flat layer of clouds in perspective, bright where it thins out towards the sun."""
    texture = fractal(canvas.rng, (1024, 1024), (7, 7), octaves=7)
    depth = 0.30 / (_SHORE + 0.02 - np.minimum(canvas.y, _SHORE - 0.02))
    u, v = 500 + 520 * (canvas.x - canvas.aspect / 2) * depth, 200 + 330 * depth
    density = look_up(texture, u, v)
    toward = look_up(texture, u + 16 * np.tanh(6 * (canvas.sun[0] - canvas.x)), v + 14)
    light = np.clip(0.55 + 3.4 * (density - toward), 0, 1)
    near = canvas.glow(0.5, squeeze=1.3)
    overhead = step(0.40, 0.05, canvas.y) * (1 - near)
    lit = blend(blend((1.0, 0.62, 0.38), (1.0, 0.93, 0.88), overhead), (1.0, 0.86, 0.55), 0.8 * near)
    dark = blend((0.48, 0.38, 0.55), (0.33, 0.42, 0.62), overhead)
    cover = step(0.44, 0.64, density) * step(_SHORE, 0.36, canvas.y)
    return blend(picture, blend(dark, lit, light), 0.92 * cover)


def _mountains(canvas: _Canvas, picture: np.ndarray) -> np.ndarray:
    """A height field in perspective, cut into upright slices from near to far."""
    depth = np.geomspace(_NEAREST, _FARTHEST, _SLICES, dtype=np.float32)[:, None]
    terrain = ridged(canvas.rng, _TEXTURE, (4.5, 4.5), octaves=7)
    u, v = 640 + 210 * (canvas.x - canvas.aspect / 2) * depth, 250 * (depth - _NEAREST)
    height = look_up(terrain, u, v) * (0.08 + 1.60 * step(_NEAREST, 6.0, depth))  # (slices, width)
    # Each pixel shows the nearest slice that reaches up to it.
    crest = np.minimum.accumulate(_SHORE + 0.005 - height / depth, axis=0)
    nearest = np.zeros(canvas.shape, dtype=np.intp)
    rows = slice(max(0, int(crest.min() * canvas.height)), int(_SHORE * canvas.height) + 1)
    for line in crest:
        nearest[rows] += line > canvas.y[rows]
    colours = _terrain_colours(canvas, terrain, (u, v), height, depth)
    seen = np.take_along_axis(colours, np.minimum(nearest, _SLICES - 1)[..., None], axis=0)
    return blend(picture, seen, canvas.below(crest[-1:]))


def _terrain_colours(
    canvas: _Canvas,
    terrain: np.ndarray,
    place: tuple[np.ndarray, np.ndarray],
    height: np.ndarray,
    depth: np.ndarray,
) -> np.ndarray:
    """Woods below, rock above, snow where it is high and flat, all in haze, (slices, width, 3)."""
    u, v = place
    slope = look_up(terrain, u + 2, v - 1) - look_up(terrain, u - 2, v + 1)
    steep = np.abs(look_up(terrain, u + 3, v) - look_up(terrain, u - 3, v))
    light = np.clip(0.45 - 11 * slope, 0, 1)
    land = blend((0.04, 0.10, 0.14), (0.30, 0.30, 0.16), light)
    rock = blend((0.17, 0.17, 0.30), (0.80, 0.50, 0.38), light)
    snow = blend((0.46, 0.56, 0.86), (1.00, 0.97, 0.93), light)
    land = blend(land, rock, step(0.10, 0.30, height + 0.5 * steep))
    land = blend(land, snow, step(0.38, 0.58, height - 2.0 * steep))
    glow = np.exp(-(((canvas.x - canvas.sun[0]) / 0.35) ** 2))
    air = blend((0.52, 0.56, 0.78), (1.0, 0.66, 0.38), glow)
    return blend(land, air, (0.03 + 0.30 * step(_NEAREST, 8.5, depth)) * (1 + 0.5 * glow))


def _forest(canvas: _Canvas, picture: np.ndarray) -> np.ndarray:
    """A dark fringe of trees along the far shore."""
    tips, hills = canvas.skyline(110, octaves=2), canvas.skyline(4, octaves=3)
    crest = _SHORE - 0.004 - 0.045 * np.maximum(hills - 0.25, 0) - 0.020 * np.maximum(tips - 0.3, 0)
    green = blend((0.03, 0.09, 0.10), (0.12, 0.20, 0.13), canvas.grain(160, octaves=2))
    return blend(picture, green, canvas.below(crest))


def _lake(canvas: _Canvas, picture: np.ndarray) -> np.ndarray:
    """The mirrored scene, broken by ripples that grow towards the viewer, and a path of sunlight."""
    below = np.maximum(canvas.y - _SHORE, 0)
    near = 1 / (below + 0.02)
    waves = fractal(canvas.rng, (1024, 1024), (60, 24), octaves=4)
    ripple = look_up(waves, 512 + 30 * (canvas.x - canvas.aspect / 2) * near, 34 * near) - 0.5
    above = _SHORE - 1.15 * below + 0.42 * ripple * np.minimum(below + 0.02, 0.22)
    rows = np.minimum(above, _SHORE - 1 / canvas.height) * canvas.height
    mirror = 0.88 * look_up(picture, canvas.x * canvas.height, rows)
    water = blend(mirror, (0.02, 0.16, 0.34), 0.10 + 0.40 * step(0.0, 0.42, below) - 0.30 * ripple)
    path = np.exp(-(((canvas.x - canvas.sun[0]) / (0.035 + 0.22 * below)) ** 2))
    glitter = 0.9 * step(0.03, 0.16, ripple + 0.05 * step(0.2, 0.0, below))
    water = blend(water, (1.0, 0.86, 0.55), path * np.maximum(glitter, 0.45 * step(0.3, 0.1, below)))
    return blend(picture, water, canvas.below(np.full((1, 1), _SHORE)))


def _foreground(canvas: _Canvas, picture: np.ndarray) -> np.ndarray:
    """A dark bank with grass, and tall firs at both sides."""
    firs = np.zeros(canvas.shape, dtype=np.uint8)
    for foot, height in _fir_places(canvas):
        cv2.fillPoly(firs, [_fir(canvas, foot, height)], 255, cv2.LINE_AA)
    bank, grass = canvas.skyline(2, octaves=3), canvas.skyline(130, octaves=3)
    crest = 0.985 - 0.38 * (canvas.x / canvas.aspect - 0.47) ** 2 - 0.07 * (bank - 0.5)
    cover = np.maximum(firs / np.float32(255), canvas.below(crest - 0.045 * (grass - 0.3)))
    dark = blend((0.01, 0.02, 0.03), (0.06, 0.09, 0.06), step(0.3, 1.0, canvas.grain(90, octaves=4)))
    return blend(picture, dark, cover)


def _fir_places(canvas: _Canvas) -> list[tuple[tuple[float, float], float]]:
    """Foot (x, y) and height of each fir: tall at the sides, most on the left, none in the middle."""
    places = []
    for k, (across, down, tall) in enumerate(canvas.rng.random((16, 3))):
        side = 0.20 * across**1.3 if k % 5 else 1 - 0.13 * across**1.3
        height = (0.24 + 0.42 * tall) * (1.15 - 3.2 * min(side, 1 - side))
        places.append(((side * canvas.aspect, 0.93 + 0.07 * down), height))
    return places


def _fir(canvas: _Canvas, foot: tuple[float, float], height: float) -> np.ndarray:
    """Outline of a fir in pixels, (points, 1, 2) int32: boughs that droop, longer towards the ground."""
    x, top = foot[0], foot[1] - height
    t = np.arange(26) / 26
    sides = []
    for sign in (1, -1):
        reach = sign * 0.17 * height * (0.04 + t) * (0.6 + 0.55 * canvas.rng.random(len(t)))
        tips = np.stack([x + reach, top + height * (0.05 + 0.93 * t)], axis=1)
        forks = np.stack([x + 0.42 * reach, top + height * (0.035 + 0.93 * t)], axis=1)
        sides.append(np.stack([tips, forks], axis=1).reshape(-1, 2))
    trunk = [(x + 0.008 * height, foot[1]), (x - 0.008 * height, foot[1])]
    points = np.concatenate([[(x, top)], sides[0], trunk, sides[1][::-1]])
    return np.round(points * canvas.height).astype(np.int32)[:, None]
