# SPDX-License-Identifier: BSD-3-Clause
"""Two devices that share the rows of a matrix: what a product moves and waits for.

Devices of one context, as of device="all", keep the vectors and send each other what changes; those
of two contexts send the same through the host. Counted are numbers between devices and over the
host's bus, and waits of the host, for each product of a solve of many steps; timed are a product,
and solves by Krylov methods with vectors on the first device (at home) or in shares on both, of
which ltcl takes what a timed step says is quicker. The devices are those of the platform, or halves
of one that can be halved.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any
from unittest import mock

import numpy as np
import scipy.sparse
from rich.table import Table

import ltcl
from _harness import Options, milliseconds, parse_options, product, publish
from launches import long_rules, record_traffic
from ltcl.device import Device, exchange
from ltcl.device.discovery import Description, open_together
from ltcl.operators import CSR, Dense, IdentityPlus, MultiDevice

KRYLOV = ("cg", "gmres", "bicgstab")
# Where the vectors of Krylov methods are: whether they are in shares.
PLACES = {"at home": False, "in shares": True}
NUMBER_BYTES = 4
# Entries on each side of the diagonal of the sparse R that is timed.
BAND = 12


def two_descriptions(device: Device) -> list[Description]:
    """Two devices: those of the platform, or halves of this one; none if there is neither."""
    everywhere = ltcl.open_device("all")
    if everywhere.others:
        return [everywhere.description, everywhere.others[0].description]
    if device.compute_units < 2 or device.handle.partition_max_sub_devices < 2:
        return []
    equally = [device.cl.device_partition_property.EQUALLY, device.compute_units // 2]
    halves = []
    for handle in device.handle.create_sub_devices(equally)[:2]:
        description = dataclasses.replace(device.description, index=f"half {handle}", handle=handle)
        halves.append(description)
    return halves


def ways(descriptions: list[Description]) -> dict[str, tuple[Device, Device]]:
    """Both devices in one context, and each in its own."""
    near = open_together(descriptions)
    first, second = map(Device, descriptions)
    return {"one context": (near, near.others[0]), "through the host": (first, second)}


def shared_matrix(devices: tuple[Device, Device], n: int) -> MultiDevice:
    """R with half of the rows on each device."""
    first, second = devices
    ring = np.roll(np.eye(n, dtype=np.float32), 1, axis=0)
    matrix = 0.45 * (ring + ring.T)
    half = n // 2
    return MultiDevice(first, [Dense(first, matrix[:half]), Dense(second, matrix[half:])])


@contextlib.contextmanager
def count_exchanged() -> Iterator[list[int]]:
    """Numbers of each copy between devices inside the block."""
    counts: list[int] = []
    send = exchange.send_rows

    def counted(source: Any, first: int, target: Any, at: int, count: int, ready: Any) -> Any:
        counts.append(count * source.columns)
        return send(source, first, target, at, count, ready)

    with mock.patch.object(exchange, "send_rows", counted):
        yield counts


def counted_row(way: str, name: str, n: int, call: Callable[[], int]) -> dict[str, Any]:
    """Counts of a call, which returns its products; per product, vectors as the unit."""
    call()
    with record_traffic() as traffic, count_exchanged() as exchanged:
        products = call()
    return {
        "way": way,
        "call": name,
        "products": products,
        "copies": round(len(exchanged) / products, 2),
        "vectors between devices": round(sum(exchanged) / n / products, 2),
        "vectors over the bus": round(traffic.nbytes / NUMBER_BYTES / n / products, 2),
        "waits": round(traffic.waits / products, 2),
    }


def calls(A: MultiDevice) -> dict[str, Callable[[], int]]:
    """A product with bound vectors, and solves by methods that ask for products alone."""
    n = A.shape[0]
    b = np.random.default_rng(1).random(n, dtype=np.float32)
    x, out = A.device.upload(b), A.device.empty(n)
    multiply = A.bind(x, out)

    def one_product() -> int:
        multiply()
        return 1

    def solve(S: IdentityPlus, method: str) -> int:
        return ltcl.solve(S, b, method, throw=False, **long_rules(method)).products

    found: dict[str, Callable[[], int]] = {"product": one_product}
    found["solve by chebyshev"] = partial(solve, IdentityPlus(A), "chebyshev")
    for place in places(A):
        S = system_with_vectors(A, place)
        for method in KRYLOV:
            found[f"solve by {method}, {place}"] = partial(solve, S, method)
    return found


def places(A: MultiDevice) -> list[str]:
    """Where the vectors of a Krylov method can be."""
    if A.row_shares() is None:
        return ["at home"]
    return list(PLACES)


def system_with_vectors(A: MultiDevice, place: str, columns: int = 1) -> IdentityPlus:
    """I + A, as if vectors in that place were the quicker ones."""
    S = IdentityPlus(A)
    S.known.is_quicker_in_shares[columns] = PLACES[place]
    return S


def solve_times(
    devices: tuple[Device, Device], n: int, columns: int, methods: tuple[str, ...]
) -> dict[str, Any]:
    """Milliseconds of solves with a sparse R in both places, and which one ltcl would take."""
    first, second = devices
    offsets: Any = [offset for offset in range(-BAND, BAND + 1) if offset]
    bands = [np.full(n - abs(offset), 0.48 / BAND, np.float32) for offset in offsets]
    matrix = scipy.sparse.csr_array(scipy.sparse.diags(bands, offsets))
    half = n // 2
    A = MultiDevice(first, [CSR(first, matrix[:half]), CSR(second, matrix[half:])])
    b = np.random.default_rng(2).random((n, columns), dtype=np.float32)
    name = f"N={n}, k={columns}"
    found: dict[str, Any] = {}
    for method in methods:
        actions = {}
        for place in PLACES:
            S = system_with_vectors(A, place, columns)
            key = f"ms of a solve by {method}, {name}, {place}"
            actions[key] = partial(ltcl.solve, S, b, method, rtol=1e-5)
        found |= milliseconds(actions, repeats=5)
    S = IdentityPlus(A)
    ltcl.solve(S, b, "cg", rtol=1e-5)
    is_shared = S.known.is_quicker_in_shares[columns]
    found[f"a timed step is quicker, {name}"] = "in shares" if is_shared else "at home"
    return found


def table(rows: list[dict[str, Any]]) -> Table:
    shown = Table(*rows[0], title="per product, in vectors of N numbers")
    for row in rows:
        shown.add_row(*map(str, row.values()))
    return shown


def compare(options: Options, descriptions: list[Description]) -> None:
    """Count and time both ways."""
    n = 512 if options.smoke else 2048
    rows = []
    actions = {}
    # Operators keep their devices open.
    for way, devices in ways(descriptions).items():
        A = shared_matrix(devices, n)
        for name, call in calls(A).items():
            rows.append(counted_row(way, name, n, call))
        actions[way] = product(A, np.ones(n))
    times = milliseconds(actions)
    facts: dict[str, Any] = {"pixels": n, "devices": ", ".join(d.name for d in descriptions)}
    facts |= {f"ms of a product, {way}": spent for way, spent in times.items()}
    together = ways(descriptions)["one context"]
    for size, methods in ((n, ("cg",)), (64 * n, KRYLOV)):
        facts |= solve_times(together, size, 3, methods)
    publish(options, "What two devices exchange", facts, table(rows), {"rows": rows})


def main() -> None:
    options = parse_options(__doc__)
    descriptions = two_descriptions(options.device)
    if not descriptions:
        print("one device, which cannot be halved: there is nothing to exchange")
        return
    compare(options, descriptions)


if __name__ == "__main__":
    main()
