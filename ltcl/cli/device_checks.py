# SPDX-License-Identifier: BSD-3-Clause
"""The doctor's checks of the device layer: cache, drivers, kernels, results against NumPy."""

from __future__ import annotations

import importlib.util
import os
import re
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pywt
import scipy.sparse

from ltcl.device import Device, kernels, list_devices
from ltcl.device.tuning import folder, make_folder, recall, remember
from ltcl.errors import DeviceError, FileError
from ltcl.operators import CSR, Dense, IdentityPlus, Operator, Tiles, Wavelet
from ltcl.operators.base import WIDTHS
from ltcl.solvers import solve

_SIZE = 70  # rows of the test matrices: no multiple of a work-group
_SECONDS = 120  # a driver that hangs is treated as one that crashes
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
_NEEDS = re.compile(r'^\s*#error ".* needs .*', re.MULTILINE)  # and -D with each define
_VALUES = {
    "K": WIDTHS,
    "TAPS": (2, 4, 8),
    "PAIRS": (1, 8),
    "WIDTH": (1, 8),
    "VALUES": (0, 1, 2),
    "CHUNK": (64,),
    "WALKS": (4, 1),
    "COLLISION": (0, 1),
    "LINKED": (0, 1),
}


def cache_folder() -> str:
    """The cache folder can be written, and by its owner only."""
    path = make_folder()
    with tempfile.TemporaryFile(dir=path):
        pass
    mode = stat.S_IMODE(path.stat().st_mode)
    if os.name == "posix" and mode & 0o077:
        raise FileError(f"{path} has mode {mode:o}; it must be 700")
    return f"{path}, private"


def drivers() -> str:
    """Every OpenCL driver compiles and runs a kernel in a child process of its own, as some crash theirs."""
    files = driver_files()
    crashing = [file for file in files if not survives(file)]
    if crashing:
        working = ", ".join(str(file) for file in files if file not in crashing) or "none"
        raise DeviceError(f"crash when they are used: {', '.join(map(str, crashing))}; working: {working}")
    devices = list_devices()
    names = ", ".join(sorted({device.driver for device in devices})) or "none"
    return f"{names} ({len(devices)} device(s), {len(files)} driver file(s))"


def driver_files() -> list[Path]:
    """The `.icd` files that the OpenCL loader of pyopencl's wheel reads: the system's and the wheel's own."""
    named = Path(os.environ.get("OCL_ICD_VENDORS") or "/etc/OpenCL/vendors")
    if named.is_file():
        return [named]
    found = importlib.util.find_spec("pyopencl")
    bundled = Path(found.origin).parent / ".libs" if found and found.origin else named
    return sorted({*named.glob("*.icd"), *bundled.glob("*.icd")})


def survives(driver: Path) -> bool:
    """Whether a child process that uses this driver alone comes to its end; a Python error is one, too."""
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        "OCL_ICD_VENDORS": str(driver),
    }
    try:
        child = subprocess.run(  # noqa: S603 - our own script with our own interpreter
            [sys.executable, "-c", TRIAL], env=environment, capture_output=True, timeout=_SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        return False
    return child.returncode in (0, 1)


def tuning() -> str:
    """The fastest kernel variants are remembered."""
    if os.environ.get("LTCL_TUNE", "1") == "0":
        return "off (LTCL_TUNE=0)"
    remember("doctor", True)
    if recall("doctor") is not True:
        raise FileError(f"{folder()}: what was written there cannot be read back")
    return f"remembered in {folder() / 'tuning.json'}"


def on_device(device: Device) -> dict[str, Callable[[], str]]:
    """The checks that run on an opened device, by name."""
    files = sorted(file.stem for file in kernels.folder().glob("*.cl"))
    rng = np.random.default_rng(0)
    R = np.abs(rng.standard_normal((_SIZE, _SIZE))) * (rng.random((_SIZE, _SIZE)) < 0.2) / 20
    return {
        **{f"kernels/{file}.cl": partial(_compile, device, file) for file in files},
        "sparse product": lambda: _product(CSR(device, scipy.sparse.csr_array(R)), R),
        "products of tiles": lambda: _tiles(device, scipy.sparse.csr_array(R)),
        "dense product": lambda: _product(Dense(device, R), R),
        "wavelets": lambda: _product(Wavelet(device, (8, 8), "db2", levels=1), _wavelets()),
        "solve": lambda: _solve(IdentityPlus(Dense(device, R)), R),
    }


def _compile(device: Device, file: str) -> str:
    """Build a kernel file with the defines that it asks for, each with every value of `_VALUES` in turn."""
    source = kernels.load(file)
    names = dict.fromkeys(name for line in _NEEDS.findall(source) for name in re.findall(r"-D(\w+)", line))
    choices = {name: _VALUES.get(name, (1,)) for name in names}
    choices |= {"LANES": (8 if device.is_cpu else 1,)} if "LANES" in names else {}
    usual = {name: values[0] for name, values in choices.items()}
    variants = [usual] + [usual | {name: value} for name, values in choices.items() for value in values[1:]]
    entries = re.findall(r"\bkernel void (\w+)", source)
    for defines in variants:
        device.kernel(file, entries[0], **defines)
    return f"compiles, {len(variants)} variant(s), {len(entries)} kernel(s) each"


def _product(A: Operator, truth: np.ndarray) -> str:
    """A x and A^T x agree with NumPy for one and for five right-hand sides."""
    worst = 0.0
    for k in (1, 5):
        x = np.random.default_rng(k).standard_normal((len(truth), k))
        for found, wanted in ((A @ x, truth @ x), (A.T @ x, truth.T @ x)):
            worst = max(worst, float(np.linalg.norm(found - wanted) / np.linalg.norm(wanted)))
    return _agrees(worst, 1e-5, "NumPy")


def _wavelets() -> np.ndarray:
    """What PyWavelets makes of pictures of 8 x 8 pixels, a column each of which has one pixel lit."""
    pictures = np.eye(64).reshape(64, 8, 8)
    coefficients = [pywt.dwt2(picture, "db2", "periodization") for picture in pictures]
    return np.stack([pywt.coeffs_to_array(list(c))[0].ravel() for c in coefficients], axis=1)


def _tiles(device: Device, R: scipy.sparse.csr_array) -> str:
    """Each width and each precision once, against what the tiles stand for."""
    kinds = ((8, "float32"), (1, "float16"), (8, "int8"))
    made = [Tiles(device, R, width, precision) for width, precision in kinds]
    return max(_product(tiles, tiles.to_dense()) for tiles in made)


def _solve(S: Operator, R: np.ndarray) -> str:
    b = np.random.default_rng(1).random(_SIZE)
    wanted = np.linalg.solve(np.eye(_SIZE) + R, b)
    found = solve(S, b, "jacobi", rtol=1e-5)
    return _agrees(float(np.linalg.norm(found.x - wanted) / np.linalg.norm(wanted)), 1e-4, "LAPACK")


def _agrees(error: float, limit: float, judge: str) -> str:
    if not error < limit:
        raise DeviceError(f"differs from {judge} by {error:.1e}; it must be below {limit:g}")
    return f"agrees with {judge} to {error:.1e}"
