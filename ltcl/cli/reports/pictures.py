# SPDX-License-Identifier: BSD-3-Clause
"""Reports of `ltcl compensate`, `film`, `separate` and `relight`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from ltcl.cli.reports.parts import (
    Files,
    FolderReport,
    Heading,
    PictureFiles,
    PictureWithStd,
    Solve,
)
from ltcl.cli.reports.report import Report

PatternCodes = Annotated[
    Literal["sRGB", "codes of the measured projector"], "Encoding of a pattern's .png."
]
Exposure = Annotated[
    float, "Factor between the linear picture and the picture in a .png for viewing."
]


@dataclass(kw_only=True)
class CompensatedPicture(Report):
    """A picture with its pattern."""

    file: Annotated[Path, "Input file."]
    gain: Annotated[float, "Factor between the picture and what the scene shows."]
    clipped: Annotated[float, "Share of the pattern at a bound."]
    error: Annotated[
        float,
        "Relative error of what the scene will show; masked pixels do not count, unless "
        "`--weights` weigh them.",
    ]
    transport_error: Annotated[
        float, "Relative error of T itself by compression, which `error` does not contain."
    ]
    gap: Annotated[float, "Bound on the distance of the error from the least possible one."]
    too_dark: Annotated[float, "Share of the picture that stays too dark."]
    too_bright: Annotated[float, "Share of the picture that stays too bright."]
    channels: Annotated[list[Solve], "Solves without bounds, one for each colour channel."]
    limited: Annotated[list[Solve], "Solves within the projector's range, if these were needed."]
    pattern: Annotated[PictureWithStd, "The pattern."]
    appearance: Annotated[
        PictureWithStd, "Picture that the scene will show, at `exposure` / `gain`."
    ]
    out_of_reach: Annotated[PictureFiles, "The picture less what the scene will show."]


@dataclass(kw_only=True)
class CompensateReport(Heading, FolderReport):
    """`ltcl compensate` with one transport; also written as compensate.json, without `folder`."""

    pattern_png: PatternCodes
    exposure: Exposure
    pictures: Annotated[list[CompensatedPicture], "One entry for each input, in their order."]
    files: Files = field(default_factory=list)


@dataclass(kw_only=True)
class ScenesReport(FolderReport):
    """`ltcl compensate --transports`."""

    scenes: Annotated[
        list[CompensateReport], "One entry for each transport, in the order of their names."
    ]


@dataclass(kw_only=True)
class FrameReport(Report):
    """A frame of a film."""

    number: Annotated[int, "Number of the frame, from 1."]
    name: Annotated[str, "Name of its file, or of the film."]
    digest: Annotated[str, "SHA-256 of the data that was read."]
    error: Annotated[float, "Relative error of what the scene will show."]
    clipped: Annotated[float, "Share of the pattern at a bound."]


@dataclass(kw_only=True)
class FilmReport(Heading, FolderReport):
    """`ltcl film`. The list of frames is also written as frames.json."""

    pattern_png: PatternCodes
    source: Annotated[Path, "The folder or the video."]
    video: Annotated[Path | None, "Video of the patterns, if one was requested."]
    gain: Annotated[float, "Gain of all frames."]
    solved: Annotated[int, "Frames of this run; the others were there already."]
    seconds: Annotated[float, "Duration of this run."]
    frames_per_second: Annotated[float, "Pace of this run; null if it solved no frame."]
    transport_error: Annotated[float, "Relative error of T itself by compression."]
    worst: Annotated[FrameReport, "Frame with the largest error."]
    most_clipped: Annotated[FrameReport, "Frame with the largest clipped share."]
    frames: Annotated[list[FrameReport], "All frames, in order."]


@dataclass(kw_only=True)
class LightPart(PictureFiles):
    """A part of the light."""

    part: Annotated[str, "Name of the part."]
    lowest: Annotated[float, "Lowest value, which noise may bring below 0."]
    share: Annotated[float | None, "Share of the light of the whole picture."]
    channels: Annotated[list[Solve], "Solves, one for each colour channel."]
    std: Annotated[
        PictureFiles | None, "Standard deviations by the noise of T, if that is known."
    ] = None


@dataclass(kw_only=True)
class SeparatedPicture(Report):
    """A picture and its parts."""

    file: Annotated[Path, "Input file."]
    transport_error: Annotated[float, "Relative error of T itself by compression."]
    warning: Annotated[str, "What is unknown of these bounces, and signs that T is wrong."]
    parts: Annotated[list[LightPart], "`direct`, `indirect`, `bounce_1`, ... and `rest`."]


@dataclass(kw_only=True)
class SeparateReport(Heading, FolderReport):
    """`ltcl separate`; also written as separate.json, without `folder`."""

    exposure: Exposure
    pictures: Annotated[list[SeparatedPicture], "One entry for each input, in their order."]
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
    pictures: Annotated[list[RelitPicture], "One entry for each pattern, in their order."]
    files: Files = field(default_factory=list)
