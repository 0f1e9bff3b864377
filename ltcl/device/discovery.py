# SPDX-License-Identifier: BSD-3-Clause
"""Which devices there are, which is best, and which one a user means.

Rank: GPUs (most compute units first), accelerators, CPUs (newest driver first); a simulator only when it is
named. A driver that crashes takes the process with it: `ltcl doctor` tries each in a child process.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
import threading
import weakref
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ltcl.device import failures
from ltcl.device.device import Device
from ltcl.errors import DeviceError, InputTypeError

KINDS = ("gpu", "accelerator", "cpu", "simulator")  # the best first
_FIXES = {
    "linux": "pip install 'pyopencl[pocl]' (any x86-64 CPU), apt install pocl-opencl-icd (any CPU), "
    "or your GPU vendor's OpenCL driver",
    "darwin": "macOS brings OpenCL; on newer machines: conda install -c conda-forge pocl",
    "win32": "install the GPU vendor's driver, or Intel's CPU Runtime for OpenCL Applications",
}
_HIDING = ("OCL_ICD_VENDORS", "OCL_ICD_FILENAMES", "POCL_CACHE_DIR")

_opened: weakref.WeakValueDictionary[str, Device] = weakref.WeakValueDictionary()
_opening = threading.Lock()
_process: list[int] = []  # the one that first asked OpenCL


@dataclass(frozen=True)
class Description:
    """One device. `index` is what `open_device` takes: "platform:device"."""

    index: str
    name: str
    kind: str
    platform: str
    driver: str
    compute_units: int
    memory: int
    max_allocation: int
    handle: Any = field(repr=False, compare=False)

    @property
    def rank(self) -> tuple:
        """Sort key, the best first; the driver's version is the last dotted number of its name."""
        version = re.findall(r"\d+(?:\.\d+)+", self.driver)[-1:] or ["0"]
        newest = [-int(number) for number in version[0].split(".")]
        units = -self.compute_units if self.kind == "gpu" else 0
        return KINDS.index(self.kind), units, (*newest, 0, 0, 0)[:4], self.index


def list_devices() -> list[Description]:
    """Every OpenCL device, the best first; an empty list where no driver is installed.

    >>> import ltcl
    >>> all(":" in device.index for device in ltcl.list_devices())
    True
    """
    if not _process:
        _process.append(os.getpid())
    failures.refuse_forked(_process[0])
    import pyopencl as cl

    # Its caches hold pickles, and where they cannot be written no kernel starts.
    cl._PYOPENCL_NO_CACHE = True
    kinds = {cl.device_type.GPU: "gpu", cl.device_type.CPU: "cpu"}
    devices = []
    with contextlib.suppress(cl.Error):  # the loader calls "no platform" an error
        for p, platform in enumerate(cl.get_platforms()):
            with contextlib.suppress(cl.Error):  # DEVICE_NOT_FOUND
                for d, handle in enumerate(platform.get_devices()):
                    kind = next((name for flag, name in kinds.items() if handle.type & flag), "accelerator")
                    brand = platform.name.strip()
                    devices.append(
                        Description(
                            index=f"{p}:{d}",
                            name=handle.name.strip(),
                            kind="simulator" if "oclgrind" in brand.lower() else kind,
                            platform=brand,
                            driver=f"{brand} {handle.driver_version.strip()}",
                            compute_units=handle.max_compute_units,
                            memory=handle.global_mem_size,
                            max_allocation=handle.max_mem_alloc_size,
                            handle=handle,
                        )
                    )
    return sorted(devices, key=lambda device: device.rank)


def open_device(select: str | Device | None = None) -> Device:
    """Open an OpenCL device; asking twice for one gives the same object while it is in use.

    Parameters
    ----------
    select : str or Device, optional
        "gpu", "cpu" or "accelerator"; an index "platform:device" as `ltcl devices` prints it; or a part of
        the name of device, platform or driver. Without it, ``LTCL_DEVICE`` says so, else the best is taken.

    Raises
    ------
    DeviceError
        No device at all (with the fix for this system), or none that `select` means (with those there are).

    Examples
    --------
    >>> import ltcl
    >>> ltcl.open_device("cpu").kind
    'cpu'
    """
    if isinstance(select, Device):
        return select
    if not isinstance(select, str | None):
        raise InputTypeError(f"device is {select!r}; it must be a Device, a name or an index like '0:1'")
    description = choose(list_devices(), select or os.environ.get("LTCL_DEVICE") or None)
    with _opening:
        device = _opened.get(description.index)
        if device is None:
            device = _opened[description.index] = Device(description)
        return device


def choose(devices: list[Description], select: str | None) -> Description:
    """The one of `devices`, best first, that `select` means."""
    fix = f"install a driver: {_FIXES.get(sys.platform, _FIXES['linux'])}"
    if not devices:
        unset = f"unset {' and '.join(suspects())}, or " if suspects() else ""
        raise DeviceError(f"no OpenCL device was found; {unset}{_pocl_advice()}{fix}")
    known = "; ".join(f"{device.index} {device.name} ({device.kind})" for device in devices)
    if not select:
        if devices[0].kind == "simulator":
            raise DeviceError(f"only a simulator was found, {known}; name it, or {fix}")
        return devices[0]
    wanted = select.strip().lower()
    for device in devices:
        names = f"{device.name}\n{device.platform}\n{device.driver}".lower()
        if wanted == device.kind or wanted == device.index or (wanted not in KINDS and wanted in names):
            return device
    raise DeviceError(
        f"device is {select!r}; it must be gpu, cpu, accelerator, an index or part of a name of: {known}"
    )


def suspects() -> list[str]:
    """Variables set by the user that can hide every driver, as NAME=value."""
    return [f"{name}={os.environ[name]}" for name in _HIDING if os.environ.get(name)]


def _pocl_advice() -> str:
    """PoCL offers no device at all where it cannot write its kernel cache."""
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path(os.environ.get("HOME") or "/", ".cache"))
    cache = Path(os.environ.get("POCL_CACHE_DIR") or home)
    place = next(folder for folder in (cache, *cache.parents) if folder.exists())
    if place.is_dir() and os.access(place, os.W_OK):
        return ""
    return f"set POCL_CACHE_DIR to a folder that can be written, as PoCL cannot write {place}, or "
