# SPDX-License-Identifier: BSD-3-Clause
"""A transport of 8 GB on a disk, host and device held to 2 GB: products, solves; and rows on two devices.

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
import statistics
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg
import scipy.sparse

import ltcl
from _coefficients import note
from _harness import Options, Row, parse_options, product, report, seconds
from ltcl.device import Device
from ltcl.operators import Dense, MultiDevice, Streamed

SIDE, CAP, TARGET, REPEATS = 212, 2 << 30, 0.8, 3
PIECE, FRAMES = 1 << 22, 8


@dataclasses.dataclass(frozen=True)
class Scene:
    """T_ij = (1 on the diagonal + kernel[|i - j|]) F_j in a file, and its products without the file."""

    side: int
    file: Path

    @property
    def kernel(self) -> np.ndarray:
        """R between pixels by their distance, (N,); rows of R sum to 0.8 at most."""
        n = self.side**2
        return 0.8 * np.exp(-np.arange(n) / (0.1 * n)) / (0.2 * n)

    @property
    def F(self) -> np.ndarray:
        """The first bounce, (N,), in numbers of float32."""
        return (1.0 + 0.5 * np.sin(np.arange(self.side**2))).astype(np.float32).astype(np.float64)

    def write(self) -> None:
        """Block by block, as no host may have room for all."""
        n, F = self.side**2, self.F.astype(np.float32)
        both = np.concatenate([self.kernel[:0:-1], self.kernel]).astype(np.float32)
        windows = np.lib.stride_tricks.sliding_window_view(both, n)[
            ::-1
        ]  # row i begins with kernel[i]
        T: Any = np.lib.format.open_memmap(self.file, "w+", np.float32, (n, n))
        for start in range(0, n, 512):
            block = np.array(windows[start : start + 512])
            block[np.arange(len(block)), start + np.arange(len(block))] += np.float32(1.0)
            T[start : start + 512] = block * F
        T.flush()
        self.forget()

    def forget(self) -> None:
        """Have the system drop the file from its cache."""
        handle = os.open(self.file, os.O_RDONLY)
        os.fsync(handle)
        os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(handle)

    def seen(self, light: np.ndarray) -> np.ndarray:
        """T light in float64, of frames (k, h, w)."""
        x = light.reshape(len(light), -1).T.astype(np.float64) * self.F[:, None]
        return (x + scipy.linalg.matmul_toeplitz(self.kernel, x)).T.reshape(light.shape)

    def read(self, threads: int) -> None:
        """All of the file, by so many threads, into buffers of theirs."""
        size = self.file.stat().st_size
        spans = [(size * k // threads, size * (k + 1) // threads) for k in range(threads)]

        def read(span: tuple[int, int]) -> None:
            buffer = memoryview(bytearray(PIECE))
            with self.file.open("rb", buffering=0) as file:
                file.seek(span[0])
                while file.tell() < span[1] and file.readinto(buffer):
                    pass

        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(read, spans))

    def speeds(self, actions: dict[str, Callable[[], object]]) -> dict[str, float]:
        """GB a second that each action reads, in turn, medians, the file not cached."""
        found: dict[str, list[float]] = {name: [] for name in actions}
        for _ in range(REPEATS):
            for name, action in actions.items():
                self.forget()
                start = time.perf_counter()
                action()
                found[name].append(self.file.stat().st_size / (time.perf_counter() - start) / 1e9)
                note(f"{name}: {found[name][-1]:.3g} GB/s")
        return {name: statistics.median(values) for name, values in found.items()}


def speeds(given: Options, scene: Scene, A: Streamed) -> tuple[list[Row], dict[str, Any]]:
    """Products by one and by several right-hand sides, against reading alone."""
    n = A.shape[1]
    ways = {f"{k} threads": (lambda k=k: scene.read(k)) for k in (1, 2, 4)}
    ours = {k: product(A, np.ones((n, k)) if k > 1 else np.ones(n)) for k in (1, FRAMES)}
    found = scene.speeds({**ways, **{f"product of {k}": run for k, run in ours.items()}})
    disk, rows = max(found[name] for name in ways), []
    for k in ours:
        speed = found[f"product of {k}"]
        question = f"product by {k} right-hand sides"
        rows.append(Row(question, "reading alone", disk, speed, "GB/s", speed / disk, TARGET))
    return rows, {"reading alone, GB/s": {name: round(found[name], 3) for name in ways}}


def answers(given: Options, scene: Scene, T: np.ndarray) -> dict[str, Any]:
    """Solves with T on the disk, whose answers are judged without it."""
    grid, n = (scene.side, scene.side), scene.side**2
    light = np.random.default_rng(0).uniform(0.3, 0.7, (FRAMES, *grid)).astype(np.float32)
    picture = scene.seen(light).astype(np.float32)
    offsets: Any = range(-8, 9)
    diagonals = [np.full(n - abs(k), scene.kernel[abs(k)] + (k == 0)) for k in offsets]
    near: Any = scipy.sparse.diags_array(diagonals, offsets=offsets) @ scipy.sparse.diags_array(
        scene.F
    )
    whole = ltcl.Transport(T, grid, device=given.device)
    rough = ltcl.Transport(
        scipy.sparse.csr_array(near), grid, whole.first_bounce, device=given.device
    )
    tasks: dict[str, Callable[[], Any]] = {
        f"compensate {FRAMES} frames to 1e-2": lambda: ltcl.compensate(whole, picture),
        f"compensate {FRAMES} frames to 1e-4, by exact=": lambda: ltcl.compensate(
            rough, picture, exact=whole, rtol=1e-4
        ),
        "separate, 2 bounces, to 1e-3": lambda: ltcl.separate(whole, picture[0], 2),
    }
    facts = {}
    for name, solve in tasks.items():
        start = time.perf_counter()
        answer = solve()
        spent = time.perf_counter() - start
        bounced = hasattr(answer, "direct")  # light whose direct part that is makes the picture
        found = (
            (answer.direct / whole.first_bounce.reshape(grid))[None] if bounced else answer.pattern
        )
        seen = picture[:1] if bounced else picture
        error = float(np.linalg.norm(scene.seen(found) - seen) / np.linalg.norm(seen))
        products = sum(s.products for s in (answer.solutions if bounced else [answer.solution]))
        facts[name] = f"{spent:.3g} s, {products} products, residual by FFT {error:.2g}"
        note(f"{name}: {facts[name]}")
    return facts


def devices(given: Options) -> list[Row]:
    """Rows on two halves of the device against one half, and against the whole."""
    device, n = given.device, 512 if given.smoke else 8192
    if device.compute_units < 2 or device.handle.partition_max_sub_devices < 2:
        return []
    equally = [device.cl.device_partition_property.EQUALLY, device.compute_units // 2]
    handles = device.handle.create_sub_devices(equally)[:2]
    described = [
        dataclasses.replace(device.description, index=f"half {h}", handle=h) for h in handles
    ]
    first, second = map(Device, described)
    matrix = np.ones((n, n), np.float32)
    both = MultiDevice(first, [Dense(first, matrix[: n // 2]), Dense(second, matrix[n // 2 :])])
    ways = {
        "both": both,
        "one half": Dense(first, matrix),
        "the whole device": Dense(device, matrix),
    }
    spent = seconds({name: product(A, np.ones(n)) for name, A in ways.items()})
    ms = {name: 1e3 * each for name, each in spent.items()}
    question, ours = f"dense, {n} rows on two halves", ms.pop("both")
    return [Row.from_times(question, name, theirs, ours, "ms") for name, theirs in ms.items()]


def main() -> None:
    os.environ.setdefault("POCL_MEMORY_LIMIT", str(CAP >> 30))  # before the device is opened
    given = parse_options(__doc__ or "")
    rows, side = devices(given), 32 if given.smoke else SIDE
    with tempfile.TemporaryDirectory() as folder:
        scene, size = Scene(side, Path(folder) / "T.npy"), 4 * side**4
        if shutil.disk_usage(folder).free < 1.5 * size:
            raise SystemExit(f"{folder} has no room for {size / 1e9:.3g} GB")
        note(f"writing {size / 1e9:.3g} GB")
        scene.write()
        if not given.smoke:
            resource.setrlimit(resource.RLIMIT_DATA, (CAP, CAP))
            with contextlib.suppress(MemoryError):
                np.fromfile(scene.file, np.float32)
                raise SystemExit("the cap leaves room for all of T")
        T = np.load(scene.file, mmap_mode="r")
        more, facts = speeds(given, scene, Streamed(given.device, T))
        facts = {"file, GB": size / 1e9, "cap, GB": CAP / 1e9} | facts | answers(given, scene, T)
    report(given, "A transport on a disk, and on two devices", rows + more, facts)


if __name__ == "__main__":
    main()
