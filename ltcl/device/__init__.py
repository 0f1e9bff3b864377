# SPDX-License-Identifier: BSD-3-Clause
"""The only package that knows OpenCL; `list_devices` or `open_device` asks for it first.

A `Device` hands out `Array`s from its memory pool and `Kernel`s that are built once.
"""

from __future__ import annotations

from ltcl.device.arrays import Array
from ltcl.device.device import Device
from ltcl.device.discovery import Description, list_devices, open_device
from ltcl.device.kernels import Kernel, Launch
from ltcl.device.profile import Profile, Times

__all__ = [
    "Array",
    "Description",
    "Device",
    "Kernel",
    "Launch",
    "Profile",
    "Times",
    "list_devices",
    "open_device",
]
