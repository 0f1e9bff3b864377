# SPDX-License-Identifier: BSD-3-Clause
"""What a step of each method asks of a device: kernels, waits, allocations and bytes over the bus.

These counts are the same on every device. For every method and kind of operator a solve runs to a
number of iterations that it cannot end before; steps are counted from product to product, medians.
First solves are counted from an operator that nothing is known of: row sums, survey and tables
included.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import numpy as np
import scipy.sparse
from rich.console import Console
from rich.table import Table

import ltcl
from _harness import Options, parse_options, record, write_json
from ltcl.device import Device
from ltcl.operators import CSR, Compressed, Dense, IdentityPlus, Tiles, Wavelet
from ltcl.solvers.bounded import minimise

WAIT = "wait"
STEPS = 16  # of a solve that is counted
# Launches and waits of a step between two checks, at most, and its products.
TARGETS = {
    **dict.fromkeys(("jacobi", "neumann", "richardson", "chebyshev"), (1, 0, 1)),
    "cg": (3, 0, 1),
    "gmres": (5, 1, 1),
    "bicgstab": (5, 1, 2),
    "bounded": (6, 1, 2),
}


@contextlib.contextmanager
def traffic() -> Iterator[list[tuple[str, int]]]:
    """What goes to a device inside the block: names of kernels, or WAIT, in order; and bytes over the bus."""
    events: list[tuple[str, int]] = []
    launch, copy, finish = Device.launch, Device.copy, Device.finish

    def launched(self: Device, name: str, *rest: Any) -> None:
        events.append((name, 0))
        launch(self, name, *rest)

    def copied(self: Device, to: Any, of: Any, **sizes: Any) -> None:
        events.extend((WAIT, host.nbytes) for host in (to, of) if isinstance(host, np.ndarray))
        copy(self, to, of, **sizes)

    def finished(self: Device) -> None:
        events.append((WAIT, 0))
        finish(self)

    with mock.patch.multiple(Device, launch=launched, copy=copied, finish=finished):
        yield events


def operators(given: Options) -> dict[str, Any]:
    """R of one kind each, made anew at every call: the mean of two neighbours.

    Its eigenvalues are all over [-0.9, 0.9], so that no method comes near rounding in those steps.
    """
    side, device = 16 if given.smoke else 64, given.device
    ring = np.roll(np.eye(side**2, dtype=np.float32), 1, axis=0)
    G, W = 0.45 * (ring + ring.T), Wavelet(device, (side, side), "db2")
    sparse = scipy.sparse.csr_array(G)
    return {
        "csr": lambda: CSR(device, sparse),
        "dense": lambda: Dense(device, G),
        "tiles": lambda: Tiles(device, sparse),
        "two-sided wavelets": lambda: Compressed(CSR(device, sparse), W, W, error=0.0),
    }


def solver(method: str, b: np.ndarray, **rules: Any) -> Callable[[IdentityPlus], Any]:
    """A solve of one system after another; `bounded` is least squares within bounds that bind."""
    if method == "bounded":
        columns = b.reshape(len(b), -1)
        lower, upper, start = np.full(len(b), 0.2), np.full(len(b), 0.5), np.zeros(columns.shape)
        return lambda S: minimise(S, columns, lower, upper, start, **rules)
    return lambda S: ltcl.solve(S, b, method, throw=False, **rules)


def row(device: Device, kind: str, make: Callable[[], Any], method: str, k: int) -> dict[str, Any]:
    target, waits_most, products = TARGETS[method]
    S = IdentityPlus(make())
    b = np.random.default_rng(1).random(
        (S.shape[0],) if k == 1 else (S.shape[0], k), dtype=np.float32
    )
    with traffic() as first:
        solver(method, b, rtol=1e-2)(S)
    options = {"arnoldi": 0, "spectrum": (0.05, 2.0)} if method == "chebyshev" else {}
    run = solver(method, b, rtol=1e-12 if method != "bounded" else 1e-9, maxiter=STEPS, **options)
    run(S)  # builds, tunes, looks at S
    before = device.allocations
    with traffic() as events:
        iterations = run(S).iterations
    allocations = device.allocations - before
    # Residuals are read every few steps only, and so are not counted where nothing else waits.
    names = [name for name, _ in events]
    marks = [i for i, name in enumerate(names) if "matvec" in name]
    spans = [names[i:j] for i, j in zip(marks, marks[products:], strict=False)]
    waits = np.array([span.count(WAIT) for span in spans])
    launches, waits = (
        round(np.median([len(span) for span in spans] - waits)),
        round(np.median(waits)),
    )
    pixels = (
        method == "bounded" and "wavelets" in kind
    )  # bounds are of pixels: transforms in every product
    hit = launches <= target and waits <= waits_most and allocations == 0
    first_waits = sum(name == WAIT for name, _ in first)
    return {
        "operator": kind,
        "method": method,
        "k": k,
        "launches a step": launches,
        "waits a step": waits,
        "targets": "none: in pixels" if pixels else f"{target}, {waits_most}",
        "waits, with checks": round(names.count(WAIT) / iterations, 2),
        "allocations": allocations,
        "bytes over the bus a step": round(sum(size for _, size in events) / iterations),
        "first solve: launches": len(first) - first_waits,
        "waits": first_waits,
        "KB over the bus": round(sum(size for _, size in first) / 1e3, 1),
        "verdict": "" if pixels else "hit" if hit else "MISS",
    }


def main() -> None:
    given = parse_options(__doc__ or "")
    kinds = itertools.product(operators(given).items(), TARGETS, (1, 3))
    rows = [row(given.device, kind, make, method, k) for (kind, make), method, k in kinds]
    misses = sum(one["verdict"] == "MISS" for one in rows)
    table = Table(*rows[0], caption=f"{misses} of {len(rows)} targets missed")
    for one in rows:
        table.add_row(*map(str, one.values()))
    Console(width=190).print(table)
    if given.json is not None:
        facts = record(given, "What a step asks of a device", {"missed": misses})
        write_json(given.json, facts | {"rows": rows})


if __name__ == "__main__":
    main()
