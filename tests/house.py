# SPDX-License-Identifier: BSD-3-Clause
"""The size of the house and the length of its ways: ``python -m tests.house`` prints both with their budgets.

Lines are those of whole files, docstrings included. A way is followed as a reader follows it: the files of
ltcl that a call runs through on its way to the first kernel, or from there to its result.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import numpy as np

import ltcl
from ltcl.device import Device

ROOT = Path(__file__).resolve().parents[1]
CORE = 11_500  # lines of all Python below but what is in `LATER`

# Lines at most, by the folders and modules that they are of.
BUDGETS: dict[str, tuple[int, list[str]]] = {
    "device": (900, ["ltcl/device"]),
    "operators": (2600, ["ltcl/operators"]),
    "solvers": (2800, ["ltcl/solvers"]),
    "theory and diagnostics": (1100, ["ltcl/theory", "ltcl/diagnostics.py"]),
    "compression": (1500, ["ltcl/compression"]),
    "compensation, separation, relighting, analysis": (
        1300,
        ["ltcl/compensation", "ltcl/separation.py", "ltcl/relighting.py", "ltcl/analysis.py"],
    ),
    "transport and the rest": (1300, ["ltcl/*.py"]),
    "kernels": (2000, ["kernels"]),
}

# Where a budget is not met yet: lines, files and frames reached, which nothing may exceed again.
REACHED: dict[str, int] = {
    "device": 1092,
    "operators": 3148,
    "solvers": 3644,
    "theory and diagnostics": 1124,
    "compression": 1867,
    "compensation, separation, relighting, analysis": 1389,
    "transport and the rest": 1656,
    "kernels": 2766,
    "compensate to the first kernel": 17,
    "compensate back": 22,
}


class Way(NamedTuple):
    """Files of ltcl run through before the first kernel, from then on, and the most frames of a product."""

    there: list[str]
    back: list[str]
    frames: int


def lines(places: list[str], root: Path = ROOT) -> int:
    """Lines of all sources in folders, or of the files that a pattern means."""
    files = {
        file
        for place in places
        for path in root.glob(place)
        for file in ([path] if path.is_file() else path.rglob("*"))
        if file.suffix in {".py", ".cl", ".h"}
    }
    return sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files)


def sizes(root: Path = ROOT) -> dict[str, tuple[int, int]]:
    """Lines and budget of each part; a module that a part names is not counted with the rest."""
    counted = {name: (lines(places, root), budget) for name, (budget, places) in BUDGETS.items()}
    named = [place for _, places in BUDGETS.values() for place in places if place.endswith(".py")]
    rest, budget = counted["transport and the rest"]
    counted["transport and the rest"] = (rest - lines([p for p in named if "*" not in p], root), budget)
    return counted


def follow(call: Callable[[], Any]) -> Way:
    """Run `call` and note the files of ltcl it passes through, before and after the first kernel."""
    package = str(Path(ltcl.__file__).parent)
    there: dict[str, None] = {}
    back: dict[str, None] = {}
    launched, deepest = False, 0

    def enter(frame: FrameType, event: str, argument: Any) -> None:
        nonlocal launched, deepest
        code = frame.f_code
        if event != "call" or not code.co_filename.startswith(package):
            return
        (back if launched else there)[code.co_filename.removeprefix(package + "/")] = None
        if code is Device.launch.__code__:
            launched = True
            if "matvec" in frame.f_locals["name"]:
                deepest = max(deepest, _frames_to_solver(frame))

    sys.setprofile(enter)
    try:
        call()
    finally:
        sys.setprofile(None)
    return Way(list(there), list(back), deepest)


def _frames_to_solver(frame: FrameType | None) -> int:
    """Frames from a launch up to the first of a solver, itself not counted; 0 where there is none."""
    count = 0
    while frame is not None and "/ltcl/solvers/" not in frame.f_code.co_filename:
        count, frame = count + 1, frame.f_back
    return count if frame is not None else 0


def ways() -> dict[str, tuple[int, int, list[str]]]:
    """Length, budget and files of the ways that readers take."""
    scene = ltcl.scenes.dihedral(16)  # 512 pixels and more are not eliminated
    T = scene.transport()
    desired = np.full(T.grid, 0.2, np.float32)
    ltcl.compensate(T, desired, method="chebyshev")  # builds kernels and uploads
    way = follow(lambda: ltcl.compensate(T, desired, method="chebyshev"))
    compress = follow(lambda: ltcl.compress(T, rtol=1e-2))
    packed = sorted(f for f in {*compress.there, *compress.back} if f.startswith("compression/"))
    solved = follow(lambda: ltcl.solve(T.interreflection, desired.ravel(), "chebyshev"))
    return {
        "compensate to the first kernel": (len(way.there), 12, way.there),
        "compensate back": (len(way.back), 15, way.back),
        "compress, in its own package": (len(packed), 10, packed),
        "Python frames of a product in a solver": (solved.frames, 4, []),
    }


def main() -> None:
    """Print lines and counts, beside what they may be."""
    out = sys.stdout
    counted = sizes()
    for name, (count, budget) in counted.items():
        out.write(f"{name:48}{count:7} lines, budget {budget:6}{'' if count <= budget else '  over'}\n")
    core = sum(count for name, (count, _) in counted.items() if name != "kernels")
    out.write(f"{'core':48}{core:7} lines, budget {CORE:6}{'' if core <= CORE else '  over'}\n")
    for name, (count, budget, files) in ways().items():
        out.write(f"{name:48}{count:7}        budget {budget:6}{'' if count <= budget else '  over'}\n")
        for file in files:
            out.write(f"    {file}\n")


if __name__ == "__main__":
    main()
