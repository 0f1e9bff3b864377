# SPDX-License-Identifier: BSD-3-Clause
"""Steps of random walks over the rows of R, beside a walker in Numba.

R has 131072 pixels and 100 nonzeros a row at random places. Walks start at every pixel, go on with
chance 1/2 (m = 1/3), and score at every step. Both draw by |R_ij| and alias tables, Numba in a
`prange` over pixels. One walk for three colours is measured beside three walks, of R whose rows
have albedos of their own in each colour and whose entries differ by a tenth; its steps count for
all three. Walks are checked against a float64 solution.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse

from _harness import Options, Row, parse_options, report, seconds
from _peers import missing
from csr import matrix
from ltcl.operators import CSR
from ltcl.operators.walks import Lengths, Tables, Walker, linked, tables

# Times faster.
TARGET = 1.5
# Chance that a walk goes on, and its mean number of steps.
GO_ON = 0.5
STEPS = 1.0 / (1.0 - GO_ON)
LENGTHS = Lengths.geometric(GO_ON, -1.0)


def numba_walker(
    R: Any, b: np.ndarray, alias_tables: Tables, samples: int
) -> Callable[[], np.ndarray] | None:
    """The same walks in Numba, or None if it is not installed (the extra `bench` brings it)."""
    if "numba" in missing():
        return None
    numba: Any = importlib.import_module("numba")
    # An entry has 18 bits of threshold, and 23 each of its own target and of its alias.
    entry = alias_tables.entries.get()
    mask = np.uint64(0x7FFFFF)
    threshold = ((entry >> np.uint64(46)) / 2**18).astype(np.float32)
    own_target = (entry >> np.uint64(23) & mask).astype(np.int32)
    alias = (entry & mask).astype(np.int32)
    sums = alias_tables.sums()
    pointers = R.indptr.astype(np.int64)
    go_on = np.float32(GO_ON)

    @numba.njit(parallel=True, fastmath=True)
    def walk(pointers, threshold, own_target, alias, sums, b, out) -> np.ndarray:
        for pixel in numba.prange(len(out)):
            total = 0.0
            for _ in range(samples):
                row = np.int64(pixel)
                weight = np.float32(1.0)
                while True:
                    place = np.random.random() * (pointers[row + 1] - pointers[row])  # noqa: NPY002
                    slot = pointers[row] + int(place)
                    target = alias[slot]
                    if place - int(place) < threshold[slot]:
                        target = own_target[slot]
                    # The lowest bit is the sign.
                    weight *= sums[row] * (1 if target & 1 else -1)
                    row = np.int64(target >> 1)
                    total += weight * b[row]
                    if np.random.random() >= go_on:  # noqa: NPY002
                        break
                    weight /= go_on
            out[pixel] = total / samples
        return out

    out = np.zeros(len(b))
    return lambda: walk(pointers, threshold, own_target, alias, sums, b, out)


def coloured_matrices(
    options: Options, R: scipy.sparse.csr_array, random: np.random.Generator
) -> list[CSR]:
    """R of three colours with one sparsity pattern."""
    n = R.shape[0]
    matrices: list[CSR] = []
    for _ in range(3):
        albedos = np.repeat(random.uniform(0.3, 1.0, n), np.diff(R.indptr))
        data = R.data * albedos * random.uniform(0.9, 1.1, R.nnz)
        numbers = (data.astype(np.float32), R.indices, R.indptr)
        host = scipy.sparse.csr_array(numbers, shape=R.shape)
        pattern = matrices[0].pattern if matrices else None
        matrices.append(CSR(options.device, host, pattern))
    return matrices


def compare_colours(options: Options, R: scipy.sparse.csr_array, samples: int) -> Row:
    """Steps of walks that three channels share, counted for each, beside those of a walk a channel."""
    random = np.random.default_rng(3)
    n = R.shape[0]
    pixels = np.arange(n)
    matrices = coloured_matrices(options, R, random)
    b = random.random((n, 3), dtype=np.float32)

    def prepare(walk_tables: Any, light: np.ndarray) -> Callable[[], Any]:
        walker = Walker(walk_tables, LENGTHS, 0)
        device_light = options.device.upload(light)
        return lambda: walker.rows(device_light, pixels, samples)

    shared_walk = prepare(linked(matrices, (1.0, 1.0, 1.0)), b)
    channel_walks = []
    for channel, light in zip(matrices, b.T, strict=True):
        channel_walks.append(prepare(tables(channel), light))

    def walk_channels() -> list[Any]:
        return [walk() for walk in channel_walks]

    times = seconds({"one": shared_walk, "three": walk_channels})
    millions = 3 * samples * n * STEPS / 1e6
    ours = millions / times["one"]
    theirs = millions / times["three"]
    return Row("steps for three colours", "three walks", theirs, ours, "M/s", ours / theirs)


def signed_matrix(n: int, per_row: int) -> Any:
    """R with a fifth of negative entries, and row sums around 0.45."""
    R = matrix(n, per_row, 1)
    values = np.random.default_rng(0).uniform(-0.3, 1.2, R.nnz)
    R.data = (values / per_row).astype(np.float32)
    return R


def exact_indirect(R: Any, b: np.ndarray) -> np.ndarray:
    """The light that walks estimate: (I + R)^-1 b - b in float64."""
    S = scipy.sparse.eye_array(len(b)) + R.astype(float)
    x, _ = scipy.sparse.linalg.bicgstab(S, b, rtol=1e-8)
    return x - b


def main() -> None:
    options = parse_options(__doc__)
    n, per_row = (1024, 16) if options.smoke else (131072, 100)
    samples = 32
    R = signed_matrix(n, per_row)
    b = np.random.default_rng(2).random(n, dtype=np.float32)
    alias_tables = Tables(CSR(options.device, R))
    light = options.device.upload(b)
    pixels = np.arange(n)
    walker = Walker(alias_tables, LENGTHS, 0)
    actions: dict[str, Callable[[], Any]] = {
        "ours": lambda: walker.rows(light, pixels, samples).mean
    }
    numba_walk = numba_walker(R, b, alias_tables, samples)
    if numba_walk is not None:
        actions["Numba alias"] = numba_walk
    exact = exact_indirect(R, b)
    # Nobody is timed doing less.
    for name, walk in actions.items():
        bias = abs(float(np.mean(walk() - exact)))
        if bias > 5.0 / (n * samples) ** 0.5:
            raise SystemExit(f"the walks of {name} do not lead to the solution")
    millions = samples * n * STEPS / 1e6
    rates = {name: millions / spent for name, spent in seconds(actions).items()}
    ours = rates.pop("ours")
    rows = []
    for name, theirs in rates.items():
        rows.append(Row("steps of walks", name, theirs, ours, "M/s", ours / theirs, TARGET))
    rows.append(compare_colours(options, R, samples))
    table_bytes = alias_tables.records.nbytes + alias_tables.entries.nbytes
    facts = {
        "pixels": n,
        "nonzeros": R.nnz,
        "samples a pixel": samples,
        "MB of tables": table_bytes / 1e6,
        "steps, M/s": ours,
        "not installed": ", ".join(missing()) or "none",
    }
    report(options, "Random walks", rows, facts)


if __name__ == "__main__":
    main()
