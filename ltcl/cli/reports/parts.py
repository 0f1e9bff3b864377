# SPDX-License-Identifier: BSD-3-Clause
"""Parts of reports that several commands share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from ltcl.cli.reports.report import Report
from ltcl.solvers import Solution
from ltcl.tasks import report
from ltcl.transport.verdict import Verdict

Channels = Annotated[Literal[1, 3], "1, or 3 for red, green and blue."]
ProjectorGrid = Annotated[tuple[int, int], "Projector pixels: height, width."]
Shape = Annotated[tuple[int, int], "Number of camera and of projector pixels."]
Gain = Annotated[float, "Factor between the picture and what the scene shows."]
Clipped = Annotated[float, "Share of the pattern at a bound."]
SceneError = Annotated[float, "Relative error of what the scene will show."]
TransportError = Annotated[float, "Relative error of T itself by compression."]
DeviceKind = Annotated[Literal["gpu", "accelerator", "cpu", "simulator"], "Kind of the device."]
Options = Annotated[
    dict[str, Any],
    "Every option of the command by its name in Python (`--on-dark` is "
    "`on_dark`), with the value that was used. The page on the command line "
    "describes each.",
]
Files = Annotated[list[str], "Files that this run wrote, relative to `folder`."]


@dataclass(kw_only=True)
class Versions(Report):
    """Versions that a result can depend on."""

    ltcl: Annotated[str, "Version of ltcl."]
    python: Annotated[str, "Version of Python."]
    system: Annotated[str, "Operating system and processor."]
    numpy: Annotated[str, "Version of NumPy."]
    scipy: Annotated[str, "Version of SciPy."]
    pyopencl: Annotated[str, "Version of pyopencl."]


@dataclass(kw_only=True)
class Device(Report):
    """The OpenCL device that was used."""

    index: Annotated[str, "Platform and device, as for `--device`."]
    name: Annotated[str, "Name of the device."]
    kind: DeviceKind
    driver: Annotated[str, "Name and version of the OpenCL platform."]


@dataclass(kw_only=True)
class TransportFacts(Report):
    """The transport that was read."""

    file: Annotated[Path, "Path of the file."]
    shape: Shape
    channels: Channels
    grid: ProjectorGrid
    camera_grid: Annotated[tuple[int, int], "Camera pixels: height, width."]
    error: Annotated[float, "Relative error of solutions by compression, or 0."]
    masked: Annotated[int, "Number of dark projector pixels; they stay unlit."]
    compressed: Annotated[bool, "Whether T is compressed."]


@dataclass(kw_only=True)
class FolderReport(Report):
    """A report on results in a folder."""

    folder: Annotated[Path, "Folder with the files."]


@dataclass(kw_only=True)
class Heading(Report):
    """The first fields of a report on work with a transport."""

    command: Annotated[str, "Name of the command."]
    versions: Versions
    device: Device
    transport: TransportFacts
    options: Options


@dataclass(kw_only=True)
class StandardErrors(Report):
    """Standard errors over the pixels."""

    largest: Annotated[float, "Largest known standard error."]
    median: Annotated[float, "Median of the known standard errors."]
    unknown: Annotated[int, "Number of pixels for which it is unknown."]


@dataclass(kw_only=True)
class Solve(Report):
    """A solve of a colour channel."""

    method: Annotated[str, "Method that ran, also for `auto`."]
    iterations: Annotated[int, "Number of iterations of the method."]
    products: Annotated[int, "Number of products with S, with those of checks."]
    residual: Annotated[float, "Relative residual of the result."]
    residuals: Annotated[list[float], "Relative residuals, from start to end."]
    seconds: Annotated[float, "Wall time."]
    reason: Annotated[str, "Reason for the choice of `auto`, or what sampling reached."]
    error: Annotated[float | None, "Bound on the relative error, as with an inverse."]
    status: Annotated[
        Literal[
            "converged",
            "maxiter",
            "diverged",
            "stagnated",
            "indefinite",
            "no_step",
            "sampled",
            "precomputed",
            "breakdown",
        ],
        "Reason for the end of the solve.",
    ]
    standard_error: Annotated[StandardErrors | None, "Noise of random walks; else null."]


ChannelSolves = Annotated[list[Solve], "Solves, one for each colour channel."]


def solves(solution: Solution | tuple[Solution, ...]) -> list[Solve]:
    """Facts of a solution, one entry for each colour channel."""
    return [Solve(**facts) for facts in report.solution(solution)]


@dataclass(kw_only=True)
class PictureFiles(Report):
    """A picture in two files, relative to `folder`."""

    exr: Annotated[str, "File of the linear values."]
    png: Annotated[str, "File for viewing, at `exposure`."]


@dataclass(kw_only=True)
class PictureWithStd(PictureFiles):
    """A picture in two files, with its standard deviations if the noise of T is known."""

    std: Annotated[PictureFiles | None, "Deviations by the noise of T."] = None


# None if it was not measured.
Measured = float | None


@dataclass(kw_only=True)
class VerdictNumbers(Report):
    """Measurements that decide on the verdict, for the worst channel, as far as they are known."""

    pictures: Annotated[Measured, "Error of a compensated picture by noise. Good up to 0.02."] = (
        None
    )
    bounces: Annotated[Measured, "Largest of `bounce_1` to `bounce_3`. Good up to 0.05."] = None
    bounce_1: Annotated[Measured, "Error of bounce 1, by noise."] = None
    bounce_2: Annotated[Measured, "Error of bounce 2, by noise."] = None
    bounce_3: Annotated[Measured, "Error of bounce 3, by noise."] = None
    spread: Annotated[
        Measured, "Largest of `spread_1` to `spread_3` if F is diag(T), else 0. Good up to 0.05."
    ] = None
    spread_1: Annotated[Measured, "Difference of bounce 1 by F = diag(T) or 1 / diag(T^-1)."] = None
    spread_2: Annotated[Measured, "The same for bounce 2."] = None
    spread_3: Annotated[Measured, "The same for bounce 3."] = None
    resolution_1: Annotated[Measured, "Change of bounce 1 by pixels of twice the size."] = None
    resolution_2: Annotated[Measured, "The same for bounce 2."] = None
    resolution_3: Annotated[Measured, "The same for bounce 3."] = None
    other_grid: Annotated[Measured, "1 if another grid fits better."] = None
    exchanged: Annotated[Measured, "Colour channels that look exchanged. Good: 0."] = None
    no_bounces: Annotated[Measured, "1 if T is not square."] = None
    blocks: Annotated[Measured, "1 if T has blocks between colours, hence no bounces."] = None
    shifted: Annotated[
        Measured,
        "Share of the camera's pixels whose brightest projector pixel is "
        "displaced in a common direction. Good up to 0.2.",
    ] = None
    hot_rows: Annotated[Measured, "Camera pixels with one value in all patterns. Good: 0."] = None
    saturated: Annotated[Measured, "Entries equal to the brightest one. Good up to 2."] = None
    quantized: Annotated[
        Measured, "Step of the codes of T over its mean indirect light. Good up to 0.3."
    ] = None
    row_offset: Annotated[
        Measured, "Offset of the camera's pixels over the light under white. Good up to 0.015."
    ] = None
    ambient: Annotated[
        Measured,
        "Least light that parts of the picture exchange in one bounce, over "
        "the mean; 0 for flat walls. Good up to 0.05.",
    ] = None
    offset: Annotated[Measured, "Lowest light below 0, over the mean. Good up to 0.02."] = None
    flicker: Annotated[Measured, "Change of the light between columns. Good up to 0.02."] = None
    outliers: Annotated[
        Measured,
        "Relative change of a picture by single entries that their "
        "neighbours do not confirm. Good: 0.",
    ] = None
    irreciprocal: Annotated[Measured, "`reciprocity_defect` beyond noise. Good up to 0.1."] = None
    dark: Annotated[Measured, "Share of projector pixels that light nothing. Good up to 0.05."] = (
        None
    )
    gain: Annotated[Measured, "Brightness of a plain picture within reach, over white."] = None
    negative_bounce: Annotated[
        Measured, "Light that a bounce takes away, beyond noise. Good up to 0.005."
    ] = None
    bounce_highest: Annotated[
        Measured, "Light that 98 % of pixels return, at most. Good up to 1."
    ] = None
    sum_deviation: Annotated[Measured, "`sum_deviation` of the scan. Good up to 0.03."] = None
    saturation: Annotated[Measured, "`saturated` of the scan. Good up to 0.01."] = None
    left_out: Annotated[Measured, "`left_out` of the scan. Good up to 0.02."] = None


@dataclass(kw_only=True)
class VerdictReport(Report):
    """Judgement of what T can be used for.

    The verdict is unknown for a compressed T, or one of fewer than 64 pixels, whose noise was not
    measured; if a number is not finite; in `ltcl info` also if the file has no grid, or takes more
    than 256 MiB. Its text then tells the reason and a command that helps.
    """

    text: Annotated[str, "Two sentences."]
    compensation: Annotated[bool | None, "Whether T is good for compensation."]
    bounces: Annotated[bool | None, "Whether T is good for bounces 1 to 3."]
    causes: Annotated[list[str], "Names of `numbers` beyond limits, the worst first."]
    numbers: Annotated[VerdictNumbers, "Measurements of the worst channel."]

    @classmethod
    def from_verdict(cls, verdict: Verdict) -> VerdictReport:
        """Return the report of a verdict."""
        return cls.from_attributes(verdict, numbers=VerdictNumbers(**verdict.numbers))
