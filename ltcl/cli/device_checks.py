# SPDX-License-Identifier: BSD-3-Clause
"""The doctor's checks of the device layer: cache, drivers, kernels, results against NumPy."""

from __future__ import annotations

import itertools
import os
import re
import stat
import tempfile
from collections.abc import Callable
from functools import partial

import numpy as np
import pywt
import scipy.sparse

from ltcl.device import Device, cache, list_devices, sources, trial
from ltcl.errors import DeviceError, FileError
from ltcl.operators import CSR, Dense, IdentityPlus, Operator, Tiles, Wavelet
from ltcl.operators.base import WIDTHS
from ltcl.solvers import solve

_SIZE = 70  # rows of the test matrices: no multiple of a work-group
_GUARD = re.compile(r"#ifndef\s+(\w+)\s*\n\s*#error")


def cache_folder() -> str:
    """The cache folder can be written, and by its owner only."""
    path = cache.make_folder()
    with tempfile.TemporaryFile(dir=path):
        pass
    mode = stat.S_IMODE(path.stat().st_mode)
    if os.name == "posix" and mode & 0o077:
        raise FileError(f"{path} has mode {mode:o}; it must be 700")
    return f"{path}, private"


def drivers() -> str:
    """Which OpenCL drivers there are; a crashing one is a failure, though ltcl works around it."""
    files = [str(file) for file in trial.icd_files()]
    fatal = trial.hide_fatal_drivers()
    if fatal:
        raise DeviceError(f"left out because they crash when loaded: {', '.join(fatal)}")
    devices = list_devices()
    names = ", ".join(sorted({device.driver for device in devices})) or "none"
    return f"{names} ({len(devices)} device(s), {len(files)} driver file(s))"


def tuning() -> str:
    """The fastest kernel variants are remembered."""
    if os.environ.get("LTCL_TUNE", "1") == "0":
        return "off (LTCL_TUNE=0)"
    cache.remember("doctor.json", "tried", True)
    if cache.recall("doctor.json", "tried") is not True:
        raise FileError(f"{cache.folder()}: what was written there cannot be read back")
    return f"remembered in {cache.folder() / 'tuning.json'}"


def on_device(device: Device) -> dict[str, Callable[[], str]]:
    """The checks that run on an opened device, by name."""
    files = sorted(file.stem for file in sources.folder().glob("*.cl"))
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
    """Build a kernel file with every value of the defines it requires."""
    values = {"K": WIDTHS, "LANES": (8 if device.is_cpu else 1,), "TAPS": (2, 4, 8)}
    names = sorted(set(_GUARD.findall(sources.load(file).text)))
    choices = [values.get(name, (1,)) for name in names]
    built = [
        device.kernel(
            file, next(iter(sources.load(file).signatures)), **dict(zip(names, choice, strict=True))
        )
        for choice in itertools.product(*choices)
    ]
    return f"compiles, {len(built)} variant(s), {len(sources.load(file).signatures)} kernel(s) each"


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
    kinds = ((16, "float32"), (8, "bfloat16"), (1, "float16"), (16, "int8"))
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
