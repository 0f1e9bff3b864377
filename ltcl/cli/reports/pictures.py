# SPDX-License-Identifier: BSD-3-Clause
"""Reports of `ltcl compensate`, `film`, `separate` and `relight`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from ltcl.cli.reports.parts import (
    ChannelSolves,
    Clipped,
    Files,
    FolderReport,
    Gain,
    Heading,
    PictureFiles,
    PictureWithStd,
    SceneError,
    Solve,
    TransportError,
)
from ltcl.cli.reports.report import Report

PatternCodes = Annotated[
    Literal["sRGB", "codes of the measured projector"],
    "Encoding of a pattern's .png.",
]
Exposure = Annotated[float, "Factor from a linear picture to its .png."]


@dataclass(kw_only=True)
class CompensatedPicture(Report):
    """A picture with its pattern."""

    file: Annotated[Path, "Input file."]
    gain: Gain
    clipped: Clipped
    error: Annotated[
        float,
        "Relative error of what the scene will show; masked pixels do not "
        "count, unless `--weights` weigh them.",
    ]
    transport_error: TransportError
    gap: Annotated[float, "Bound on the error beyond the least one."]
    too_dark: Annotated[float, "Share of the picture that stays too dark."]
    too_bright: Annotated[float, "Share of the picture that stays too bright."]
    channels: ChannelSolves
    limited: Annotated[list[Solve], "Solves within bounds, if needed."]
    pattern: Annotated[PictureWithStd, "The pattern."]
    appearance: Annotated[PictureWithStd, "What the scene will show, at `exposure` / `gain`."]
    out_of_reach: Annotated[PictureFiles, "Picture less `appearance`."]


@dataclass(kw_only=True)
class CompensateReport(Heading, FolderReport):
    """`ltcl compensate` with one transport; also written as compensate.json, without `folder`."""

    pattern_png: PatternCodes
    exposure: Exposure
    pictures: Annotated[list[CompensatedPicture], "One for each input."]
    files: Files = field(default_factory=list)


@dataclass(kw_only=True)
class ScenesReport(FolderReport):
    """`ltcl compensate --transports`."""

    scenes: Annotated[list[CompensateReport], "One for each transport, ordered by name."]


@dataclass(kw_only=True)
class FrameReport(Report):
    """A frame of a film."""

    number: Annotated[int, "Number of the frame, from 1."]
    name: Annotated[str, "Name of its file, or of the film."]
    digest: Annotated[str, "SHA-256 of the data that was read."]
    output_digest: Annotated[str, "SHA-256 of the files that were written."]
    error: SceneError
    clipped: Clipped


@dataclass(kw_only=True)
class FilmReport(Heading, FolderReport):
    """`ltcl film`. The list of frames is also written as frames.json."""

    pattern_png: PatternCodes
    source: Annotated[Path, "The folder or the video."]
    video: Annotated[Path | None, "Video of the patterns."]
    gain: Annotated[float, "Gain of all frames."]
    solved: Annotated[int, "Number of frames that this run solved."]
    seconds: Annotated[float, "Duration of this run."]
    frames_per_second: Annotated[float, "Pace; null if no frame was solved."]
    transport_error: TransportError
    worst: Annotated[FrameReport, "Frame with the largest error."]
    most_clipped: Annotated[FrameReport, "Frame with most clipping."]
    frames: Annotated[list[FrameReport], "All frames, in order."]


@dataclass(kw_only=True)
class LightPart(PictureFiles):
    """A part of the light."""

    part: Annotated[str, "Name of the part."]
    lowest: Annotated[float, "Lowest value; noise may be below 0."]
    share: Annotated[float | None, "Share of all light."]
    channels: ChannelSolves
    std: Annotated[PictureFiles | None, "Deviations by the noise of T."] = None


@dataclass(kw_only=True)
class SeparatedPicture(Report):
    """A picture and its parts."""

    file: Annotated[Path, "Input file."]
    transport_error: TransportError
    warning: Annotated[str, "What T leaves unknown of the bounces."]
    parts: Annotated[list[LightPart], "Direct light, bounces and the rest."]


@dataclass(kw_only=True)
class SeparateReport(Heading, FolderReport):
    """`ltcl separate`; also written as separate.json, without `folder`."""

    exposure: Exposure
    pictures: Annotated[list[SeparatedPicture], "One for each input."]
    files: Files = field(default_factory=list)


@dataclass(kw_only=True)
class RelitPicture(PictureFiles):
    """A picture under a pattern."""

    file: Annotated[Path, "File of the pattern."]
    brightest: Annotated[float, "Largest value of the picture."]


@dataclass(kw_only=True)
class RelightReport(Heading, FolderReport):
    """`ltcl relight`; also written as relight.json, without `folder`."""

    exposure: Exposure
    pictures: Annotated[list[RelitPicture], "One for each pattern."]
    files: Files = field(default_factory=list)
