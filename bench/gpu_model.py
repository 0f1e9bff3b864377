# SPDX-License-Identifier: BSD-3-Clause
"""How long calls would take on an H100 and an H200: launches, bytes and waits, counted, not timed.

    seconds = 5 us a launch + bytes of the arrays of each launch / bandwidth + 10 us a wait
              + bytes over the bus / 20 GB/s + what inner loops wait beyond the bytes

Counts are those of the launch shape of a GPU, also where a CPU runs it, without timed variants. An
array counts once a launch, whole, but in kernels of which PARTS says what they take. A loop waits
1 us a turn (column, then x), and a turn takes three numbers, or four times as many in products by
groups; groups start at 3.5 a nanosecond. On a GPU a column has its measured time.
"""

from __future__ import annotations

import contextlib
import os
import weakref
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any
from unittest import mock

from rich.table import Table

from _gpu_cases import CASES, Action
from _harness import Options, milliseconds, parse_options, publish
from launches import COPY, Traffic, record_traffic
from ltcl.device import Array, Device, Launch

LAUNCH_SECONDS = 5e-6
WAIT_SECONDS = 10e-6
# Pageable memory over PCI Express.
BUS_BANDWIDTH = 20e9
# A turn of an inner loop: two loads, of which the second needs the first, and what they bring.
TURN_SECONDS = 1e-6
TURN_BYTES = 12
# Entries that a turn of these kernels takes.
ENTRIES_A_TURN = {"csr_matvec_group": 4, "dense_matvec_group": 4, "relax_rows": 4}
# A tile of eight numbers of 16 bits is a turn.
TILE_BYTES = 18
GROUPS_A_SECOND = 3.5e9
WARMING_CALLS = 2
NUMBER_BYTES = 4
# The work-items of a launch, beside its arguments.
SHAPE = "work-items"
Arguments = Mapping[str, Any]

# Arguments of the launches of this process.
known_arguments: weakref.WeakKeyDictionary[Launch, dict[str, Any]] = weakref.WeakKeyDictionary()


@dataclass(frozen=True)
class Machine:
    """A GPU: bytes a second that kernels reach of its memory, and work-items that run at once."""

    name: str
    bandwidth: float
    resident_items: int


# 90 % of the memory's bandwidth; each multiprocessor has 2048 items.
MULTIPROCESSORS = 132
RESIDENT_ITEMS = 2048 * MULTIPROCESSORS
MACHINES = (Machine("H100", 3.0e12, RESIDENT_ITEMS), Machine("H200", 4.3e12, RESIDENT_ITEMS))


@dataclass(frozen=True)
class Work:
    """A launch: its kernel, work-items, work-groups, and bytes of its arrays."""

    kernel: str
    items: int
    groups: int
    nbytes: int

    def seconds(self, machine: Machine) -> float:
        """Time of its memory traffic, or of its inner loops or groups if they take longer."""
        waves = -(-self.items // machine.resident_items)
        turn_bytes = TURN_BYTES * ENTRIES_A_TURN.get(self.kernel, 1)
        if self.kernel == "tile_matvec_group":
            turn_bytes = TILE_BYTES
        turns = max(1.0, self.nbytes / turn_bytes / max(self.items, 1))
        loops = waves * turns * TURN_SECONDS
        return max(self.nbytes / machine.bandwidth, loops, self.groups / GROUPS_A_SECOND)


def block_bytes(arguments: Arguments) -> float:
    """A block of the rows of a sparse matrix, for one block of a sweep."""
    share = (arguments["end"] - arguments["begin"]) / arguments["x"].shape[0]
    return share * whole_bytes(arguments)


def dense_bytes(arguments: Arguments) -> float:
    """Rows of a matrix, and as much of the vectors as they meet."""
    rows, width, k = arguments["rows"], arguments["width"], arguments["stride"]
    return NUMBER_BYTES * (rows * width + (2 * rows + width) * k)


def transform_bytes(arguments: Arguments) -> float:
    """Levels of a wavelet transform, each read and written."""
    pixels = 0.0
    for level in range(arguments["first_level"], arguments["end_level"]):
        pixels += arguments["height"] * arguments["width"] / 4**level
    return 2 * NUMBER_BYTES * pixels * arguments["k"]


def direction_bytes(arguments: Arguments) -> float:
    """Directions of a Krylov space so far, and the new one, read and written."""
    return NUMBER_BYTES * arguments["rows"] * arguments["k"] * (arguments["count"] + 2)


def dot_bytes(arguments: Arguments) -> float:
    """Vectors of the pairs that are multiplied, of which one is of all pairs."""
    pairs = arguments[SHAPE][1]
    return NUMBER_BYTES * arguments["rows"] * arguments["k"] * (pairs + 1)


def gathered_bytes(arguments: Arguments) -> float:
    """Rows of k numbers, read and written, and the place of each."""
    return NUMBER_BYTES * arguments["rows"] * (2 * arguments["k"] + 1)


def whole_bytes(arguments: Arguments) -> float:
    """All arrays; a buffer with two names counts once."""
    sizes = {}
    for value in arguments.values():
        if isinstance(value, Array):
            sizes[value.buffer.int_ptr] = value.nbytes
    return sum(sizes.values())


# Bytes of kernels that take parts of their arrays, from their arguments.
PARTS: dict[str, Callable[[Arguments], float]] = {
    "relax_rows": block_bytes,
    "dense_matvec_group": dense_bytes,
    "wavelet_split": transform_bytes,
    "wavelet_join": transform_bytes,
    "krylov_subtract": direction_bytes,
    "vector_dots": dot_bytes,
    "ordered_gather": gathered_bytes,
    "ordered_scatter": gathered_bytes,
}


@dataclass
class Counts:
    """What one call asks of a device."""

    works: list[Work]
    traffic: Traffic

    @property
    def copies(self) -> int:
        """Number of copies that are queued."""
        return self.traffic.names.count(COPY)

    @property
    def waits(self) -> int:
        """Number of waits; a call whose copies are queued waits for their end once."""
        return self.traffic.waits + min(self.copies, 1)

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays of all launches."""
        return sum(work.nbytes for work in self.works)

    def microseconds(self, machine: Machine) -> dict[str, float]:
        """Predicted microseconds by cause, and their sum."""
        memory = self.nbytes / machine.bandwidth
        loops = sum(work.seconds(machine) for work in self.works) - memory
        causes = {
            "launches": (len(self.works) + self.copies) * LAUNCH_SECONDS,
            "memory": memory,
            "loops": loops,
            "waits": self.waits * WAIT_SECONDS,
            "bus": self.traffic.nbytes / BUS_BANDWIDTH,
        }
        causes["sum"] = sum(causes.values())
        return {name: round(1e6 * spent, 1) for name, spent in causes.items()}


@contextlib.contextmanager
def count_work() -> Iterator[Counts]:
    """Count all launches, waits and bytes inside the block."""
    works: list[Work] = []
    call = Launch.__call__

    def counted(self: Launch) -> None:
        if self.items > 0:
            arguments = {**known_arguments[self], SHAPE: self.shape}
            nbytes = PARTS.get(self.name, whole_bytes)(arguments)
            works.append(Work(self.name, self.items, self.groups, int(nbytes)))
        call(self)

    with record_traffic() as traffic, mock.patch.object(Launch, "__call__", counted):
        yield Counts(works, traffic)


@contextlib.contextmanager
def keep_arguments() -> Iterator[None]:
    """Keep the arguments of all launches that are made inside the block."""
    set_arguments = Launch.set

    def kept(self: Launch, /, **values: Any) -> None:
        known_arguments.setdefault(self, {}).update(values)
        set_arguments(self, **values)

    with mock.patch.object(Launch, "set", kept):
        yield


def count(action: Action) -> Counts:
    """Counts of a call after others like it."""
    for _ in range(WARMING_CALLS):
        action()
    with count_work() as counts:
        action()
    return counts


def launched_as_gpu(options: Options) -> Options:
    """The options with a device that is launched as a GPU, and without timed variants on a CPU."""
    if not options.device.is_cpu:
        return options
    os.environ["LTCL_TUNE"] = "0"
    device = Device(options.device.description)
    device.kind = "gpu"
    # Reductions get groups by compute units.
    device.compute_units = MULTIPROCESSORS
    return replace(options, device=device)


def predictions(counts: Counts) -> dict[str, Any]:
    """Counts and the predicted microseconds of each machine, as cells of a row."""
    cells: dict[str, Any] = {
        "launches": len(counts.works),
        "queued copies": counts.copies,
        "waits": counts.waits,
        "MB": round(counts.nbytes / 1e6, 2),
        "KB over the bus": round(counts.traffic.nbytes / 1e3, 1),
    }
    for machine in MACHINES:
        cells[machine.name] = counts.microseconds(machine)
    return cells


def most_expensive(counts: Counts, machine: Machine) -> str:
    """The kernel that takes the most of the prediction, with its share of the device's time."""
    spent: dict[str, float] = {}
    for work in counts.works:
        spent[work.kernel] = spent.get(work.kernel, 0.0) + work.seconds(machine) + LAUNCH_SECONDS
    if not spent:
        return ""
    kernel = max(spent, key=spent.__getitem__)
    return f"{kernel}, {spent[kernel] / sum(spent.values()):.0%}"


def case_row(name: str, action: Action, options: Options) -> dict[str, Any]:
    """Counts, predictions and, on a GPU, the measured microseconds of one case."""
    counts = count(action)
    row: dict[str, Any] = {"case": name, **predictions(counts)}
    row["most time"] = most_expensive(counts, MACHINES[-1])
    row["measured"] = None
    if not is_stand_in(options.device):
        row["measured"] = round(1e3 * milliseconds({name: action})[name], 1)
    return row


def is_stand_in(device: Device) -> bool:
    """True if a CPU runs the launches of a GPU."""
    return device.description.kind in ("cpu", "simulator")


def table(rows: list[dict[str, Any]]) -> Table:
    """Predictions as a table; microseconds."""
    columns = ["case", "launches", "waits", "MB", "KB bus"]
    shown = Table(*columns, "H100 us", "H200 us", "of it loops", "most time", "measured us")
    for row in rows:
        measured = "-" if row["measured"] is None else f"{row['measured']:.1f}"
        cells = [row["case"], row["launches"], row["waits"], row["MB"], row["KB over the bus"]]
        cells += [row["H100"]["sum"], row["H200"]["sum"], row["H200"]["loops"]]
        shown.add_row(*map(str, cells), row["most time"], measured)
    return shown


def main() -> None:
    options = launched_as_gpu(parse_options(__doc__))
    rows = []
    with keep_arguments():
        for case in CASES:
            action = case.make(options)
            rows.append(case_row(case.name, action, options))
    facts = {"machines": ", ".join(f"{m.name} {m.bandwidth / 1e12:g} TB/s" for m in MACHINES)}
    machines = [asdict(machine) for machine in MACHINES]
    content = {"rows": rows, "machines": machines}
    publish(options, "What calls would take on a GPU", facts, table(rows), content)


if __name__ == "__main__":
    main()
