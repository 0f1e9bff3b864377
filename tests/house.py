# SPDX-License-Identifier: BSD-3-Clause
"""The layers of ltcl, and the length of its ways: ``python -m tests.house`` prints the ways.

A way is the files of ltcl that a call runs through up to its first kernel, or from there to its
result: how many files a reader opens to follow the call.
"""

from __future__ import annotations

import contextlib
import importlib
import sys
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Any, NamedTuple

import numpy as np

import ltcl
from ltcl.cli.main import main as run_command_line
from ltcl.device import Device

# Low to high. A unit is a file or a folder of ltcl; a file within a folder that stands lower than
# its folder is a unit of its own.
LAYERS: list[set[str]] = [
    {"errors"},
    {"interop"},
    {"checks"},
    {"files", "batch.main_guard"},
    {"images", "device"},
    {"operators", "transport.frames", "transport.matrices", "batch.cluster"},
    {"theory"},
    {"solvers"},
    {"transport"},
    {"store", "acquisition", "tasks", "scenes"},
    {"plots"},
    {"batch", "demo", "viewer"},
    {"show"},
    {"cli"},
    {"__init__", "__main__"},
]
# The imports that are allowed within one layer.
SIDEWAYS = {("acquisition", "store")}
# Folders that stay free of OpenCL, although it stands below them, and the modules in them that
# open the device of the caller.
WITHOUT_DEVICE = {"acquisition", "images", "store"}
OPENS_DEVICE = {
    ("ltcl.acquisition.task", "ltcl.device"),
    ("ltcl.acquisition.updating.task", "ltcl.device"),
}
DEVICE_UNITS = {"device", "operators"}

# Folders around the core: a scan from the command line passes through some of their files.
AROUND_CORE = {"acquisition", "store", "images", "batch", "cli", "scenes"}
PACKAGE = Path(ltcl.__file__).parent


@dataclass(kw_only=True)
class Way:
    """The files of ltcl that one call has run through, in order."""

    before_kernel: list[str] = field(default_factory=list)
    after_kernel: list[str] = field(default_factory=list)
    frames_of_product: int = 0

    @property
    def files(self) -> set[str]:
        return {*self.before_kernel, *self.after_kernel}


def follow(call: Callable[[], Any]) -> Way:
    """Run `call`, and record the files that it passes through."""
    way = Way()
    has_launched = False

    def enter(frame: FrameType, event: str, argument: Any) -> None:
        nonlocal has_launched
        code = frame.f_code
        is_ours = code.co_filename.startswith(str(PACKAGE))
        if event != "call" or not is_ours or code.co_name == "<module>":
            return
        files = way.after_kernel if has_launched else way.before_kernel
        file = Path(code.co_filename).relative_to(PACKAGE).as_posix()
        if file not in files:
            files.append(file)
        if code is Device.launch.__code__:
            has_launched = True
            if "matvec" in frame.f_locals["name"]:
                frames = frames_below_solver(frame)
                way.frames_of_product = max(way.frames_of_product, frames)

    sys.setprofile(enter)
    try:
        call()
    finally:
        sys.setprofile(None)
    return way


def frames_below_solver(frame: FrameType) -> int:
    """Python frames from the launch of a product up to the solver that asked, 0 without one."""
    for depth, (caller, _) in enumerate(traceback.walk_stack(frame)):
        if "/ltcl/solvers/" in caller.f_code.co_filename:
            return depth
    return 0


class Length(NamedTuple):
    """Length of a way: as it is, as it may be, and as the design wants it."""

    files: list[str]
    length: int
    limit: int
    aim: int


def ways() -> dict[str, Length]:
    """Lengths of the ways that readers take.

    Compensation is measured with a transport that has been used before, by Chebyshev's iteration
    and with gain 1; "auto" passes through more files, of the choice and of the search for a gain.
    """
    scene = ltcl.scenes.dihedral(16)  # systems below 512 pixels are eliminated instead
    T = scene.transport()
    desired = np.full(T.grid, 0.2, np.float32)

    def compensate() -> None:
        ltcl.compensate(T, desired, method="chebyshev")

    # Modules are imported when they are first used, which is no part of a way.
    importlib.import_module("ltcl.tasks.compression")
    compensate()  # builds kernels and uploads T
    compensation = follow(compensate)
    compression = follow(lambda: ltcl.compress(T, rtol=1e-2))
    own_files = sorted(file for file in compression.files if file.startswith("tasks/compression/"))
    solve = follow(lambda: ltcl.solve(T.interreflection, desired.ravel(), "chebyshev"))
    scan = scan_files()

    there = compensation.before_kernel
    back = compensation.after_kernel
    return {
        "compensate to the first kernel": Length(there, len(there), limit=15, aim=12),
        "compensate back": Length(back, len(back), limit=21, aim=16),
        "compress, in its own package": Length(own_files, len(own_files), limit=10, aim=10),
        "acquire run, around the core": Length(scan, len(scan), limit=52, aim=30),
        "Python frames of a product in a solver": Length([], solve.frames_of_product, 4, 4),
    }


def scan_files() -> list[str]:
    """Files around the core between `ltcl acquire run` and T on disk."""
    with (
        TemporaryDirectory() as folder,
        contextlib.redirect_stdout(None),
        contextlib.redirect_stderr(None),
    ):
        first = str(Path(folder) / "first")
        second = str(Path(folder) / "second")
        for corner in (first, second):
            run_command_line(["simulate", "dihedral", "--size", "4", "--out", corner])
        run_command_line(["acquire", "run", first])  # imports modules and builds kernels
        way = follow(lambda: run_command_line(["acquire", "run", second]))
    return sorted(file for file in way.files if file.split("/")[0] in AROUND_CORE)


def main() -> None:
    """Print each way with its files, beside how long it should be."""
    for name, way in ways().items():
        verdict = "" if way.length <= way.aim else "  longer than the aim"
        sys.stdout.write(f"{name:48}{way.length:4}, aim {way.aim:3}{verdict}\n")
        for file in way.files:
            sys.stdout.write(f"    {file}\n")


if __name__ == "__main__":
    main()
