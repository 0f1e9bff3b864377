# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl doctor`: everything ltcl needs, tried one by one, with a fix for what fails.

A check returns what it found, or raises. Drivers are tried in child processes first, since some crash the
process that uses them; kernels by calls that launch all of them, whose results NumPy must agree with.
"""

from __future__ import annotations

import importlib.util
import os
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import typer

from ltcl import report
from ltcl.cli import options
from ltcl.cli.command import FAILED, Answer, Context
from ltcl.device import Device, discovery, open_device
from ltcl.device.tuning import make_folder
from ltcl.errors import DeviceError, FileError, LtclError

_UPGRADE = "pip install --upgrade ltcl"
_HIDING = "update or remove that driver, or use a working one alone: OCL_ICD_VENDORS=FILE.icd"
_OPENING = "install a driver, or name one that 'ltcl devices' lists (--device, LTCL_DEVICE)"
_CACHE = "chmod 700 the folder, or set LTCL_CACHE=DIR to a folder that can be written"
SECONDS = 120  # a driver that hangs is treated as one that crashes
LIMITS = {"product": 1e-4, "solve": 0.02}  # relative errors; solves are to 1 %
TRIAL = """
import os
os.environ["PYOPENCL_NO_CACHE"] = "1"  # it holds pickles
import numpy as np
import pyopencl as cl
source = "kernel void trial(global int *x) { x[get_global_id(0)] += 41; }"
for platform in cl.get_platforms():
    for device in platform.get_devices():
        queue = cl.CommandQueue(cl.Context([device]))
        values = np.ones(4, np.int32)
        buffer = cl.Buffer(queue.context, cl.mem_flags.COPY_HOST_PTR, hostbuf=values)
        cl.Kernel(cl.Program(queue.context, source).build(), "trial")(queue, (4,), None, buffer)
        cl.enqueue_copy(queue, values, buffer)
"""


def doctor(context: Context, device: options.Device = None) -> Answer:
    """Try everything ltcl needs: Python, drivers, kernels, results, cache; exit code 1 if something fails."""
    checks = list(_examine(device, context))
    failed = sum(not check["passed"] for check in checks)
    return Answer({"passed": not failed, "checks": checks}, partial(_show, checks), FAILED if failed else 0)


def _show(checks: list[dict[str, Any]]) -> None:
    for check in checks:
        mark = "ok    " if check["passed"] else "FAILED"
        typer.echo(f"{mark}  {check['check']:<24}  {check['found']}")
        if not check["passed"]:
            typer.echo(f"        {'':<24}  fix: {check['fix']}")
    failed = sum(not check["passed"] for check in checks)
    typer.echo("\n" + (f"{failed} of {len(checks)} checks failed" if failed else "all is well"))


def _examine(device: str | None, context: Context) -> Iterator[dict[str, Any]]:
    """Every check in turn; those that need a device only where one opens."""

    def attempt(check: str, action: Callable[[], str], fix: str) -> dict[str, Any]:
        context.progress(check)
        try:
            return {"check": check, "passed": True, "found": action(), "fix": ""}
        except Exception as error:  # noqa: BLE001 - a broken driver may raise anything
            known = isinstance(error, (LtclError, OSError))
            text = " ".join((str(error) if known else f"{type(error).__name__}: {error}").split())
            return {"check": check, "passed": False, "found": text, "fix": fix}

    yield attempt("versions", lambda: ", ".join(map(" ".join, report.versions().items())), _UPGRADE)
    yield attempt("cache folder", _cache_folder, _CACHE)
    yield (drivers := attempt("drivers", _drivers, _HIDING))
    if not drivers["passed"]:  # what crashes a child would crash this process, too
        return
    yield (opening := attempt("device", lambda: str(open_device(device)), _OPENING))
    if not opening["passed"]:
        return
    opened = open_device(device)
    update = f"update the driver {opened.driver}, or choose another device with LTCL_DEVICE"
    for name, error in _calls(opened):
        yield attempt(name, partial(_agreement, error, LIMITS[name.partition(",")[0]]), update)


def _cache_folder() -> str:
    """It can be written, and by its owner only."""
    path = make_folder()
    with tempfile.TemporaryFile(dir=path):
        pass
    mode = stat.S_IMODE(path.stat().st_mode)
    if os.name == "posix" and mode & 0o077:
        raise FileError(f"{path} has mode {mode:o}; it must be 700")
    return f"{path}, private"


def _drivers() -> str:
    """Every OpenCL driver compiles and runs a kernel in a child process of its own."""
    vendors = Path(os.environ.get("OCL_ICD_VENDORS") or "/etc/OpenCL/vendors")
    spec = importlib.util.find_spec("pyopencl")
    bundled = Path(spec.origin).parent / ".libs" if spec and spec.origin else vendors  # of pyopencl's wheel
    files = [vendors] if vendors.is_file() else sorted({*vendors.glob("*.icd"), *bundled.glob("*.icd")})
    crashing = [file for file in files if not _survives(file)]
    if crashing:
        working = ", ".join(str(file) for file in files if file not in crashing) or "none"
        raise DeviceError(f"crash when they are used: {', '.join(map(str, crashing))}; working: {working}")
    devices = discovery.list_devices()
    names = ", ".join(sorted({device.driver for device in devices})) or "none"
    return f"{names} ({len(devices)} device(s), {len(files)} driver file(s))"


def _survives(driver: Path) -> bool:
    """Whether a child process that uses this driver alone comes to its end; a Python error is one, too."""
    paths = os.pathsep.join(filter(None, sys.path))
    environment = {**os.environ, "PYTHONPATH": paths, "OCL_ICD_VENDORS": str(driver)}
    try:
        child = subprocess.run(  # noqa: S603 - our own script with our own interpreter
            [sys.executable, "-c", TRIAL], env=environment, capture_output=True, timeout=SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        return False
    return child.returncode in (0, 1)


def _calls(device: Device) -> Iterator[tuple[str, Callable[[], float]]]:
    """The error of every kind of product and solve, against NumPy, by its name."""
    import scipy.sparse

    from ltcl import scenes
    from ltcl.operators import CSR, Dense, IdentityPlus, Tiles, Wavelet
    from ltcl.solvers import METHODS, solve

    scene, x = scenes.dihedral(4, albedo=0.3), np.random.default_rng(0).random((32, 5))
    S = np.asarray(scene.transport(device=device).systems[0].to_dense())
    sparse, wavelet = scipy.sparse.csr_array(S - np.eye(32)), Wavelet(device, scene.grid, "db2")
    form_factor = scenes.FormFactor(scenes.cut(scene.walls, 4), albedo=0.3, device=device)
    operators = {"sparse": (CSR(device, sparse), sparse), "dense": (Dense(device, S), S)}
    operators |= {"form factor": (form_factor, scene.A), "wavelet": (wavelet, wavelet.to_dense())}
    for width, precision in ((8, "float32"), (1, "float16"), (8, "int8")):
        tiles = Tiles(device, sparse, width, precision)
        operators[f"tiles of {width}, {precision}"] = (tiles, tiles.to_dense())

    def relative(found: Any, truth: np.ndarray) -> float:
        return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))

    for name, (A, matrix) in operators.items():
        yield f"product, {name}", partial(lambda A, matrix: relative(A @ x, matrix @ x), A, matrix)
    system, b = IdentityPlus(CSR(device, sparse)), S @ x[:, 0]
    for name in METHODS:
        options = {"samples": 4096} if name in ("monte_carlo", "hybrid") else {}
        solved = partial(solve, system, b, name, rtol=1e-2, **options)
        yield f"solve, {name}", partial(lambda solved: relative(solved().x, x[:, 0]), solved)


def _agreement(error: Callable[[], float], limit: float) -> str:
    if not (found := error()) < limit:
        raise DeviceError(f"differs from NumPy by {found:.1e}; it must be below {limit:g}")
    return f"agrees with NumPy to {found:.1e}"
