# SPDX-License-Identifier: BSD-3-Clause
"""Acquisitions in processes of their own that die at a given moment: `Nursery`, and the process behind it.

That process has imported everything and opened no OpenCL device, and forks for every acquisition. (A child of
a process that had opened one lacks PoCL's threads, and waits for them for ever.)

A child writes what it does into a log, a line each: `stage NAME` when it comes to scan, store or finalize;
`shot KEY` of every photograph, `kept` when it is of the calibration and was committed; `block CHANNEL NUMBER`
of every block that was committed. It counts events of
a stage: photographs, and calls of the system that change the disk. At the one that is asked for it kills
itself, before, inside or behind it; or it tells, and is killed from outside while it goes on.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import ltcl
from ltcl.acquisition import VirtualRig, run
from ltcl.acquisition.radiometry import Response
from ltcl.store import BlockStore, zarr_folder
from ltcl.store.blocks.shelf import Shelf

ROOT = Path(__file__).resolve().parents[2]
CALLS = ("write", "mkdir", "rename", "replace", "open", "rmdir", "unlink", "fsync", "close")
LINE = Response(np.array([[-0.004 / 0.996, 1.0]]))  # of a camera with an offset of 0.4 %
MADE: dict[str, dict[str, Any]] = {
    "pixel": {"grid": (12, 16)},
    "hadamard": {"grid": (8, 8), "order": 15},
    "block": {"grid": (12, 12), "channels": 3, "block": 2},
    "adaptive": {"grid": (8, 8)},
}
"""Rigs and settings, by strategy."""


def scene(grid: tuple[int, int]) -> np.ndarray:
    """A T whose light falls off with the distance, float64; made without a device."""
    y, x = np.mgrid[: grid[0], : grid[1]].reshape(2, -1)
    return 0.5 * np.eye(len(x)) + 0.004 * np.exp(-np.hypot(x[:, None] - x, y[:, None] - y) / 3)


def made(strategy: str) -> tuple[VirtualRig, dict[str, Any]]:
    """The rig of a strategy, and what `acquire` is given with it."""
    told = dict(MADE[strategy])
    grid, channels = told.pop("grid"), told.pop("channels", 1)
    T = [scene(grid) * (1.0 - 0.2 * c) for c in range(channels)]
    rig = VirtualRig(T if channels == 3 else T[0], grid, bits=12, ambient=0.01, response="linear")
    common = {"geometry": "aligned", "response": LINE, "exposures": [0.5], "frames": 2}
    return rig, {"strategy": strategy, **common, **told}


class Moment(NamedTuple):
    """The `event`-th photograph or call in a stage, or what comes behind that; and how the process ends."""

    stage: str
    event: int
    how: str  # "before", "inside", "behind", or "outside" and some milliseconds
    later: float = 0.0


class Told(NamedTuple):
    """How an acquisition ended, and what its log says."""

    killed: bool
    stage: str  # where it ended
    calibrated: int  # photographs of the calibration
    kept: int  # of these, committed
    shots: list[str]  # photographs of the scan
    blocks: dict[tuple[int, int], int]  # committed, and how many of `shots` there were then
    events: dict[str, int]  # of each stage, where it was not killed


class Nursery:
    """A process that forks acquisitions."""

    def __init__(self) -> None:
        command = [sys.executable, "-m", "tests.acquisition.stopping"]
        own = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self._process = subprocess.Popen(command, cwd=ROOT, env=own, **pipes)
        self._logs = 0

    def acquire(self, store: Path, strategy: str, moment: Moment | None, keep: Path | None = None) -> Told:
        """Acquire, or go on with it, and be killed at a moment; `keep` gets a copy of what was scanned."""
        self._logs += 1
        log = store.with_name(f"{store.name}.{self._logs}.log")
        self._say({"store": str(store), "strategy": strategy, "log": str(log), "moment": moment,
                   "keep": None if keep is None else str(keep)})  # fmt: skip
        child, answer = int(self._hear()), self._hear()
        if answer == "now":
            time.sleep(moment.later if moment else 0.0)
            with contextlib.suppress(ProcessLookupError):  # it has come to its end before
                os.kill(child, signal.SIGKILL)
            answer = self._hear()
        status = int(answer)
        assert status in (0, -signal.SIGKILL), f"{strategy} at {moment} ended with {status}"
        return _told(log, status != 0)

    def close(self) -> None:
        with self._process as process:  # closes its pipes, upon which it ends
            pass
        assert process.returncode == 0

    def _say(self, what: Any) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(what) + "\n")
        self._process.stdin.flush()

    def _hear(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        assert line, "the process that forks acquisitions has ended"
        return line.strip()


def _told(log: Path, killed: bool) -> Told:
    found = Told(killed, "calibrating", 0, 0, [], {}, {})
    for line in log.read_text().splitlines() if log.exists() else ():
        what, *rest = line.split()
        if what == "stage":
            found = found._replace(stage=rest[0])
        elif what == "kept":
            found = found._replace(kept=found.kept + 1)
        elif what == "block":
            found.blocks[int(rest[0]), int(rest[1])] = len(found.shots)
        elif what == "events":
            found.events[rest[0]] = int(rest[1])
        elif found.stage == "calibrating":
            found = found._replace(calibrated=found.calibrated + 1)
        else:
            found.shots.append(rest[0])
    return found


class _Child:
    """What happens in a child."""

    def __init__(self, log: str, moment: Moment | None) -> None:
        self._write, self._log = os.write, os.open(log, os.O_CREAT | os.O_APPEND | os.O_WRONLY, 0o666)
        self._moment, self._stage = moment, "calibrating"
        self._passed: Counter[str] = Counter()

    def tell(self, *line: Any) -> None:
        self._write(self._log, (" ".join(map(str, line)) + "\n").encode())

    def comes_to(self, stage: str) -> None:
        self._stage = stage
        self.tell("stage", stage)

    @contextlib.contextmanager
    def within(self, stage: str) -> Iterator[None]:
        before = self._stage
        self.comes_to(stage)
        yield
        self.comes_to(before)

    def end(self) -> None:
        for stage, events in self._passed.items():
            self.tell("events", stage, events)

    def event(self, act: Callable[[float], Any]) -> Any:
        """Do a part of it (1: all), and perhaps die."""
        how = self._due()
        if how == "before":
            os.kill(os.getpid(), signal.SIGKILL)
        result = act(0.5 if how == "inside" else 1.0)
        if how in ("inside", "behind"):
            os.kill(os.getpid(), signal.SIGKILL)
        if how == "outside":
            self._write(1, b"now\n")
        return result

    def _due(self) -> str:
        self._passed[self._stage] += 1
        if self._moment is None or self._stage != self._moment.stage:
            return ""
        return self._moment.how if self._passed[self._stage] == self._moment.event else ""

    def count_calls(self) -> None:
        """From here on calls of the system are events. Nothing is flushed: no power is cut here."""
        for name in CALLS:
            setattr(os, name, self._counted(name, getattr(os, name)))

    def _counted(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def act(*arguments: Any, **options: Any) -> Any:
            def call(part: float) -> Any:
                given = arguments
                if name == "write" and part < 1.0:
                    given = (arguments[0], bytes(arguments[1])[: int(part * len(arguments[1]))])
                return real(*given, **options) if name != "fsync" else None

            return self.event(call)

        return act

    def count_photographs(self, rig: VirtualRig) -> None:
        real, again = rig.photograph, Counter[bytes]()

        def photograph(codes: Any, seconds: float) -> np.ndarray:
            image = self.event(lambda part: real(codes, seconds))
            key = hashlib.blake2b(np.asarray(codes).tobytes() + repr(seconds).encode(), digest_size=8)
            again[key.digest()] += 1
            self.tell("shot", key.hexdigest())
            return image

        rig.photograph = photograph

    def count_stages(self, keep: str | None) -> None:
        put = Shelf.put

        def committed(shelf: Shelf, name: str, array: np.ndarray) -> None:
            put(shelf, name, array)
            self.tell("kept")

        write, finalize, conclude = BlockStore.write, BlockStore.finalize, zarr_folder.conclude
        scan = run.scan

        def written(store: BlockStore, channel: int, block: int, *parts: Any) -> None:
            with self.within("storing"):
                write(store, channel, block, *parts)
                self.tell("block", channel, block)

        def kept(store: BlockStore, work: Callable[..., None], *given: Any, **options: Any) -> None:
            if keep is not None and not os.path.exists(keep):
                shutil.copytree(store.path, keep)
            with self.within("finalizing"):
                work(store, *given, **options)

        def scanned(*given: Any) -> None:
            self.comes_to("scanning")
            scan(*given)
            self.comes_to("loading")

        patched: Any = Shelf
        patched.put = committed
        patched = BlockStore
        patched.write = written
        patched.finalize = lambda store, **options: kept(store, finalize, **options)
        zarr_folder.conclude = lambda store, *given: kept(store, conclude, *given)
        run.scan = scanned


def _work(task: dict[str, Any]) -> None:
    child = _Child(task["log"], None if task["moment"] is None else Moment(*task["moment"]))
    rig, given = made(task["strategy"])
    child.count_photographs(rig)
    child.count_stages(task["keep"])
    child.count_calls()
    ltcl.acquire(rig, store=task["store"], **given)
    child.end()


def main() -> None:
    """Read a task from each line; answer with the number of the process, and its status when it has ended."""
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            status = 1
            try:
                os.write(1, f"{os.getpid()}\n".encode())
                _work(json.loads(line))
                status = 0
            except BaseException as error:
                sys.stderr.write(f"{type(error).__name__}: {error}\n")
                raise
            finally:
                sys.stderr.flush()
                os._exit(status)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        os.write(1, f"{status}\n".encode())


if __name__ == "__main__":
    main()
