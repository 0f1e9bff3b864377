# SPDX-License-Identifier: BSD-3-Clause
"""Which devices there are, which is best, and which one a user means.

Rank: GPUs (most compute units first), accelerators, CPUs (newest driver first); a simulator only
when it is named. A driver that crashes takes the process with it: `ltcl doctor` tries each in a
child process.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
import threading
import weakref
from dataclasses import dataclass, field, replace
from typing import Any

from ltcl.device import kernels
from ltcl.device import pocl_linker as linker
from ltcl.device.device import Device
from ltcl.errors import DeviceError, InputTypeError

KINDS = ("gpu", "accelerator", "cpu", "simulator")  # the best first
_CONDA = "conda install -c conda-forge pyopencl pocl-cpu"  # which the wheels on PyPI lack there
_FIXES = {"x86_64": "python -m pip install 'pyopencl[pocl]'", "darwin": _CONDA, "win32": _CONDA}
_HIDING = ("OCL_ICD_VENDORS", "OCL_ICD_FILENAMES", "POCL_CACHE_DIR")  # may hide every driver

_opened: weakref.WeakValueDictionary[str, Device] = weakref.WeakValueDictionary()
_opening = threading.Lock()


@dataclass(frozen=True)
class Description:
    """One device. `index` is what `open_device` takes: "platform:device"."""

    index: str
    name: str
    kind: str
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

    >>> all(":" in device.index for device in list_devices())
    True
    """
    kernels.refuse_forked()
    import pyopencl as cl

    # Its caches hold pickles, and where they cannot be written no kernel starts.
    cl._PYOPENCL_NO_CACHE = True
    kinds, devices = {cl.device_type.GPU: "gpu", cl.device_type.CPU: "cpu"}, []
    with contextlib.suppress(cl.Error):  # the loader calls "no platform" an error
        for p, platform in enumerate(cl.get_platforms()):
            brand = platform.name.strip()
            with contextlib.suppress(cl.Error):  # DEVICE_NOT_FOUND
                for d, handle in enumerate(platform.get_devices()):
                    kind = next(
                        (name for flag, name in kinds.items() if handle.type & flag), "accelerator"
                    )
                    kind = "simulator" if "oclgrind" in brand.lower() else kind
                    driver = f"{brand} {handle.driver_version.strip()}"
                    sizes = (
                        handle.max_compute_units,
                        handle.global_mem_size,
                        handle.max_mem_alloc_size,
                    )
                    devices.append(
                        Description(f"{p}:{d}", handle.name.strip(), kind, driver, *sizes, handle)
                    )
    linker.provide(device.driver for device in devices)
    return sorted(devices, key=lambda device: device.rank)


def open_device(select: str | Device | None = None) -> Device:
    """Open an OpenCL device; asking twice for one gives the same object while it is in use.

    Parameters
    ----------
    select : str or Device, optional
        "gpu", "cpu" or "accelerator"; an index "platform:device" as `ltcl devices` prints it; a
        part of the name of device or driver; or "all": the best, with the others of its platform,
        over which the rows of matrices that are not compressed are spread by measured speed.
        Without it, ``LTCL_DEVICE`` says so, else the best is taken.

    Raises
    ------
    DeviceError
        No device at all (with the fix for this system), or none that `select` means (with those
        there are).

    Examples
    --------
    >>> import ltcl
    >>> ltcl.open_device("cpu").kind
    'cpu'
    """
    if isinstance(select, Device):
        return select
    if not isinstance(select, str | None):
        raise InputTypeError(
            f"device is {select!r}; it must be a Device, a name or an index like '0:1'"
        )
    devices, select = list_devices(), select or os.environ.get("LTCL_DEVICE") or ""
    every = select.strip().lower() == "all"
    description, others = choose(devices, "" if every else select), []
    if every:
        platform = description.index.partition(":")[0] + ":"
        others = [
            open_device(d.index)
            for d in devices
            if d.index.startswith(platform) and d != description
        ]
        description = replace(description, index="all") if others else description
    linker.require(description.driver)
    with _opening:
        device = _opened.get(description.index) or Device(description)
        device.others = tuple(others)
        return _opened.setdefault(description.index, device)


def choose(devices: list[Description], select: str | None) -> Description:
    """The one of `devices`, best first, that `select` means."""
    command = _FIXES.get(sys.platform) or _FIXES.get(
        os.uname().machine, "sudo apt install pocl-opencl-icd"
    )
    folder = "PoCL needs a folder that it can write, which POCL_CACHE_DIR names"
    fix = f"install a driver: {command}, or that of your GPU's vendor; {folder}"
    if not devices:
        set_by_user = [f"{name}={os.environ[name]}" for name in _HIDING if os.environ.get(name)]
        unset = f"unset {' and '.join(set_by_user)}, or " if set_by_user else ""
        raise DeviceError(f"no OpenCL device was found; {unset}{fix}")
    known = "; ".join(f"{device.index} {device.name} ({device.kind})" for device in devices)
    if not select and devices[0].kind == "simulator":
        raise DeviceError(f"only a simulator was found, {known}; name it, or {fix}")
    if not select:
        return devices[0]
    name = select.strip().lower()
    for device in devices:
        names = f"{device.name}\n{device.driver}".lower()
        if name in (device.kind, device.index) or (name not in KINDS and name in names):
            return device
    kind = (
        {"gpu": "GPU", "cpu": "CPU"}.get(name, name)
        if name in KINDS
        else "device of this index or name"
    )
    raise DeviceError(
        f"device is {select!r}, but there is no {kind} here; the devices are: {known}"
    )
