# SPDX-License-Identifier: BSD-3-Clause
"""How much faster two MPI ranks solve than one, and what a model says of 64 GPUs.

A product over p ranks takes t(p) = a + b E / p + c N with E stored entries and N pixels: calls; the
entries of a rank; and the vector, whole on each, which is read from the device, exchanged, written
back and added to.

Products wait for memory, which cores share. The limit is what two ranks gain where they do nothing
but read the same numbers, half of them each, in the same turns; beside it stands that of the triad,
which also writes.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy.optimize
import scipy.sparse

import ltcl
from _harness import Options, Row, parse_options, report, triad
from ltcl.operators import CSR, Dense, Distributed, IdentityPlus

SIZES = {
    False: ((1024, 16), (32_768, 256), (131_072, 256), (16_384, 16_384)),
    True: ((1024, 16), (4096, 16), (512, 512)),
}
LARGE = 1 << 25  # entries, from which on two ranks must be 1.8 times as fast
ONE_THREAD = {"POCL_MAX_PTHREAD_COUNT": "1", "POCL_CPU_MAX_CU_COUNT": "1", "OMP_NUM_THREADS": "1"}
ROUNDS, BLOCK, PRODUCTS = 11, 256, 4
GPUS, MEMORY, BUS, STEP = 64, 0.8 * 3.35e12, 25e9, 5e-6  # bytes a second, and seconds
ASSUMED = (
    "a GPU a rank, 80 % of 3.35 TB/s; bus and network 25 GB/s; log2 p steps of 5 us; a as here"
)


def mpi(given: Options) -> tuple[list[Row], dict[str, Any]]:
    """Two ranks, a core and a thread each, in one run; rows and facts of the report."""
    sizes, rows, facts = SIZES[given.smoke], [], {}
    launcher = Path(sys.executable).with_name("mpiexec")
    command = [
        str(launcher if launcher.exists() else "mpiexec"),
        "-n",
        "2",
        sys.executable,
        "-m",
        "mpi4py",
    ]
    command += [__file__, "rank", json.dumps(sizes)]
    run = subprocess.run(command, env=os.environ | ONE_THREAD, check=True, stdout=subprocess.PIPE)  # noqa: S603
    for (n, k), times in zip(sizes, found := json.loads(run.stdout), strict=True):
        for who, target in (("1 rank", 1.8 if n * k >= LARGE else None), ("no MPI", None)):
            pair = times[f"solve {who}"], times["solve 2 ranks"]
            rows.append(Row.from_times(f"Chebyshev by 2 ranks, {n} x {k}", who, *pair, "s", target))
        for what in ("reading the same", "triad"):
            limit, gain = (
                times[f"{each} 1 rank"] / times[f"{each} 2 ranks"] for each in (what, "solve")
            )
            rows.append(
                Row(f"gain by 2 ranks, {n} x {k}", what, limit, gain, "times", gain / limit)
            )
        facts[f"Allgatherv of {n}, ms"] = 1e3 * times["exchange"]
        facts[f"relative difference from the solution without MPI, {n} x {k}"] = times["difference"]
    terms = [[1.0, n * k / p, n] for n, k in sizes[:-1] for p in (1, 2, 4)]
    names = [f"product {name}" for name in ("1 rank", "2 ranks", "4 ranks")]
    return rows, facts | model(
        np.array(terms), np.array([times[name] for times in found[:-1] for name in names])
    )


def model(terms: np.ndarray, times: np.ndarray) -> dict[str, Any]:
    """a, b and c, at least 0, by least squares of relative deviations, and what follows for GPUs."""
    shares = terms / times[:, None]
    a, b, c = scipy.optimize.nnls(shares, np.ones(len(times)))[0]
    facts: dict[str, Any] = {
        "a in us, b and c in ns": f"{1e6 * a:.3g}, {1e9 * b:.3g}, {1e9 * c:.3g}"
    }
    facts["largest relative deviation of the model"] = float(np.abs(shares @ (a, b, c) - 1.0).max())
    facts["4 ranks are measured on 2 cores"] = "a quarter of the rows and whole vectors on each"
    n = 131_072
    vector = 8 * n / BUS + 4 * n / BUS + STEP * np.log2(GPUS)
    for what, nbytes in ((f"{n} x 256, sparse", 256 * 8 * n), (f"{n} x {n}, dense", 4 * n * n)):
        one, many = a + nbytes / MEMORY, a + nbytes / MEMORY / GPUS + vector
        facts[f"product on {GPUS} GPUs, {what}"] = (
            f"{1e6 * many:.3g} us, {one / many:.3g} times as fast as one"
        )
    return facts | {"assumed": ASSUMED}


def rank(sizes: list[list[int]]) -> None:
    """What each rank runs; the first prints."""
    from mpi4py import MPI

    cores, comm = sorted(os.sched_getaffinity(0)), MPI.COMM_WORLD
    os.sched_setaffinity(0, {cores[comm.rank % len(cores)]})
    found = [compare(comm, MPI.COMM_SELF, n, entries) for n, entries in sizes]
    if comm.rank == 0:
        print(json.dumps(found))


def compare(comm: Any, alone: Any, n: int, entries: int) -> dict[str, float]:
    """Median seconds of solves and products; a quarter of a matrix on two ranks stands for four."""
    half, b, operators = n // 2, np.random.default_rng(1).random(n, np.float32), {}
    if comm.rank == 0:
        A = (CSR if entries < n else Dense)(ltcl.open_device(), matrix(0, n, n, entries))
        operators = {"no MPI": A, "1 rank": Distributed(alone, A)}
    own = matrix(comm.rank * half, (comm.rank + 1) * half, n, entries)
    operators["2 ranks"] = Distributed(comm, own)
    if entries < n:
        empty = scipy.sparse.csr_array((half - half // 2, n), dtype=np.float32)
        operators["4 ranks"] = Distributed(
            comm, scipy.sparse.vstack([own[: half // 2], empty], "csr")
        )
    mine, whole = np.zeros(half, np.float32), np.zeros(n, np.float32)

    def solve(A: Any) -> np.ndarray:
        return ltcl.solve(IdentityPlus(A), b, "chebyshev", rtol=1e-4, spectrum=(0.5, 1.5)).x

    def product(A: Any, x: Any) -> None:
        for _ in range(PRODUCTS):
            A.apply(x).device.finish()

    actions: dict[str, Any] = {
        "exchange": lambda: [comm.Allgatherv(mine, whole) for _ in range(PRODUCTS)]
    }
    for who in ("no MPI", "1 rank", "2 ranks", "4 ranks"):
        A = operators.get(who)
        actions[f"product {who}"] = A and partial(product, A, A.device.upload(b))
        actions[f"solve {who}"] = A and who != "4 ranks" and partial(solve, A)
    numbers = [each.view(np.int32) for each in ((own.data, own.indices) if entries < n else (own,))]
    triad_of_half, _ = triad(operators["2 ranks"].device, n * entries < 1 << 20, 2)

    def read() -> None:
        for each in numbers:
            each.max()

    for what, half_of in (("reading the same", read), ("triad", triad_of_half)):
        actions[f"{what} 1 rank"] = comm.rank == 0 and (
            lambda half_of=half_of: (half_of(), half_of())
        )
        actions[f"{what} 2 ranks"] = lambda half_of=half_of: (half_of(), comm.Barrier())
    times = paired(comm, actions)
    times |= {
        name: t / PRODUCTS for name, t in times.items() if name.startswith(("product", "exchange"))
    }
    answers = [solve(operators[who]) for who in ("2 ranks", "no MPI") if who in operators]
    return times | {
        "difference": float(np.linalg.norm(answers[0] - answers[-1]) / np.linalg.norm(answers[0]))
    }


def matrix(start: int, stop: int, n: int, entries: int) -> Any:
    """Rows that sum to 1/4, the same whoever makes them, with an entry in each of `entries` equal pieces."""
    piece, blocks = n // entries, []
    for first in range(start, stop, BLOCK):
        random = np.random.default_rng(first)
        rows = random.random((min(BLOCK, stop - first), entries), np.float32) / (2 * entries)
        if piece > 1:
            columns = np.arange(entries) * piece + random.integers(0, piece, rows.shape)
            ends = np.arange(0, rows.size + 1, entries)
            rows = scipy.sparse.csr_array((rows.ravel(), columns.ravel(), ends), (len(rows), n))
        blocks.append(rows)
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
            if action:
                action()
            times[name] += [time.perf_counter() - start] * (turn > 0)
    return {name: statistics.median(values) for name, values in times.items()}


def main() -> None:
    given = parse_options(__doc__ or "")
    report(given, "Scaling over ranks", *mpi(given))


if __name__ == "__main__":
    rank(json.loads(sys.argv[2])) if sys.argv[1:2] == ["rank"] else main()
