# SPDX-License-Identifier: BSD-3-Clause
"""Device traffic of a step of each method: kernels, waits, allocations and bytes over the bus.

These counts are the same on every device. For every method and kind of operator a solve runs to a
number of iterations that it cannot end before; steps are counted from product to product, medians.
First solves are counted from an operator whose properties are unknown: row sums, survey and tables
included.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any
from unittest import mock

import numpy as np
import scipy.sparse
from rich.console import Console
from rich.table import Table

import ltcl
from _harness import Options, parse_options, record, write_json
from ltcl.device import Device
from ltcl.device.transfers import PinnedDownload, PinnedUpload
from ltcl.operators import CSR, Compressed, Dense, IdentityPlus, Tiles, Wavelet
from ltcl.solvers.bounded import minimise

WAIT = "wait"
# A copy that is queued.
COPY = "copy"
# Iterations of a solve that is counted.
STEPS = 16


@dataclass(frozen=True)
class Target:
    """Largest launches and waits of a step between two checks, and its products."""

    launches: int
    waits: int
    products: int


TARGETS = {
    "jacobi": Target(1, 0, 1),
    "neumann": Target(1, 0, 1),
    "richardson": Target(1, 0, 1),
    "chebyshev": Target(1, 0, 1),
    "cg": Target(3, 0, 1),
    "gmres": Target(5, 1, 1),
    "bicgstab": Target(5, 1, 2),
    "bounded": Target(6, 1, 2),
}


class Traffic:
    """Calls to a device in their order: kernels, WAIT or COPY, with bytes over the bus."""

    def __init__(self) -> None:
        self.events: list[tuple[str, int]] = []

    @property
    def names(self) -> list[str]:
        """Names of kernels, WAIT or COPY."""
        return [name for name, _ in self.events]

    @property
    def waits(self) -> int:
        """Number of waits."""
        return self.names.count(WAIT)

    @property
    def nbytes(self) -> int:
        """Bytes over the bus."""
        return sum(size for _, size in self.events)


@contextlib.contextmanager
def record_traffic() -> Iterator[Traffic]:
    """Record the calls to all devices inside the block."""
    traffic = Traffic()
    launch = Device.launch
    copy = Device.copy
    queue_copy = Device.queue_copy
    finish = Device.finish

    def recorded_launch(self: Device, name: str, *rest: Any) -> Any:
        traffic.events.append((name, 0))
        return launch(self, name, *rest)

    def recorded_copy(self: Device, to: Any, source: Any, **sizes: Any) -> None:
        for array in (to, source):
            if isinstance(array, np.ndarray):
                traffic.events.append((WAIT, array.nbytes))
        copy(self, to, source, **sizes)

    def recorded_queue_copy(self: Device, to: Any, source: Any) -> Any:
        for array in (to, source):
            if isinstance(array, np.ndarray):
                traffic.events.append((COPY, array.nbytes))
        return queue_copy(self, to, source)

    def recorded_finish(self: Device) -> None:
        traffic.events.append((WAIT, 0))
        finish(self)

    def recorded_send(send: Callable[..., None]) -> Callable[..., None]:
        def recorded(self: PinnedUpload | PinnedDownload, *rest: Any) -> None:
            traffic.events.append((COPY, self.array.nbytes))
            send(self, *rest)

        return recorded

    with (
        mock.patch.multiple(
            Device,
            launch=recorded_launch,
            copy=recorded_copy,
            queue_copy=recorded_queue_copy,
            finish=recorded_finish,
        ),
        mock.patch.object(PinnedUpload, "send", recorded_send(PinnedUpload.send)),
        mock.patch.object(PinnedDownload, "send", recorded_send(PinnedDownload.send)),
    ):
        yield traffic


def operators(options: Options) -> dict[str, Callable[[], Any]]:
    """R of one kind each, made anew at every call: the mean of two neighbours.

    Its eigenvalues are all over [-0.9, 0.9], so that no method comes near rounding in those steps.
    """
    device = options.device
    side = 16 if options.smoke else 64
    ring = np.roll(np.eye(side**2, dtype=np.float32), 1, axis=0)
    G = 0.45 * (ring + ring.T)
    W = Wavelet(device, (side, side), "db2")
    sparse = scipy.sparse.csr_array(G)
    return {
        "csr": lambda: CSR(device, sparse),
        "dense": lambda: Dense(device, G),
        "tiles": lambda: Tiles(device, sparse),
        "two-sided wavelets": lambda: Compressed(CSR(device, sparse), W, W, error=0.0),
    }


def solve(S: IdentityPlus, b: np.ndarray, method: str, **rules: Any) -> Any:
    """A solve by one method; `bounded` is least squares within bounds that bind."""
    if method != "bounded":
        return ltcl.solve(S, b, method, throw=False, **rules)
    columns = b.reshape(len(b), -1)
    lower = np.full(len(b), 0.2)
    upper = np.full(len(b), 0.5)
    return minimise(S, columns, lower, upper, np.zeros(columns.shape), **rules)


def long_rules(method: str) -> dict[str, Any]:
    """Settings with which a solve takes STEPS iterations, and nothing else."""
    if method == "bounded":
        return {"rtol": 1e-9, "maxiter": STEPS}
    rules: dict[str, Any] = {"rtol": 1e-12, "maxiter": STEPS}
    if method == "chebyshev":
        rules |= {"arnoldi": 0, "spectrum": (0.05, 2.0)}
    return rules


def step_medians(names: list[str], products: int) -> tuple[int, int]:
    """Median launches and waits of a step, which begins with a product and has `products`."""
    starts = [i for i, name in enumerate(names) if "matvec" in name]
    launches = []
    waits = []
    for start, stop in zip(starts, starts[products:], strict=False):
        step_waits = names[start:stop].count(WAIT)
        waits.append(step_waits)
        launches.append(stop - start - step_waits)
    return round(np.median(launches)), round(np.median(waits))


def row(device: Device, kind: str, make: Callable[[], Any], method: str, k: int) -> dict[str, Any]:
    """Counts of one method on one kind of operator with k right-hand sides."""
    target = TARGETS[method]
    S = IdentityPlus(make())
    n = S.shape[0]
    shape = (n,) if k == 1 else (n, k)
    b = np.random.default_rng(1).random(shape, dtype=np.float32)
    with record_traffic() as first:
        solve(S, b, method, rtol=1e-2)
    rules = long_rules(method)
    # Builds, tunes, surveys S.
    solve(S, b, method, **rules)
    before = device.allocations
    with record_traffic() as traffic:
        iterations = solve(S, b, method, **rules).iterations
    allocations = device.allocations - before
    # Residuals are read every few steps only, and so are not counted where nothing else waits.
    launches, waits = step_medians(traffic.names, target.products)
    # Bounds are of pixels: transforms in every product, without a target.
    has_target = not (method == "bounded" and "wavelets" in kind)
    is_hit = launches <= target.launches and waits <= target.waits and allocations == 0
    verdict = "hit" if is_hit else "MISS"
    targets = f"{target.launches}, {target.waits}"
    if not has_target:
        verdict = ""
        targets = "none: in pixels"
    return {
        "operator": kind,
        "method": method,
        "k": k,
        "launches a step": launches,
        "waits a step": waits,
        "targets": targets,
        "waits, with checks": round(traffic.waits / iterations, 2),
        "allocations": allocations,
        "bytes over the bus a step": round(traffic.nbytes / iterations),
        "first solve: launches": len(first.events) - first.waits,
        "waits": first.waits,
        "KB over the bus": round(first.nbytes / 1e3, 1),
        "verdict": verdict,
    }


def main() -> None:
    options = parse_options(__doc__)
    kinds = operators(options).items()
    rows = []
    for (kind, make), method, k in itertools.product(kinds, TARGETS, (1, 3)):
        rows.append(row(options.device, kind, make, method, k))
    misses = [cells["verdict"] for cells in rows].count("MISS")
    table = Table(*rows[0], caption=f"{misses} of {len(rows)} targets missed")
    for cells in rows:
        table.add_row(*map(str, cells.values()))
    Console(width=190).print(table)
    if options.json is not None:
        content = record(options, "What a step asks of a device", {"missed": misses})
        write_json(options.json, content | {"rows": rows})


if __name__ == "__main__":
    main()
