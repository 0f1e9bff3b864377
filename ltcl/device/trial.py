# SPDX-License-Identifier: BSD-3-Clause
"""Keep drivers that abort out of the user's process.

All drivers are tried together in a child process (`probe.py`). Where that child dies, each driver is tried
alone, and the ones that die are hidden from this process's OpenCL loader before it is first asked. The
verdict is remembered until a driver, an OpenCL environment variable or pyopencl changes.
"""

from __future__ import annotations

import atexit
import functools
import hashlib
import importlib.metadata
import importlib.util
import logging
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from ltcl.device import cache

log = logging.getLogger(__name__)
_FILE = "drivers.json"
_POCL = "POCL_CACHE_DIR"  # where PoCL keeps kernels says nothing about its health
_SCRIPT = Path(__file__).with_name("probe.py")
_SECONDS = 120  # a driver that hangs is treated as one that died
_PREFIXES = (
    "OCL_",
    "OPENCL_",
    "POCL_",
    "CUDA_VISIBLE",
    "ROCR_",
    "HIP_VISIBLE",
    "ZE_",
    "ONEAPI_",
    "LD_LIBRARY_PATH",
)


@functools.cache
def hide_fatal_drivers() -> list[str]:
    """Hide drivers that kill their process; returns their `.icd` files. Call before OpenCL is first asked.

    Done once: the loader reads its settings once, and hiding changes them.
    """
    # pyopencl's own caches hold pickles, and it cannot launch a kernel where they cannot be written.
    os.environ.setdefault("PYOPENCL_NO_CACHE", "1")
    files = icd_files()
    key = _key(files)
    _let_pocl_cache()
    fatal = cache.recall(_FILE, key)
    if not isinstance(fatal, list):
        fatal = find_fatal(files)
        cache.remember(_FILE, key, fatal)
    if fatal:
        log.warning("OpenCL drivers left out because they crash when loaded: %s", ", ".join(fatal))
        _hide([file for file in files if str(file) not in fatal], key)
    return fatal


def find_fatal(files: list[Path]) -> list[str]:
    """The `.icd` files whose driver kills or hangs a process that uses it."""
    if survives({}):
        return []
    if not files:
        log.warning("trying the OpenCL drivers killed the trial process, and no driver files are known")
    return [str(file) for file in files if not survives(_only(file))]


def survives(environment: dict[str, str]) -> bool:
    """Whether a child process with these additions to the environment lists and tries all its devices."""
    if not sys.executable:  # an embedded interpreter: nothing to run a trial with
        return True
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), **environment}
    try:
        child = subprocess.run(  # noqa: S603 - our own script with our own interpreter
            # -P: the script's folder must not be searched, its array.py is not the standard library's.
            [sys.executable, "-P", str(_SCRIPT)],
            env=environment,
            capture_output=True,
            timeout=_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return False
    # An ordinary Python error (no platform, one refused device) exits with 1: no harm to this process.
    if child.returncode == 1:
        log.info("the trial of the OpenCL drivers ended early: %s", child.stderr.decode(errors="replace"))
    return child.returncode in (0, 1)


def icd_files() -> list[Path]:
    """The driver files that the OpenCL loader of pyopencl's wheel reads: the system's and the wheel's own."""
    named = Path(os.environ.get("OCL_ICD_VENDORS") or "/etc/OpenCL/vendors")
    system = [named] if named.is_file() else sorted(named.glob("*.icd"))
    return system + sorted((_home() / ".libs").glob("*.icd"))


def _home() -> Path:
    spec = importlib.util.find_spec("pyopencl")
    return Path(spec.origin).parent if spec and spec.origin else Path("/nonexistent")


def _only(file: Path) -> dict[str, str]:
    """The environment in which the loader sees this driver alone."""
    if file.parent == _home() / ".libs":
        return {"OCL_ICD_VENDORS": str(_empty_folder()), "LTCL_PROBE_HOME": str(_home())}
    return {"OCL_ICD_VENDORS": str(file), "LTCL_PROBE_HOME": ""}


def _empty_folder() -> Path:
    return _folder("none")


def _folder(name: str) -> Path:
    """A folder in the cache, or a temporary one where the cache cannot be written."""
    try:
        return cache.make_folder(name)
    except OSError:
        return _temporary_folder()


def _temporary_folder() -> Path:
    folder = tempfile.mkdtemp(prefix="ltcl-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def _let_pocl_cache() -> None:
    """PoCL offers no device at all where it cannot write its kernel cache: give it a temporary one there."""
    if os.name != "posix" or _POCL in os.environ:
        return
    place = Path(os.environ.get("XDG_CACHE_HOME") or Path(os.environ.get("HOME") or "/", ".cache"))
    while not place.exists():
        place = place.parent
    if not (place.is_dir() and os.access(place, os.W_OK)):
        os.environ[_POCL] = str(_temporary_folder())


def _hide(keep: list[Path], verdict: str) -> None:
    """Point this process's loader at `keep` only.

    Each verdict has a folder of its own: a child process starts from what its parent hid, and others may
    read theirs at this moment.
    """
    import pyopencl  # noqa: F401 - it sets PYOPENCL_HOME when imported; only then can that be taken back

    folder = _folder(f"vendors-{verdict[:16]}")
    bundled = [file for file in keep if file.parent == _home() / ".libs"]
    for file in keep:
        if file not in bundled:
            shutil.copy2(file, folder / file.name)  # with its time, which is part of the key
    os.environ["OCL_ICD_VENDORS"] = str(folder)
    if not bundled:
        os.environ["PYOPENCL_HOME"] = ""


def _key(files: list[Path]) -> str:
    facts = [f"pyopencl {importlib.metadata.version('pyopencl')}"]
    for file in files:
        facts.append(_stamp(file))
        try:
            # The library named by the file may be replaced by an upgrade while the .icd stays the same.
            facts.append(_stamp(Path(file.read_text(errors="replace").strip())))
        except OSError:
            facts.append(f"{file} cannot be read")
    facts += [
        f"{name}={value}"
        for name, value in sorted(os.environ.items())
        if name.startswith(_PREFIXES) and name != _POCL
    ]
    return hashlib.sha256("\n".join(facts).encode()).hexdigest()


def _stamp(path: Path) -> str:
    try:
        status = path.stat()
        return f"{path} {status.st_mtime_ns} {status.st_size}"
    except (OSError, ValueError):  # the name of a library to be searched for, or none at all
        return f"{path} not a path"
