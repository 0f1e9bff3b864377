# SPDX-License-Identifier: BSD-3-Clause
r"""Registers, spills, stack and occupancy of every kernel on GPUs that are not here.

Every program that the public calls build is compiled for NVIDIA (PTX and ptxas, sm_90) and AMD
(gfx906), and to SPIR-V, which spirv-val judges. `bench/results/gpu_static.json` keeps programs and
figures. The bench fails if a program does not compile, or if a kernel in the launch shape of a GPU
spills more, takes more stack or fits fewer warps than there; programs whose source has changed come
first, then those of `--part`. A change that is meant goes into the record by `--json` to that file.

The list of programs is made by a run of tests, which is repeated when kernels get new defines:

    LTCL_PROGRAMS=programs.json PYTHONPATH=.ci python -m pytest -n 0 -m '' -p record_programs \
        tests/operators tests/solvers tests/tasks tests/scenes tests/test_public_calls.py
    python bench/gpu_static.py --programs programs.json --json bench/results/gpu_static.json
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from _compilers import CompileError, Figures, Program, Target, targets
from ltcl.device import sources

# Figures of a program's kernels, or why it does not compile.
Outcome = Figures | CompileError

RECORD = Path(__file__).parent / "results" / "gpu_static.json"
# Figures that are worse if they grow, and if they fall.
COSTS = ("spilled_bytes", "spilled_registers", "stack_bytes")
GAINS = ("occupancy",)
# Kernels that no GPU runs, in programs that it builds.
CPU_KERNELS = ("relax_strips",)
# Right-hand sides of one launch.
SIDES = ("1", "2", "3", "4", "8")
# Files of which a GPU takes one right-hand side an item, and triangles, which have none.
ONE_SIDE_FILES = ("wavelet", "wavelet_tail", "pyramid", "hats", "ordered", "triangle")
# Complaints that are printed.
MAX_COMPLAINTS = 40


@dataclass
class Entry:
    """A program of the record: the checksum of its source, and figures by target and kernel.

    `shapes` are the launch shapes in which the tests built it, "cpu" or "gpu" or both.
    """

    program: Program
    shapes: set[str] = field(default_factory=set)
    source: str = ""
    figures: dict[str, Figures] = field(default_factory=dict)

    def plain(self) -> dict[str, Any]:
        """The entry as plain JSON."""
        return {
            "file": self.program.file,
            "defines": dict(self.program.defines),
            "shapes": sorted(self.shapes),
            "source": self.source,
            "figures": self.figures,
        }

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Entry:
        """The entry that `plain` wrote."""
        program = Program(plain["file"], tuple(sorted(plain["defines"].items())))
        return cls(program, set(plain["shapes"]), plain["source"], plain["figures"])

    @property
    def has_changed(self) -> bool:
        """True if the source is another than that of the record."""
        return self.source != checksum(self.program)


def checksum(program: Program) -> str:
    """A number of the source with its headers."""
    return f"{zlib.crc32(sources.load(program.file).encode()):08x}"


def read_record(path: Path) -> tuple[dict[str, str], list[Entry]]:
    """Versions of the compilers, and the programs, of a record; nothing if there is none."""
    if not path.exists():
        return {}, []
    content = json.loads(path.read_text(encoding="utf-8"))
    return content["compilers"], [Entry.from_plain(plain) for plain in content["programs"]]


def write_record(path: Path, compilers: dict[str, str], entries: Iterable[Entry]) -> None:
    """Write a record, a program a line."""
    lines = [json.dumps(entry.plain()) for entry in sorted(entries, key=lambda e: e.program)]
    programs = ",\n".join(lines)
    title = "Registers, spills, stack and occupancy of every kernel, by offline compilers"
    head = json.dumps({"title": title, "compilers": compilers}, indent=1)[:-2]
    path.write_text(f'{head},\n "programs": [\n{programs}\n]}}\n', encoding="utf-8")


def add_programs(entries: list[Entry], file: Path) -> None:
    """Add the programs that a run of tests has written down.

    Those for GPUs are added for each number of right-hand sides, but for several rows a group: who
    asks for 15 of them gets launches of 8, 4 and 3, so every K can be.
    """
    known = {entry.program: entry for entry in entries}
    for plain in json.loads(file.read_text(encoding="utf-8")):
        defines = plain["defines"]
        sides = [defines.get("K")]
        has_all_sides = plain["file"] not in ("walk", *ONE_SIDE_FILES)
        is_default = has_all_sides and "ROWS" not in defines
        if plain["shape"] == "gpu" and sides[0] in SIDES and is_default:
            sides = list(SIDES)
        for k in sides:
            if k is not None:
                defines = defines | {"K": k}
            program = Program(plain["file"], tuple(sorted(defines.items())))
            if program not in known:
                known[program] = Entry(program)
                entries.append(known[program])
            known[program].shapes.add(plain["shape"])


def chosen(entries: list[Entry], part: str, smoke: bool) -> list[Entry]:
    """Programs of changed sources, and those whose turn it is; with `smoke` one of each file."""
    if smoke:
        first = {entry.program.file: entry for entry in reversed(entries)}
        return list(first.values())
    number, parts = map(int, part.split("/"))
    changed = []
    turn = []
    for position, entry in enumerate(entries):
        if entry.has_changed:
            changed.append(entry)
        elif position % parts == number % parts:
            turn.append(entry)
    # Where time is short, others come first at the next commit.
    first = len(changed) * (number % parts) // parts
    return changed[first:] + changed[:first] + turn


def compile_all(
    entries: list[Entry], available: list[Target], seconds: float
) -> dict[Program, dict[str, Outcome]]:
    """Figures of programs for each target, or what its compiler says against them.

    Programs whose turn has not come after `seconds` are left out.
    """
    end = time.monotonic() + seconds

    def compile_one(entry: Entry) -> dict[str, Outcome]:
        outcomes: dict[str, Outcome] = {}
        if time.monotonic() > end:
            return outcomes
        for target in available:
            if not entry.shapes & target.shapes:
                continue
            with tempfile.TemporaryDirectory() as folder:
                try:
                    outcomes[target.name] = target.compile(entry.program, Path(folder))
                except CompileError as error:
                    outcomes[target.name] = error
        return outcomes

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        results = list(pool.map(compile_one, entries))
    by_program = {}
    for entry, outcomes in zip(entries, results, strict=True):
        if outcomes:
            by_program[entry.program] = outcomes
    return by_program


def worsened(entry: Entry, target: str, figures: Figures) -> list[str]:
    """Figures of an entry's kernels that are worse than those of the record, in words."""
    complaints = []
    for kernel, new in figures.items():
        old = entry.figures.get(target, {}).get(kernel)
        if old is None or kernel in CPU_KERNELS:
            continue
        for name in (*COSTS, *GAINS):
            if name not in new or name not in old:
                continue
            growth = new[name] - old[name]
            is_worse = growth > 0 if name in COSTS else growth < 0
            if is_worse:
                change = f"{name} {old[name]:g} became {new[name]:g}"
                complaints.append(f"{kernel} of {entry.program} on {target}: {change}")
    return complaints


def check(entry: Entry, outcomes: dict[str, Outcome], comparable: set[str]) -> list[str]:
    """Keep the figures of an entry, and say what fails or became worse."""
    complaints = []
    for target, outcome in outcomes.items():
        if isinstance(outcome, CompileError):
            complaints.append(f"{entry.program} for {target}: {outcome}")
            continue
        if target in comparable and "gpu" in entry.shapes:
            complaints += worsened(entry, target, outcome)
        entry.figures[target] = outcome
    entry.source = checksum(entry.program)
    return complaints


def available_targets(compilers: dict[str, str]) -> tuple[list[Target], set[str]]:
    """Targets whose compilers are here, and names of those that the record compares with."""
    available = []
    comparable = set()
    for target in targets():
        recorded = compilers.get(target.name)
        if target.version is None:
            print(f"NOT TESTED: kernels for {target.name}, for want of {target.needs}")
            continue
        available.append(target)
        if recorded == target.version:
            comparable.add(target.name)
        elif recorded is not None:
            print(f"NOT COMPARED: {target.name} by {target.version}; the record is by {recorded}")
    return available, comparable


def summarize(entries: list[Entry]) -> None:
    """Print the kernels of GPUs that fit the fewest warps, and those that spill."""
    kernels = []
    for entry in entries:
        if "gpu" not in entry.shapes:
            continue
        for kernel, figures in entry.figures.get("nvidia", {}).items():
            kernels.append((figures["occupancy"], kernel, entry.program, figures))
    shares = Counter(share for share, *_ in kernels)
    print("kernels in the launch shape of a GPU, by occupancy on NVIDIA:")
    print("  " + ", ".join(f"{share:g}: {count}" for share, count in sorted(shares.items())))
    for share, kernel, program, figures in sorted(kernels, key=lambda row: row[:3])[:8]:
        registers = f"{figures['registers']} registers, {figures['spilled_bytes']} bytes spilled"
        print(f"  {share:g}  {kernel} of {program}: {registers}")


def complain(complaints: list[str]) -> None:
    """End with the first complaints, if there are any."""
    if complaints:
        first = "\n".join(complaints[:MAX_COMPLAINTS])
        raise SystemExit(f"\n{first}\n{len(complaints)} complaints")


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--smoke", action="store_true", help="one program of each file")
    parser.add_argument("--part", default="0/1", help="'2/8': programs 2, 10, 18, ...")
    parser.add_argument("--programs", type=Path, help="programs that a run of tests has built")
    parser.add_argument("--seconds", type=float, default=1e9, help="start no program after these")
    parser.add_argument("--json", type=Path, help="write the record to this file")
    return parser.parse_args()


def main() -> None:
    options = parse()
    compilers, entries = read_record(RECORD)
    if options.programs is not None:
        add_programs(entries, options.programs)
    available, comparable = available_targets(compilers)
    selected = chosen(entries, options.part, options.smoke)
    outcomes = compile_all(selected, available, options.seconds)
    complaints = []
    for entry in selected:
        if entry.program in outcomes:
            complaints += check(entry, outcomes[entry.program], comparable)
    names = ", ".join(f"{target.name} ({target.version})" for target in available)
    print(f"{len(outcomes)} of {len(entries)} programs compiled for {names or 'nothing'}")
    if available and len(outcomes) < len(selected):
        left = len(selected) - len(outcomes)
        print(f"NOT TESTED: {left} programs, for want of time; those of the record stay")
    summarize(entries)
    if options.json is not None:
        compilers |= {target.name: str(target.version) for target in available}
        write_record(options.json, compilers, entries)
    complain(complaints)


if __name__ == "__main__":
    main()
