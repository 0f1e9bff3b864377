# SPDX-License-Identifier: BSD-3-Clause
"""Gain of two MPI ranks over one, and a model's prediction for 64 GPUs.

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
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy.optimize
import scipy.sparse

import ltcl
from _harness import Row, medians, parse_options, report, triad
from ltcl.operators import CSR, Dense, Distributed, IdentityPlus

# Pixels and entries a row; as many of both: a dense matrix.
SIZES = ((1024, 16), (32_768, 256), (131_072, 256), (16_384, 16_384))
SMOKE_SIZES = ((1024, 16), (4096, 16), (512, 512))
# From this number of entries on, two ranks must be faster by this factor.
MIN_LARGE_ENTRIES = 1 << 25
LARGE_TARGET = 1.8
ONE_THREAD = {"POCL_MAX_PTHREAD_COUNT": "1", "POCL_CPU_MAX_CU_COUNT": "1", "OMP_NUM_THREADS": "1"}
ROUNDS = 11
# Products, or exchanges, of one timing.
PRODUCTS = 4
# Rows of a matrix that one random generator makes.
BLOCK_ROWS = 256
Actions = dict[str, Callable[[], object] | None]
# The model's machine; bytes a second, and seconds.
GPUS = 64
MEMORY_SPEED = 0.8 * 3.35e12
BUS_SPEED = 25e9
NETWORK_STEP = 5e-6
ASSUMED = (
    "a GPU a rank, 80 % of 3.35 TB/s; bus and network 25 GB/s; log2 p steps of 5 us; a as here"
)


def run_ranks(sizes: tuple[tuple[int, int], ...]) -> list[dict[str, float]]:
    """Seconds of two ranks, a core and a thread each, one dictionary for each size."""
    launcher = Path(sys.executable).with_name("mpiexec")
    mpiexec = str(launcher) if launcher.exists() else "mpiexec"
    command = [mpiexec, "-n", "2", sys.executable, "-m", "mpi4py"]
    command += [__file__, "rank", json.dumps(sizes)]
    environment = os.environ | ONE_THREAD
    run = subprocess.run(  # noqa: S603
        command, env=environment, check=True, stdout=subprocess.PIPE
    )
    return json.loads(run.stdout)


def size_rows(n: int, k: int, times: dict[str, float]) -> list[Row]:
    """Two ranks against one, against a solve without MPI, and against the limits of memory."""
    name = f"{n} x {k}"
    ours = times["solve 2 ranks"]
    one_rank = times["solve 1 rank"]
    target = LARGE_TARGET if n * k >= MIN_LARGE_ENTRIES else None
    question = f"Chebyshev by 2 ranks, {name}"
    rows = [
        Row.from_times(question, "1 rank", one_rank, ours, "s", target),
        Row.from_times(question, "no MPI", times["solve no MPI"], ours, "s"),
    ]
    gain = one_rank / ours
    for reading in ("reading the same", "triad"):
        limit = times[f"{reading} 1 rank"] / times[f"{reading} 2 ranks"]
        question = f"gain by 2 ranks, {name}"
        rows.append(Row(question, reading, limit, gain, "times", gain / limit))
    return rows


def model(sizes: tuple[tuple[int, int], ...], results: list[dict[str, float]]) -> dict[str, Any]:
    """Fit a, b and c, at least 0, to relative deviations, and predict products on GPUs."""
    terms = []
    times = []
    for (n, k), result in zip(sizes, results, strict=True):
        for ranks, name in ((1, "1 rank"), (2, "2 ranks"), (4, "4 ranks")):
            terms.append([1.0, n * k / ranks, n])
            times.append(result[f"product {name}"])
    shares = np.array(terms) / np.array(times)[:, None]
    a, b, c = scipy.optimize.nnls(shares, np.ones(len(times)))[0]
    deviations = np.abs(shares @ (a, b, c) - 1.0)
    facts: dict[str, Any] = {
        "a in us, b and c in ns": f"{1e6 * a:.3g}, {1e9 * b:.3g}, {1e9 * c:.3g}",
        "largest relative deviation of the model": float(deviations.max()),
        "4 ranks are measured on 2 cores": "a quarter of the rows and whole vectors on each",
    }
    n = 131_072
    facts[f"product on {GPUS} GPUs, {n} x 256, sparse"] = predict(a, n, 256 * 8 * n)
    facts[f"product on {GPUS} GPUs, {n} x {n}, dense"] = predict(a, n, 4 * n * n)
    return facts | {"assumed": ASSUMED}


def predict(a: float, n: int, nbytes: int) -> str:
    """Time of a product on many GPUs, and beside one."""
    exchange = 8 * n / BUS_SPEED + 4 * n / BUS_SPEED + NETWORK_STEP * np.log2(GPUS)
    one = a + nbytes / MEMORY_SPEED
    many = a + nbytes / MEMORY_SPEED / GPUS + exchange
    return f"{1e6 * many:.3g} us, {one / many:.3g} times as fast as one"


def run_rank(sizes: list[list[int]]) -> None:
    """The work of each rank; the first one prints."""
    from mpi4py import MPI

    comm = MPI.COMM_WORLD
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cores[comm.rank % len(cores)]})
    results = [compare(comm, MPI.COMM_SELF, n, entries) for n, entries in sizes]
    if comm.rank == 0:
        print(json.dumps(results))


def rank_operators(comm: Any, alone: Any, n: int, entries: int, own_rows: Any) -> dict[str, Any]:
    """R over 1, 2 and 4 ranks, and without MPI; a rank has the operators in which it takes part.

    A quarter of a sparse matrix on two ranks stands for four.
    """
    is_sparse = scipy.sparse.issparse(own_rows)
    half = n // 2
    operators: dict[str, Any] = {"2 ranks": Distributed(comm, own_rows)}
    if comm.rank == 0:
        make = CSR if is_sparse else Dense
        A = make(ltcl.open_device(), matrix(0, n, n, entries))
        operators["no MPI"] = A
        operators["1 rank"] = Distributed(alone, A)
    if is_sparse:
        empty = scipy.sparse.csr_array((half - half // 2, n), dtype=np.float32)
        quarter = scipy.sparse.vstack([own_rows[: half // 2], empty], "csr")
        operators["4 ranks"] = Distributed(comm, quarter)
    return operators


def compare(comm: Any, alone: Any, n: int, entries: int) -> dict[str, float]:
    """Median seconds of solves and products."""
    half = n // 2
    b = np.random.default_rng(1).random(n, np.float32)
    own_rows = matrix(comm.rank * half, (comm.rank + 1) * half, n, entries)
    operators = rank_operators(comm, alone, n, entries, own_rows)
    is_small = n * entries < 1 << 20
    triad_of_half, _ = triad(operators["2 ranks"].device, is_small, 2)
    actions: Actions = {"exchange": exchange_halves(comm, n)}
    actions |= operator_actions(operators, b)
    actions |= memory_actions(comm, "reading the same", partial(read_numbers, own_rows))
    actions |= memory_actions(comm, "triad", triad_of_half)
    times = median_seconds(comm, actions)
    for name in times:
        if name.startswith(("product", "exchange")):
            times[name] /= PRODUCTS
    distributed = solve(operators["2 ranks"], b)
    difference = 0.0
    if "no MPI" in operators:
        deviation = np.linalg.norm(distributed - solve(operators["no MPI"], b))
        difference = float(deviation / np.linalg.norm(distributed))
    return times | {"difference": difference}


def solve(A: Any, b: np.ndarray) -> np.ndarray:
    return ltcl.solve(IdentityPlus(A), b, "chebyshev", rtol=1e-4, spectrum=(0.5, 1.5)).x


def run_products(A: Any, x: Any) -> None:
    for _ in range(PRODUCTS):
        A.apply(x).device.finish()


def operator_actions(operators: dict[str, Any], b: np.ndarray) -> Actions:
    """Products and solves; None for operators in which the rank takes no part.

    All ranks go through the same names in the same order.
    """
    actions: Actions = {}
    for name in ("no MPI", "1 rank", "2 ranks", "4 ranks"):
        A = operators.get(name)
        actions[f"product {name}"] = None
        actions[f"solve {name}"] = None
        if A is not None:
            actions[f"product {name}"] = partial(run_products, A, A.device.upload(b))
            if name != "4 ranks":
                actions[f"solve {name}"] = partial(solve, A, b)
    return actions


def exchange_halves(comm: Any, n: int) -> Callable[[], None]:
    """Exchanges of the halves of a vector, as products make them."""
    own_half = np.zeros(n // 2, np.float32)
    whole = np.zeros(n, np.float32)

    def exchange() -> None:
        for _ in range(PRODUCTS):
            comm.Allgatherv(own_half, whole)

    return exchange


def read_numbers(own_rows: Any) -> None:
    """Read all numbers of a matrix, and do next to nothing with them."""
    if scipy.sparse.issparse(own_rows):
        own_rows.data.view(np.int32).max()
        own_rows.indices.view(np.int32).max()
    else:
        own_rows.view(np.int32).max()


def memory_actions(comm: Any, name: str, read_half: Callable[[], object]) -> Actions:
    """Reading of both halves by the first rank, and of a half by each."""

    def one_rank() -> None:
        read_half()
        read_half()

    def two_ranks() -> None:
        read_half()
        comm.Barrier()

    return {f"{name} 1 rank": one_rank if comm.rank == 0 else None, f"{name} 2 ranks": two_ranks}


def matrix(start: int, stop: int, n: int, entries: int) -> Any:
    """Rows that sum to 1/4, the same on all ranks, an entry in each of `entries` equal pieces."""
    piece = n // entries
    blocks = []
    for first in range(start, stop, BLOCK_ROWS):
        random = np.random.default_rng(first)
        shape = (min(BLOCK_ROWS, stop - first), entries)
        values = random.random(shape, np.float32) / (2 * entries)
        if piece == 1:
            blocks.append(values)
            continue
        columns = np.arange(entries) * piece + random.integers(0, piece, shape)
        ends = np.arange(0, values.size + 1, entries)
        numbers = (values.ravel(), columns.ravel(), ends)
        blocks.append(scipy.sparse.csr_array(numbers, (len(values), n)))
    if piece == 1:
        return np.concatenate(blocks)
    return scipy.sparse.vstack(blocks, "csr")


def median_seconds(comm: Any, actions: Actions) -> dict[str, float]:
    """Median seconds of each in turn; a rank sleeps while others have something to do alone."""
    times = defaultdict(list)
    # The first round warms up.
    for turn in range(ROUNDS + 1):
        for name, action in actions.items():
            arrived = comm.Ibarrier()
            while not arrived.Test():
                time.sleep(1e-3)
            start = time.perf_counter()
            if action is not None:
                action()
            if turn > 0:
                times[name].append(time.perf_counter() - start)
    return medians(times)


def main() -> None:
    options = parse_options(__doc__)
    sizes = SMOKE_SIZES if options.smoke else SIZES
    results = run_ranks(sizes)
    rows = []
    facts: dict[str, Any] = {}
    for (n, k), times in zip(sizes, results, strict=True):
        rows += size_rows(n, k, times)
        facts[f"Allgatherv of {n}, ms"] = 1e3 * times["exchange"]
        difference = f"relative difference from the solution without MPI, {n} x {k}"
        facts[difference] = times["difference"]
    # The last size is dense, and has no 4 ranks.
    facts |= model(sizes[:-1], results[:-1])
    report(options, "Scaling over ranks", rows, facts)


if __name__ == "__main__":
    if sys.argv[1:2] == ["rank"]:
        run_rank(json.loads(sys.argv[2]))
    else:
        main()
