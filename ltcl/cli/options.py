# SPDX-License-Identifier: BSD-3-Clause
"""Options and arguments that several commands share, each defined once, and the test of output places."""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ltcl.errors import FileError
from ltcl.solvers.solve import METHODS, SAMPLED


def grid(text: str) -> tuple[int, int]:
    """Height x width."""
    match = re.fullmatch(r"\s*(\d+)\s*[xX,]\s*(\d+)\s*", text)
    if match is None or 0 in (size := (int(match[1]), int(match[2]))):
        raise typer.BadParameter(f"{text!r} is no grid; write height x width, for instance 48x64")
    return size


def path(text: str) -> Path:
    """A path that is not empty, which Path would take for this folder."""
    if not text.strip():
        raise typer.BadParameter("the path is empty; write . for this folder")
    return Path(text)


def writable_folder(place: Path | None) -> Path | None:
    """Refuse, before any work, a folder that results cannot be written to."""
    return place and _writable(place, place)


def writable_file(place: Path | None) -> Path | None:
    """Refuse, before any work, a file that cannot be written."""
    return place and _writable(place, place.parent)


def _writable(place: Path, folder: Path) -> Path:
    """`place`, if a nameless file can be made in the lowest folder above it that is there."""
    try:
        above = next(each for each in (folder, *folder.absolute().parents) if os.path.lexists(each))
        with tempfile.TemporaryFile(dir=above):
            return place
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise FileError(f"{place}: cannot be written: {reason}") from None


def _method(name: str) -> str:
    if name not in METHODS:
        raise typer.BadParameter(f"{name!r} is no method; choose one of {', '.join(METHODS)}")
    return name


def sampling(options: dict[str, Any]) -> dict[str, Any]:
    """Arguments of a method that samples; the library refuses them with another."""
    return {name: options[name] for name in ("samples", "seed") if options[name] is not None}


def solves(method: str, channels: int) -> int:
    """How often a callback counts from 0: once for all channels of a method that samples."""
    return 1 if method in SAMPLED else channels


def argument(metavar: str, help: str, **settings: Any) -> Any:
    """An argument, by default a path."""
    arguments: dict[str, Any] = {"parser": path, "metavar": metavar, "help": help, **settings}
    return typer.Argument(**arguments)


def option(help: str, *names: str, **settings: Any) -> Any:
    """An option."""
    return typer.Option(*names, help=help, **settings)


def file(help: str, *names: str, metavar: str = "FILE", **settings: Any) -> Any:
    """An option that is a path."""
    return typer.Option(*names, parser=path, metavar=metavar, help=help, **settings)


def out(help: str, callback: Any = writable_file, metavar: str = "FILE") -> Any:
    """The option --out."""
    return file(help, "--out", "-o", callback=callback, metavar=metavar)


FORMATS = "Light transport: .npz, .npy, .mtx or .zarr; with the extra hdf5 also .h5, .hdf5 and .mat."
_DEVICE = "gpu, cpu, an index of 'ltcl devices', or part of a name. Default: LTCL_DEVICE, else the best."
_RTOL = (
    "Relative residual at which a solve ends. Default: 0.01 (separate: 0.001), or the error of T where more."
)
_EXACT = "What TRANSPORT was compressed from: corrects solves to any RTOL; errors are those with it."
_SAMPLES = "Random walks from each pixel (monte_carlo, 256), or columns of a row (hybrid, 32)."
_BASIS = (
    "pixels or a wavelet (haar, db2, ...; of compress 'db2 rows', too); more than once: the best of them."
)
_FIRST = (
    "Direct light: the diagonal of T, or 1 / diag(T^-1), dense or estimated. Default: as the file has it."
)
_DARK = (
    "Projector pixels without direct light: refuse, or leave unlit; auto: unlit if 'ltcl acquire' measured T."
)
Matrix = Annotated[Path, argument("TRANSPORT", FORMATS)]
Matrices = Annotated[list[Path], argument("FILE...", FORMATS)]
Pictures = Annotated[list[Path], argument("PICTURE...", "Pictures: .png, .jpg, .tif, .bmp or .exr.")]
Out = Annotated[Path, out("Folder for the results; filled only on success.", writable_folder, "DIR")]
Acquisition = Annotated[Path, argument("DIR", "Folder with an acquisition.toml; 'ltcl simulate' makes one.")]
Device = Annotated[str | None, option(_DEVICE)]
Method = Annotated[str, option(f"One of {', '.join(METHODS)}.", callback=_method, metavar="NAME")]
SolutionRtol = Annotated[float, option("Relative error that a solution may have.")]
Rtol = Annotated[float, option("Relative residual at which a solve ends.")]
TaskRtol = Annotated[float | None, option(_RTOL)]
Inverse = Annotated[Path | None, file("From 'ltcl invert': each picture takes one product and no solve.")]
Exact = Annotated[Path | None, file(_EXACT)]
Samples = Annotated[int | None, option(_SAMPLES, min=1, max=2**32 - 1)]
Seed = Annotated[int | None, option("Of monte_carlo and hybrid: the same numbers.", min=0, max=2**64 - 1)]
Basis = Annotated[list[str] | None, option(_BASIS)]
Grid = Annotated[
    tuple | None, option("Projector pixels, if the file lacks them.", parser=grid, metavar="HxW")
]
CameraGrid = Annotated[tuple | None, option("Camera pixels, if other ones.", parser=grid, metavar="HxW")]
FirstBounce = Annotated[Literal["diagonal", "exact", "estimate"] | None, option(_FIRST)]
OnDark = Annotated[Literal["auto", "raise", "mask"], option(_DARK)]
Resize = Annotated[bool, option("Scale pictures of another size to the grid.", "--resize")]
Encoding = Annotated[
    Literal["auto", "srgb", "linear"], option("Of pictures; auto: integers sRGB, floats linear.")
]
Variable = Annotated[str | None, option("Name of the matrix in a .mat, .h5 or .npz file.", metavar="NAME")]
