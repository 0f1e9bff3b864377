# SPDX-License-Identifier: BSD-3-Clause
"""Options that several commands share, each defined once, and what they ask for.

Groups of options have their function here: `load` the transport that a command works with,
`solving` how, and `heading` what its report says of both. Output places are tested before any work.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from ltcl import checks, store
from ltcl.cli.command import Context, note, table
from ltcl.device import open_device
from ltcl.errors import FileError, InputError
from ltcl.operators import rank_device
from ltcl.solvers.solve import METHODS, SAMPLED
from ltcl.tasks import report
from ltcl.tasks.requirements import default_rtol, resolve_reference
from ltcl.transport.first_bounce import DARK_THRESHOLD
from ltcl.transport.transport import Transport
from ltcl.transport.verdict import Verdict

_ROUNDING = 1e-5  # of float32, in a picture


def grid(text: str) -> tuple[int, int]:
    """Height x width."""
    match = re.fullmatch(r"\s*(\d+)\s*[xX,]\s*(\d+)\s*", text)
    if match is None or 0 in (size := (int(match[1]), int(match[2]))):
        raise typer.BadParameter(f"{text!r} is no grid; write height x width, for instance 48x64")
    return size


def path(text: str) -> Path:
    """A path that is not empty, which Path would take for this folder."""
    if not str(text).strip():  # a default is a Path
        raise typer.BadParameter("the path is empty; write . for this folder")
    return Path(text)


def writable(place: Path, folder: Path) -> Path:
    """`place`, in `folder`; refused before any work if no file can be made in what exists of the folder."""
    try:
        above = next(each for each in (folder, *folder.absolute().parents) if os.path.lexists(each))
        with tempfile.TemporaryFile(dir=above):
            return place
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise FileError(f"{place}: cannot be written: {reason}") from None


def writable_file(place: Path | None) -> Path | None:
    """The same of a file."""
    return place and writable(place, place.parent)


def _known(name: str) -> str:
    if name not in METHODS:
        raise typer.BadParameter(f"{name!r} is no method; choose one of {', '.join(METHODS)}")
    return name


def argument(metavar: str, help: str, parser: Any = path, **settings: Any) -> Any:
    """An argument, by default a path."""
    return typer.Argument(metavar=metavar, help=help, parser=parser, **settings)


def option(help: str, *names: str, **settings: Any) -> Any:
    """An option."""
    return typer.Option(*names, help=help, **settings)


file = partial(option, parser=path, metavar="FILE")  # that is a path
pixels = partial(option, parser=grid, metavar="HxW")  # that is a grid


def out(help: str, callback: Any = writable_file, metavar: str = "FILE") -> Any:
    """The option --out."""
    return file(help, "--out", "-o", callback=callback, metavar=metavar)


FORMATS = "Light transport: .npz, .npy, .mtx, .mat or .zarr; with the extra hdf5 also .h5, and .mat of v7.3."
_DEVICE = "gpu, cpu, an index of 'ltcl devices', part of a name, or all. Default: LTCL_DEVICE, else the best."
_SEED = "Of monte_carlo and hybrid: the same numbers."
_ENCODING = "Of pictures; auto: integers sRGB, floats linear."
_RTOL = "Relative residual that ends a solve. Default: 0.01 (separate: 0.001), or the error of T where more."
_EXACT = (
    "What TRANSPORT was compressed from: corrects solves to any RTOL; errors are those with it."
)
_SAMPLES = "Random walks from each pixel (monte_carlo, 256), or columns of a row (hybrid, 32)."
_FIRST = "Direct light: the diagonal of T, or 1 / diag(T^-1), dense or estimated. Default: as in the file."
_NOISE = "A second measurement of the same scene, of which the noise of TRANSPORT follows; else estimated."
_ON_DARK = "Projector pixels whose direct light is 0 or within its noise: leave unlit, or refuse."
_SHOW_DARK = "Picture, a PNG, of direct light; pixels without it are orange."
_DARK = "Direct light below DARK times its median is dark, too; 0 leaves it lit."
Matrix = Annotated[Path, argument("TRANSPORT", FORMATS)]
Matrices = Annotated[list[Path], argument("FILE...", FORMATS)]
Pictures = Annotated[
    list[Path], argument("PICTURE...", "Pictures: .png, .jpg, .tif, .bmp or .exr.")
]
Out = Annotated[
    Path, out("Folder for the results; filled only on success.", lambda p: writable(p, p), "DIR")
]
Acquisition = Annotated[
    Path, argument("DIR", "Folder with an acquisition.toml; 'ltcl simulate' makes one.")
]
Device = Annotated[str | None, option(_DEVICE)]
OnDark = Annotated[Literal["mask", "raise"], option(_ON_DARK)]
ShowDark = Annotated[Path | None, file(_SHOW_DARK, callback=writable_file)]
Variable = Annotated[
    str | None, option("Name of the matrix in a .mat, .h5 or .npz file.", metavar="NAME")
]


def file_options(
    grid: Annotated[tuple | None, pixels("Projector pixels, if the file lacks them.")] = None,
    camera_grid: Annotated[tuple | None, pixels("Camera pixels, if other ones.")] = None,
    variable: Variable = None,
) -> None:
    """What a transport file may not contain."""


def transport_options(
    first_bounce: Annotated[Literal["diagonal", "exact", "estimate"] | None, option(_FIRST)] = None,
    on_dark: OnDark = "mask",
    dark: Annotated[float, option(_DARK)] = DARK_THRESHOLD,
    noise: Annotated[Path | None, file(_NOISE)] = None,
    device: Device = None,
) -> None:
    """How a transport is loaded; with those of `file_options`."""


def solve_options(
    method: Annotated[
        str, option(f"One of {', '.join(METHODS)}.", callback=_known, metavar="NAME")
    ] = "auto",
    rtol: Annotated[float | None, option(_RTOL)] = None,
    inverse: Annotated[
        Path | None, file("From 'ltcl invert': one product a picture and no solve.")
    ] = None,
    exact: Annotated[Path | None, file(_EXACT)] = None,
    samples: Annotated[int | None, option(_SAMPLES, min=1, max=2**32 - 1)] = None,
    seed: Annotated[int | None, option(_SEED, min=0, max=2**64 - 1)] = None,
) -> None:
    """How a task solves."""


def picture_options(
    resize: Annotated[
        bool, option("Scale pictures of another size to the grid.", "--resize")
    ] = False,
    encoding: Annotated[Literal["auto", "srgb", "linear"], option(_ENCODING)] = "auto",
) -> None:
    """How pictures are read."""


TRANSPORT = (file_options, transport_options)
TASK = (*TRANSPORT, solve_options, picture_options)


def load(context: Context, path: Path, dark_note: bool = True) -> Transport:
    """Open the device, then load: a mistyped device does not wait for a large file."""
    device, out = context.options["device"], context.options.get("out")
    if (
        out is not None
        and path.exists()
        and path.resolve() in (out.resolve(), *out.resolve().parents)
    ):
        raise InputError(
            f"--out is {out}, which is TRANSPORT itself or in it; it must be another place"
        )
    if context.options.get("mpi"):
        from mpi4py import MPI

        device = rank_device(MPI.COMM_WORLD, device)
    device = open_device(device)
    context.progress(f"reading {path}")
    names = ("variable", "grid", "camera_grid", "first_bounce", "on_dark")
    settings = {
        name: context.options[name] for name in names if context.options.get(name) is not None
    }
    if context.options.get("dark") is not None:
        settings["dark_threshold"] = context.options["dark"]
    if noise := context.options.get("noise"):
        context.progress(f"reading {noise}")
        second = {name: settings[name] for name in names[:3] if name in settings}
        settings["noise"] = store.load(noise, device=device, **second)
    T = store.load(path, device=device, **settings)
    if (dark := int(T.masked.sum())) and dark_note and not T.dark_note:  # which was logged
        note(
            f"{path}: {dark} of {T.shape[1]} projector pixels give no direct light; they stay unlit"
        )
    return T


def is_measured(path: Path) -> bool:
    """Whether `ltcl.acquire` made this store; whoever loads a damaged one says what is wrong."""
    with suppress(InputError):
        return path.is_dir() and "strategy" in store.BlockStore.open(path).attributes
    return False


def setup(transport: Path, calibration: Path | None = None) -> Any:
    """How the projector of a measured transport, or the one of `calibration`, was measured; else None."""
    if calibration is None and not is_measured(transport):
        return None
    from ltcl.acquisition import Setup  # which takes a second

    return Setup.of(calibration or transport)


def note_lost(source: Path, target: Path) -> None:
    """Say what a copy of a measured transport does not keep."""
    if is_measured(source):
        note(
            f"{target}: does not keep how the projector was measured; use compensate --calibration {source}"
        )


def solving(context: Context, T: Transport, rtol: float, solves: int = 1) -> dict[str, Any]:
    """Arguments of a task of tolerance `rtol` by default; its progress: so many solves a channel."""
    asked = context.options
    inverse = asked["inverse"] and store.load_inverse(asked["inverse"], device=T.device)
    exact, path = None, asked["exact"]
    if path is not None:  # what T was compressed from, with its first bounce
        same = {"grid": T.grid, "first_bounce": T.first_bounce, "device": T.device}
        on_dark, variable = "mask" if T.masked.any() else "raise", asked["variable"]
        exact = store.load(path, variable=variable, on_dark=on_dark, dark_threshold=0.0, **same)
        resolve_reference(T, exact)  # refuses other colours
        pattern = np.random.default_rng(0).random((*T.grid, *(3,) * (T.channels == 3)))
        picture = T @ pattern
        error = float(np.linalg.norm(picture - exact @ pattern) / np.linalg.norm(picture))
        if not error <= T.error + _ROUNDING:
            text = (
                f"pictures differ by {error:.2g}, more than {checks.upwards(T.error + _ROUNDING)}"
            )
            raise InputError(f"{path}: is not what TRANSPORT was compressed from: {text}")
    rtol = default_rtol(rtol, T, exact, inverse) if asked["rtol"] is None else asked["rtol"]
    settings = {"method": asked["method"], "rtol": rtol, "inverse": inverse, "exact": exact}
    settings |= {name: asked[name] for name in ("samples", "seed") if asked[name] is not None}
    solves *= 1 if asked["method"] in SAMPLED else T.channels
    return settings | {"callback": context.progress.solve(rtol, solves)}


def shows_noise(T: Transport, settings: dict[str, Any]) -> bool:
    """Whether its results have standard deviations: noise of T was measured, or T shows its entries."""
    judged = settings["exact"] or T
    return not judged.is_compressed or judged.measured_noise is not None


def verdicts(files: Mapping[str, Verdict]) -> list[str]:
    """The end of a report: numbers of each file, and what follows from them."""
    names = dict.fromkeys(name for v in files.values() for name in v.numbers)
    rows = ([name, *(v.numbers.get(name) for v in files.values())] for name in names)
    lines = [f"{file}: {v.text}" if files.keys() - {file} else v.text for file, v in files.items()]
    return ["", table(["verdict", *files], rows), *lines] if names else lines


def caveat(what: str, T: Transport, exact: Path | None = None) -> str | None:
    """A line on the error of a compressed T, which `what` does not include."""
    if not T.error:
        return None
    if exact is not None:
        return f"{what} of {exact}, by which solutions were corrected"
    bound = f"{100 * float(checks.upwards(T.error)):.2g} %" + " for pictures" * (
        T.error < T.error_bound
    )
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
        "options": {name: value for name, value in context.options.items() if name != "out"}
        | options,
    }


def on_disk(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    return sum(file.stat().st_size for file in (path, *path.rglob("*")) if file.is_file())
