# SPDX-License-Identifier: BSD-3-Clause
"""Acquisitions in processes of their own that end at a given line of ltcl.

That process has imported everything and opened no OpenCL device, and forks for every acquisition. (A child of
a process that had opened one lacks PoCL's threads, and waits for them for ever.)
"""

from __future__ import annotations

import json
import mmap
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

import ltcl
from ltcl.acquisition import VirtualRig
from ltcl.acquisition.radiometry import Response
from tests.store.stores import at_line, in_child, interrupt, kill, status_of

ROOT = Path(__file__).resolve().parents[2]
LINE = Response(np.array([[-0.004 / 0.996, 1.0]]))  # of a camera with an offset of 0.4 %
MADE: dict[str, dict[str, Any]] = {
    "pixel": {"grid": (6, 8)},
    "hadamard": {"grid": (6, 6), "order": 15},
    "block": {"grid": (8, 8), "channels": 3, "block": 2},
    "adaptive": {"grid": (8, 8)},
}
"""Rigs and settings, by strategy."""
ENDS = {"SIGKILL": kill, "Ctrl-C": interrupt}


def scene(grid: tuple[int, int]) -> np.ndarray:
    """A T whose light falls off with the distance, float64; made without a device."""
    y, x = np.mgrid[: grid[0], : grid[1]].reshape(2, -1)
    return 0.5 * np.eye(len(x)) + 0.004 * np.exp(-np.hypot(x[:, None] - x, y[:, None] - y) / 3)


def made(strategy: str) -> tuple[VirtualRig, dict[str, Any]]:
    """The rig of a strategy, and the arguments of `acquire`."""
    given = dict(MADE[strategy])
    grid, channels = given.pop("grid"), given.pop("channels", 1)
    T = [scene(grid) * (1.0 - 0.2 * c) for c in range(channels)]
    rig = VirtualRig(T if channels == 3 else T[0], grid, bits=12, ambient=0.01, response="linear")
    common = {"geometry": "aligned", "response": LINE, "exposures": [0.5], "frames": 2}
    return rig, {"strategy": strategy, **common, **given}


class Nursery:
    """A process that forks acquisitions."""

    def __init__(self) -> None:
        command = [sys.executable, "-m", "tests.acquisition.stopping"]
        own = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self._process = subprocess.Popen(command, cwd=ROOT, env=own, **pipes)

    def acquire(
        self, store: Path, strategy: str, line: int = 0, end: str = "SIGKILL"
    ) -> tuple[int, int, int]:
        """Acquire, and end at a line of ltcl; the status, the lines and the photographs."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        task = {"store": str(store), "strategy": strategy, "line": line, "end": end}
        self._process.stdin.write(json.dumps(task) + "\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        assert answer, "the process that forks acquisitions has ended"
        status, lines, photographs = json.loads(answer)
        return status, lines, photographs

    def close(self) -> None:
        """End the process."""
        with self._process as process:  # closes its pipes, upon which it ends
            pass
        assert process.returncode == 0


def _work(task: dict[str, Any], counts: np.ndarray) -> None:
    rig, given = made(task["strategy"])
    real = rig.photograph

    def photograph(codes: Any, seconds: float) -> np.ndarray:
        counts[1] += 1
        return real(codes, seconds)

    rig.photograph = photograph
    lines = at_line(task["line"], ENDS[task["end"]])
    ltcl.acquire(rig, store=task["store"], **given)
    sys.settrace(None)
    counts[0] = lines[0]


def main() -> None:
    """Read a task from each line; answer with status, lines and photographs."""
    os.fsync = lambda _: None  # no power is cut here
    for line in sys.stdin:
        shared = mmap.mmap(-1, 16)
        counts = np.frombuffer(shared, np.int64)
        status = status_of(in_child(lambda line=line, counts=counts: _work(json.loads(line), counts)))
        sys.stdout.write(json.dumps([status, *counts.tolist()]) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
