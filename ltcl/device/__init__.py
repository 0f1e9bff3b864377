# SPDX-License-Identifier: BSD-3-Clause
"""OpenCL, and nothing else of ltcl knows about it: devices, kernels, arrays, vectors, tuning.

Importing this package touches no OpenCL; the first `list_devices` or `open_device` does.
"""

from __future__ import annotations

from ltcl.device.array import Array
from ltcl.device.description import Description
from ltcl.device.device import Device, Profile
from ltcl.device.discovery import list_devices, open_device

__all__ = ["Array", "Description", "Device", "Profile", "list_devices", "open_device"]
