# SPDX-License-Identifier: BSD-3-Clause
"""`ltcl play --pipe`: raw video from stdin, its codes to stdout, and all that is said to stderr."""

from __future__ import annotations

import contextlib
import math
import sys
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from ltcl.cli.command import Answer, Context, note
from ltcl.cli.options import option
from ltcl.cli.reports.program import PlayReport
from ltcl.errors import InputError

pipe_option = partial(option, panel="Raw video through pipes")


def pipe_options(
    pipe: Annotated[
        bool,
        pipe_option(
            "Read raw video from stdin, for which FILM is -, and write codes of the projector as "
            "raw video to stdout.",
            "--pipe",
        ),
    ] = False,
    video_size: Annotated[
        str | None,
        pipe_option(
            "Width and height of the video on stdin, as for FFmpeg. Default: the camera's grid.",
            metavar="WxH",
        ),
    ] = None,
    pixel_format: Annotated[
        Literal["rgb24", "rgb48le", "gbrpf32le"],
        pipe_option("Pixel format of both videos, as for FFmpeg."),
    ] = "rgb24",
    framerate: Annotated[
        float, pipe_option("Frames per second, as for FFmpeg.", metavar="FPS", min=0.001)
    ] = 25.0,
    encoding: Annotated[
        Literal["auto", "srgb", "linear"],
        pipe_option(
            "Encoding of the video on stdin; auto: rgb24 and rgb48le are sRGB, floats linear."
        ),
    ] = "auto",
    late: Annotated[
        Literal["wait", "drop"],
        pipe_option(
            "When frames come faster than they are computed or read: let the program before wait, "
            "or write the codes of an earlier frame once more."
        ),
    ] = "wait",
) -> None:
    """Options of `ltcl play --pipe`."""


def check(context: Context, gain: Any) -> None:
    """Refuse options that do not go with a pipe, before the transport is read."""
    from ltcl.show.pipes import parse_video_size

    if context.json:
        raise InputError("--json is given, but with --pipe stdout is video; leave it out")
    if gain == "auto":
        raise InputError(
            "--gain is auto, but the frames of a pipe are not known before; it must be a number "
            "or follow"
        )
    if context.options["video_size"] is not None:
        parse_video_size(context.options["video_size"])
    if sys.stdin is None:
        raise InputError("stdin is closed; with --pipe it must be a pipe or a file")
    if sys.stdout is None or sys.stdout.isatty():
        raise InputError("stdout is a terminal; with --pipe it must be a pipe or a file")


def run(context: Context, scene: Any, gain: Any, resize: str, settings: dict[str, Any]) -> Answer:
    """Compensate raw video for the T of `scene`, until stdin or stdout ends."""
    from ltcl.show import pipes
    from ltcl.show.projection import Projection

    source = _source(context, scene.T.camera_grid)
    if gain is None:
        # That of several projectors is between the camera's pixels.
        can_follow = scene.setup is not None and scene.T.scene.is_square
        gain = "follow" if can_follow else 1.0
    encoding = context.options["encoding"]
    if encoding == "auto":
        encoding = "linear" if source.dtype.kind == "f" else "srgb"
    projection = Projection(
        scene,
        gain,
        fps=source.fps,
        resize=resize,
        decode=encoding,
        encode=encoding,
        dtype=source.dtype.name,
        **settings,
    )
    with (
        open(sys.stdin.fileno(), "rb", buffering=0, closefd=False) as stdin,
        open(sys.stdout.fileno(), "wb", buffering=0, closefd=False) as stdout,
        contextlib.suppress(KeyboardInterrupt),
    ):
        note(f"stdout is {pipes.projected_video(projection, source).options}")
        late = context.options["late"]
        result = pipes.pipe(projection, source, stdin, stdout, late=late, progress=context.progress)
        note(describe_pipe(result, projection.statistics.latency_p99))
    return Answer(PlayReport(film=Path("-")), [])


def _source(context: Context, camera_grid: tuple[int, int]) -> Any:
    """Size and pixel format of the video on stdin."""
    from ltcl.show import pipes

    height, width = camera_grid
    if context.options["video_size"] is not None:
        width, height = pipes.parse_video_size(context.options["video_size"])
    return pipes.RawVideo(
        width=width,
        height=height,
        pixel_format=context.options["pixel_format"],
        fps=context.options["framerate"],
    )


def describe_pipe(result: Any, computing: float) -> str:
    """Return a line on what went through."""
    line = (
        f"{result.written} frames written, {result.frames_per_second:.1f} a second, "
        f"{result.dropped} of them repeated"
    )
    if not math.isnan(computing):
        # Without a frame there is no time.
        line += f"; 99 % computed within {1e3 * computing:.1f} ms"
    if result.is_cut_off:
        line += "; nobody reads stdout any more"
    return line
