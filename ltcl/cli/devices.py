# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl devices`: what OpenCL offers here, and which of it ltcl would take."""

from __future__ import annotations

import os

from ltcl import checks
from ltcl.cli import console, options
from ltcl.device import discovery
from ltcl.errors import DeviceError


def run(json: options.Json = False) -> None:
    """List the OpenCL devices, the best first; the arrow marks the one that would be chosen."""
    devices = discovery.list_devices()
    chosen = _chosen(devices)
    if json:
        console.answer([_facts(device) | {"chosen": device is chosen} for device in devices])
        return
    rows = [
        (
            "->" if device is chosen else "",
            device.index,
            device.name,
            device.kind,
            device.driver,
            device.compute_units,
            checks.size(device.memory),
            checks.size(device.max_allocation),
        )
        for device in devices
    ]
    console.table(("", "index", "name", "kind", "driver", "units", "memory", "largest buffer"), rows)


def _chosen(devices: list[discovery.Description]) -> discovery.Description | None:
    """What a command would take; None, with a note, where it would refuse all there is."""
    wanted = os.environ.get("LTCL_DEVICE") or None
    try:
        return discovery.choose(devices, wanted)
    except DeviceError as error:
        if not devices:
            raise
        console.note(str(error) if wanted is None else f"LTCL_DEVICE={wanted} matches none of these")
        return None


def _facts(device: discovery.Description) -> dict:
    names = ("index", "name", "kind", "driver", "compute_units", "memory", "max_allocation")
    return {name: getattr(device, name) for name in names}
