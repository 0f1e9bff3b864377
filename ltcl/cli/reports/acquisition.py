# SPDX-License-Identifier: BSD-3-Clause
"""Reports of `ltcl simulate` and `ltcl acquire`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from ltcl.cli.reports.parts import Channels, Files, FolderReport, Options, VerdictReport, Versions
from ltcl.cli.reports.report import Report

RigKind = Annotated[Literal["virtual", "mitsuba", "folder", "live"], "Kind of the rig."]


@dataclass(kw_only=True)
class SimulateReport(FolderReport):
    """`ltcl simulate`; also written as simulate.json, without `folder`."""

    command: Annotated[str, "Name of the command."]
    versions: Versions
    scene: Annotated[str, "Requested scene."]
    options: Options
    projector_grid: Annotated[tuple[int, int], "Projector pixels: height, width."]
    channels: Annotated[Channels, "1, or 3 for red, green and blue."]
    files: Files = field(default_factory=list)


@dataclass(kw_only=True)
class CameraNoise(Report):
    """Noise of the camera."""

    electrons: Annotated[float, "Electrons at full scale; null: no photon noise."]
    read: Annotated[float, "Standard deviation without light, in units of full scale."]
    black: Annotated[float, "Value without light."]
    saturation: Annotated[float, "Largest valid value."]
    levels: Annotated[int, "Number of codes of the camera; 0: floats."]


@dataclass(kw_only=True)
class ScanLight(Report):
    """Light in sensor values a second."""

    direct: Annotated[float, "Light of a projector pixel where it arrives."]
    indirect: Annotated[float, "Light of all other projector pixels together."]
    ambient: Annotated[float, "Light without the projector."]


@dataclass(kw_only=True)
class StrategyPlan(Report):
    """Cost and accuracy of a strategy."""

    strategy: Annotated[str, "Name of the strategy."]
    grid: Annotated[tuple[int, int], "Pixels of T: height, width."]
    patterns: Annotated[int, "Number of patterns."]
    calibration: Annotated[int, "Number of photographs of the calibration."]
    photographs: Annotated[int, "Number of all photographs."]
    seconds: Annotated[float, "Duration of all photographs."]
    disk: Annotated[int, "Bytes on disk at most."]
    error: Annotated[float, "Relative error of T p by noise."]


@dataclass(kw_only=True)
class PlanReport(FolderReport):
    """`ltcl acquire plan`."""

    rig: RigKind
    measured: Annotated[bool, "Whether noise and light were measured; else they are guessed."]
    asked_for: Annotated[str, "Strategy in acquisition.toml."]
    auto: Annotated[str, "Strategy that `auto` uses."]
    why: Annotated[str, "Reason for that strategy."]
    exposures: Annotated[list[float], "Seconds of the photographs of each pattern."]
    noise: Annotated[CameraNoise, "Noise of the camera."]
    light: Annotated[ScanLight, "Light in sensor values a second."]
    channels: Annotated[Channels, "1, or 3 for red, green and blue."]
    plans: Annotated[
        dict[str, StrategyPlan],
        "Plans by strategy: the attributes of `ltcl.acquisition.scanning.Plan`.",
    ]


@dataclass(kw_only=True)
class ScanReport(FolderReport):
    """`ltcl acquire report`: the attributes of `ltcl.acquisition.Report`."""

    store: Annotated[Path, "Folder of the transport."]
    strategy: Annotated[Literal["adaptive", "pixel", "block", "hadamard"], "Strategy of the scan."]
    why: Annotated[str, "Reason for the strategy."]
    grid: Annotated[tuple[int, int], "Projector pixels of T: height, width."]
    channels: Annotated[Channels, "1, or 3 for red, green and blue."]
    patterns: Annotated[int, "Number of patterns of the scan."]
    photographs: Annotated[int, "Photographs of the scan, without those of the calibration."]
    exposures: Annotated[list[float], "Seconds of the photographs of each pattern."]
    coverage: Annotated[float, "Share of the projector's pixels that the camera sees."]
    doubtful: Annotated[
        float, "Share of these pixels that are too dark next to bright ones, and masked."
    ]
    sharpness: Annotated[
        float, "Share of the light at a pixel that is its own; null for an aligned camera."
    ]
    blur: Annotated[
        float, "Relative error of a picture of fine detail; null for an aligned camera."
    ]
    masked: Annotated[float, "Share of the projector's pixels without a first bounce."]
    saturated: Annotated[
        float, "Share of the camera's pixels that saturate in all exposures under white."
    ]
    entries: Annotated[int, "Number of stored entries of all channels."]
    unknown: Annotated[float, "Share of the entries without a valid photograph; they are 0."]
    noise_direct: Annotated[float, "Median relative standard deviation of the first bounce."]
    noise_sum: Annotated[float, "Median relative standard deviation of row sums."]
    sum_deviation: Annotated[
        float | None, "Relative deviation of column sums from white; null for an adaptive scan."
    ]
    verdict: VerdictReport
    error: Annotated[
        list[float] | None, "Relative error of T p by channel, for a virtual rig only."
    ] = None


@dataclass(kw_only=True)
class NextPhotograph(Report):
    """The photograph to take."""

    number: Annotated[int, "Number of the photograph."]
    pattern: Annotated[str, "File of the pattern to show, in `folder`."]
    seconds: Annotated[float, "Exposure in seconds."]
    save_as: Annotated[str, "Name without extension, in `folder`."]


@dataclass(kw_only=True)
class PhotographMissing(FolderReport):
    """`ltcl acquire run` that waits for photographs; the exit code is 3."""

    next: Annotated[NextPhotograph, "The photograph to take."]
    missing: Annotated[list[int], "Numbers of all missing photographs."]
    exit_code: Annotated[Literal[3], "3."] = 3
