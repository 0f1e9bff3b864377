# SPDX-License-Identifier: BSD-3-Clause
"""Which devices there are, which is best, and which one a user means.

Rank: GPUs, accelerators, CPUs, each with the most compute units first among GPUs and the newest driver
first among CPUs; a simulator only when asked for by name.
"""

from __future__ import annotations

import os
import re
import sys
import weakref
from typing import Any

from ltcl.device import trial
from ltcl.device.description import KINDS, Description, describe
from ltcl.device.device import Device
from ltcl.errors import DeviceError, InputTypeError

_FIXES = {
    "linux": "pip install 'pyopencl[pocl]' (any x86-64 CPU), apt install pocl-opencl-icd (any CPU), "
    "or your GPU vendor's OpenCL driver",
    "darwin": "macOS brings OpenCL; on newer machines: conda install -c conda-forge pocl",
    "win32": "install the GPU vendor's driver, or Intel's CPU Runtime for OpenCL Applications",
}
_HIDING = ("OCL_ICD_VENDORS", "OCL_ICD_FILENAMES", "POCL_CACHE_DIR")

_opened: weakref.WeakValueDictionary[str, Device] = weakref.WeakValueDictionary()


def list_devices() -> list[Description]:
    """Every usable OpenCL device, the best first; drivers that crash are left out.

    Returns
    -------
    list of Description
        Empty where no driver is installed.

    Examples
    --------
    >>> import ltcl
    >>> all(":" in device.index for device in ltcl.list_devices())
    True
    """
    trial.hide_fatal_drivers()
    import pyopencl as cl

    try:
        platforms = cl.get_platforms()
    except cl.Error:  # the loader calls "no platform" an error
        return []
    found = [
        describe(f"{p}:{d}", platform, handle)
        for p, platform in enumerate(platforms)
        for d, handle in enumerate(_devices(platform))
    ]
    return sorted(found, key=lambda device: device.rank)


def open_device(select: str | Device | None = None) -> Device:
    """Open an OpenCL device.

    Parameters
    ----------
    select : str or Device, optional
        "gpu", "cpu" or "accelerator"; an index "platform:device" as `ltcl devices` prints it; or a part of
        the name of the device, platform or driver, in any case. Without it, ``LTCL_DEVICE`` is asked,
        then the best device is taken. An opened device is returned as it is.

    Returns
    -------
    Device
        Asking twice for one device gives the same object while it is in use.

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
    device = _opened.get(description.index)
    if device is None:
        device = _opened[description.index] = Device(description)
    return device


def choose(devices: list[Description], select: str | None) -> Description:
    """The one of `devices`, best first, that `select` means."""
    fix = _FIXES.get(sys.platform, _FIXES["linux"])
    if not devices:
        named = " and ".join(suspects())
        unset = f" with {named}; unset that, or" if named else ";"
        raise DeviceError(f"no OpenCL device was found{unset} install a driver: {fix}")
    if select is None:
        real = [device for device in devices if device.kind != "simulator"]
        if not real:
            raise DeviceError(
                f"only a simulator was found; name it ({devices[0].name}), or install a driver: {fix}"
            )
        return real[0]
    matches = [device for device in devices if _means(select, device)]
    if not matches:
        known = "; ".join(f"{device.index} {device.name} ({device.kind})" for device in devices)
        kind = select.strip().lower()
        if kind in KINDS:
            raise DeviceError(f"no {kind} here; there are: {known}")
        raise DeviceError(
            f"device is {select!r}; it must be gpu, cpu, accelerator, an index or part of a name; "
            f"there are: {known}"
        )
    return matches[0]


def suspects() -> list[str]:
    """Variables set by the user that can hide every driver, as NAME=value."""
    found = [(name, os.environ.get(name, "")) for name in _HIDING]
    # ltcl points them at folders of its own, too: see `trial`.
    return [
        f"{name}={value}"
        for name, value in found
        if value and not os.path.basename(value).startswith(("ltcl-", "vendors-"))
    ]


def _means(select: str, device: Description) -> bool:
    wanted = select.strip().lower()
    if wanted in KINDS:
        return device.kind == wanted
    if re.fullmatch(r"\d+:\d+", wanted):
        return device.index == wanted
    return any(wanted in text.lower() for text in (device.name, device.platform, device.driver))


def _devices(platform: Any) -> list[Any]:
    import pyopencl as cl

    try:
        return platform.get_devices()
    except cl.Error:  # a platform without devices answers DEVICE_NOT_FOUND
        return []
