# SPDX-License-Identifier: BSD-3-Clause
"""Reports of `ltcl devices`, `doctor`, `demo`, `view`, `play` and `show`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from ltcl.cli.reports.parts import Device, Files, FolderReport, Solve, Versions
from ltcl.cli.reports.report import Report
from ltcl.cli.reports.transports import AnalysisReport


@dataclass(kw_only=True)
class ListedDevice(Device):
    """An OpenCL device of this machine."""

    compute_units: Annotated[int, "Number of compute units."]
    memory: Annotated[int, "Bytes of memory."]
    max_allocation: Annotated[int, "Bytes of the largest buffer."]
    chosen: Annotated[bool, "Whether ltcl would use this device."]


@dataclass(kw_only=True)
class Check(Report):
    """A check of the installation."""

    check: Annotated[str, "Name of the check."]
    passed: Annotated[bool, "Whether the check passed."]
    found: Annotated[str, "Result of the check, or its error."]
    fix: Annotated[str, "Remedy; empty if the check passed."]


@dataclass(kw_only=True)
class DoctorReport(Report):
    """`ltcl doctor`; the exit code is 1 if a check fails."""

    passed: Annotated[bool, "Whether all checks passed."]
    checks: Annotated[list[Check], "All checks, in the order in which they ran."]


@dataclass(kw_only=True)
class DemoScene(Report):
    """The room corner."""

    grid: Annotated[tuple[int, int], "Projector pixels: height, width."]
    pixels: Annotated[int, "Number of pixels."]
    albedo: Annotated[dict[str, list[float]], "Red, green and blue, by wall."]


@dataclass(kw_only=True)
class ColourRadii(Report):
    """Spectral radius of R in each colour."""

    red: Annotated[float, "Spectral radius in red."]
    green: Annotated[float, "Spectral radius in green."]
    blue: Annotated[float, "Spectral radius in blue."]


@dataclass(kw_only=True)
class DemoTarget(Report):
    """The desired picture."""

    mist: Annotated[float, "Share of the mist that brings the picture within reach."]


@dataclass(kw_only=True)
class DemoErrors(Report):
    """Relative errors of the picture that a viewer sees."""

    uncompensated: Annotated[float, "Error of the picture projected as it is."]
    colours_only: Annotated[float, "Error with wall colours undone and bounces left."]
    compensated: Annotated[float, "Error with compensation."]


@dataclass(kw_only=True)
class DemoCompensation(Report):
    """The pattern."""

    gain: Annotated[float, "Factor between the picture and what the scene shows."]
    clipped: Annotated[float, "Share of the pattern at a bound."]
    channels: Annotated[list[Solve], "Solves, one for each colour channel."]


@dataclass(kw_only=True)
class DemoBounce(Report):
    """A bounce."""

    bounce: Annotated[int, "Number of the bounce; 0 is the direct light."]
    share: Annotated[float, "Share of all light."]
    error: Annotated[float, "Relative error against the scene's form factors."]


@dataclass(kw_only=True)
class DemoConvergence(Report):
    """Comparison of the methods."""

    channel: Annotated[str, "Colour channel."]
    methods: Annotated[list[Solve], "One solve for each method."]


@dataclass(kw_only=True)
class DemoReport(FolderReport):
    """`ltcl demo`; also written as report.json, without `folder` and `files`."""

    files: Files
    versions: Versions
    device: Device
    scene: Annotated[DemoScene, "The room corner."]
    spectral_radius: Annotated[ColourRadii, "Spectral radius of R in each colour."]
    analysis: AnalysisReport
    target: Annotated[DemoTarget, "The desired picture."]
    errors: Annotated[DemoErrors, "Relative errors of the picture that a viewer sees."]
    exposure_of_views: Annotated[
        dict[str, float], "Factor between the linear picture and its .png, by view."
    ]
    compensation: Annotated[DemoCompensation, "The pattern."]
    bounces: Annotated[list[DemoBounce], "Direct light, and bounces 1 to 4."]
    convergence: Annotated[DemoConvergence, "Comparison of the methods."]
    seconds: Annotated[dict[str, float], "Duration, by step."]


@dataclass(kw_only=True)
class ViewReport(Report):
    """`ltcl view`, after Ctrl-C ended it with exit code 0. stderr has the URL from the start."""

    url: Annotated[str, "Address of the page."]


@dataclass(kw_only=True)
class PlayReport(Report):
    """`ltcl play`; all fields but `film` are there only if the film came to its end."""

    film: Annotated[Path, "The folder or the video."]
    shown: Annotated[int | None, "Number of frames that were shown."] = None
    dropped: Annotated[int | None, "Number of frames that would have been late."] = None
    gain: Annotated[float | None, "Gain of all frames."] = None
    frames_per_second: Annotated[float | None, "Pace of the frames that were shown."] = None
    latency: Annotated[
        float | None, "Median of the seconds between the due time of a frame and its drawing."
    ] = None


@dataclass(kw_only=True)
class ShowReport(FolderReport):
    """`ltcl show`."""

    shown: Annotated[int, "Number of patterns that were shown."]
