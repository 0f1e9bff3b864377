# SPDX-License-Identifier: BSD-3-Clause
"""Options and arguments that several commands share, each defined once."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

import typer

from ltcl.errors import InputError
from ltcl.solvers.solve import METHODS, SAMPLED


def grid(text: str) -> tuple[int, int]:
    """Height x width."""
    found = re.fullmatch(r"\s*(\d+)\s*[xX,]\s*(\d+)\s*", text)
    if found is None or 0 in (size := (int(found[1]), int(found[2]))):
        raise typer.BadParameter(f"{text!r} is no grid; write height x width, for instance 48x64")
    return size


def folder(text: str) -> Path:
    """A name that is not empty."""
    if not text.strip():
        raise typer.BadParameter("the name is empty; write . for this folder")
    return Path(text)


def _method(name: str) -> str:
    if name not in METHODS:
        raise typer.BadParameter(f"{name!r} is no method; choose one of {', '.join(METHODS)}")
    return name


def sampling(method: str, samples: int | None, seed: int | None) -> dict[str, int]:
    """Options of a method that samples, for the solver and the report; none of the others.

    Raises
    ------
    InputError
        Samples or a seed for a method that draws none.
    """
    if method in SAMPLED:
        usual = SAMPLED[method].usual
        return {"samples": usual if samples is None else samples, "seed": seed or 0}
    for name, value in (("samples", samples), ("seed", seed)):
        if value is not None:
            raise InputError(
                f"--{name} is {value}, but --method is {method}; only {' and '.join(SAMPLED)} sample"
            )
    return {}


def solves(method: str, channels: int) -> int:
    """How often a callback hears numbers begin: of methods that sample once, whatever the channels.

    >>> solves("cg", 3), solves("hybrid", 3)
    (3, 1)
    """
    return 1 if method in SAMPLED else channels


FORMATS = (
    "Light transport: .npz, .npy, .mtx or .zarr; with the extra hdf5 also .h5, .hdf5, and .mat of MATLAB's "
    "v7.3, variable LTM."
)
Matrix = Annotated[Path, typer.Argument(metavar="TRANSPORT", help=FORMATS)]
Matrices = Annotated[list[Path], typer.Argument(metavar="FILE...", help=FORMATS)]
Pictures = Annotated[
    list[Path], typer.Argument(metavar="PICTURE...", help="Pictures: .png, .jpg, .tif, .bmp or .exr.")
]
PicturesOrFrames = Annotated[
    list[Path],
    typer.Argument(
        metavar="PICTURE...",
        help="Pictures: .png, .jpg, .tif, .bmp or .exr; or one folder or one video of frames.",
    ),
]
Patterns = Annotated[
    list[Path], typer.Argument(metavar="PATTERN...", help="Pictures: .png, .jpg, .tif, .bmp or .exr.")
]
Out = Annotated[
    Path,
    typer.Option(
        "--out",
        "-o",
        parser=folder,
        metavar="DIR",
        help="Folder for the results; filled only on success.",
    ),
]
Acquisition = Annotated[
    Path, typer.Argument(metavar="DIR", help="Folder with an acquisition.toml; 'ltcl simulate' makes one.")
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")]
Device = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="gpu, cpu, an index of 'ltcl devices', or part of a name. Default: LTCL_DEVICE, else the best.",
        show_default=False,
    ),
]
Method = Annotated[str, typer.Option(callback=_method, metavar="NAME", help=f"One of {', '.join(METHODS)}.")]
SolutionRtol = Annotated[
    float, typer.Option(metavar="FRACTION", help="Relative error that a solution may have for it.")
]
Rtol = Annotated[float, typer.Option(metavar="FRACTION", help="Relative residual at which a solve is done.")]
TaskRtol = Annotated[
    float | None,
    typer.Option(
        metavar="FRACTION",
        help="Relative residual at which a solve is done. Default: 0.01 of compensate, 0.001 of separate, or "
        "the error of a compressed TRANSPORT without --exact, or of the inverse, where that is more.",
        show_default=False,
    ),
]
Inverse = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="What 'ltcl invert' made of the transport: then each picture takes one product and no solve.",
        show_default=False,
    ),
]
Exact = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="What a compressed TRANSPORT was compressed from: solves are then corrected to any RTOL, and "
        "everything that is told is of FILE.",
        show_default=False,
    ),
]
Samples = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=2**32 - 1,
        metavar="N",
        help="Random walks from each pixel (monte_carlo, default 256), or columns drawn of each row in an "
        "iteration (hybrid, 32).",
        show_default=False,
    ),
]
Seed = Annotated[
    int | None,
    typer.Option(
        min=0,
        max=2**64 - 1,
        metavar="N",
        help="Of the random numbers of monte_carlo and hybrid: the same gives the same result. Default: 0.",
        show_default=False,
    ),
]
Grid = Annotated[
    tuple | None,
    typer.Option(
        parser=grid,
        metavar="HxW",
        help="Projector pixels, height x width, where the file does not tell.",
        show_default=False,
    ),
]
CameraGrid = Annotated[
    tuple | None,
    typer.Option(
        parser=grid, metavar="HxW", help="Camera pixels, if not those of the projector.", show_default=False
    ),
]
FirstBounce = Annotated[
    Literal["diagonal", "exact", "estimate"] | None,
    typer.Option(
        help="Where the direct light comes from: the diagonal of T, or 1 / diag(T^-1), slower and free of "
        "returned light, by a dense inverse or estimated by products. Default: the file's, else diagonal.",
        show_default=False,
    ),
]
OnDark = Annotated[
    Literal["auto", "raise", "mask"],
    typer.Option(
        help="Projector pixels without direct light: refuse, or leave unlit; auto: refuse, but leave "
        "unlit with a transport of 'ltcl acquire', which knows what the camera does not see."
    ),
]
Resize = Annotated[
    bool,
    typer.Option("--resize", help="Scale pictures of another size to the grid, without keeping proportions."),
]
Encoding = Annotated[
    Literal["auto", "srgb", "linear"],
    typer.Option(help="What picture files hold; auto: integers sRGB, floats linear."),
]
