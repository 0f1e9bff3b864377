# SPDX-License-Identifier: BSD-3-Clause
"""A transport of 8 GB on a disk, host and device held to 2 GB; and rows on two devices.

T = (I + R) F on a grid of 212 x 212 pixels has light between pixels that falls with their distance
in the order of rows, so that products are also to be had by FFT in float64: these judge the
answers. The file is written block by block below TMPDIR, and removed. Memory of the process is
limited by RLIMIT_DATA, which counts all but files that are mapped to be read, and that of PoCL by
POCL_MEMORY_LIMIT; reading T at once has to fail. Before each timing the system drops the file from
its cache (posix_fadvise, DONTNEED). The disk's own speed is that of the best of 1, 2 and 4 threads
that read the file into buffers of 4 MB and do nothing else.

Two devices are halves of a PoCL device (OpenCL sub-devices), each with half of the rows of a dense
matrix.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import resource
import shutil
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse

import ltcl
from _coefficients import note
from _harness import Options, Row, medians, parse_options, product, report, seconds
from ltcl import Transport
from ltcl.device import Device
from ltcl.device.discovery import open_together
from ltcl.operators import Dense, MultiDevice, Streamed

# Pixels along a side of the grid.
SIDE = 212
MEMORY_CAP = 2 << 30
# A product should read with at least this share of the disk's speed.
SPEED_TARGET = 0.8
REPEATS = 3
READ_BYTES = 1 << 22
READ_THREADS = (1, 2, 4)
WRITTEN_ROWS = 512
FRAMES = 8
# Diagonals on each side that the sparse preconditioner keeps.
NEAR_DIAGONALS = 8


@dataclasses.dataclass(frozen=True)
class Scene:
    """T_ij = ((i == j) + kernel[|i - j|]) F_j in a file, and its products without the file."""

    side: int
    file: Path

    @property
    def pixels(self) -> int:
        """N."""
        return self.side**2

    @property
    def kernel(self) -> np.ndarray:
        """R between pixels by their distance, (N,); rows of R sum to 0.8 at most."""
        n = self.pixels
        return 0.8 * np.exp(-np.arange(n) / (0.1 * n)) / (0.2 * n)

    @property
    def F(self) -> np.ndarray:
        """The first bounce, (N,), in numbers of float32."""
        waves = 1.0 + 0.5 * np.sin(np.arange(self.pixels))
        return waves.astype(np.float32).astype(np.float64)

    def write(self) -> None:
        """Write the file block by block, as no host may have room for all."""
        n = self.pixels
        F = self.F.astype(np.float32)
        both_sides = np.concatenate([self.kernel[:0:-1], self.kernel]).astype(np.float32)
        # Row i begins with kernel[i].
        rows = np.lib.stride_tricks.sliding_window_view(both_sides, n)[::-1]
        T: Any = np.lib.format.open_memmap(self.file, "w+", np.float32, (n, n))
        for start in range(0, n, WRITTEN_ROWS):
            block = np.array(rows[start : start + WRITTEN_ROWS])
            within = np.arange(len(block))
            block[within, start + within] += np.float32(1.0)
            T[start : start + WRITTEN_ROWS] = block * F
        T.flush()
        self.forget()

    def forget(self) -> None:
        """Have the system drop the file from its cache."""
        handle = os.open(self.file, os.O_RDONLY)
        os.fsync(handle)
        os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(handle)

    def relight(self, light: np.ndarray) -> np.ndarray:
        """T light in float64, of frames (k, h, w)."""
        columns = light.reshape(len(light), -1).T.astype(np.float64)
        direct = columns * self.F[:, None]
        indirect = scipy.linalg.matmul_toeplitz(self.kernel, direct)
        return (direct + indirect).T.reshape(light.shape)

    def read(self, threads: int) -> None:
        """Read all of the file by several threads, each into a buffer of its own."""
        size = self.file.stat().st_size
        edges = [size * k // threads for k in range(threads + 1)]

        def read_span(start: int, stop: int) -> None:
            buffer = memoryview(bytearray(READ_BYTES))
            with self.file.open("rb", buffering=0) as file:
                file.seek(start)
                while file.tell() < stop and file.readinto(buffer):
                    pass

        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(read_span, edges[:-1], edges[1:]))

    def speeds(self, actions: dict[str, Callable[[], object]]) -> dict[str, float]:
        """Median GB a second that each action reads, in turn, the file not cached."""
        rates = defaultdict(list)
        gigabytes = self.file.stat().st_size / 1e9
        for _ in range(REPEATS):
            for name, action in actions.items():
                self.forget()
                start = time.perf_counter()
                action()
                rate = gigabytes / (time.perf_counter() - start)
                rates[name].append(rate)
                note(f"{name}: {rate:.3g} GB/s")
        return medians(rates)


def compare_speeds(scene: Scene, A: Streamed) -> tuple[list[Row], dict[str, Any]]:
    """Products by one and by several right-hand sides, against reading alone."""
    n = A.shape[1]
    readings = {f"{k} threads": partial(scene.read, k) for k in READ_THREADS}
    products = {1: product(A, np.ones(n)), FRAMES: product(A, np.ones((n, FRAMES)))}
    actions: dict[str, Callable[[], object]] = dict(readings)
    for k, run in products.items():
        actions[f"product of {k}"] = run
    speeds = scene.speeds(actions)
    disk = max(speeds[name] for name in readings)
    rows = []
    for k in products:
        speed = speeds[f"product of {k}"]
        question = f"product by {k} right-hand sides"
        ratio = speed / disk
        rows.append(Row(question, "reading alone", disk, speed, "GB/s", ratio, SPEED_TARGET))
    alone = {name: round(speeds[name], 3) for name in readings}
    return rows, {"reading alone, GB/s": alone}


def near_transport(scene: Scene, whole: Transport, device: Device) -> Transport:
    """The diagonals of T around the main one, as a sparse transport."""
    offsets: Any = range(-NEAR_DIAGONALS, NEAR_DIAGONALS + 1)
    diagonals = []
    for k in offsets:
        value = scene.kernel[abs(k)] + (k == 0)
        diagonals.append(np.full(scene.pixels - abs(k), value))
    S: Any = scipy.sparse.diags_array(diagonals, offsets=offsets)
    T = S @ scipy.sparse.diags_array(scene.F)
    return Transport(scipy.sparse.csr_array(T), whole.grid, whole.first_bounce, device=device)


def solve_tasks(options: Options, scene: Scene, T: np.ndarray) -> dict[str, str]:
    """Solves with T on the disk, whose answers are judged without it."""
    grid = (scene.side, scene.side)
    light = np.random.default_rng(0).uniform(0.3, 0.7, (FRAMES, *grid)).astype(np.float32)
    pictures = scene.relight(light).astype(np.float32)
    whole = Transport(T, grid, device=options.device)
    near = near_transport(scene, whole, options.device)

    def compensate(T: Transport, **settings: Any) -> tuple[int, float]:
        answer: Any = ltcl.compensate(T, pictures, **settings)
        return answer.solution.products, residual(scene, answer.pattern, pictures)

    def separate() -> tuple[int, float]:
        answer: Any = ltcl.separate(whole, pictures[0], 2)
        products = sum(solution.products for solution in answer.solutions)
        # Light on the projector with this direct part makes the picture.
        pattern = answer.direct / whole.first_bounce.reshape(grid)
        return products, residual(scene, pattern[None], pictures[:1])

    tasks: dict[str, Callable[[], tuple[int, float]]] = {
        f"compensate {FRAMES} frames to 1e-2": lambda: compensate(whole),
        f"compensate {FRAMES} frames to 1e-4, by exact=": lambda: compensate(
            near, exact=whole, rtol=1e-4
        ),
        "separate, 2 bounces, to 1e-3": separate,
    }
    facts = {}
    for name, solve in tasks.items():
        start = time.perf_counter()
        products, error = solve()
        spent = time.perf_counter() - start
        facts[name] = f"{spent:.3g} s, {products} products, residual by FFT {error:.2g}"
        note(f"{name}: {facts[name]}")
    return facts


def residual(scene: Scene, light: np.ndarray, pictures: np.ndarray) -> float:
    """Relative residual of the pictures under some light, by FFT in float64."""
    deviation = scene.relight(light) - pictures
    return float(np.linalg.norm(deviation) / np.linalg.norm(pictures))


def half_devices(device: Device) -> tuple[Device, Device]:
    """Both halves of a device, as OpenCL sub-devices that share a context, as of device="all"."""
    equally = [device.cl.device_partition_property.EQUALLY, device.compute_units // 2]
    halves = []
    for handle in device.handle.create_sub_devices(equally)[:2]:
        index = f"half {handle}"
        halves.append(dataclasses.replace(device.description, index=index, handle=handle))
    first = open_together(halves)
    return first, first.others[0]


def compare_devices(options: Options) -> list[Row]:
    """Rows on two halves of the device against one half, and against the whole."""
    device = options.device
    if device.compute_units < 2 or device.handle.partition_max_sub_devices < 2:
        return []
    n = 512 if options.smoke else 8192
    first, second = half_devices(device)
    matrix = np.ones((n, n), np.float32)
    parts = [Dense(first, matrix[: n // 2]), Dense(second, matrix[n // 2 :])]
    x = np.ones(n)
    times = seconds(
        {
            "both": product(MultiDevice(first, parts), x),
            "one half": product(Dense(first, matrix), x),
            "the whole device": product(Dense(device, matrix), x),
        }
    )
    question = f"dense, {n} rows on two halves"
    ours = 1e3 * times["both"]
    rows = []
    for name in ("one half", "the whole device"):
        rows.append(Row.from_times(question, name, 1e3 * times[name], ours, "ms"))
    return rows


def limit_memory(file: Path) -> None:
    """Limit the memory of the process, and check that T does not fit."""
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_CAP, MEMORY_CAP))
    with contextlib.suppress(MemoryError):
        np.fromfile(file, np.float32)
        raise SystemExit("the cap leaves room for all of T")


def main() -> None:
    # PoCL reads it when the device is opened.
    os.environ.setdefault("POCL_MEMORY_LIMIT", str(MEMORY_CAP >> 30))
    options = parse_options(__doc__)
    rows = compare_devices(options)
    side = 32 if options.smoke else SIDE
    with tempfile.TemporaryDirectory() as folder:
        scene = Scene(side, Path(folder) / "T.npy")
        size = 4 * side**4
        if shutil.disk_usage(folder).free < 1.5 * size:
            raise SystemExit(f"{folder} has no room for {size / 1e9:.3g} GB")
        note(f"writing {size / 1e9:.3g} GB")
        scene.write()
        if not options.smoke:
            limit_memory(scene.file)
        T = np.load(scene.file, mmap_mode="r")
        facts: dict[str, Any] = {"file, GB": size / 1e9, "cap, GB": MEMORY_CAP / 1e9}
        speed_rows, speed_facts = compare_speeds(scene, Streamed(options.device, T))
        facts |= speed_facts | solve_tasks(options, scene, T)
    report(options, "A transport on a disk, and on two devices", rows + speed_rows, facts)


if __name__ == "__main__":
    main()
