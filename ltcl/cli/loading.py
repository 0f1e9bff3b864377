# SPDX-License-Identifier: BSD-3-Clause
"""The transport that a command works with, how its task solves, and the heading of its report."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks, store
from ltcl.cli.command import Context, note
from ltcl.cli.reports.parts import Device, TransportFacts, Versions
from ltcl.device import open_device
from ltcl.errors import InputError
from ltcl.operators import rank_device
from ltcl.solvers import Inverse
from ltcl.solvers.solve import SAMPLED
from ltcl.tasks import report
from ltcl.tasks.requirements import check_exact, default_rtol
from ltcl.transport.transport import Transport

# Relative error of a float32 picture by rounding.
PICTURE_ROUNDING = 1e-5


def load(context: Context, path: Path, notes_dark: bool = True) -> Transport:
    """Open the device, then load: a mistyped device does not wait for a large file."""
    options = context.options
    _check_out(options.get("out"), path)
    device = _open_device(context)
    context.progress(f"reading {path}")
    settings = _given_options(context, "variable", "grid", "camera_grid")
    noise_path = options.get("noise")
    if noise_path is not None:
        context.progress(f"reading {noise_path}")
        settings["noise"] = store.load(noise_path, device=device, **settings)
    settings |= _given_options(context, "first_bounce", "on_dark")
    if options.get("dark") is not None:
        settings["dark_threshold"] = options["dark"]
    T = store.load(path, device=device, **settings)
    dark_pixels = int(T.masked.sum())
    # Loading has logged the note on pixels that are below a threshold.
    has_note = notes_dark and T.scene is T
    if dark_pixels and has_note and not T.dark_note:
        pixels = f"{dark_pixels} of {T.shape[1]} projector pixels"
        note(f"{path}: {pixels} give no direct light; they stay unlit")
    return T


def _check_out(out: Path | None, transport: Path) -> None:
    """Refuse results in the folder of the transport."""
    if out is None or not transport.exists():
        return
    place = out.resolve()
    if transport.resolve() in (place, *place.parents):
        problem = f"--out is {out}, which is TRANSPORT itself or in it"
        raise InputError(f"{problem}; it must be another place")


def _open_device(context: Context) -> Any:
    name = context.options["device"]
    if context.options.get("mpi"):
        from mpi4py import MPI

        name = rank_device(MPI.COMM_WORLD, name)
    return open_device(name)


def _given_options(context: Context, *names: str) -> dict[str, Any]:
    """Return the options of these names that the command has and that are set."""
    values = {name: context.options.get(name) for name in names}
    return {name: value for name, value in values.items() if value is not None}


def is_measured(path: Path) -> bool:
    """True if `ltcl.acquire` made this store; False if damaged, which loading refuses."""
    with suppress(InputError):
        return path.is_dir() and "strategy" in store.BlockStore.open(path).attributes
    return False


def load_setup(transport: Path, calibration: Path | None = None) -> Any:
    """Load how the projector was measured: by `calibration`, or with the transport; else None."""
    if calibration is None and not is_measured(transport):
        return None
    # The import takes a second.
    from ltcl.acquisition import CombinedSetup, Setup

    scan = transport if calibration is None else calibration
    setup = CombinedSetup.of_scan(scan)
    if setup is not None:
        return setup
    _note_squares(scan)
    return Setup.of(scan)


def _note_squares(scan: Path) -> None:
    """Tell that codes are not for a projector, where a store lacks the files beside it."""
    from ltcl.acquisition.calibration import stored_map
    from ltcl.acquisition.projectors.combined import facts_path
    from ltcl.acquisition.projectors.warp import is_of_squares

    # Stores of earlier versions have no map, and were not made of several projectors.
    with suppress(InputError):
        if is_of_squares(stored_map(store.BlockStore.open(scan))):
            note(
                f"{scan}: has squares of camera pixels, as scans of several projectors; codes are "
                f"on them, not on the projector's pixels, unless {facts_path(scan).name} and the "
                "map that it names stand beside it"
            )


def setup_of_several(T: Transport) -> Any:
    """Calibrations of the projectors of a combination of scans; None for any other T."""
    if T.scene is T:
        return None
    # The import takes a second.
    from ltcl.acquisition.projectors import CombinedSetup

    return CombinedSetup.of(T)


def note_lost_setup(source: Path, target: Path) -> None:
    """Tell that a copy of a measured transport lacks the measurement of the projector."""
    if is_measured(source):
        advice = f"use compensate --calibration {source}"
        note(f"{target}: does not keep how the projector was measured; {advice}")


def solver_settings(
    context: Context, T: Transport, base_rtol: float, solves: int = 1
) -> dict[str, Any]:
    """Return arguments of a task: method, tolerance, inverse, original, and progress.

    The default tolerance is `base_rtol`; the task makes `solves` solves for each channel.
    """
    options = context.options
    method = options["method"]
    inverse = load_inverse(context, T)
    exact = None
    if options["exact"] is not None:
        exact = _load_original(context, T)
    rtol = options["rtol"]
    if rtol is None:
        rtol = default_rtol(base_rtol, T, exact, inverse)
    # Sampling methods solve all channels at once.
    if method not in SAMPLED:
        solves *= T.channels
    return {
        "method": method,
        "rtol": rtol,
        "inverse": inverse,
        "exact": exact,
        "callback": context.progress.solve(rtol, solves),
        **_given_options(context, "samples", "seed"),
    }


def load_inverse(context: Context, T: Transport) -> Inverse | None:
    """Load the inverse that --inverse names, on the device of T."""
    path = context.options["inverse"]
    if path is None:
        return None
    return store.load_inverse(path, device=T.device)


def _load_original(context: Context, T: Transport) -> Transport:
    """Load the original of a compressed T, with the first bounce of T; refuse another one."""
    path = context.options["exact"]
    on_dark = "raise"
    if T.masked.any():
        on_dark = "mask"
    exact = store.load(
        path,
        variable=context.options["variable"],
        grid=T.grid,
        first_bounce=T.first_bounce,
        on_dark=on_dark,
        dark_threshold=0.0,
        device=T.device,
    )
    # It refuses other colours.
    check_exact(T, exact)
    channels = (3,) if T.channels == 3 else ()
    pattern = np.random.default_rng(0).random((*T.grid, *channels))
    picture = T @ pattern
    difference = np.linalg.norm(picture - exact @ pattern)
    error = float(difference / np.linalg.norm(picture))
    limit = T.error + PICTURE_ROUNDING
    if not error <= limit:
        reason = f"pictures differ by {error:.2g}, more than {checks.upwards(limit)}"
        problem = f"{path}: is not what TRANSPORT was compressed from"
        raise InputError(f"{problem}: {reason}")
    return exact


def has_std(T: Transport, settings: dict[str, Any]) -> bool:
    """True if results have standard deviations: the noise was measured, or T has its entries."""
    if settings["exact"] is not None:
        T = settings["exact"]
    return not T.is_compressed or T.measured_noise is not None


def compression_caveat(subject: str, T: Transport, exact: Path | None = None) -> str | None:
    """Return a line on the error of a compressed T, which errors of the `subject` leave out."""
    if not T.error:
        return None
    if exact is not None:
        return f"{subject} of {exact}, by which solutions were corrected"
    bound = f"{100 * float(checks.upwards(T.error)):.2g} %"
    if T.error < T.error_bound:
        bound += " for pictures"
    limit = f"whose own relative error is at most {bound}"
    return f"{subject} of the compressed transport, {limit}"


def heading(context: Context, path: Path, T: Transport, **resolved: Any) -> dict[str, Any]:
    """Return the fields of a `Heading`; `resolved` are options with the values that were used."""
    options = {**context.options}
    options.pop("out", None)
    transport = TransportFacts.from_attributes(
        T, file=path, masked=int(T.masked.sum()), compressed=T.is_compressed
    )
    return {
        "command": context.name,
        "versions": Versions(**report.versions()),
        "device": Device(**report.device(T.device)),
        "transport": transport,
        "options": {**options, **resolved},
    }


def bytes_on_disk(path: Path) -> int:
    """Count the bytes of a file, or of all files in a folder."""
    total = 0
    for file in (path, *path.rglob("*")):
        if file.is_file():
            total += file.stat().st_size
    return total
