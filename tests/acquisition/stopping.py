# SPDX-License-Identifier: BSD-3-Clause
"""Rigs that fail, and acquisitions in processes of their own that end at a line of ltcl.

They are forks of a server that has opened no OpenCL device: a child of a process that had opened
one lacks PoCL's threads, and waits for them for ever.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

import ltcl
from ltcl.acquisition import VirtualRig
from ltcl.acquisition.radiometry import Response
from tests.store.stores import at_line, interrupt, kill

LINE = Response(np.array([[-0.004 / 0.996, 1.0]]))  # of a camera with an offset of 0.4 %
SETTINGS: dict[str, dict[str, Any]] = {  # rigs and settings, by strategy
    "pixel": {"grid": (6, 8)},
    "hadamard": {"grid": (6, 6), "order": 15},
    "block": {"grid": (8, 8), "channels": 3, "block": 2},
    "adaptive": {"grid": (8, 8)},
}


def scene(grid: tuple[int, int]) -> np.ndarray:
    """A T whose light falls off with the distance, float64; made without a device."""
    y, x = np.mgrid[: grid[0], : grid[1]].reshape(2, -1)
    return 0.5 * np.eye(len(x)) + 0.004 * np.exp(-np.hypot(x[:, None] - x, y[:, None] - y) / 3)


class Unplugged(VirtualRig):
    """Gives `left` photographs, which it counts, then fails; `fault` changes them, by their codes."""

    keeps_photographs = False

    def __init__(
        self,
        T: Any,
        grid: tuple[int, int],
        *,
        left: int = 1 << 30,
        fault: Any = None,
        **options: Any,
    ) -> None:
        super().__init__(T, grid, **{"bits": 12, "ambient": 0.01, **options})
        self.left, self.counts, self.fault = left, [0], fault

    @property
    def count(self) -> int:
        return self.counts[0]

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        if self.count == self.left:
            raise OSError("unplugged")
        self.counts[0] += 1
        image = super().photograph(codes, seconds)
        return self.fault(codes, image) if self.fault else image


def set_up(strategy: str, left: int = 1 << 30) -> tuple[Unplugged, dict[str, Any]]:
    """The rig of a strategy, and the arguments of `acquire`."""
    settings = dict(SETTINGS[strategy])
    grid, channels = settings.pop("grid"), settings.pop("channels", 1)
    T = [scene(grid) * (1.0 - 0.2 * c) for c in range(channels)]
    rig = Unplugged(T if channels == 3 else T[0], grid, left=left, response="linear")
    common = {"geometry": "aligned", "response": LINE, "exposures": [0.5], "frames": 2}
    return rig, {"strategy": strategy, **common, **settings}


def acquire_and_end(
    store: Path, strategy: str, line: int = 0, end: str = "SIGKILL"
) -> tuple[int, int, int]:
    """Acquire in a process of its own, and end at a line of ltcl; its status, photographs and lines."""
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
