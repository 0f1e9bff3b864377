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

Channels = Literal[1, 3]
Options = Annotated[
    dict[str, Any],
    "Every option of the command by its name in Python (`--on-dark` is `on_dark`), with the value "
    "that was used. The page on the command line describes each.",
]
Files = Annotated[list[str], "All files that this run wrote, relative to `folder`."]


@dataclass(kw_only=True)
class ErrorReport(Report):
    """A command that failed; the exit code is not 0."""

    error: Annotated[str, "The problem in one line; the same line is on stderr."]
    type: Annotated[
        str, "A class in `ltcl.errors`, or `UsageError`, or another exception of Python."
    ]
    exit_code: Annotated[int, "Exit code of the program; the page on exit codes lists all."]


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

    index: Annotated[str, "Platform and device, as `--device` takes it."]
    name: Annotated[str, "Name of the device."]
    kind: Annotated[Literal["gpu", "accelerator", "cpu", "simulator"], "Kind of the device."]
    driver: Annotated[str, "Name and version of the OpenCL platform."]


@dataclass(kw_only=True)
class TransportFacts(Report):
    """The transport that was read."""

    file: Annotated[Path, "Path of the file."]
    shape: Annotated[tuple[int, int], "Number of camera pixels and of projector pixels."]
    channels: Annotated[Channels, "1, or 3 for red, green and blue."]
    grid: Annotated[tuple[int, int], "Projector pixels: height, width."]
    camera_grid: Annotated[tuple[int, int], "Camera pixels: height, width."]
    error: Annotated[float, "Relative error of solutions by compression; 0 if T is not compressed."]
    masked: Annotated[int, "Number of projector pixels that are too dark and stay unlit."]
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

    largest: Annotated[float, "Largest standard error of the pixels for which it is known."]
    median: Annotated[float, "Median standard error of these pixels."]
    unknown: Annotated[int, "Number of pixels without a known standard error."]


@dataclass(kw_only=True)
class Solve(Report):
    """A solve of a colour channel."""

    method: Annotated[str, "Method that ran, also if `auto` was requested."]
    iterations: Annotated[int, "Number of iterations of the method."]
    products: Annotated[int, "Number of products with S, those for checks included."]
    residual: Annotated[float, "Relative residual of the result."]
    residuals: Annotated[list[float], "Relative residuals before each iteration and at the end."]
    seconds: Annotated[float, "Wall time."]
    reason: Annotated[
        str, "Why `auto` chose the method, or what a sampling method reached; else empty."
    ]
    error: Annotated[
        float | None, "Bound on the relative error, if one is known, as with an inverse."
    ]
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
    standard_error: Annotated[
        StandardErrors | None, "Standard errors of random walks; null for other methods."
    ]


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

    std: Annotated[PictureFiles | None, "Standard deviations by the noise of T."] = None


@dataclass(kw_only=True)
class VerdictNumbers(Report):
    """Measurements that decide on the verdict, for the worst channel, as far as they are known."""

    pictures: Annotated[
        float | None, "Relative error of a compensated picture by noise. Good up to 0.02."
    ] = None
    bounces: Annotated[
        float | None, "Largest value of `bounce_1` to `bounce_3`. Good up to 0.05."
    ] = None
    bounce_1: Annotated[float | None, "Relative error of bounce 1 under white, by noise."] = None
    bounce_2: Annotated[float | None, "Relative error of bounce 2 under white, by noise."] = None
    bounce_3: Annotated[float | None, "Relative error of bounce 3 under white, by noise."] = None
    spread: Annotated[
        float | None,
        "Largest value of `spread_1` to `spread_3` if the first bounce is diag(T), else 0. "
        "Good up to 0.05.",
    ] = None
    spread_1: Annotated[
        float | None,
        "Relative difference of bounce 1 under white by the first bounces diag(T) and "
        "1 / diag(T^-1).",
    ] = None
    spread_2: Annotated[float | None, "The same for bounce 2."] = None
    spread_3: Annotated[float | None, "The same for bounce 3."] = None
    other_grid: Annotated[float | None, "1 if T fits another grid better. Good: 0."] = None
    exchanged: Annotated[
        float | None, "Number of colour channels that look exchanged. Good: 0."
    ] = None
    no_bounces: Annotated[float | None, "1 if T has no S, hence no bounces. Good: 0."] = None
    shifted: Annotated[
        float | None,
        "Share of the camera's pixels whose brightest projector pixel is displaced in a common "
        "direction. Good up to 0.2.",
    ] = None
    hot_rows: Annotated[
        float | None, "Number of camera pixels with one value in all patterns. Good: 0."
    ] = None
    saturated: Annotated[
        float | None, "Number of entries of T equal to its brightest one. Good up to 2."
    ] = None
    quantized: Annotated[
        float | None,
        "Step of the codes of T over its mean indirect light; 0 without codes. Good up to 0.3.",
    ] = None
    row_offset: Annotated[
        float | None,
        "Offset of the camera's pixels, as of a dark frame, over the light under white. "
        "Good up to 0.015.",
    ] = None
    ambient: Annotated[
        float | None,
        "Least light that parts of the picture exchange in one bounce, over the mean; "
        "0 for flat walls. Good up to 0.05.",
    ] = None
    offset: Annotated[
        float | None, "Distance of the lowest light below 0, over the mean. Good up to 0.02."
    ] = None
    flicker: Annotated[
        float | None, "Relative change of the light from column to column. Good up to 0.02."
    ] = None
    outliers: Annotated[
        float | None,
        "Relative change of a picture by single entries that their neighbours do not confirm. "
        "Good: 0.",
    ] = None
    irreciprocal: Annotated[
        float | None, "`reciprocity_defect` beyond the part due to noise. Good up to 0.1."
    ] = None
    dark: Annotated[
        float | None, "Share of the projector's pixels that light nothing. Good up to 0.05."
    ] = None
    gain: Annotated[
        float | None, "Brightness of a plain picture within reach, over the median under white."
    ] = None
    negative_bounce: Annotated[
        float | None, "Share of light that one bounce takes away. Good up to 0.005."
    ] = None
    bounce_highest: Annotated[
        float | None, "Share of light that a bounce returns at 98 % of pixels. Good up to 1."
    ] = None
    sum_deviation: Annotated[
        float | None, "`sum_deviation` of `ltcl acquire report`. Good up to 0.03."
    ] = None
    saturation: Annotated[
        float | None, "`saturated` of `ltcl acquire report`. Good up to 0.01."
    ] = None


@dataclass(kw_only=True)
class VerdictReport(Report):
    """Judgement of what T can be used for.

    The verdict is unknown for a compressed T, or one of fewer than 64 pixels, whose noise was not
    measured; if a number is not finite; in `ltcl info` also if the file has no grid, or takes more
    than 256 MiB. Its text then tells the reason and a command that helps.
    """

    text: Annotated[str, "Two sentences."]
    compensation: Annotated[bool | None, "Whether T can be used for compensation; null if unknown."]
    bounces: Annotated[bool | None, "Whether T can be used for bounces 1 to 3; null if unknown."]
    causes: Annotated[
        list[str], "Names of `numbers` beyond their limits, the most important first."
    ]
    numbers: Annotated[
        VerdictNumbers, "Measurements of the worst channel, as far as they are known."
    ]

    @classmethod
    def from_verdict(cls, verdict: Verdict) -> VerdictReport:
        """Return the report of a verdict."""
        return cls.from_attributes(verdict, numbers=VerdictNumbers(**verdict.numbers))
