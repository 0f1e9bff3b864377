# SPDX-License-Identifier: BSD-3-Clause
"""The transport that a command works with, and what its report says about it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ltcl import report, store
from ltcl.device import open_device
from ltcl.transport import Transport


def load(path: Path, device: str | None, **options: Any) -> Transport:
    """Open the device, then load: a mistyped device should not wait for a large file."""
    return store.load(path, device=open_device(device), **options)


def heading(command: str, path: Path, T: Transport, **options: Any) -> dict[str, Any]:
    """The beginning of every report: who made it, from what, how."""
    return {
        "command": command,
        "versions": report.versions(),
        "device": report.device(T.device),
        "transport": {
            "file": path,
            "shape": T.shape,
            "channels": T.channels,
            "grid": T.grid,
            "camera_grid": T.camera_grid,
            "masked": int(T.masked.sum()),
        },
        "options": options,
    }
