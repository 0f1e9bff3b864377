# SPDX-License-Identifier: BSD-3-Clause
"""The transport that a command works with, and what its report says about it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from ltcl import checks, report, store
from ltcl.cli import console
from ltcl.cli.command import Context
from ltcl.device import open_device
from ltcl.errors import FileError, InputError
from ltcl.store import formats
from ltcl.transport import Transport, resolve_reference

_ROUNDING = 1e-5  # of float32, in a picture


def load(context: Context, path: Path, needs: Literal["S", "light", "T"] = "S") -> Transport:
    """Open the device, then load: a mistyped device does not wait for a large file.

    A command needs S, which only a square T has; patterns, in which masked pixels stay unlit; or T alone.
    """
    device = open_device(context.options["device"])
    context.progress(f"reading {path}")
    try:
        T = store.load(path, device=device, **_settings(path, context.options))
    except FileError:
        rows, columns = formats.read(path).shape  # raises again where that is the reason
        if needs == "S" and rows != columns:  # no grid helps
            text = f"{path}: T is {rows} x {columns}; only compensate and relight can use it"
            raise FileError(text) from None
        raise
    dark = int(T.masked.sum())
    if dark and needs != "T":  # relighting needs no first bounce
        console.note(f"{path}: {dark} of {T.shape[1]} projector pixels give no direct light; they stay unlit")
    return T


def _settings(path: Path, options: dict[str, Any]) -> dict[str, Any]:
    """Arguments of `store.load` among the options."""
    names = ("variable", "grid", "camera_grid", "first_bounce")
    on_dark = options["on_dark"]
    on_dark = ("mask" if is_measured(path) else "raise") if on_dark == "auto" else on_dark
    return {name: options[name] for name in names if options.get(name)} | {"on_dark": on_dark}


def is_measured(path: Path) -> bool:
    """Whether `ltcl.acquire` made this store."""
    if not path.is_dir():
        return False
    from ltcl.acquisition.setup import has_calibration

    return has_calibration(path)


def setup_of(path: Path) -> Any:
    """The `ltcl.acquisition.Setup` in a store that `ltcl.acquire` made; else None."""
    if not is_measured(path):
        return None
    from ltcl.acquisition import Setup

    return Setup.of(path)


def note_lost(source: Path, target: Path) -> None:
    """Say what a copy of a measured transport does not keep."""
    if is_measured(source):
        text = f"does not keep how the projector was measured; use compensate --calibration {source}"
        console.note(f"{target}: {text}")


def load_judges(context: Context, T: Transport) -> dict[str, Any]:
    """The arguments `inverse` and `exact` of a task: what is in the files that were named."""
    inverse, exact = context.options["inverse"], context.options["exact"]
    return {
        "inverse": None if inverse is None else store.load_inverse(inverse, device=T.device),
        "exact": None if exact is None else _load_exact(context, exact, T),
    }


def _load_exact(context: Context, path: Path, T: Transport) -> Transport:
    """What T was compressed from, with its first bounce; InputError where it is another transport."""
    options = {
        name: value for name, value in context.options.items() if name in ("grid", "on_dark", "variable")
    }
    exact = store.load(path, device=T.device, **_settings(path, options))
    if exact.is_square and (exact.grid, exact.channels) == (T.grid, T.channels):
        matrices: Any = exact.matrices if exact.channels == 3 else exact.matrices[0]
        dark = "mask" if T.masked.any() else "raise"
        settings = {"device": T.device, "on_dark": dark, "mixing": exact.mixing}
        exact = Transport(matrices, T.grid, T.first_bounce, **settings)
    resolve_reference(T, exact)  # refuses other sizes
    pattern = np.random.default_rng(0).random((*T.grid, *(3,) * (T.channels == 3)))
    ours = T @ pattern
    error = float(np.linalg.norm(ours - exact @ pattern) / np.linalg.norm(ours))
    if not error <= T.error + _ROUNDING:
        raise InputError(
            f"{path}: is not what TRANSPORT was compressed from: pictures under a random pattern differ by "
            f"{error:.2g}, more than {checks.upwards(T.error + _ROUNDING)}"
        )
    return exact


def refuse_same(out: Path, file: Path) -> None:
    """Refuse to replace a transport by what is made of it."""
    if out.exists() and file.exists() and out.samefile(file):
        raise InputError(f"--out is {out}, which is TRANSPORT itself; it must be another file")


def caveat(what: str, T: Transport, exact: Path | None = None) -> str:
    """A line on the error of a compressed T, which `what` does not include; else an empty one."""
    if exact is not None and T.error:
        return f"{what} of {exact}, by which solutions were corrected"
    own = f"whose own relative error is at most {100 * float(checks.upwards(T.error)):.2g} %"
    return f"{what} of the compressed transport, {own}" if T.error else ""


def heading(context: Context, path: Path, T: Transport, **options: Any) -> dict[str, Any]:
    """The beginning of every report: the command, versions, device, transport, and options as resolved."""
    names = ("shape", "channels", "grid", "camera_grid", "error")
    facts = {"masked": int(T.masked.sum()), "compressed": T.is_compressed}
    return {
        "command": context.name,
        "versions": report.versions(),
        "device": report.device(T.device),
        "transport": {"file": path, **{name: getattr(T, name) for name in names}, **facts},
        "options": {name: value for name, value in context.options.items() if name != "out"} | options,
    }


def on_disk(path: Path) -> int:
    """Bytes of a file, of all files in a folder, or of the three of a .mtx in colour."""
    channels = path.parent.glob(f"{path.stem}_[rgb]{path.suffix}")
    files = path.rglob("*") if path.is_dir() else [path] if path.exists() else channels
    return sum(file.stat().st_size for file in files if file.is_file())
