# SPDX-License-Identifier: BSD-3-Clause
"""Steps of random walks over the rows of R, beside walkers in NumPy and in Numba, and beside random loads.

R has 131072 pixels and 100 nonzeros a row at random places. Walks start at every pixel, go on with chance
1/2 (m = 1/3), and score at every step. All walkers draw by |R_ij|: NumPy by `searchsorted` in cumulative
sums, all walks at once; Numba by alias tables of float32 and int32 in a `prange` over pixels. A step of ours
loads the record of a row, an entry of its table and b; a random load is one of 8 bytes in a table of the same
size.
One walk for three colours is measured beside three walks, of R whose rows have albedos of their own in each
colour and whose entries differ by a tenth; its steps count for all three.
The walks of all walkers are checked against the same float64 solution. Error against time is that of
`_pays.py`.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse

import _pays as pays
from _harness import Options, Row, options, report, seconds
from ltcl import plots
from ltcl.operators import CSR
from ltcl.operators.walks import Lengths, Tables, Walker, linked, tables

NUMPY_TARGET, NUMBA_TARGET, LOADS_TARGET = 10.0, 1.5, 0.6
GO_ON = 0.5
STEPS = 1.0 / (1.0 - GO_ON)  # of a walk, in the mean


def matrix(n: int, per_row: int) -> scipy.sparse.csr_array:
    """R of n pixels, entries of row sums around 0.6 at random places, a fifth of them negative."""
    random = np.random.default_rng(0)
    columns = random.integers(0, n, (n, per_row), dtype=np.int32)
    values = random.uniform(-0.25, 1.0, (n, per_row)).astype(np.float32) * np.float32(1.2 / per_row)
    R = scipy.sparse.csr_array((values.ravel(), columns.ravel(), np.arange(n + 1) * per_row), shape=(n, n))
    R.sum_duplicates()
    return R


class NumpyWalker:
    """All walks side by side; those that have ended are dropped after each step."""

    def __init__(self, R: scipy.sparse.csr_array, b: np.ndarray) -> None:
        self.R, self.b, self.random = R, b, np.random.default_rng(1)
        self.cumulative = np.append(0.0, np.cumsum(np.abs(R.data), dtype=np.float64))
        self.sums = np.diff(self.cumulative[R.indptr])
        self.sign = -np.sign(R.data)

    def __call__(self, samples: int) -> np.ndarray:
        """Means of the terms k >= 1, (N,)."""
        n = len(self.b)
        pixel = np.repeat(np.arange(n), samples)
        row, weight, score = pixel.copy(), np.ones(pixel.size), np.zeros(n)
        while row.size:
            target = self.cumulative[self.R.indptr[row]] + self.random.random(row.size) * self.sums[row]
            entry = np.searchsorted(self.cumulative, target, side="right") - 1
            weight = weight * self.sums[row] * self.sign[entry]
            row = self.R.indices[entry]
            score += np.bincount(pixel, weight * self.b[row], n)
            alive = self.random.random(row.size) < GO_ON
            row, pixel, weight = row[alive], pixel[alive], weight[alive] / GO_ON
        return score / samples


def numba_walker(R: scipy.sparse.csr_array, b: np.ndarray, made: Tables) -> Callable[[int], Any] | None:
    """The same by alias tables, or None where Numba is not installed."""
    try:
        numba: Any = importlib.import_module("numba")
    except ImportError:
        print("numba is not installed (pip install numba, or the extra `bench`): its rows are left out")
        return None
    entry = made.entries.get()
    threshold = ((entry >> np.uint64(46)) / 2**18).astype(np.float32)
    own = (entry >> np.uint64(23) & np.uint64(0x7FFFFF)).astype(np.int32)
    other = (entry & np.uint64(0x7FFFFF)).astype(np.int32)
    sums, pointers, go_on = made.sums(), R.indptr.astype(np.int64), np.float32(GO_ON)

    @numba.njit(parallel=True, fastmath=True)
    def walk(samples: int, pointers, threshold, own, other, sums, b, out) -> None:
        for pixel in numba.prange(len(out)):
            total = 0.0
            for _ in range(samples):
                row, weight = np.int64(pixel), np.float32(1.0)
                while True:
                    place = np.random.random() * (pointers[row + 1] - pointers[row])  # noqa: NPY002
                    slot = pointers[row] + int(place)
                    target = own[slot] if place - int(place) < threshold[slot] else other[slot]
                    weight *= sums[row] * (1 if target & 1 else -1)
                    row = np.int64(target >> 1)
                    total += weight * b[row]
                    if np.random.random() >= go_on:  # noqa: NPY002
                        break
                    weight /= go_on
            out[pixel] = total / samples

    out = np.zeros(len(b))

    def run(samples: int) -> np.ndarray:
        walk(samples, pointers, threshold, own, other, sums, b, out)
        return out

    return run


def colours(given: Options, R: scipy.sparse.csr_array, samples: int) -> Row:
    """Steps of walks that three channels share, counted for each, beside those of a walk a channel."""
    random, n = np.random.default_rng(3), len(R.indptr) - 1
    Rs: list[CSR] = []
    for _ in range(3):
        rows = np.repeat(random.uniform(0.3, 1.0, n), np.diff(R.indptr))
        data = R.data * rows * random.uniform(0.9, 1.1, R.nnz)
        host = scipy.sparse.csr_array((data.astype(np.float32), R.indices, R.indptr), shape=R.shape)
        Rs.append(CSR(given.device, host, Rs[0].pattern if Rs else None))
    b, lengths = random.random((n, 3), dtype=np.float32), Lengths.geometric(GO_ON, -1.0)
    together = Walker(linked(Rs, (1.0, 1.0, 1.0)), lengths, "collision", 0), given.device.upload(b)
    apart = [
        (Walker(tables(M), lengths, "collision", 0), given.device.upload(column))
        for M, column in zip(Rs, b.T, strict=True)
    ]
    actions = {
        "one walk": lambda: together[0].rows(together[1], np.arange(n), samples),
        "three walks": lambda: [walker.rows(b_c, np.arange(n), samples) for walker, b_c in apart],
    }
    times = seconds(actions)
    rate = {name: 3 * samples * n * STEPS / time / 1e6 for name, time in times.items()}
    theirs, ours = rate["three walks"], rate["one walk"]
    return Row("steps for three colours", "three walks", theirs, ours, "M/s", ours / theirs)


def check(name: str, found: np.ndarray, exact: np.ndarray, samples: int) -> None:
    """Stop where the mean over all pixels is not that of the solution: nobody is timed doing less."""
    if abs(float(np.mean(found - exact))) > 5.0 / (len(exact) * samples) ** 0.5:
        raise SystemExit(f"the walks of {name} do not lead to the solution")


def rows(given: Options, n: int, per_row: int, samples: int) -> tuple[list[Row], dict[str, Any]]:
    """All comparisons."""
    R, b = matrix(n, per_row), np.random.default_rng(2).random(n, dtype=np.float32)
    M, device = CSR(given.device, R), given.device
    made, b_there, pixels = Tables(M), device.upload(b), np.arange(n)
    walker = Walker(made, Lengths.geometric(GO_ON, -1.0), "collision", 0)
    numpy_walker, theirs = NumpyWalker(R, b), numba_walker(R, b, made)
    few, loads, out = max(1, samples // 16), 512, device.empty((4096,), np.uint64)
    kernel = device.kernel("random", "random_loads")

    def random_loads() -> None:
        kernel(out.size, 1 if device.is_cpu else 64, out.size, loads, made.entries.size, made.entries, out)
        device.finish()

    actions: dict[str, Callable[[], Any]] = {
        "ours": lambda: walker.rows(b_there, pixels, samples).mean,
        "NumPy searchsorted": lambda: numpy_walker(few),
        "random loads": random_loads,
        "tables": lambda: (Tables(M), device.finish()),
        "NumPy cumulative sums": lambda: NumpyWalker(R, b),
    }
    if theirs is not None:
        actions["Numba alias"] = lambda: theirs(samples)
    exact = scipy.sparse.linalg.bicgstab(scipy.sparse.eye_array(n) + R.astype(float), b, rtol=1e-8)[0] - b
    for name, count in (("ours", samples), ("NumPy searchsorted", few), ("Numba alias", samples)):
        if name in actions:
            check(name, actions[name](), exact, count)
    times = seconds(actions)
    rate = {name: samples * n * STEPS / time / 1e6 for name, time in times.items()}
    rate["NumPy searchsorted"] *= few / samples
    rate["random loads"] = out.size * 8 * loads / times["random loads"] / 1e6
    targets = {
        "NumPy searchsorted": NUMPY_TARGET,
        "Numba alias": NUMBA_TARGET,
        "random loads": LOADS_TARGET,
    }
    found = [
        Row("steps of walks", name, rate[name], rate["ours"], "M/s", rate["ours"] / rate[name], target)
        for name, target in targets.items()
        if name in rate
    ]
    ours, other = times["tables"] * 1e3, times["NumPy cumulative sums"] * 1e3
    found.append(Row("tables", "NumPy cumulative sums", other, ours, "ms", other / ours))
    found.append(colours(given, R, samples))
    return found, {
        "pixels": n,
        "nonzeros": R.nnz,
        "samples a pixel": samples,
        "MB of tables": made.nbytes / 1e6,
    }


def main() -> None:
    """Run the bench."""
    given = options(__doc__ or "")
    n, per_row, samples = (1024, 16, 32) if given.smoke else (131072, 100, 32)
    found, facts = rows(given, n, per_row, samples)
    side, repeats = (128, 1) if given.smoke else (8192, 3)
    curves = [
        pays.curves(given.device, matrix(n, per_row), f"{n} pixels, {per_row} entries a row", repeats),
        pays.curves(given.device, pays.dense(side), f"{side} pixels, all entries", repeats),
    ]
    report(dataclasses.replace(given, plot=None), "Random walks", found, facts | pays.facts(curves))
    if given.plot is not None:
        given.plot.parent.mkdir(parents=True, exist_ok=True)
        plots.save(pays.draw(curves), given.plot)


if __name__ == "__main__":
    main()
