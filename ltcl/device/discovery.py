# SPDX-License-Identifier: BSD-3-Clause
"""Discovery: the devices of this machine, their ranking, and the one that a user selects.

Rank: GPUs (most compute units first), accelerators, CPUs (newest driver first); a simulator only
when it is named. A driver that crashes takes the process with it: `ltcl doctor` tries each in a
child process.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import sys
import threading
import weakref
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

from ltcl.device import ahead, driver_errors, pocl_processor
from ltcl.device import pocl_linker as linker
from ltcl.device.device import Device, Session
from ltcl.errors import DeviceError, InputTypeError

# What opens the best device with the others of its platform, and its index then.
ALL = "all"
NAME_OF_SIMPLE_POCL = "basic-"
# The best first.
KINDS = ("gpu", "accelerator", "cpu", "simulator")
KIND_NAMES = {"gpu": "GPU", "cpu": "CPU"}
# Commands that install a driver, by machine or system; PyPI has wheels of PoCL for Linux on x86_64.
CONDA_COMMAND = "conda install -c conda-forge pyopencl pocl-cpu"
INSTALL_COMMANDS = {
    "x86_64": "python -m pip install 'pyopencl[pocl]'",
    "darwin": CONDA_COMMAND,
    "win32": CONDA_COMMAND,
}
APT_COMMAND = "sudo apt install pocl-opencl-icd"
# Variables of the environment that may hide every driver.
HIDING_VARIABLES = (
    "OCL_ICD_VENDORS",
    "OCL_ICD_FILENAMES",
    "OPENCL_VENDOR_PATH",
    "POCL_DEVICES",
    "POCL_CACHE_DIR",
    "CUDA_VISIBLE_DEVICES",
)

_opened: weakref.WeakValueDictionary[str, Device] = weakref.WeakValueDictionary()
_opening = threading.Lock()


@dataclass(frozen=True)
class Description:
    """Description of a device. `index` is what `open_device` takes: "platform:device"."""

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
        versions = re.findall(r"\d+(?:\.\d+)+", self.driver)
        version = versions[-1] if versions else "0"
        newest_first = [-int(number) for number in version.split(".")]
        padded = (*newest_first, 0, 0, 0)[:4]
        most_units_first = -self.compute_units if self.kind == "gpu" else 0
        return KINDS.index(self.kind), most_units_first, padded, self.index


def list_devices() -> list[Description]:
    """List every OpenCL device, the best first; an empty list if no driver is installed.

    >>> all(":" in device.index for device in list_devices())
    True
    """
    driver_errors.refuse_forked()
    with _interrupts_held():
        import pyopencl as cl

    # Its caches hold pickles, and if they cannot be written no kernel starts.
    cl._PYOPENCL_NO_CACHE = True
    devices: list[Description] = []
    # The loader calls "no platform" an error.
    with contextlib.suppress(cl.Error):
        for number, platform in enumerate(cl.get_platforms()):
            # A platform without devices is an error, too.
            with contextlib.suppress(cl.Error):
                devices.extend(_platform_devices(number, platform))
    linker.provide(device.driver for device in devices)
    return sorted(devices, key=lambda device: device.rank)


@contextlib.contextmanager
def _interrupts_held() -> Iterator[None]:
    """Let Ctrl-C wait until a block is over: the native part of pyopencl aborts at one.

    Only the main thread has handlers, and those of other languages cannot be put back.
    """
    handler = signal.getsignal(signal.SIGINT)
    if handler is None or threading.current_thread() is not threading.main_thread():
        yield
        return
    waiting: list[int] = []
    signal.signal(signal.SIGINT, lambda number, _: waiting.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if waiting:
            signal.raise_signal(signal.SIGINT)


def _platform_devices(platform_number: int, platform: Any) -> Iterator[Description]:
    """Descriptions of the devices of one platform."""
    brand = platform.name.strip()
    for number, handle in enumerate(platform.get_devices()):
        pocl_processor.provide(brand, handle)
        yield Description(
            index=f"{platform_number}:{number}",
            name=handle.name.strip(),
            kind=_kind(brand, handle.type),
            driver=f"{brand} {handle.driver_version.strip()}",
            compute_units=handle.max_compute_units,
            memory=handle.global_mem_size,
            max_allocation=handle.max_mem_alloc_size,
            handle=handle,
        )


def _kind(brand: str, device_type: int) -> str:
    """Kind of a device, by the flags of its type."""
    import pyopencl as cl

    if "oclgrind" in brand.lower():
        return "simulator"
    if device_type & cl.device_type.GPU:
        return "gpu"
    if device_type & cl.device_type.CPU:
        return "cpu"
    return "accelerator"


def open_device(select: str | Device | None = None) -> Device:
    """Open an OpenCL device; asking twice for one gives the same object while it is in use.

    Parameters
    ----------
    select : str or Device, optional
        "gpu", "cpu" or "accelerator"; an index "platform:device" as `ltcl devices` prints it; a
        part of the name of device or driver; or "all": the best, with the others of its platform,
        over which the rows of matrices that are not compressed are spread by measured speed.
        Default: the environment variable ``LTCL_DEVICE``, else the best device.

    Raises
    ------
    DeviceError
        There is no device at all (the message has the fix for this system), or none that `select`
        means (the message lists the devices).

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
    devices = list_devices()
    if not select:
        select = os.environ.get("LTCL_DEVICE", "")
    if select.strip().lower() == ALL:
        return _open_all(devices)
    return _open(choose(devices, select))


def _open_all(devices: list[Description]) -> Device:
    """Open the best device, with the others of its platform in the same context."""
    best = choose(devices, None)
    platform = best.index.partition(":")[0] + ":"
    others = []
    for description in devices:
        if description.index.startswith(platform) and description != best:
            others.append(description)
    if not others:
        return _open(best)
    for description in (best, *others):
        linker.require(description.driver)
    with _opening:
        device = _opened.get(ALL)
        if device is None or [other.description for other in device.others] != others:
            device = _open_several([replace(best, index=ALL), *others])
            for each in (device, *device.others):
                _opened.setdefault(each.description.index, each)
            _opened[ALL] = device
        return device


def _open_several(descriptions: list[Description]) -> Device:
    """Open devices in one context, or each in its own, where they exchange through the host."""
    # PoCL's simplest devices lock themselves up when an event of another device ends.
    are_simple = (NAME_OF_SIMPLE_POCL in description.name for description in descriptions)
    if not any(are_simple):
        return open_together(descriptions)
    device, *others = map(Device, descriptions)
    device.others = tuple(others)
    return device


def open_together(descriptions: list[Description]) -> Device:
    """Open devices in one context, in which they send each other vectors without the host.

    The first one is returned, and has the others as its `others`.
    """
    import pyopencl as cl

    # Each once: tests open one device under two names.
    handles = [description.handle for description in descriptions]
    handles = list(dict.fromkeys(handles))
    with driver_errors.translated("opening several devices"):
        context = cl.Context(handles)
        opened = []
        for description in descriptions:
            opened.append(Device(description, Session(description.handle, context)))
    device, *others = opened
    device.others = tuple(others)
    for each in opened:
        ahead.begin_with_vectors(each)
    return device


def _open(description: Description) -> Device:
    """Open the described device, or find it if it is open."""
    linker.require(description.driver)
    with _opening:
        device = _opened.get(description.index)
        if device is None:
            device = Device(description)
            _opened[description.index] = device
            ahead.begin_with_vectors(device)
        return device


def choose(devices: list[Description], select: str | None) -> Description:
    """The one of `devices`, best first, that `select` means."""
    if not devices:
        raise DeviceError(f"no OpenCL device was found; {_unset_advice()}{_install_advice()}")
    known = "; ".join(f"{device.index} {device.name} ({device.kind})" for device in devices)
    if not select:
        best = devices[0]
        if best.kind == "simulator":
            raise DeviceError(
                f"only a simulator was found, {known}; name it, or {_install_advice()}"
            )
        return best

    name = select.strip().lower()
    for device in devices:
        if name in (device.kind, device.index):
            return device
        names = f"{device.name}\n{device.driver}".lower()
        if name not in KINDS and name in names:
            return device
    missing = "device of this index or name"
    if name in KINDS:
        missing = KIND_NAMES.get(name, name)
    raise DeviceError(
        f"device is {select!r}, but there is no {missing} here; the devices are: {known}"
    )


def _install_advice() -> str:
    """Advice to install a driver, for this system."""
    command = INSTALL_COMMANDS.get(sys.platform)
    if command is None:
        command = INSTALL_COMMANDS.get(os.uname().machine, APT_COMMAND)
    return (
        f"install a driver: {command}, or that of your GPU's vendor; "
        "PoCL needs a folder that it can write, which POCL_CACHE_DIR names"
    )


def hiding_variables() -> list[str]:
    """Variables of the environment that are set and may hide every driver, as NAME=value."""
    variables = []
    for name in HIDING_VARIABLES:
        # An empty list of devices hides them, too.
        if name in os.environ:
            variables.append(f"{name}={os.environ[name]}")
    return variables


def _unset_advice() -> str:
    """Advice to unset variables that may hide every driver; empty if none is set."""
    variables = hiding_variables()
    if not variables:
        return ""
    return f"unset {' and '.join(variables)}, or "
