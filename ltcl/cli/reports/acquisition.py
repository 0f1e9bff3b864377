# SPDX-License-Identifier: BSD-3-Clause
"""Reports of `ltcl simulate` and `ltcl acquire`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from ltcl.cli.reports.parts import (
    Channels,
    Files,
    FolderReport,
    Options,
    ProjectorGrid,
    VerdictReport,
    Versions,
)
from ltcl.cli.reports.report import Report

RigKind = Annotated[Literal["virtual", "mitsuba", "folder", "live"], "Kind of the rig."]
Strategy = Annotated[
    Literal["sketch", "adaptive", "direct", "pixel", "block", "hadamard"],
    "Strategy of the scan.",
]
Exposures = Annotated[list[float], "Seconds of the photographs of a pattern."]


@dataclass(kw_only=True)
class SimulateReport(FolderReport):
    """`ltcl simulate`; also written as simulate.json, without `folder`."""

    command: Annotated[str, "Name of the command."]
    versions: Versions
    scene: Annotated[str, "Requested scene."]
    options: Options
    projector_grid: ProjectorGrid
    channels: Channels
    files: Files = field(default_factory=list)


@dataclass(kw_only=True)
class CameraNoise(Report):
    """Noise of the camera."""

    electrons: Annotated[float, "Electrons at full scale, or null."]
    read: Annotated[float, "Noise without light, in units of full scale."]
    black: Annotated[float, "Value without light."]
    saturation: Annotated[float, "Largest valid value."]
    levels: Annotated[int, "Number of codes of the camera; 0: floats."]


@dataclass(kw_only=True)
class ScanLight(Report):
    """Light in sensor values a second."""

    direct: Annotated[float, "Light where a projector pixel arrives."]
    indirect: Annotated[float, "Light of all other projector pixels."]
    ambient: Annotated[float, "Light without the projector."]


@dataclass(kw_only=True)
class StrategyPlan(Report):
    """Cost and accuracy of a strategy."""

    strategy: Annotated[str, "Name of the strategy."]
    grid: Annotated[tuple[int, int], "Pixels of T: height, width."]
    patterns: Annotated[int, "Number of patterns."]
    calibration: Annotated[int, "Photographs of the calibration."]
    photographs: Annotated[int, "All photographs."]
    seconds: Annotated[float, "Duration of all photographs."]
    disk: Annotated[int, "Bytes on disk at most."]
    error: Annotated[float, "Forecast of the relative error of T p."]
    computing: Annotated[
        float | None, "Seconds of computing; null if the size of the camera is not known."
    ] = None


@dataclass(kw_only=True)
class PlanReport(FolderReport):
    """`ltcl acquire plan`."""

    rig: RigKind
    measured: Annotated[bool, "Noise and light were measured, not guessed."]
    asked_for: Annotated[str, "Strategy in acquisition.toml."]
    auto: Annotated[str, "Strategy that `auto` uses."]
    why: Annotated[str, "Reason for that strategy."]
    exposures: Exposures
    noise: Annotated[CameraNoise, "Noise of the camera."]
    light: Annotated[ScanLight, "Light in sensor values a second."]
    channels: Channels
    megapixels: Annotated[float | None, "Pixels of the camera in millions; null if not known."]
    pace: Annotated[float, "Seconds of computing for each photograph and megapixel, as measured."]
    rounds: Annotated[int, "Rounds at most that a sketch takes beyond its plan, as asked for."]
    photographs_of_round: Annotated[int, "Photographs of each of these rounds, at most."]
    plans: Annotated[
        dict[str, StrategyPlan],
        "Plans by strategy, as `ltcl.acquisition.scanning.Plan`.",
    ]


@dataclass(kw_only=True)
class ScanReport(FolderReport):
    """`ltcl acquire report`: the attributes of `ltcl.acquisition.Report`."""

    store: Annotated[Path, "Folder of the transport."]
    strategy: Strategy
    why: Annotated[str, "Reason for the strategy."]
    grid: ProjectorGrid
    channels: Channels
    patterns: Annotated[int, "Number of patterns of the scan."]
    photographs: Annotated[int, "Photographs without the calibration."]
    exposures: Exposures
    coverage: Annotated[float, "Share of projector pixels that are seen."]
    doubtful: Annotated[float, "Share of these that are masked: too dark next to bright ones."]
    sharpness: Annotated[float, "Share of a pixel's own light; null for an aligned camera."]
    blur: Annotated[float, "Relative error of fine detail; null for an aligned camera."]
    masked: Annotated[float, "Share of pixels without a first bounce."]
    saturated: Annotated[float, "Share of camera pixels saturated in all exposures of white."]
    entries: Annotated[int, "Number of stored entries."]
    unknown: Annotated[float, "Share of entries never well exposed; they are 0."]
    noise_direct: Annotated[float, "Median relative noise of the first bounce."]
    noise_sum: Annotated[float, "Median relative noise of row sums."]
    sum_deviation: Annotated[
        float | None, "Deviation of column sums from white; null for scans that take no columns."
    ]
    judged_error: Annotated[
        float | None,
        "Relative error for pictures that a sketch, or a scan of direct light, was not fitted to: "
        "of T p, or of the direct light; else null.",
    ]
    judged_bound: Annotated[
        float | None, "That of other pictures is below, with a probability of 95 %; else null."
    ]
    left_out: Annotated[
        float | None,
        "Indirect light that a scan of direct light left out, relative to all light of the median "
        "pixel under white; null for other scans.",
    ]
    wrong_patterns: Annotated[
        list[int], "Patterns of a sketch, from 1 on, whose pictures contradict all others."
    ]
    verdict: VerdictReport
    error: Annotated[list[float] | None, "Relative error of T p by channel; virtual rigs only."] = (
        None
    )


@dataclass(kw_only=True)
class PlansReport(FolderReport):
    """`ltcl acquire plan` of several projectors."""

    projectors: Annotated[dict[str, PlanReport], "Plans by the name of the projector."]


@dataclass(kw_only=True)
class ScansReport(FolderReport):
    """`ltcl acquire report` of several projectors."""

    projectors: Annotated[dict[str, ScanReport], "Reports by the name of the projector."]


@dataclass(kw_only=True)
class ProjectorsReport(FolderReport):
    """`ltcl acquire run` of several projectors, when all are scanned."""

    projectors: Annotated[list[str], "Names of the projectors, in the order of their scans."]
    stores: Annotated[list[Path], "Folders of their transports."]
    movements: Annotated[
        dict[str, float],
        "Movement of the camera in its pixels before the scan of that name, and at the end.",
    ]


@dataclass(kw_only=True)
class NextPhotograph(Report):
    """The photograph to take."""

    number: Annotated[int, "Number of the photograph."]
    pattern: Annotated[str, "File of the pattern to show, in `folder`."]
    seconds: Annotated[float, "Exposure in seconds."]
    save_as: Annotated[str, "Name without extension, in `folder`."]


@dataclass(kw_only=True)
class PhotographMissing(FolderReport):
    """`ltcl acquire run` or `update` that waits for photographs; the exit code is 3."""

    next: Annotated[NextPhotograph, "The photograph to take."]
    missing: Annotated[list[int], "Numbers of all missing photographs."]
    exit_code: Annotated[Literal[3], "3."] = 3


@dataclass(kw_only=True)
class UpdateReport(FolderReport):
    """`ltcl acquire update`: the attributes of `ltcl.acquisition.Update`."""

    store: Annotated[Path, "Folder of the new transport."]
    scan: Annotated[Path, "Folder of the old one, which is as before."]
    grid: ProjectorGrid
    channels: Channels
    photographs: Annotated[int, "Number of photographs."]
    shift: Annotated[
        tuple[float, float], "Rows and columns by which the picture has moved, in its middle."
    ]
    largest: Annotated[float, "Largest movement of a pixel, in projector pixels."]
    gain: Annotated[list[float], "Light of the lamp by channel, relative to that in the scan."]
    masked: Annotated[int, "Pixels beyond the old picture, or not seen."]
    measured_again: Annotated[int, "Pixels that failed at first, and were measured again."]
    error: Annotated[float, "Relative error of T p for pictures that it was not fitted to."]
    bound: Annotated[float, "That of other pictures is below, with a probability of 95 %."]
    previous_error: Annotated[
        float | None, "Error of the scan for the same pictures; null if they did not judge it."
    ]
    holds: Annotated[bool, "False: a new scan is needed."]
    failing: Annotated[float, "Share of the picture that fails."]
    judgement: Annotated[str, "The same in words, with the place that fails."]


@dataclass(kw_only=True)
class FitReport(FolderReport):
    """`ltcl acquire fit`: the attributes of `ltcl.acquisition.Fit`."""

    out: Annotated[Path, "File of the transport."]
    grid: ProjectorGrid
    channels: Channels
    pairs: Annotated[int, "Number of pairs."]
    held_out: Annotated[int, "Number of pairs that judged the fit."]
    error: Annotated[float, "Relative error of T p for these, root mean square."]
    worst: Annotated[float, "The largest of their errors."]
    drift: Annotated[float, "Change of brightness over all pairs, which was corrected."]
    noise: Annotated[float, "What T leaves of a photograph, relative to the light of a pixel."]


@dataclass(kw_only=True)
class ImportReport(FolderReport):
    """`ltcl acquire import`."""

    photographs: Annotated[int, "Number of photographs."]
    grid: ProjectorGrid
    camera_grid: Annotated[tuple[int, int], "Height and width of the photographs."]
    decoded: Annotated[float, "Share of the camera's pixels in the map."]
    seen: Annotated[float, "Share of the projector's pixels that the camera sees."]
    saturated: Annotated[
        float | None, "Share of the lit camera pixels that are saturated; null without white."
    ]
    indirect: Annotated[
        float | None,
        "Share of the light of white that is not direct, at the median pixel; null without white.",
    ]
    files: Files


@dataclass(kw_only=True)
class AimReport(Report):
    """`ltcl acquire aim`: the last look; without one only `folder` and `looks`."""

    folder: Annotated[Path, "Folder of the acquisition."]
    looks: Annotated[int, "Number of looks."] = 0
    seconds: Annotated[float | None, "Exposure; left out if it is not known."] = None
    brightness: Annotated[float | None, "Code of the brightest lit pixels, of full scale."] = None
    saturated: Annotated[float | None, "Share of the lit area that is saturated."] = None
    lit: Annotated[float | None, "Share of the photograph that the projector lights."] = None
    focus: Annotated[
        float | None, "Contrast of stripes of 2 projector pixels; left out of a single photograph."
    ] = None
    sharpness: Annotated[
        float | None, "Mean difference of lit pixels from their neighbours, relative."
    ] = None
    advice: Annotated[list[str], "What should be better."] = field(default_factory=list)
