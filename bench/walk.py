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

TARGET = 1.5  # times faster
GO_ON = 0.5
STEPS = 1.0 / (1.0 - GO_ON)  # of a walk, in the mean


def numba_walker(
    R: Any, b: np.ndarray, made: Tables, samples: int
) -> Callable[[], np.ndarray] | None:
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
    def walk(pointers, threshold, own, other, sums, b, out) -> np.ndarray:
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
        return out

    out = np.zeros(len(b))
    return lambda: walk(pointers, threshold, own, other, sums, b, out)


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
    of_light = [
        (linked(Rs, (1.0, 1.0, 1.0)), b),
        *((tables(M), l) for M, l in zip(Rs, b.T, strict=True)),
    ]
    walkers = [(Walker(made, lengths, 0), given.device.upload(light)) for made, light in of_light]

    def walk(some: list[Any]) -> list[Any]:
        return [walker.rows(light, np.arange(n), samples) for walker, light in some]

    times = seconds({"one": lambda: walk(walkers[:1]), "three": lambda: walk(walkers[1:])})
    ours, theirs = (3 * samples * n * STEPS / times[name] / 1e6 for name in ("one", "three"))
    return Row("steps for three colours", "three walks", theirs, ours, "M/s", ours / theirs)


def main() -> None:
    given = parse_options(__doc__ or "")
    n, per_row, samples = (1024, 16, 32) if given.smoke else (131072, 100, 32)
    R, b = matrix(n, per_row, 1), np.random.default_rng(2).random(n, dtype=np.float32)
    values = np.random.default_rng(0).uniform(
        -0.3, 1.2, R.nnz
    )  # a fifth negative; row sums around 0.45
    R.data = (values / per_row).astype(np.float32)
    made, light, pixels = Tables(CSR(given.device, R)), given.device.upload(b), np.arange(n)
    walker = Walker(made, Lengths.geometric(GO_ON, -1.0), 0)
    actions: dict[str, Callable[[], Any]] = {
        "ours": lambda: walker.rows(light, pixels, samples).mean
    }
    if (theirs := numba_walker(R, b, made, samples)) is not None:
        actions["Numba alias"] = theirs
    exact = (
        scipy.sparse.linalg.bicgstab(scipy.sparse.eye_array(n) + R.astype(float), b, rtol=1e-8)[0]
        - b
    )
    for name, action in actions.items():  # nobody is timed doing less
        if abs(float(np.mean(action() - exact))) > 5.0 / (n * samples) ** 0.5:
            raise SystemExit(f"the walks of {name} do not lead to the solution")
    rate = {name: samples * n * STEPS / time / 1e6 for name, time in seconds(actions).items()}
    ours = rate.pop("ours")
    rows = [
        Row("steps of walks", who, peer, ours, "M/s", ours / peer, TARGET)
        for who, peer in rate.items()
    ]
    facts = {
        "pixels": n,
        "nonzeros": R.nnz,
        "samples a pixel": samples,
        "MB of tables": (made.records.nbytes + made.entries.nbytes) / 1e6,
        "steps, M/s": ours,
        "not installed": ", ".join(missing()) or "none",
    }
    report(given, "Random walks", [*rows, colours(given, R, samples)], facts)


if __name__ == "__main__":
    main()
