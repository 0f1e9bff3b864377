# SPDX-License-Identifier: BSD-3-Clause
"""The transport that a command works with, and what its report says about it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from ltcl import report, store
from ltcl.cli import console
from ltcl.device import open_device
from ltcl.errors import FileError
from ltcl.solvers import Inverse
from ltcl.store import formats
from ltcl.transport import Transport


def load(
    path: Path, device: str | None, *, needs: Literal["S", "light", "T"] = "S", **options: Any
) -> Transport:
    """Open the device, then load: a mistyped device should not wait for a large file.

    Parameters
    ----------
    needs
        What the command is going to use: S, which only a square T has; patterns, in which masked pixels stay
        unlit; or nothing but T.

    Raises
    ------
    FileError
        As `store.load`; or S is needed, and T maps to another number of pixels.
    """
    opened = open_device(device)
    try:
        T = store.load(path, device=opened, **options)
    except FileError as error:
        if needs == "S" and "grid=(" in str(error):  # no grid helps where T is rectangular
            _require_square(path)
        raise
    dark = int(T.masked.sum())
    if dark and needs != "T":  # relighting needs no first bounce
        console.note(f"{path}: {dark} of {T.shape[1]} projector pixels give no direct light; they stay unlit")
    return T


def load_inverse(path: Path | None, T: Transport) -> Inverse | None:
    """The inverse in a file, on the device of T; None where there is no file."""
    return None if path is None else store.load_inverse(path, device=T.device)


def _require_square(path: Path) -> None:
    rows, columns = formats.read(path).shape
    if rows != columns:
        raise FileError(f"{path}: T is {rows} x {columns}; only compensate and relight can use it")


def heading(command: str, path: Path, T: Transport, **options: Any) -> dict[str, Any]:
    """The beginning of every report: who made it, from what, how; `options` by their names here."""
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
