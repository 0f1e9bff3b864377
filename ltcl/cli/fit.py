# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl acquire fit`: a transport from pictures and their photographs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from ltcl import store
from ltcl.cli import options
from ltcl.cli.command import Answer, Context, command
from ltcl.cli.options import argument, file_option, option, out_option
from ltcl.cli.reports.acquisition import FitReport
from ltcl.cli.reports.parts import Channels
from ltcl.cli.tables import percent
from ltcl.errors import FileError, InputError
from ltcl.store import formats

# Camera pixels to a side of a projector pixel, beyond which photographs show nothing more.
MAX_CAMERA_PIXELS = 4
# Light below a photograph of black, to that above it, at most: more is not noise.
MAX_NEGATIVE_SHARE = 0.2

PairsFolder = Annotated[
    Path, argument("FOLDER", "Folder with patterns and photographs: folders of pictures, or films.")
]
FitGeometry = Annotated[
    Literal["aligned", "pairs"],
    option(
        "Direction of the camera; aligned: at the projector's pixels, pairs: found from the pairs."
    ),
]
# Not a tuple: typer would ask for two words.
FitGrid = Annotated[
    Any,
    option(
        "Pixels of T, to which patterns are averaged. Default: those of the patterns.",
        parser=options.parse_grid,
        metavar="HxW",
    ),
]
Black = Annotated[
    Path | None,
    file_option("Photograph of black, with the ambient light, which is taken off all others."),
]


@command(options.encoding_options)
def fit(
    context: Context,
    folder: PairsFolder,
    out: Annotated[
        Path | None, out_option("The transport: .npz or .zarr. Default: FOLDER/transport.npz.")
    ] = None,
    geometry: FitGeometry = "aligned",
    grid: FitGrid = None,
    black: Black = None,
    device: options.DeviceName = None,
) -> Answer:
    """Find the transport that turned pictures into their photographs.

    FOLDER has patterns and photographs, in the same order: two folders of pictures, or two films,
    such as patterns.mkv and photographs.mp4. Any 50 to 500 different pictures do. A fifth of them
    is held out, and the error of T for them is shown.
    """
    from ltcl import acquisition

    target = folder / "transport.npz" if out is None else out
    formats.find(target)
    patterns = _read_frames(context, _find_frames(folder, "patterns"), grid, averages=True)
    size = patterns.shape[1:3]
    path = _find_frames(folder, "photographs")
    if geometry == "pairs":
        photographs = _read_frames(context, path, None, MAX_CAMERA_PIXELS * max(size))
    else:
        photographs = _read_frames(context, path, grid)
    if black is not None:
        photographs = photographs - _read_black(context, black, path, photographs)
    result = acquisition.fit(
        patterns, photographs, geometry=geometry, device=device, progress=context.progress
    )
    store.save(target, result.transport)
    report = FitReport(
        folder=folder,
        out=target,
        grid=result.transport.grid,
        channels=_channels(result),
        pairs=len(result.pairs),
        held_out=len(result.held_out),
        error=result.error,
        worst=float(result.errors.max()),
        drift=result.drift,
        noise=result.noise,
    )
    return Answer(report, _lines(report))


def _channels(result: Any) -> Channels:
    return result.transport.channels


def _lines(report: FitReport) -> list[str]:
    height, width = report.grid
    return [
        f"{report.out}: {height} x {width} pixels, from {report.pairs} pairs",
        f"error of T p {percent(report.error, 2)}, at most {percent(report.worst, 2)}: for "
        f"{report.held_out} pairs that were held out",
        f"brightness changed by {percent(report.drift, 1)}; "
        f"T leaves {percent(report.noise, 2)} of the light of a pixel",
    ]


def _find_frames(folder: Path, name: str) -> Path:
    """The folder of pictures, or the film, of this name."""
    from ltcl.images.frames import is_frames

    advice = f"it must have one folder of pictures, or one film, called {name}"
    frames = []
    for path in sorted(folder.glob(f"{name}*")):
        if path.stem == name and is_frames(path):
            frames.append(path)
    if not frames:
        raise FileError(f"{folder}: has no {name}; {advice}")
    if len(frames) > 1:
        names = " and ".join(path.name for path in frames)
        raise FileError(f"{folder}: has {names}; {advice}")
    return frames[0]


def _read_frames(
    context: Context,
    path: Path,
    grid: tuple[int, int] | None,
    most: int | None = None,
    *,
    averages: bool = False,
) -> np.ndarray:
    """All frames as linear light, (frames, h, w[, 3]), on a grid, or with `most` pixels a side.

    One that `averages` refuses a grid of more pixels than the frames have.
    """
    from ltcl import images
    from ltcl.images.frames import open_frames

    source = open_frames(path, encoding=context.options["encoding"])
    frames: list[Any] = []
    for frame in source:
        picture = frame.picture()
        size = picture.shape[:2]
        if most is not None and max(size) > most:
            scale = most / max(size)
            size = (max(round(size[0] * scale), 1), max(round(size[1] * scale), 1))
        if grid is not None:
            if averages and (grid[0] > size[0] or grid[1] > size[1]):
                raise InputError(
                    f"--grid is {grid[0]}x{grid[1]}, but {path} has {size[0]} x {size[1]} pixels; "
                    "it must be as many or fewer"
                )
            size = grid
        if size != picture.shape[:2]:
            picture = images.resize(picture, size)
        if frames and picture.shape[:2] != frames[0].shape[:2]:
            raise FileError(
                f"{path}: {frame.name} has {picture.shape[0]} x {picture.shape[1]} pixels, the "
                f"first {frames[0].shape[0]} x {frames[0].shape[1]}; all must be alike"
            )
        frames.append(picture)
        context.progress(path.name, frame.number, source.count)
    return _stack_frames(frames)


def _stack_frames(frames: list[np.ndarray]) -> np.ndarray:
    """Frames as one array; grey ones among coloured ones, such as black, get three channels."""
    has_colour = any(picture.ndim == 3 for picture in frames)
    stacked = []
    for picture in frames:
        if has_colour and picture.ndim == 2:
            picture = np.repeat(picture[..., None], 3, axis=2)
        stacked.append(picture)
    return np.stack(stacked)


def _read_black(context: Context, path: Path, source: Path, photographs: np.ndarray) -> np.ndarray:
    """The photograph of black, on the pixels and in the colours of those of `source`."""
    from ltcl import images
    from ltcl.images.frames import open_frames

    encoding = context.options["encoding"]
    picture = images.read(path, encoding=encoding)
    first = next(iter(open_frames(source, encoding=encoding))).picture()
    if picture.shape[:2] != first.shape[:2]:
        sizes = [f"{height} x {width}" for height, width in (picture.shape[:2], first.shape[:2])]
        raise InputError(
            f"{path}: has {sizes[0]} pixels, the photographs {sizes[1]}; it must be a photograph "
            "by the same camera"
        )
    picture = images.resize(picture, photographs.shape[1:3])
    if picture.ndim < photographs.ndim - 1:
        picture = picture[..., None]
    light = photographs.mean(axis=0) - picture
    negative = np.minimum(light, 0.0).sum()
    if -negative > MAX_NEGATIVE_SHARE * np.maximum(light, 0.0).sum():
        share = (light < 0.0).mean()
        raise InputError(
            f"{path}: is brighter than the mean photograph at {percent(share, 2)} of the pixels; "
            "it must be taken with the same exposure, while the projector shows black"
        )
    return picture
