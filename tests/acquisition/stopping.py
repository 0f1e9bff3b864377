# SPDX-License-Identifier: BSD-3-Clause
"""Rigs that fail, and acquisitions in processes of their own that end at a line of ltcl.

They are forks of a server that has opened no OpenCL device: a child of a process that had opened
one lacks PoCL's threads, and waits for them for ever.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import ltcl
from ltcl.acquisition import VirtualRig
from ltcl.acquisition.radiometry import Response
from tests.store.stores import at_line, interrupt, kill

LINEAR_RESPONSE = Response(np.array([[-0.004 / 0.996, 1.0]]))
"""Response of a linear camera with an offset of 0.4 %."""
SETTINGS: dict[str, dict[str, Any]] = {
    "pixel": {"grid": (6, 8)},
    "hadamard": {"grid": (6, 6), "order": 15},
    "block": {"grid": (8, 8), "channels": 3, "block": 2},
    "adaptive": {"grid": (8, 8)},
    "sketch": {"grid": (8, 8)},
    "direct": {"grid": (8, 8)},
}
"""Rigs and settings by strategy."""


def scene(grid: tuple[int, int]) -> np.ndarray:
    """A T whose light falls off with the distance, float64; made without a device."""
    y, x = np.mgrid[: grid[0], : grid[1]].reshape(2, -1)
    distance = np.hypot(x[:, None] - x, y[:, None] - y)
    return 0.5 * np.eye(len(x)) + 0.004 * np.exp(-distance / 3)


class Unplugged(VirtualRig):
    """A rig that gives `left` photographs, which it counts, then fails.

    `fault` changes an image by its codes.
    """

    keeps_photographs = False

    def __init__(
        self,
        T: Any,
        grid: tuple[int, int],
        *,
        left: int = 1 << 30,
        fault: Callable[[Any, np.ndarray], np.ndarray] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(T, grid, **{"bits": 12, "ambient": 0.01, **options})
        self.left = left
        self.fault = fault
        # A list, in whose place a child process has memory that it shares.
        self.counts: Any = [0]

    @property
    def count(self) -> int:
        return self.counts[0]

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        if self.count == self.left:
            raise OSError("unplugged")
        self.counts[0] += 1
        image = super().photograph(codes, seconds)
        return image if self.fault is None else self.fault(codes, image)


def set_up(strategy: str, left: int = 1 << 30) -> tuple[Unplugged, dict[str, Any]]:
    """The rig of a strategy, and the arguments of `acquire`."""
    settings = dict(SETTINGS[strategy])
    grid = settings.pop("grid")
    T: Any = scene(grid)
    if settings.pop("channels", 1) == 3:
        T = [T, 0.8 * T, 0.6 * T]
    rig = Unplugged(T, grid, left=left, response="linear")
    return rig, {
        "strategy": strategy,
        "geometry": "aligned",
        "response": LINEAR_RESPONSE,
        "exposures": [0.5],
        "frames": 2,
        **settings,
    }


def acquire_and_end(
    store: Path, strategy: str, line: int = 0, end: str = "SIGKILL"
) -> tuple[int, int, int]:
    """Acquire in a child process, which ends at a line of ltcl: status, photographs and lines."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["pytest", __name__])
    counts = context.RawArray("q", 2)
    child = context.Process(target=_work, args=(store, strategy, line, end, counts))
    child.start()
    child.join()
    assert child.exitcode is not None
    return child.exitcode, counts[0], counts[1]


def _work(store: Path, strategy: str, line: int, end: str, counts: Any) -> None:
    os.fsync = lambda _: None  # no power is cut here
    rig, settings = set_up(strategy)
    rig.counts = counts
    lines = at_line(line, kill if end == "SIGKILL" else interrupt)
    try:
        ltcl.acquire(rig, store=store, **settings)
    except KeyboardInterrupt:
        sys.exit(2)
    finally:
        sys.settrace(None)
        counts[1] = lines[0]
