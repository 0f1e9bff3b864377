# SPDX-License-Identifier: BSD-3-Clause
"""Options and arguments that several commands share, each defined once; output places are tested at once."""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ltcl.errors import FileError
from ltcl.first_bounce import DARK
from ltcl.solvers.solve import METHODS


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
    """`place`, if a nameless file can be made in the lowest folder above it that exists."""
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


FORMATS = "Light transport: .npz, .npy, .mtx, .mat or .zarr; with the extra hdf5 also .h5, and .mat of v7.3."
_DEVICE = "gpu, cpu, an index of 'ltcl devices', part of a name, or all. Default: LTCL_DEVICE, else the best."
_GRID, _CAMERA = "Projector pixels, if the file lacks them.", "Camera pixels, if other ones."
_METHOD = f"One of {', '.join(METHODS)}."
_INVERSE = "From 'ltcl invert': each picture takes one product and no solve."
_SEED = "Of monte_carlo and hybrid: the same numbers."
_ENCODING = "Of pictures; auto: integers sRGB, floats linear."
_RTOL = "Relative residual that ends a solve. Default: 0.01 (separate: 0.001), or the error of T where more."
_EXACT = "What TRANSPORT was compressed from: corrects solves to any RTOL; errors are those with it."
_SAMPLES = "Random walks from each pixel (monte_carlo, 256), or columns of a row (hybrid, 32)."
_FIRST = "Direct light: the diagonal of T, or 1 / diag(T^-1), dense or estimated. Default: as in the file."
_NOISE = "A second measurement of the same scene, of which the noise of TRANSPORT follows; else estimated."
_ON_DARK = "Projector pixels whose direct light is 0 or within its noise: leave unlit, or refuse."
_SHOW_DARK = "Picture, a PNG, of direct light; pixels without it are orange."
_DARK = "Direct light below DARK times its median is dark, too; 0 leaves it lit."
Matrix = Annotated[Path, argument("TRANSPORT", FORMATS)]
Matrices = Annotated[list[Path], argument("FILE...", FORMATS)]
Pictures = Annotated[list[Path], argument("PICTURE...", "Pictures: .png, .jpg, .tif, .bmp or .exr.")]
Out = Annotated[Path, out("Folder for the results; filled only on success.", writable_folder, "DIR")]
Acquisition = Annotated[Path, argument("DIR", "Folder with an acquisition.toml; 'ltcl simulate' makes one.")]
Device = Annotated[str | None, option(_DEVICE)]
OnDark = Annotated[Literal["mask", "raise"], option(_ON_DARK)]
ShowDark = Annotated[Path | None, file(_SHOW_DARK, callback=writable_file)]
Variable = Annotated[str | None, option("Name of the matrix in a .mat, .h5 or .npz file.", metavar="NAME")]


def file_options(
    grid: Annotated[tuple | None, option(_GRID, parser=grid, metavar="HxW")] = None,
    camera_grid: Annotated[tuple | None, option(_CAMERA, parser=grid, metavar="HxW")] = None,
    variable: Variable = None,
) -> None:
    """What a transport file may not contain."""


def transport_options(
    first_bounce: Annotated[Literal["diagonal", "exact", "estimate"] | None, option(_FIRST)] = None,
    on_dark: OnDark = "mask",
    dark: Annotated[float, option(_DARK)] = DARK,
    noise: Annotated[Path | None, file(_NOISE)] = None,
    device: Device = None,
) -> None:
    """How a transport is loaded; with those of `file_options`."""


def solve_options(
    method: Annotated[str, option(_METHOD, callback=_method, metavar="NAME")] = "auto",
    rtol: Annotated[float | None, option(_RTOL)] = None,
    inverse: Annotated[Path | None, file(_INVERSE)] = None,
    exact: Annotated[Path | None, file(_EXACT)] = None,
    samples: Annotated[int | None, option(_SAMPLES, min=1, max=2**32 - 1)] = None,
    seed: Annotated[int | None, option(_SEED, min=0, max=2**64 - 1)] = None,
) -> None:
    """How a task solves."""


def picture_options(
    resize: Annotated[bool, option("Scale pictures of another size to the grid.", "--resize")] = False,
    encoding: Annotated[Literal["auto", "srgb", "linear"], option(_ENCODING)] = "auto",
) -> None:
    """How pictures are read."""
