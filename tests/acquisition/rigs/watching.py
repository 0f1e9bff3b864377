# SPDX-License-Identifier: BSD-3-Clause
"""A camera that looks at pygame's surface through a `VirtualRig`; time passes only where one waits for it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pygame

from ltcl.acquisition import VirtualRig
from ltcl.errors import AcquisitionError

GRID = (6, 8)
N = 48
SECONDS = 1 / 15
T = 0.5 * np.eye(N) + 0.2 / N
CLEAN: dict[str, Any] = {"gain": None, "read": 0.0}
FRAME = 1 / 30  # seconds between two frames of the camera


def scene(**options: Any) -> VirtualRig:
    """White gives about 0.6 of full scale, before the response, in SECONDS."""
    return VirtualRig(T, GRID, **{"sensitivity": 13.0, **options})


def codes_on_screen() -> np.ndarray:
    """What the middles of the blocks show, (h, w) of green, if they stand in the middle of the surface."""
    surface = pygame.display.get_surface()
    assert surface is not None
    width, height = surface.get_size()
    block = min(width // GRID[1], height // GRID[0])
    x, y = (width - GRID[1] * block) // 2 + block // 2, (height - GRID[0] * block) // 2 + block // 2
    shown = pygame.surfarray.pixels3d(surface)[x::block, y::block, 1]
    return shown[: GRID[1], : GRID[0]].T.astype(np.float32) / np.float32(255)


class Clock:
    """In place of the module `time`."""

    def __init__(self) -> None:
        self.now = 100.0
        self.watchers: list[Callable[[], None]] = []

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.pass_to(self.now + seconds + 1e-9)  # no sleep ends early, as rounding could let it

    def pass_to(self, moment: float) -> None:
        for look in self.watchers:
            look()
        self.now = max(self.now, moment)


class Watcher:
    """A streaming camera with a rolling shutter.

    Row r of the frame that arrives at time t shows what was on the screen at
    t - latency(t) - readout (1 - r / H), but nothing older than the frame before: when the latency grows,
    frames hang. Frames wait in a queue; who reads too late gets old ones.
    """

    channels = 1
    stream = True

    def __init__(
        self,
        clock: Clock,
        rig: VirtualRig,
        *,
        latency: float | Callable[[float], float] = 0.08,
        readout: float = 0.02,
        queue: int = 3,
        exposures: tuple[float, ...] | None = None,
    ) -> None:
        self.clock, self.rig, self.readout, self.queue = clock, rig, readout, queue
        self.latency = latency if callable(latency) else lambda _: latency
        self.exposures = exposures
        self.seconds = SECONDS
        self.gain: Callable[[float, np.ndarray], float] = lambda moment, codes: 1.0
        self.frames = 0
        self.unplugged = False
        self.frozen: np.ndarray | None = None
        self._index = 0
        self._seen = -math.inf
        self._history: list[tuple[float, np.ndarray]] = [(-math.inf, np.zeros(GRID, np.float32))]
        clock.watchers.append(self._look)

    def expose(self, seconds: float) -> None:
        self.seconds = seconds

    def frame(self) -> np.ndarray:
        if self.unplugged:
            raise AcquisitionError("no frame comes: the camera was unplugged")
        newest = math.floor(self.clock.now / FRAME)
        self._index = max(self._index + 1, newest - self.queue + 1)
        arrival = self._index * FRAME
        self.clock.pass_to(arrival)
        self.frames += 1
        return self._picture(arrival) if self.frozen is None else self.frozen

    def _look(self) -> None:
        shown = codes_on_screen()
        if not np.array_equal(shown, self._history[-1][1]):
            self._history.append((self.clock.now, shown))

    def _picture(self, arrival: float) -> np.ndarray:
        h = GRID[0]
        self._seen = max(self._seen, arrival - self.latency(arrival))
        moments = self._seen - self.readout * (1 - np.arange(h) / h)
        places = [max(k for k, (since, _) in enumerate(self._history) if since <= m) for m in moments]
        image = None
        for place in sorted(set(places)):
            codes = self._history[place][1]
            rows = np.array(places) == place
            whole = self.rig.photograph(codes, self.seconds * self.gain(arrival, codes))
            image = whole if image is None else image
            image[rows] = whole[rows]
        assert image is not None
        return image
