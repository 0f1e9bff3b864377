# SPDX-License-Identifier: BSD-3-Clause
"""The transport that a command works with, and what its report says about it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from ltcl import checks, report, store
from ltcl.cli import console
from ltcl.device import open_device
from ltcl.errors import FileError, InputError
from ltcl.solvers import Inverse
from ltcl.store import formats, mtx
from ltcl.transport import Transport, resolve_reference

_ROUNDING = 1e-5  # of float32, in a picture


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
    options["on_dark"] = _on_dark(path, options.get("on_dark", "raise"))
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


def _on_dark(path: Path, asked: str) -> str:
    if asked != "auto":
        return asked
    return "mask" if _is_measured(path) else "raise"


def _is_measured(path: Path) -> bool:
    if not path.is_dir():
        return False
    from ltcl.acquisition.setup import has_calibration

    return has_calibration(path)


def setup_of(path: Path, calibration: Path | None = None) -> Any:
    """The `ltcl.acquisition.Setup` in a store that `ltcl.acquire` made; None of any other file.

    Raises
    ------
    FileError
        `calibration`, which is preferred, is no such store.
    """
    if calibration is None and not _is_measured(path):
        return None
    from ltcl.acquisition import Setup

    return Setup.of(path if calibration is None else calibration)


def refuse_other(setup: Any, calibration: Path | None, T: Transport) -> None:
    """Refuse the calibration of other pixels than those of T."""
    if setup is not None and (setup.grid, setup.channels) != (T.grid, T.channels):
        raise InputError(
            f"{calibration}: is of {setup.grid} pixels and {setup.channels} channel(s); TRANSPORT has "
            f"{T.grid} and {T.channels}"
        )


def note_lost(source: Path, target: Path) -> None:
    """Say what a copy of a measured transport does not keep."""
    if _is_measured(source):
        console.note(
            f"{target}: does not keep how the projector was measured; give compensate --calibration {source}"
        )


def load_inverse(path: Path | None, T: Transport) -> Inverse | None:
    """The inverse in a file, on the device of T; None where there is no file."""
    return None if path is None else store.load_inverse(path, device=T.device)


def load_exact(path: Path | None, T: Transport, **options: Any) -> Transport | None:
    """What T was compressed from, of the same first bounce and on its device; None where there is no file.

    Raises
    ------
    FileError
        As `store.load`.
    InputError
        It is another transport, told by pixels, colours, or one random pattern.
    """
    if path is None:
        return None
    options["on_dark"] = _on_dark(path, options.get("on_dark", "raise"))
    exact = store.load(path, device=T.device, **options)
    if exact.is_square and (exact.grid, exact.channels) == (T.grid, T.channels):
        exact = _with_first_bounce(exact, T)
    resolve_reference(T, exact)  # refuses others
    pattern = np.random.default_rng(0).random((*T.grid, *(3,) * (T.channels == 3)))
    ours, theirs = T @ pattern, exact @ pattern
    missed, allowed = float(np.linalg.norm(ours - theirs) / np.linalg.norm(ours)), T.error + _ROUNDING
    if not missed <= allowed:
        raise InputError(
            f"{path}: is not what TRANSPORT was compressed from: under a random pattern they differ by "
            f"{missed:.2g}, which may be {checks.upwards(allowed)} at most"
        )
    return exact


def _with_first_bounce(exact: Transport, T: Transport) -> Transport:
    """The same transport, split as T is, whose first bounce may have been chosen when it was compressed."""
    return Transport(
        exact.matrices if exact.channels == 3 else exact.matrices[0],
        T.grid,
        T.first_bounce,
        device=T.device,
        on_dark="mask" if T.masked.any() else "raise",
        mixing=exact.mixing,
    )


def refuse_same(out: Path, file: Path) -> None:
    """Refuse to put what is made of a transport in the place of the transport.

    Raises
    ------
    InputError
        Both are one file.
    """
    if out.exists() and file.exists() and out.samefile(file):
        raise InputError(f"--out is {out}, which is TRANSPORT itself; it must be another file")


def on_disk(path: Path) -> int:
    """Bytes of a file, of all files in a folder, or of the three of a .mtx in colour."""
    files = path.rglob("*") if path.is_dir() else [path] if path.exists() else mtx.beside(path)
    return sum(file.stat().st_size for file in files if file.is_file())


def caveat(what: str, T: Transport, exact: Path | None = None) -> str:
    """A line on which transport `what` is shown is of; none where T is no compressed one.

    >>> caveat("errors are", Transport([[0.5, 0.1], [0.1, 0.5]], grid=(1, 2)))
    ''
    """
    if exact is not None and T.error:
        return f"{what} of {exact}, by which solutions were corrected"
    off = f"which itself is off by up to {100 * float(checks.upwards(T.error)):.2g} %"
    return f"{what} of the compressed transport, {off}" if T.error else ""


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
            "compressed": T.is_compressed,
            "error": T.error,
        },
        "options": options,
    }
