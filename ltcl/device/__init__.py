# SPDX-License-Identifier: BSD-3-Clause
"""OpenCL, and nothing else of ltcl knows about it.

`discovery` finds and opens a `Device`, which hands out `Array`s from its memory pool and `Kernel`s that are
built once; `vectors` has what solvers do between two products, `tuning` times variants and machine speeds and
remembers them, `failures` turns status codes into errors of ltcl.

Importing this package touches no OpenCL; the first `list_devices` or `open_device` does.
"""

from __future__ import annotations

from ltcl.device.array import Array
from ltcl.device.device import Device, Profile
from ltcl.device.discovery import Description, list_devices, open_device
from ltcl.device.kernels import Kernel, Launch

__all__ = ["Array", "Description", "Device", "Kernel", "Launch", "Profile", "list_devices", "open_device"]
