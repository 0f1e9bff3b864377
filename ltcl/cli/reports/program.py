# SPDX-License-Identifier: BSD-3-Clause
"""Reports of `ltcl devices`, `doctor`, `demo`, `view`, `play` and `show`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from ltcl.cli.reports.parts import (
    ChannelSolves,
    Clipped,
    Device,
    Files,
    FolderReport,
    Gain,
    ProjectorGrid,
    Solve,
    Versions,
)
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
    checks: Annotated[list[Check], "All checks, in their order."]


@dataclass(kw_only=True)
class DemoScene(Report):
    """The room corner."""

    grid: ProjectorGrid
    pixels: Annotated[int, "Number of pixels."]
    albedo: Annotated[dict[str, list[float]], "RGB, by wall."]


@dataclass(kw_only=True)
class ColourRadii(Report):
    """Spectral radius of R in each colour."""

    red: Annotated[float, "Spectral radius in red."]
    green: Annotated[float, "Spectral radius in green."]
    blue: Annotated[float, "Spectral radius in blue."]


@dataclass(kw_only=True)
class DemoTarget(Report):
    """The desired picture."""

    mist: Annotated[float, "Share of mist in the picture."]


@dataclass(kw_only=True)
class DemoErrors(Report):
    """Relative errors of the picture that a viewer sees."""

    uncompensated: Annotated[float, "Picture projected as it is."]
    colours_only: Annotated[float, "Wall colours undone, bounces left."]
    compensated: Annotated[float, "With compensation."]


@dataclass(kw_only=True)
class DemoCompensation(Report):
    """The pattern."""

    gain: Gain
    clipped: Clipped
    channels: ChannelSolves


@dataclass(kw_only=True)
class DemoBounce(Report):
    """A bounce."""

    bounce: Annotated[int, "Its number; 0: direct light."]
    share: Annotated[float, "Share of all light."]
    error: Annotated[float, "Relative error by form factors."]


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
    spectral_radius: Annotated[ColourRadii, "Spectral radii of R."]
    analysis: AnalysisReport
    target: Annotated[DemoTarget, "The desired picture."]
    errors: Annotated[DemoErrors, "Errors of what a viewer sees."]
    exposure_of_views: Annotated[
        dict[str, float], "Factor from a linear picture to its .png, by view."
    ]
    compensation: Annotated[DemoCompensation, "The pattern."]
    bounces: Annotated[list[DemoBounce], "Direct light, bounces 1 to 4."]
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
    shown: Annotated[int | None, "Number of shown frames."] = None
    dropped: Annotated[int | None, "Number of late frames."] = None
    gain: Annotated[float | None, "Gain of all frames."] = None
    frames_per_second: Annotated[float | None, "Pace."] = None
    latency: Annotated[float | None, "Median seconds from a frame's due time to its drawing."] = (
        None
    )
    computing_p50: Annotated[float | None, "Median seconds of computing a frame."] = None
    computing_p99: Annotated[
        float | None, "Seconds of computing that 99 % of frames stay below."
    ] = None


@dataclass(kw_only=True)
class ShowReport(FolderReport):
    """`ltcl show`."""

    shown: Annotated[int, "Number of patterns that were shown."]
