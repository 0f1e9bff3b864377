# SPDX-License-Identifier: BSD-3-Clause
"""Arguments and options that several commands share, each defined once.

A group of options is a function whose parameters they are. Output places are tested before any
work.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from ltcl.errors import FileError
from ltcl.solvers.solve import METHODS
from ltcl.transport.first_bounce import DARK_THRESHOLD

TRANSPORT_PANEL = "Reading the transport"
SOLVER_PANEL = "Solving"
PICTURES_PANEL = "Reading pictures"
# Larger limits are printed as powers of two.
MAX_PRINTED = 65535


def parse_grid(text: str) -> tuple[int, int]:
    """Parse height x width."""
    match = re.fullmatch(r"\s*(\d+)\s*[xX,]\s*(\d+)\s*", text)
    if match is not None:
        height = int(match[1])
        width = int(match[2])
        if height > 0 and width > 0:
            return height, width
    advice = "write height x width, for instance 48x64"
    raise typer.BadParameter(f"{text!r} is not a grid; {advice}")


def parse_path(text: str) -> Path:
    """Parse a path; refuse an empty one, which Path would take for the current folder."""
    # The default value of an option comes here, too, and is a Path.
    if not str(text).strip():
        raise typer.BadParameter("the path is empty; write . for this folder")
    return Path(text)


def parse_method(name: str) -> str:
    """Parse the name of a method."""
    if name not in METHODS:
        known = ", ".join(METHODS)
        raise typer.BadParameter(f"{name!r} is not a method; choose one of {known}")
    return name


def check_writable(place: Path, folder: Path) -> Path:
    """Return `place`, a file or folder in `folder`, or `folder` itself.

    FileError, before any work, if no file can be made in the existing part of the folder's path.
    """
    try:
        with tempfile.TemporaryFile(dir=_existing_part(folder)):
            return place
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise FileError(f"{place}: cannot be written: {reason}") from None


def _existing_part(folder: Path) -> Path:
    for place in _with_parents(folder):
        if os.path.lexists(place):
            return place
    return folder


def _with_parents(folder: Path) -> Iterator[Path]:
    yield folder
    yield from folder.absolute().parents


def check_writable_file(place: Path | None) -> Path | None:
    """Return the path of a file; FileError if it cannot be written."""
    if place is None:
        return None
    return check_writable(place, place.parent)


def check_writable_folder(place: Path) -> Path:
    """Return the path of a folder; FileError if it cannot be written."""
    return check_writable(place, place)


def argument(metavar: str, help: str, parser: Any = parse_path, **settings: Any) -> Any:
    """Declare an argument, by default a path."""
    return typer.Argument(metavar=metavar, help=help, parser=parser, **settings)


def option(
    help: str,
    *names: str,
    min: float | None = None,
    max: float | None = None,
    **settings: Any,
) -> Any:
    """Declare an option of numbers within a range, or of other values.

    `panel` is the heading in the help under which it stands.
    """
    if "panel" in settings:
        settings["rich_help_panel"] = settings.pop("panel")
    if min is not None:
        allowed = _range_in_words(min, max)
        help = f"{help} {allowed[0].upper()}{allowed[1:]}."
        settings["callback"] = _range_check(min, max)
    return typer.Option(*names, help=help, **settings)


def _range_in_words(least: float, most: float | None) -> str:
    if most is None:
        return f"at least {least:g}"
    highest = f"{most:g}"
    if most > MAX_PRINTED:
        highest = f"2^{int(most).bit_length()} - 1"
    return f"from {least:g} to {highest}"


def _range_check(least: float, most: float | None) -> Any:
    """Make a callback that refuses numbers beyond a range.

    Typer's own ranges print as <int range [0<=x<=18446744073709551615]>.
    """

    def check(value: Any) -> Any:
        # None is the default of an option that may be left out.
        if value is None or (value >= least and (most is None or value <= most)):
            return value
        raise typer.BadParameter(f"it must be {_range_in_words(least, most)}")

    return check


file_option = partial(option, parser=parse_path, metavar="FILE")
grid_option = partial(option, parser=parse_grid, metavar="HxW", panel=TRANSPORT_PANEL)
transport_option = partial(option, panel=TRANSPORT_PANEL)
solver_option = partial(option, panel=SOLVER_PANEL)
picture_option = partial(option, panel=PICTURES_PANEL)


def out_option(help: str, callback: Any = check_writable_file, metavar: str = "FILE") -> Any:
    """Declare the option --out."""
    return file_option(help, "--out", "-o", callback=callback, metavar=metavar)


FORMATS = (
    "Light transport: .npz, .npy, .mtx, .mat or .zarr; with the extra hdf5 also .h5, and .mat of "
    "v7.3."
)
SHOW_DARK_HELP = "PNG of the direct light to write; pixels without it are orange."
TransportFile = Annotated[Path, argument("TRANSPORT", FORMATS)]
TransportFiles = Annotated[list[Path], argument("FILE", FORMATS)]
Pictures = Annotated[list[Path], argument("PICTURE", "Pictures: .png, .jpg, .tif, .bmp or .exr.")]
OutFolder = Annotated[
    Path,
    out_option(
        "Folder for the results; it is filled only if the command succeeds.",
        check_writable_folder,
        "DIR",
    ),
]
Acquisition = Annotated[
    Path, argument("DIR", "Folder with an acquisition.toml; 'ltcl simulate' makes one.")
]
ProjectorName = Annotated[
    str | None,
    option("Name of the projector, of several in acquisition.toml.", "--projector", metavar="NAME"),
]
DeviceName = Annotated[
    str | None,
    option(
        "OpenCL device: gpu, cpu, an index from 'ltcl devices', part of a name, or all. "
        "Default: LTCL_DEVICE, else the best."
    ),
]
OnDark = Annotated[
    Literal["mask", "raise"],
    transport_option(
        "Projector pixels whose direct light is 0 or within its noise: keep them unlit, or refuse."
    ),
]
ShowDark = Annotated[Path | None, file_option(SHOW_DARK_HELP, callback=check_writable_file)]
Variable = Annotated[
    str | None,
    transport_option(
        "Name of the matrix in a .mat, .h5 or .npz file, or three: red,green,blue.", metavar="NAME"
    ),
]


def file_options(
    grid: Annotated[
        tuple | None,
        grid_option("Projector pixels, if the file lacks them."),
    ] = None,
    camera_grid: Annotated[
        tuple | None,
        grid_option("Camera pixels, if they differ from the projector's."),
    ] = None,
    variable: Variable = None,
) -> None:
    """Facts that a transport file may lack."""


def transport_options(
    first_bounce: Annotated[
        Literal["diagonal", "exact", "estimate"] | None,
        transport_option(
            "Direct light: the diagonal of T, or 1 / diag(T^-1), dense or "
            "estimated. Default: as in the file."
        ),
    ] = None,
    on_dark: OnDark = "mask",
    dark: Annotated[
        float,
        transport_option(
            "Threshold of dark pixels: direct light below DARK times its median "
            "is dark, too; 0 keeps them lit."
        ),
    ] = DARK_THRESHOLD,
    noise: Annotated[
        Path | None,
        file_option(
            "Second measurement of the same scene, to measure the noise of "
            "TRANSPORT; without it the noise is estimated.",
            panel=TRANSPORT_PANEL,
        ),
    ] = None,
    device: DeviceName = None,
) -> None:
    """Options of loading a transport, together with `file_options`."""


def solve_options(
    method: Annotated[
        str,
        solver_option(
            f"Method of solution: one of {', '.join(METHODS)}.",
            callback=parse_method,
            metavar="NAME",
        ),
    ] = "auto",
    rtol: Annotated[
        float | None,
        solver_option(
            "Relative residual that ends a solve. Default: 0.01 (separate: "
            "0.001), or the error of T if that is larger."
        ),
    ] = None,
    inverse: Annotated[
        Path | None,
        file_option(
            "Inverse made by 'ltcl invert': one product for each picture, and no solve.",
            panel=SOLVER_PANEL,
        ),
    ] = None,
    exact: Annotated[
        Path | None,
        file_option(
            "Original of a compressed TRANSPORT: solutions are corrected by it to "
            "any RTOL, and errors are measured with it.",
            panel=SOLVER_PANEL,
        ),
    ] = None,
    samples: Annotated[
        int | None,
        solver_option(
            "Random walks from each pixel (monte_carlo, 256), or columns of a row (hybrid, 32).",
            min=1,
            max=2**32 - 1,
        ),
    ] = None,
    seed: Annotated[
        int | None,
        solver_option("Random seed for monte_carlo and hybrid.", min=0, max=2**64 - 1),
    ] = None,
) -> None:
    """Options of the solver."""


def frame_options(
    rtol: Annotated[
        float | None,
        solver_option(
            "Relative residual that frames are computed to. Default: 0.01, or the error of T if "
            "that is larger."
        ),
    ] = None,
    inverse: Annotated[
        Path | None,
        file_option(
            "Inverse made by 'ltcl invert': one product for each frame, and no solve.",
            panel=SOLVER_PANEL,
        ),
    ] = None,
    bounces_every: Annotated[
        int,
        solver_option(
            "Compute the light of bounces of every N-th frame, for the frames in between, too: "
            "faster, and wrong by the bounces of what has changed.",
            metavar="N",
            min=1,
        ),
    ] = 1,
) -> None:
    """Options of frames that are prepared once."""


PictureEncoding = Annotated[
    Literal["auto", "srgb", "linear"],
    picture_option("Encoding of input pictures; auto: integers are sRGB, floats linear."),
]


def picture_options(
    resize: Annotated[
        Literal["crop", "letterbox", "stretch"] | None,
        picture_option(
            "Scale pictures of another size to the grid. With other proportions, cut off what is "
            "too much, add black bars, or distort them."
        ),
    ] = None,
    encoding: PictureEncoding = "auto",
) -> None:
    """Options of reading pictures."""


def encoding_options(encoding: PictureEncoding = "auto") -> None:
    """Options of reading pictures that are not scaled as asked for."""


READ_OPTIONS = (file_options, transport_options)
TASK_OPTIONS = (*READ_OPTIONS, solve_options, picture_options)
