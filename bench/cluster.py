# SPDX-License-Identifier: BSD-3-Clause
"""Frames over a cluster: frames a second and efficiency over workers, memory over many frames, and kills.

Workers are processes on this machine, of one core each, so that two are a machine twice as large as
one. This process, which reads and writes the frames, has no core of its own; what it takes of one
says how many frames it can feed to workers. The rate of one film is that of a long one: after the
first quarter, when workers have T and its kernels. The other has a quarter of the pixels and is
timed with the start, so that what a cluster costs shows. In the kill table workers end by SIGKILL
while a run is on its way; its files are compared with a serial run's.
"""

from __future__ import annotations

import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import dask.config
import numpy as np
import psutil
from distributed import Client, LocalCluster

import ltcl
from _harness import Row, parse_options, report

BATCH, RTOL, KILLS = 4, 1e-4, 10
EFFICIENCY, GROWTH = 0.9, 1.1  # of two workers; of memory over the run


@contextmanager
def cluster(workers: int, cache: Path) -> Iterator[Client]:
    """So many workers of one core on loopback; those that are killed are started again."""
    quiet: dict[str, Any] = {"dashboard": False, "dashboard_address": "127.0.0.1:0"}
    local: dict[str, Any] = {"n_workers": workers, "threads_per_worker": 1, "host": "127.0.0.1"}
    local |= {"silence_logs": 50, "env": {"LTCL_CACHE": str(cache)}, "scheduler_kwargs": quiet}
    with ExitStack() as stack:
        stack.enter_context(dask.config.set({"distributed.deploy.lost-worker-timeout": "120s"}))
        client = stack.enter_context(Client(stack.enter_context(LocalCluster(**local))))
        # Bound to a core a worker has as many compute units as others, so the same bits.
        for core, address in zip(range(workers), client.scheduler_info()["workers"], strict=True):
            client.run(os.sched_setaffinity, 0, {core}, workers=[address])
        yield client


def pids(client: Client) -> list[int]:
    answers: Any = client.run(os.getpid, on_error="ignore")  # of a worker that is ending
    return [*answers.values()]


def film(T: ltcl.Transport, folder: Path, frames: int) -> Path:
    """Pictures of a light that drifts, within reach of the projector."""
    h, w = T.grid
    light = 0.3 + 0.2 * np.random.default_rng(0).random((h, w), np.float32)
    for number in range(frames):
        ltcl.images.write(folder / f"{number:05}.png", T @ np.roll(light, number, axis=1))
    return folder


def rate(run: Callable[..., float], frames: int, out: str, client: Client) -> float:
    """Frames a second after the first quarter."""
    seen: list[tuple[int, float]] = []

    def note(step: str, done: int, total: int | None) -> None:
        if 4 * done >= frames:
            seen.append((done, time.perf_counter()))

    run(out, client=client, progress=note)
    (before, start), (after, end) = seen[0], seen[-1]
    return (after - before) / (end - start)


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir() if file.is_file()}


def main() -> None:
    given = parse_options(__doc__ or "")
    size, frames, many = (6, 12, 40) if given.smoke else (48, 96, 2000)
    kills, rows, facts = 1 if given.smoke else KILLS, [], {}
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        place = Path(name)
        for name, side in (("T.npz", size), ("little.npz", size // 2)):
            ltcl.save(place / name, ltcl.scenes.box(side, sides=3).transport())
        T, little = (
            ltcl.load(place / name, device=given.device) for name in ("T.npz", "little.npz")
        )
        os.environ["LTCL_CACHE"] = str(
            place / "cache"
        )  # one memory of timings, so the same kernels
        source, short = film(T, place / "film", frames), film(little, place / "short", frames)

        def run(out: str, source: Path = source, T: ltcl.Transport = T, **others: Any) -> float:
            start = time.perf_counter()
            rules: Any = {"batch": BATCH, "rtol": RTOL, "clamp": True, **others}
            ltcl.batch.compensate_frames(T, source, place / out, **rules)
            return time.perf_counter() - start

        run("serial")
        rates: dict[int, list[float]] = {1: [], 2: []}
        whole: dict[int, list[float]] = {1: [], 2: []}
        fed: list[float] = []  # frames a second of this process's core
        clients = {count: stack.enter_context(cluster(count, place / "cache")) for count in rates}
        for turn in range(2 if given.smoke else 6):  # the first compiles
            for count, client in clients.items():
                before = time.process_time()
                rates[count].append(rate(run, frames, f"{count} {turn}", client))
                whole[count].append(
                    frames / run(f"whole {count} {turn}", short, little, client=client)
                )
                fed += [2 * frames / (time.process_time() - before)] * (turn > 0)
        facts |= {
            "pixels": T.shape[1],
            "frames": frames,
            "of memory": many,
            "cores": os.cpu_count(),
        }
        facts["frames a second that this process can feed, of a core"] = float(np.median(fed))
        goal = None if given.smoke else 2.0 * EFFICIENCY
        for what, found in (("long film", rates), ("short film of a quarter of the pixels", whole)):
            one, two = (float(np.median(found[count][1:])) for count in found)
            rows.append(
                Row(f"two workers, {what}", "one worker", one, two, "frames/s", two / one, goal)
            )
        client, sizes, own = clients[2], [], psutil.Process()

        def weigh(step: str, done: int, total: int | None) -> None:
            if done % (10 * BATCH) == 0:
                processes = [own, *(psutil.Process(pid) for pid in pids(client))]
                sizes.append(max(process.memory_info().rss for process in processes) / 1e6)

        small = film(ltcl.Transport(np.eye(64), (8, 8)), place / "small", many)
        run("many", small, client=client, progress=weigh, resize=True)
        quarter = max(1, len(sizes) // 4)
        early, late = np.median(sizes[:quarter]), np.median(sizes[-quarter:])
        goal = None if given.smoke else 1.0 / GROWTH
        rows.append(
            Row("largest process, last quarter", "first", early, late, "MB", early / late, goal)
        )

        ended: list[int] = []

        def kill(step: str, done: int, total: int | None) -> None:
            if len(ended) < kills and done >= frames * (len(ended) + 1) // (kills + 2):
                while not (alive := pids(client)):
                    time.sleep(0.2)
                os.kill(alive[len(ended) % len(alive)], signal.SIGKILL)
                ended.append(done)

        slow = run("killed", client=client, progress=kill)
        same = float(bytes_of(place / "killed") == bytes_of(place / "serial"))
        facts |= {"kills, after frames": ended, "seconds with kills": slow, "files": frames + 1}
        rows.append(
            Row(f"bytes after {len(ended)} kills", "serial run", 1.0, same, "equal", same, 1.0)
        )
    report(given, "Frames over a cluster", rows, facts)


if __name__ == "__main__":
    main()
