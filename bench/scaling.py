# SPDX-License-Identifier: BSD-3-Clause
"""How much faster two MPI ranks solve than one, and what a model says of 64 GPUs.

A product over p ranks takes t(p) = a + b E / p + c N with E stored entries and N pixels: calls; the entries
of a rank; and the vector, whole on each, which is read from the device, exchanged, written back and added to.
"""

from __future__ import annotations

import functools
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

import ltcl
from _harness import Options, Row, options, report
from ltcl.operators import CSR, Dense, Distributed, IdentityPlus

SIZES = {False: ((32_768, 256), (131_072, 256), (16_384, 16_384)), True: ((1024, 16), (4096, 16), (512, 512))}
ONE_THREAD = {"POCL_MAX_PTHREAD_COUNT": "1", "POCL_CPU_MAX_CU_COUNT": "1", "OMP_NUM_THREADS": "1"}
ROUNDS, BLOCK, PRODUCTS = 5, 256, 8
GPUS, MEMORY, BUS, STEP = 64, 0.8 * 3.35e12, 25e9, 5e-6  # bytes a second, and seconds
ASSUMED = "a GPU a rank, 80 % of 3.35 TB/s; bus and network 25 GB/s; log2 p steps of 5 us; a as here"


def mpi(given: Options) -> tuple[list[Row], dict[str, Any]]:
    """Two ranks, a core and a thread each, in one run."""
    sizes, rows, facts = SIZES[given.smoke], [], {}
    launcher = Path(sys.executable).with_name("mpiexec")
    command = [str(launcher if launcher.exists() else "mpiexec"), "-n", "2", sys.executable, "-m", "mpi4py"]
    command += [__file__, "rank", json.dumps(sizes)]
    run = subprocess.run(command, env=os.environ | ONE_THREAD, check=True, stdout=subprocess.PIPE)  # noqa: S603
    for (n, k), times in zip(sizes, found := json.loads(run.stdout), strict=True):
        for who, target in (("1 rank", 1.8 if n != sizes[0][0] else None), ("no MPI", None)):
            pair = times[f"solve {who}"], times["solve 2 ranks"]
            rows.append(Row.of_times(f"Chebyshev by 2 ranks, {n} x {k}", who, *pair, "s", target))
        facts[f"Allgatherv of {n}, ms"] = 1e3 * times["exchange"]
        facts[f"relative difference from the solution without MPI, {n} x {k}"] = times["difference"]
    return rows, facts | model(sizes, found)


def model(sizes: Any, found: list[dict[str, float]]) -> dict[str, Any]:
    """a, b and c by least squares of relative deviations from sparse products, and 64 GPUs."""
    shares = np.array(
        [
            np.array([1.0, n * k / p, n]) / times[f"product {name}"]
            for (n, k), times in zip(sizes[:2], found, strict=False)
            for p, name in ((1, "1 rank"), (2, "2 ranks"), (4, "4 ranks"))
        ]
    )
    fit = np.linalg.lstsq(shares, np.ones(len(shares)), rcond=None)[0]
    facts: dict[str, Any] = {"a in us, b and c in ns": ", ".join(f"{v:.3g}" for v in fit * (1e6, 1e9, 1e9))}
    facts["largest relative deviation of the model"] = float(np.abs(shares @ fit - 1.0).max())
    facts["4 ranks are measured on 2 cores"] = "a quarter of the rows and whole vectors on each"
    n = 131_072
    vector = 8 * n / BUS + 4 * n / BUS + STEP * np.log2(GPUS)
    for what, nbytes in ((f"{n} x 256, sparse", 256 * 8 * n), (f"{n} x {n}, dense", 4 * n * n)):
        t = fit[0] + nbytes / MEMORY / GPUS + vector
        times = (fit[0] + nbytes / MEMORY) / t
        facts[f"product on {GPUS} GPUs, {what}"] = f"{1e6 * t:.3g} us, {times:.3g} times as fast as on one"
    return facts | {"assumed": ASSUMED}


def compare(comm: Any, alone: Any, n: int, entries: int) -> dict[str, float]:
    """Median seconds of solves and products; a quarter of a matrix on two ranks stands for four."""
    device, half = ltcl.open_device(), n // 2
    b, operators = np.random.default_rng(1).random(n, np.float32), {}
    if comm.rank == 0:
        A = operators["no MPI"] = (CSR if entries < n else Dense)(device, matrix(0, n, n, entries))
        operators["1 rank"] = Distributed(alone, A)
    own = matrix(comm.rank * half, (comm.rank + 1) * half, n, entries)
    operators["2 ranks"] = Distributed(comm, own)
    if entries < n:
        quarter = scipy.sparse.vstack(
            [own[: half // 2], scipy.sparse.csr_array((half - half // 2, n))], "csr"
        )
        operators["4 ranks"] = Distributed(comm, quarter)
    mine, whole = np.zeros(half, np.float32), np.zeros(n, np.float32)

    def solve(who: str) -> np.ndarray:
        return ltcl.solve(IdentityPlus(operators[who]), b, "chebyshev", rtol=1e-6, spectrum=(0.5, 1.5)).x

    def product(who: str) -> None:
        x, y = (operators[who].device.upload(b) for _ in range(2))
        for _ in range(PRODUCTS):
            operators[who].apply(x, y).device.finish()

    names = {
        f"{do.__name__} {who}": (do, who)
        for do in (solve, product)
        for who in ("no MPI", "1 rank", "2 ranks", "4 ranks")
    }
    own = {name: functools.partial(*pair) if pair[1] in operators else None for name, pair in names.items()}
    own["exchange"] = lambda: [comm.Allgatherv(mine, whole) for _ in range(PRODUCTS)]
    times = {name: t / (1 if "solve" in name else PRODUCTS) for name, t in paired(comm, own).items()}
    answers = [solve(who) for who in ("2 ranks", "no MPI") if who in operators]
    return times | {
        "difference": float(np.linalg.norm(answers[0] - answers[-1]) / np.linalg.norm(answers[0]))
    }


def matrix(start: int, stop: int, n: int, entries: int) -> Any:
    """Rows that sum to 1/4, the same whoever makes them, with an entry in each of `entries` equal pieces."""
    piece, blocks = n // entries, []
    for first in range(start, stop, BLOCK):
        random = np.random.default_rng(first)
        values = random.random((min(BLOCK, stop - first), entries), np.float32) / (2 * entries)
        if piece > 1:
            columns = np.arange(entries) * piece + random.integers(0, piece, values.shape)
            ends = np.arange(0, values.size + 1, entries)
            values = scipy.sparse.csr_array((values.ravel(), columns.ravel(), ends), (len(values), n))
        blocks.append(values)
    return scipy.sparse.vstack(blocks, "csr") if piece > 1 else np.concatenate(blocks)


def paired(comm: Any, actions: dict[str, Callable[[], Any] | None]) -> dict[str, float]:
    """Median seconds of each in turn; a rank sleeps while others have something to do alone."""
    times: dict[str, list[float]] = {name: [] for name in actions}
    for turn in range(ROUNDS + 1):  # the first one warms up
        for name, action in actions.items():
            arrived = comm.Ibarrier()
            while not arrived.Test():
                time.sleep(1e-3)
            start = time.perf_counter()
            if action is not None:
                action()
            times[name] += [time.perf_counter() - start] * (turn > 0)
    return {name: statistics.median(values) for name, values in times.items()}


def rank(sizes: Any) -> None:
    from mpi4py import MPI

    cores, comm = sorted(os.sched_getaffinity(0)), MPI.COMM_WORLD
    os.sched_setaffinity(0, {cores[comm.rank % len(cores)]})
    found = [compare(comm, MPI.COMM_SELF, *size) for size in sizes]
    if comm.rank == 0:
        print(json.dumps(found))


def main() -> None:
    given = options(__doc__ or "")
    report(given, "Scaling over ranks", *mpi(given))


if __name__ == "__main__":
    rank(json.loads(sys.argv[2])) if sys.argv[1:2] == ["rank"] else main()
