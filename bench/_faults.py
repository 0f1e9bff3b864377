# SPDX-License-Identifier: BSD-3-Clause
"""A person who photographs a list of patterns, with one fault: shared by benches of faults."""

from __future__ import annotations

import re
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np
import scipy.sparse

from ltcl.acquisition import VirtualRig, camera_map

# Camera pixels to one of the projector's, of an oblique camera.
SIZE = 3.0
EXCHANGED = "two exchanged"
REPEATED = "one repeated"
MISSING = "one missing"
LIGHT_ON = "light on in one"
OVEREXPOSED = "a third of a stop"
JPEG = "JPEG from one on"
# Shift of the camera in its pixels.
MOVES = {"moved 0.5 pixels": 0.5, "moved 2 pixels": 2.0}
KINDS = (EXCHANGED, REPEATED, MISSING, LIGHT_ON, *MOVES, OVEREXPOSED, JPEG)
# Different places of the cameras.
VIEWS = 10
# Most photographs in a range that still names one.
MAX_RANGE = 4


@cache
def view(
    grid: tuple[int, int], seed: int, shift: float, is_aligned: bool
) -> tuple[tuple[int, int], scipy.sparse.csr_array]:
    """A camera, shifted by `shift` of its pixels: its grid and its map.

    It is at a random place, or has the pixels of the projector.
    """
    h, w = grid
    rng = np.random.default_rng(seed)
    dx, dy = rng.uniform(-0.5, 0.5, 2)
    angle = rng.uniform(-0.05, 0.05)
    direction = rng.uniform(0, 2 * np.pi)
    size = SIZE
    shape = (int(1.2 * SIZE * h), int(1.2 * SIZE * w))
    middle = shape
    if is_aligned:
        dx = dy = angle = 0.0
        size = 1.0
        shape = grid
        middle = (h - 1, w - 1)
    c = np.cos(angle) / size
    s = np.sin(angle) / size

    def place(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        a = u - middle[1] / 2 + shift * np.cos(direction)
        b = v - middle[0] / 2 + shift * np.sin(direction)
        x = c * a + s * b + (w - 1) / 2 + dx
        y = c * b - s * a + (h - 1) / 2 + dy
        return x, y

    return shape, camera_map(place, shape, grid)


Shot = tuple[np.ndarray, float]


@dataclass(frozen=True, kw_only=True)
class Setup:
    """A scene T (N, N) of a projector of (h, w) pixels, options of a camera, and how it is scanned.

    `seed` is that of the noise, and of the place of the camera if it is not aligned. Faults are in
    the last `own_photographs`, those of the scan itself, or anywhere if that is 0.
    """

    name: str
    T: np.ndarray
    grid: tuple[int, int]
    camera: dict[str, Any]
    strategy: str
    seed: int
    is_aligned: bool = False
    own_photographs: int = 0

    def draw_photograph(self, random: np.random.Generator, photographs: int) -> int:
        """A number at random among so many photographs, but the last one."""
        first = 2
        if self.own_photographs:
            first = photographs - self.own_photographs + 1
        return int(random.integers(first, photographs - 1))


class Person:
    """A rig whose photographs come from a list, with a fault at number `at`."""

    keeps_photographs = True

    def __init__(self, setup: Setup, kind: str | None, at: int) -> None:
        self.setup = setup
        self.projector_grid = setup.grid
        self.channels = 1
        self.kind = kind
        self.at = at
        self.number = 0
        self._list: deque[Shot] = deque()
        self._postponed: Shot | None = None
        self._last: np.ndarray | None = None
        self._rig = self._make_rig(shift=0.0, ambient=0.01)
        ambient: Any = 0.01
        if kind == LIGHT_ON:
            strength = np.random.default_rng(setup.seed).uniform(0.01, 0.1)
            ambient = 0.01 + self._lamp(setup.T) * strength
        shift = 0.0
        if kind is not None:
            shift = MOVES.get(kind, 0.0)
        self._faulty_rig = self._make_rig(shift, ambient)
        self.bits = self._rig.bits

    def _make_rig(self, shift: float, ambient: Any) -> VirtualRig:
        setup = self.setup
        shape, C = view(setup.grid, setup.seed % VIEWS, shift, setup.is_aligned)
        return VirtualRig(
            setup.T,
            setup.grid,
            seed=setup.seed,
            camera_grid=shape,
            camera_map=C,
            ambient=ambient,
            **setup.camera,
        )

    def _lamp(self, T: np.ndarray) -> np.ndarray:
        """Light of a lamp in the room, (N,), brighter on the right."""
        h, w = self.projector_grid
        y, x = np.mgrid[:h, :w] / max(h, w)
        return T.sum(axis=1) * (0.6 + 0.8 * x + 0.3 * y).ravel()

    def prepare(self, shots: Iterable[tuple[Any, float]]) -> None:
        """Put shots at the end of the list, unless they are on it."""
        listed = Counter((codes.tobytes(), seconds) for codes, seconds in self._list)
        for codes, seconds in shots:
            key = (np.asarray(codes).tobytes(), seconds)
            listed[key] -= 1
            if listed[key] < 0:
                self._list.append((codes, seconds))

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        """Take the next photograph."""
        self.number += 1
        if self._is_next(codes, seconds):
            self._list.popleft()
        is_faulty = self.number == self.at
        is_from_fault_on = self.number >= self.at
        if self.kind == REPEATED and is_faulty and self._last is not None:
            return self._last
        rig = self._rig
        if self.kind in MOVES and is_from_fault_on:
            rig = self._faulty_rig
        if self.kind == LIGHT_ON and is_faulty:
            rig = self._faulty_rig
        image = rig.photograph(*self._actual_shot((codes, seconds)))
        if self.kind == JPEG and is_from_fault_on:
            image = self._through_jpeg(image)
        self._last = image
        return image

    def _is_next(self, codes: np.ndarray, seconds: float) -> bool:
        """Whether a shot is the next on the list."""
        if not self._list:
            return False
        next_codes, next_seconds = self._list[0]
        return next_seconds == seconds and np.array_equal(next_codes, codes)

    def _actual_shot(self, shot: Shot) -> Shot:
        """The shot that is taken instead, by the fault."""
        is_faulty = self.number == self.at
        following = shot
        if self._list:
            following = self._list[0]
        if self.kind == EXCHANGED and is_faulty:
            self._postponed = shot
            return following
        if self.kind == EXCHANGED and self.number == self.at + 1 and self._postponed is not None:
            return self._postponed
        if self.kind == MISSING and self.number >= self.at:
            return following
        if self.kind == OVEREXPOSED and is_faulty:
            codes, seconds = shot
            return codes, seconds * 2.0 ** (1 / 3)
        return shot

    def _through_jpeg(self, image: np.ndarray) -> np.ndarray:
        """Store a photograph as JPEG of quality 70, which has 8 bits."""
        dropped_bits = 0
        if self.bits:
            dropped_bits = self.bits - 8
        eight_bits = (image >> dropped_bits).astype(np.uint8)
        _, data = cv2.imencode(".jpg", eight_bits, [cv2.IMWRITE_JPEG_QUALITY, 70])
        decoded = np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE))
        return decoded.astype(image.dtype) << dropped_bits


def named_photographs(message: str) -> set[int]:
    """Numbers of photographs in a message, single ones and those of short ranges."""
    numbers: set[int] = set()
    pattern = r"photographs? (\d+)(?: \([^)]*\))?(?: to (?:photograph )?(\d+))?"
    for first_text, last_text in re.findall(pattern, message):
        first = int(first_text)
        last = first
        if last_text:
            last = int(last_text)
        if last - first < MAX_RANGE:
            numbers |= set(range(first, last + 1))
    return numbers
