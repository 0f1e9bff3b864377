# SPDX-License-Identifier: BSD-3-Clause
"""Frames over a cluster: frames a second and efficiency by workers, memory, and kills.

Workers are processes on this machine, of one core each, so that two are a machine twice as large as
one. This process, which reads and writes the frames, has no core of its own; the time it takes of
one says how many frames it can feed to workers. The rate of one film is that of a long one: after
the first quarter, when workers have T and its kernels. The other has a quarter of the pixels and is
timed with the start, so that the cost of a cluster shows. In the kill table workers end by SIGKILL
during a run; its files are compared with a serial run's.
"""

from __future__ import annotations

import os
import signal
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import dask.config
import numpy as np
import psutil
from distributed import Client, LocalCluster

import ltcl
from _harness import Row, parse_options, report
from ltcl import Transport

# Frames in a batch, and tolerance of their solves.
BATCH = 4
RTOL = 1e-4
# Least efficiency of two workers, and largest growth of memory over the run.
EFFICIENCY = 0.9
GROWTH = 1.1


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """Pixels along a wall, frames of a film, frames of the memory run, kills, and timed turns."""

    side: int = 48
    frames: int = 96
    many_frames: int = 2000
    kills: int = 10
    turns: int = 6


SMOKE_SIZES = Sizes(side=6, frames=12, many_frames=40, kills=1, turns=2)


@contextmanager
def cluster(workers: int, cache: Path) -> Iterator[Client]:
    """Start workers of one core on loopback; those that are killed are started again."""
    scheduler: dict[str, Any] = {"dashboard": False, "dashboard_address": "127.0.0.1:0"}
    settings: dict[str, Any] = {
        "n_workers": workers,
        "threads_per_worker": 1,
        "host": "127.0.0.1",
        "silence_logs": 50,
        "env": {"LTCL_CACHE": str(cache)},
        "scheduler_kwargs": scheduler,
    }
    with (
        dask.config.set({"distributed.deploy.lost-worker-timeout": "120s"}),
        LocalCluster(**settings) as local,
        Client(local) as client,
    ):
        # A worker bound to a core has as many compute units as any other, so the same bits.
        addresses = client.scheduler_info()["workers"]
        for core, address in zip(range(workers), addresses, strict=True):
            client.run(os.sched_setaffinity, 0, {core}, workers=[address])
        yield client


def process_ids(client: Client) -> list[int]:
    """Process ids of the workers; one that is ending gives none."""
    answers: Any = client.run(os.getpid, on_error="ignore")
    return [*answers.values()]


def film(T: Transport, folder: Path, frames: int) -> Path:
    """Write pictures of a light that drifts, within the projector's range."""
    light = 0.3 + 0.2 * np.random.default_rng(0).random(T.grid, np.float32)
    for number in range(frames):
        ltcl.images.write(folder / f"{number:05}.png", T @ np.roll(light, number, axis=1))
    return folder


@dataclass(frozen=True, kw_only=True)
class Film:
    """A film of `frames` pictures in the folder `source`, and the transport of its scene."""

    T: Transport
    source: Path
    frames: int

    def compensate(self, out: Path, **others: Any) -> float:
        """Compensate all frames, and return the seconds."""
        start = time.perf_counter()
        rules: Any = {"batch": BATCH, "rtol": RTOL, "clamp": True, **others}
        ltcl.batch.compensate_frames(self.T, self.source, out, **rules)
        return time.perf_counter() - start

    def steady_rate(self, out: Path, client: Client) -> float:
        """Frames a second after the first quarter."""
        progress: list[tuple[int, float]] = []

        def note(step: str, done: int, total: int | None) -> None:
            if 4 * done >= self.frames:
                progress.append((done, time.perf_counter()))

        self.compensate(out, client=client, progress=note)
        first_done, start = progress[0]
        last_done, end = progress[-1]
        return (last_done - first_done) / (end - start)


def make_film(folder: Path, name: str, side: int, frames: int, device: Any) -> Film:
    """Make the transport of a box, through a file as users have it, and its film."""
    path = folder / f"{name}.npz"
    ltcl.save(path, ltcl.scenes.box(side, sides=3).transport())
    T = ltcl.load(path, device=device)
    return Film(T=T, source=film(T, folder / name, frames), frames=frames)


@dataclass(frozen=True, kw_only=True)
class Rates:
    """Frames a second by number of workers, and those that one core of this process feeds."""

    steady: dict[int, list[float]] = field(default_factory=lambda: {1: [], 2: []})
    whole: dict[int, list[float]] = field(default_factory=lambda: {1: [], 2: []})
    fed: list[float] = field(default_factory=list)


def measure_rates(
    long: Film, short: Film, clients: dict[int, Client], folder: Path, turns: int
) -> Rates:
    """Run both films over each cluster in turn; the first turn compiles, and feeds nothing."""
    rates = Rates()
    for turn in range(turns):
        for count, client in clients.items():
            start = time.process_time()
            rates.steady[count].append(long.steady_rate(folder / f"{count} {turn}", client))
            spent = short.compensate(folder / f"whole {count} {turn}", client=client)
            rates.whole[count].append(short.frames / spent)
            if turn > 0:
                frames = long.frames + short.frames
                rates.fed.append(frames / (time.process_time() - start))
    return rates


def efficiency_row(name: str, rates: dict[int, list[float]], is_smoke: bool) -> Row:
    """Compare two workers with one, without the turn that compiles."""
    one = float(np.median(rates[1][1:]))
    two = float(np.median(rates[2][1:]))
    return Row(
        question=f"two workers, {name}",
        competitor="one worker",
        theirs=one,
        ours=two,
        unit="frames/s",
        ratio=two / one,
        target=None if is_smoke else 2.0 * EFFICIENCY,
    )


def measure_memory(client: Client, folder: Path, frames: int, is_smoke: bool) -> Row:
    """Compare the largest process at the end of a film of many small frames with its beginning."""
    megabytes: list[float] = []
    this_process = psutil.Process()

    def weigh(step: str, done: int, total: int | None) -> None:
        if done % (10 * BATCH) == 0:
            processes = [this_process, *map(psutil.Process, process_ids(client))]
            nbytes = [process.memory_info().rss for process in processes]
            megabytes.append(max(nbytes) / 1e6)

    T = Transport(np.eye(64), (8, 8))
    small = Film(T=T, source=film(T, folder / "small", frames), frames=frames)
    small.compensate(folder / "many", client=client, progress=weigh, resize="stretch")
    quarter = max(1, len(megabytes) // 4)
    early = np.median(megabytes[:quarter])
    late = np.median(megabytes[-quarter:])
    return Row(
        question="largest process, last quarter",
        competitor="first",
        theirs=float(early),
        ours=float(late),
        unit="MB",
        ratio=float(early / late),
        target=None if is_smoke else 1.0 / GROWTH,
    )


def compensate_with_kills(
    film: Film, out: Path, client: Client, kills: int
) -> tuple[list[int], float]:
    """Kill workers in turn, evenly over the film; return the frames done then, and the seconds."""
    frames_at_kills: list[int] = []

    def kill(step: str, done: int, total: int | None) -> None:
        killed = len(frames_at_kills)
        if killed >= kills or done < film.frames * (killed + 1) // (kills + 2):
            return
        alive = process_ids(client)
        while not alive:
            time.sleep(0.2)
            alive = process_ids(client)
        os.kill(alive[killed % len(alive)], signal.SIGKILL)
        frames_at_kills.append(done)

    spent = film.compensate(out, client=client, progress=kill)
    return frames_at_kills, spent


def file_contents(folder: Path) -> dict[str, bytes]:
    """Bytes of all files of a folder, by name."""
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}


def equality_row(kills: int, are_equal: bool) -> Row:
    """Compare the files of a run with kills with those of a serial run."""
    equal = float(are_equal)
    return Row(
        question=f"bytes after {kills} kills",
        competitor="serial run",
        theirs=1.0,
        ours=equal,
        unit="equal",
        ratio=equal,
        target=1.0,
    )


def main() -> None:
    """Run the bench."""
    options = parse_options(__doc__)
    sizes = SMOKE_SIZES if options.smoke else Sizes()
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        # One memory of timings, so that all processes take the same kernels.
        os.environ["LTCL_CACHE"] = str(folder / "cache")
        long = make_film(folder, "film", sizes.side, sizes.frames, options.device)
        short = make_film(folder, "short", sizes.side // 2, sizes.frames, options.device)
        long.compensate(folder / "serial")
        clients = {}
        for count in (1, 2):
            clients[count] = stack.enter_context(cluster(count, folder / "cache"))
        rates = measure_rates(long, short, clients, folder, sizes.turns)
        memory = measure_memory(clients[2], folder, sizes.many_frames, options.smoke)
        out = folder / "killed"
        kills, spent = compensate_with_kills(long, out, clients[2], sizes.kills)
        are_equal = file_contents(out) == file_contents(folder / "serial")
    rows = [
        efficiency_row("long film", rates.steady, options.smoke),
        efficiency_row("short film of a quarter of the pixels", rates.whole, options.smoke),
        memory,
        equality_row(len(kills), are_equal),
    ]
    facts = {
        "pixels": long.T.shape[1],
        "frames": sizes.frames,
        "of memory": sizes.many_frames,
        "cores": os.cpu_count(),
        "frames a second that this process can feed, of a core": float(np.median(rates.fed)),
        "kills, after frames": kills,
        "seconds with kills": spent,
        "files": sizes.frames + 1,
    }
    report(options, "Frames over a cluster", rows, facts)


if __name__ == "__main__":
    main()
