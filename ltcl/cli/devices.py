# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl devices`: what OpenCL offers here, and which of it ltcl would take."""

from __future__ import annotations

import os

from ltcl import checks
from ltcl.cli import console
from ltcl.cli.command import Answer, Context
from ltcl.device import discovery
from ltcl.errors import DeviceError

_FACTS = ("index", "name", "kind", "driver", "compute_units", "memory", "max_allocation")


def devices(context: Context) -> Answer:
    """List the OpenCL devices, the best first; the arrow marks the one that would be chosen."""
    found, chosen, name = discovery.list_devices(), None, os.environ.get("LTCL_DEVICE") or None
    try:
        chosen = discovery.choose(found, name)
    except DeviceError as error:
        if not found:
            raise
        console.note(str(error) if name is None else f"LTCL_DEVICE={name} matches none of these")
    data = [{fact: getattr(device, fact) for fact in _FACTS} for device in found]
    rows = [
        ("->" if device is chosen else "", *facts[:-2], *map(checks.size, facts[-2:]))
        for device, facts in zip(found, (list(each.values()) for each in data), strict=True)
    ]
    for device, facts in zip(found, data, strict=True):
        facts["chosen"] = device is chosen
    columns = ("", "index", "name", "kind", "driver", "units", "memory", "largest buffer")
    return Answer(data, lambda: console.table(columns, rows))
