# SPDX-License-Identifier: BSD-3-Clause
"""Steps of random walks over the rows of R, beside a walker in Numba.

R has 131072 pixels and 100 nonzeros a row at random places. Walks start at every pixel, go on with chance
1/2 (m = 1/3), and score at every step. Both draw by |R_ij|, Numba by alias tables of float32 and int32 in a
`prange` over pixels.
One walk for three colours is measured beside three walks, of R whose rows have albedos of their own in each
colour and whose entries differ by a tenth; its steps count for all three.
All walks are checked against the same float64 solution.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse

from _harness import Options, Row, options, report, seconds
from _peers import missing
from ltcl.operators import CSR
from ltcl.operators.walks import Lengths, Tables, Walker, linked, tables

TARGET = 1.5  # times faster
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


def numba_walker(R: scipy.sparse.csr_array, b: np.ndarray, made: Tables) -> Callable[[int], Any] | None:
    """The same by alias tables, or None where Numba is not installed (the extra `bench` brings it)."""
    if "numba" in missing():
        return None
    numba: Any = importlib.import_module("numba")
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
    together = Walker(linked(Rs, (1.0, 1.0, 1.0)), lengths, 0), given.device.upload(b)
    apart = [
        (Walker(tables(M), lengths, 0), given.device.upload(column))
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
    walker = Walker(made, Lengths.geometric(GO_ON, -1.0), 0)
    actions: dict[str, Callable[[], Any]] = {"ours": lambda: walker.rows(b_there, pixels, samples).mean}
    if (theirs := numba_walker(R, b, made)) is not None:
        actions["Numba alias"] = lambda: theirs(samples)
    exact = scipy.sparse.linalg.bicgstab(scipy.sparse.eye_array(n) + R.astype(float), b, rtol=1e-8)[0] - b
    for name, action in actions.items():
        check(name, action(), exact, samples)
    rate = {name: samples * n * STEPS / time / 1e6 for name, time in seconds(actions).items()}
    ours, numba = rate["ours"], rate.get("Numba alias")
    found = [colours(given, R, samples)]
    if numba is not None:
        found.insert(0, Row("steps of walks", "Numba alias", numba, ours, "M/s", ours / numba, TARGET))
    megabytes = (made.records.nbytes + made.entries.nbytes) / 1e6
    facts = {"pixels": n, "nonzeros": R.nnz, "samples a pixel": samples, "MB of tables": megabytes}
    return found, facts | {"steps, M/s": ours, "not installed": ", ".join(missing()) or "none"}


def main() -> None:
    """Run the bench."""
    given = options(__doc__ or "")
    n, per_row, samples = (1024, 16, 32) if given.smoke else (131072, 100, 32)
    found, facts = rows(given, n, per_row, samples)
    report(given, "Random walks", found, facts)


if __name__ == "__main__":
    main()
