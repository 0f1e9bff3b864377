# SPDX-License-Identifier: BSD-3-Clause
"""The transport that a command works with, how it solves, and what its report says about both."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks, report, store
from ltcl.cli.command import Context, note, table
from ltcl.device import open_device
from ltcl.errors import InputError
from ltcl.solvers.solve import SAMPLED
from ltcl.store import formats
from ltcl.transport import Transport, default_rtol, resolve_reference
from ltcl.verdict import Verdict

_ROUNDING = 1e-5  # of float32, in a picture


def load(context: Context, path: Path, dark_note: bool = True) -> Transport:
    """Open the device, then load: a mistyped device does not wait for a large file."""
    device = open_device(context.options["device"])
    context.progress(f"reading {path}")
    names = ("variable", "grid", "camera_grid", "first_bounce", "on_dark", "dark")
    settings = {name: context.options[name] for name in names if context.options.get(name)}
    if noise := context.options.get("noise"):
        context.progress(f"reading {noise}")
        second = {name: settings[name] for name in names[:3] if name in settings}
        settings["noise"] = store.load(noise, device=device, **second)
    T = store.load(path, device=device, **settings)
    if (dark := int(T.masked.sum())) and dark_note and not T.dark:  # which was logged
        note(f"{path}: {dark} of {T.shape[1]} projector pixels give no direct light; they stay unlit")
    return T


def is_measured(path: Path) -> bool:
    """Whether `ltcl.acquire` made this store; whoever loads a damaged one says what is wrong."""
    with suppress(InputError):
        return path.is_dir() and "strategy" in store.BlockStore.open(path).attributes
    return False


def note_lost(source: Path, target: Path) -> None:
    """Say what a copy of a measured transport does not keep."""
    if is_measured(source):
        note(f"{target}: does not keep how the projector was measured; use compensate --calibration {source}")


def solving(context: Context, T: Transport, rtol: float) -> dict[str, Any]:
    """Arguments of a task of tolerance `rtol` by default, from `options.solve_options`."""
    asked = context.options
    inverse = asked["inverse"] and store.load_inverse(asked["inverse"], device=T.device)
    exact = asked["exact"] and _load_exact(asked["exact"], T, asked["variable"])
    rtol = default_rtol(rtol, T, exact, inverse) if asked["rtol"] is None else asked["rtol"]
    sampling = {name: asked[name] for name in ("samples", "seed") if asked[name] is not None}
    return {"method": asked["method"], "rtol": rtol, "inverse": inverse, "exact": exact, **sampling}


def shows_noise(T: Transport, settings: dict[str, Any]) -> bool:
    """Whether its results have standard deviations: noise of T was measured, or T shows its entries."""
    judged = settings["exact"] or T
    return not judged.is_compressed or judged.measured_noise is not None


def callback(context: Context, T: Transport, settings: dict[str, Any], solves: int = 1) -> Any:
    """Progress of so many solves of all channels, of a method that samples one for all."""
    channels = 1 if settings["method"] in SAMPLED else T.channels
    return context.progress.solve(settings["rtol"], channels * solves)


def _load_exact(path: Path, T: Transport, variable: str | None) -> Transport:
    """What T was compressed from, with its first bounce; InputError where it is another transport."""
    on_dark, same = "mask" if T.masked.any() else "raise", {"grid": T.grid, "first_bounce": T.first_bounce}
    exact = store.load(path, variable=variable, on_dark=on_dark, dark=0.0, device=T.device, **same)
    resolve_reference(T, exact)  # refuses other colours
    pattern = np.random.default_rng(0).random((*T.grid, *(3,) * (T.channels == 3)))
    picture = T @ pattern
    error = float(np.linalg.norm(picture - exact @ pattern) / np.linalg.norm(picture))
    if not error <= T.error + _ROUNDING:
        bound = f"differ by {error:.2g}, more than {checks.upwards(T.error + _ROUNDING)}"
        text = f"is not what TRANSPORT was compressed from: pictures under a random pattern {bound}"
        raise InputError(f"{path}: {text}")
    return exact


def verdicts(files: Mapping[str, Verdict]) -> list[Any]:
    """The end of a report: numbers of each file, and what follows from them."""
    names = dict.fromkeys(name for v in files.values() for name in v.numbers)
    rows = ([name, *(v.numbers.get(name) for v in files.values())] for name in names)
    lines = [f"{file}: {v.text}" if files.keys() - {file} else v.text for file, v in files.items()]
    return ["", table(["verdict", *files], rows), *lines] if names else lines


def load_source(context: Context, file: Path, out: Path, inverse: bool = False) -> Transport:
    """The transport that becomes another one in `out`, which is checked before a long computation."""
    formats.find(out, inverse=inverse)
    if not inverse and out.suffix.lower() not in (".npz", ".zarr"):
        raise InputError(f"--out is {out}; a {context.name}ed transport must be a .npz or a .zarr")
    if out.exists() and file.exists() and out.samefile(file):
        raise InputError(f"--out is {out}, which is TRANSPORT itself; it must be another file")
    return load(context, file)


def caveat(what: str, T: Transport, exact: Path | None = None) -> str | None:
    """A line on the error of a compressed T, which `what` does not include."""
    if not T.error:
        return None
    if exact is not None:
        return f"{what} of {exact}, by which solutions were corrected"
    bound = f"{100 * float(checks.upwards(T.error)):.2g} %" + " for pictures" * (T.error < T.error_bound)
    return f"{what} of the compressed transport, whose own relative error is at most {bound}"


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
    """Bytes of a file, or of all files in a folder."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())
