# SPDX-License-Identifier: BSD-3-Clause
"""How long calls would take on an H100 and an H200: launches, bytes and waits, counted, not timed.

    seconds = 5 us a launch + bytes of the arrays of each launch / bandwidth + 10 us a wait
              + bytes over the bus / 20 GB/s + what inner loops wait beyond the bytes

Counts are those of the launch shape of a GPU, also where a CPU runs it, without timed variants. An
array counts once a launch, whole, but in kernels of which PARTS says what they take. A loop waits
1 us a turn (column, then x), and a turn takes three numbers, or four times as many in products by
groups; each level that a launch makes is a turn at least; groups start at 3.5 a nanosecond. On a
GPU a column has its measured time.

Wavelets wait half a turn for loads that do not need each other. Their small levels wait for local
memory: a row of loads takes 60 cycles at 1.755 GHz, 30 to the numbers and the others for six sums
one after the other, and a level takes 200 more, a barrier and the arithmetic of its sides; or they
wait for its 128 bytes a cycle of a multiprocessor. Cycles of an H100 are published as 20 for local
memory, 200 for the second cache, 400 for memory and 4 for a sum (table 3 of
doi:10.1016/j.ultsonch.2023.106546).

"of cuSPARSE" is how many times faster a sparse product is than cuSPARSE's in CSR, with a launch
each and no wait. It is a model as well, of a cuSPARSE that moves its bytes, once, at 80 % of the
peak of the memory: of an A100's 1555 GB/s it reached 1102 to 1252 with three matrices of 4 to 6
million numbers (README of github.com/VSJ001/Cache-Aware-and-GPU-Accelerated-Sparse-Matrix-Vector-
Multiplication). If it reached the 90 % that ours are given, ratios would be 0.9 of these.
"""

from __future__ import annotations

import contextlib
import math
import os
import weakref
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any
from unittest import mock

from rich.table import Table

from _gpu_cases import CASES, Action, Case
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
ENTRIES_A_TURN = {
    "csr_matvec_group": 4,
    "dense_matvec_group": 4,
    "relax_rows": 4,
    "relax_correct": 4,
}
# Levels of wavelets in local memory; rows of `wavelet_split` that are loaded at the same time, and
# what an item of a group loads at the same time before the first level.
CYCLE_SECONDS = 1 / 1.755e9
LOCAL_ROW_CYCLES = 60
LOCAL_LEVEL_CYCLES = 200
LOCAL_BYTES_A_CYCLE = 128
SPLIT_ROWS = 2
ITEM_LOADS = 8
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

    def cusparse_seconds(self, nbytes: int) -> float:
        """Time of a launch of cuSPARSE that moves so many bytes, by the share of the peak."""
        peak = self.bandwidth / BANDWIDTH_SHARE
        return LAUNCH_SECONDS + nbytes / (CUSPARSE_SHARE * peak)


# Share of the memory's bandwidth that our kernels reach, and cuSPARSE.
BANDWIDTH_SHARE = 0.9
CUSPARSE_SHARE = 0.8
# Each multiprocessor has 2048 items.
MULTIPROCESSORS = 132
MAX_GROUP = 1024
# What NVIDIA's OpenCL gives a work-group.
LOCAL_MEMORY = 48 << 10
RESIDENT_ITEMS = 2048 * MULTIPROCESSORS
MACHINES = (Machine("H100", 3.0e12, RESIDENT_ITEMS), Machine("H200", 4.3e12, RESIDENT_ITEMS))


@dataclass(frozen=True)
class Work:
    """A launch: its kernel, work-items, work-groups, and bytes of its arrays.

    `levels` are those that a launch makes one after the other, at a turn each at least. `turns` of
    an item stand in place of what bytes and levels tell, where they are known, and `local_seconds`
    are beside them.
    """

    kernel: str
    items: int
    groups: int
    nbytes: int
    levels: int = 1
    turns: float | None = None
    local_seconds: float = 0.0

    def seconds(self, machine: Machine) -> float:
        """Time of its memory traffic, or of its inner loops or groups if they take longer."""
        waves = -(-self.items // machine.resident_items)
        turn_bytes = TURN_BYTES * ENTRIES_A_TURN.get(self.kernel, 1)
        if self.kernel == "tile_matvec_group":
            turn_bytes = TILE_BYTES
        turns = self.turns
        if turns is None:
            turns = max(self.levels, self.nbytes / turn_bytes / max(self.items, 1))
        loops = waves * (turns * TURN_SECONDS + self.local_seconds)
        return max(self.nbytes / machine.bandwidth, loops, self.groups / GROUPS_A_SECOND)


def block_bytes(arguments: Arguments) -> float:
    """A block of the rows of a sparse matrix, for one block of a sweep."""
    share = (arguments["end"] - arguments["begin"]) / arguments["x"].shape[0]
    return share * whole_bytes(arguments)


def correction_bytes(arguments: Arguments) -> float:
    """The inverse of a block, or its triangle, and a block of the vectors."""
    rows, k = arguments["rows"], arguments["stride"]
    numbers = rows**2
    if arguments["is_triangle"]:
        numbers = rows * (rows + 1) / 2
    return NUMBER_BYTES * (numbers + 3 * rows * k)


def dense_bytes(arguments: Arguments) -> float:
    """Rows of a matrix, and as much of the vectors as they meet."""
    rows, width, k = arguments["rows"], arguments["width"], arguments["stride"]
    return NUMBER_BYTES * (rows * width + (2 * rows + width) * k)


def transform_bytes(arguments: Arguments) -> float:
    """Levels of a wavelet transform, each read and written, with the places of coefficients."""
    pixels = 0.0
    for level in levels_of(arguments):
        pixels += arguments["height"] * arguments["width"] / 4**level
    numbers = 2 * pixels * arguments["k"]
    if "order" in arguments:
        numbers += pixels
    return NUMBER_BYTES * numbers


def needed_loads(arguments: Arguments) -> int:
    """Loads one after the other for a coefficient: its place first, where there is an order."""
    return 2 if "order" in arguments else 1


def split_turns(arguments: Arguments) -> float:
    """Loads of the rows of a pair, SPLIT_ROWS at a time, then the places of coefficients."""
    rounds = math.ceil(taps_of(arguments) / SPLIT_ROWS)
    return (rounds + needed_loads(arguments) - 1) / 2


def join_turns(arguments: Arguments) -> float:
    """Loads of the rows of a pair, one at a time."""
    rounds = taps_of(arguments) // 2
    return rounds * needed_loads(arguments) / 2


def tail_split_turns(arguments: Arguments) -> float:
    """Loads of the first level, then the places of its coefficients, and those of the others."""
    items = group_items(arguments)
    sizes = level_sizes(arguments)
    loads = math.ceil(sizes[0] / items / ITEM_LOADS)
    if "order" in arguments:
        loads += math.ceil(sizes[1] / items)
        loads += math.ceil(sizes[1] / items / ITEM_LOADS)
    return loads / 2


def tail_join_turns(arguments: Arguments) -> float:
    """Loads of the coefficients of all levels."""
    rounds = math.ceil(level_sizes(arguments)[0] / group_items(arguments) / ITEM_LOADS)
    return rounds * needed_loads(arguments) / 2


def local_seconds(arguments: Arguments) -> float:
    """Time of levels in local memory: their items one after the other, or their bytes."""
    items = group_items(arguments)
    taps = taps_of(arguments)
    cycles = 0.0
    # Pairs of a level are the samples of the next one. Join has half the rows, of twice the loads.
    for pairs in level_sizes(arguments)[1:]:
        waiting = math.ceil(pairs / items) * taps * LOCAL_ROW_CYCLES
        moving = NUMBER_BYTES * pairs * taps**2 / LOCAL_BYTES_A_CYCLE
        cycles += LOCAL_LEVEL_CYCLES + max(waiting, moving)
    return cycles * CYCLE_SECONDS


def taps_of(arguments: Arguments) -> int:
    """Length of the filters of a wavelet."""
    return arguments["taps"].shape[1]


def group_items(arguments: Arguments) -> int:
    """Work-items of the group that makes all levels of a right-hand side."""
    return arguments[SHAPE][1] * arguments[SHAPE][2]


def level_sizes(arguments: Arguments) -> list[int]:
    """Samples of each level of a launch, and of the one after them."""
    sizes = []
    for level in range(arguments["first_level"], arguments["end_level"] + 1):
        rows = -(-arguments["height"] // 2**level)
        columns = -(-arguments["width"] // 2**level)
        sizes.append(rows * columns)
    return sizes


def levels_of(arguments: Arguments) -> range:
    """Levels that a launch makes one after the other; one where it knows of none."""
    return range(arguments.get("first_level", 0), arguments.get("end_level", 1))


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
    "relax_correct": correction_bytes,
    "dense_matvec_group": dense_bytes,
    "wavelet_split": transform_bytes,
    "wavelet_join": transform_bytes,
    "wavelet_tail_split": transform_bytes,
    "wavelet_tail_join": transform_bytes,
    "krylov_subtract": direction_bytes,
    "vector_dots": dot_bytes,
    "ordered_gather": gathered_bytes,
    "ordered_scatter": gathered_bytes,
}


# Turns of an item of kernels whose bytes do not tell them.
TURNS: dict[str, Callable[[Arguments], float]] = {
    "wavelet_split": split_turns,
    "wavelet_join": join_turns,
    "wavelet_tail_split": tail_split_turns,
    "wavelet_tail_join": tail_join_turns,
}
LOCAL_KERNELS = ("wavelet_tail_split", "wavelet_tail_join")


def work_of(launch: Launch, arguments: Arguments) -> Work:
    """What a launch asks of a device."""
    nbytes = PARTS.get(launch.name, whole_bytes)(arguments)
    turns = None
    if launch.name in TURNS:
        turns = TURNS[launch.name](arguments)
    in_local_memory = 0.0
    if launch.name in LOCAL_KERNELS:
        in_local_memory = local_seconds(arguments)
    return Work(
        kernel=launch.name,
        items=launch.items,
        groups=launch.groups,
        nbytes=int(nbytes),
        levels=len(levels_of(arguments)),
        turns=turns,
        local_seconds=in_local_memory,
    )


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

    def counted(self: Launch) -> Any:
        if self.items > 0:
            arguments = {**known_arguments[self], SHAPE: self.shape}
            works.append(work_of(self, arguments))
        return call(self)

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
    # Reductions get groups by compute units, small levels of transforms by the largest group.
    device.compute_units = MULTIPROCESSORS
    device.max_group = MAX_GROUP
    device.local_memory = LOCAL_MEMORY
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


def cusparse_ratios(case: Case, counts: Counts, options: Options) -> dict[str, float] | None:
    """How many times faster than cuSPARSE in CSR, both by the model, of each machine."""
    if case.csr_bytes is None:
        return None
    ratios = {}
    for machine in MACHINES:
        ours = sum(work.seconds(machine) + LAUNCH_SECONDS for work in counts.works)
        theirs = machine.cusparse_seconds(case.csr_bytes(options))
        ratios[machine.name] = round(theirs / ours, 2)
    return ratios


def case_row(case: Case, action: Action, options: Options) -> dict[str, Any]:
    """Counts, predictions and, on a GPU, the measured microseconds of one case."""
    counts = count(action)
    row: dict[str, Any] = {"case": case.name, **predictions(counts)}
    row["of cuSPARSE"] = cusparse_ratios(case, counts, options)
    row["most time"] = most_expensive(counts, MACHINES[-1])
    with options.device.profile() as profile:
        action()
    row["busy here"] = round(1e6 * profile.busy, 1)
    row["copies here"] = round(profile.copy_share, 4)
    row["measured"] = None
    if not is_stand_in(options.device):
        row["measured"] = round(1e3 * milliseconds({case.name: action})[case.name], 1)
    return row


def is_stand_in(device: Device) -> bool:
    """True if a CPU runs the launches of a GPU."""
    return device.description.kind in ("cpu", "simulator")


def table(rows: list[dict[str, Any]]) -> Table:
    """Predictions as a table; microseconds."""
    columns = ["case", "launches", "waits", "MB", "KB bus"]
    columns += ["H100 us", "H200 us", "of it loops", "of it bus", "of cuSPARSE (model)"]
    columns += ["most time", "measured us"]
    shown = Table(*columns, "busy here us", "of it copies")
    for row in rows:
        measured = "-" if row["measured"] is None else f"{row['measured']:.1f}"
        ratios = row["of cuSPARSE"]
        ratio = "-" if ratios is None else f"{ratios['H200']:.2f}x"
        cells = [row["case"], row["launches"], row["waits"], row["MB"], row["KB over the bus"]]
        cells += [row["H100"]["sum"], row["H200"]["sum"], row["H200"]["loops"]]
        cells += [row["H200"]["bus"], ratio, row["most time"], measured, row["busy here"]]
        shown.add_row(*map(str, cells), f"{row['copies here']:.0%}")
    return shown


def main() -> None:
    options = launched_as_gpu(parse_options(__doc__))
    rows = []
    with keep_arguments():
        for case in CASES:
            action = case.make(options)
            rows.append(case_row(case, action, options))
    share = f"{CUSPARSE_SHARE:.0%} of the peak"
    facts = {
        "machines": ", ".join(f"{m.name} {m.bandwidth / 1e12:g} TB/s" for m in MACHINES),
        "of cuSPARSE": f"a model of its CSR as well: a launch, and its bytes at {share}",
    }
    machines = [asdict(machine) for machine in MACHINES]
    content = {"rows": rows, "machines": machines}
    publish(options, "What calls would take on a GPU", facts, table(rows), content)


if __name__ == "__main__":
    main()
