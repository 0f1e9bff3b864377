# SPDX-License-Identifier: BSD-3-Clause
"""Reports of commands on transport files: info, analyze, convert, compress, invert, denoise."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from ltcl.cli.reports.parts import (
    Channels,
    Heading,
    ProjectorGrid,
    Shape,
    VerdictReport,
)
from ltcl.cli.reports.report import ErrorReport, Report

SolutionError = Annotated[float, "Bound on the error of solutions, by `--norm`."]
ErrorBound = Annotated[float, "Bound on the error of solutions for any light."]
StoredForm = Annotated[
    Literal["dense", "sparse", "row blocks", "compressed", "inverse", "combined"],
    "Form of storage.",
]


@dataclass(kw_only=True)
class FileFacts(Report):
    """Contents of a transport file or of an inverse."""

    file: Annotated[Path, "Path of the file."]
    shape: Shape
    grid: Annotated[tuple[int, int] | None, "Projector pixels, if known."]
    camera_grid: Annotated[tuple[int, int] | None, "Camera pixels, if known."]
    mixing: Annotated[list[list[float]] | None, "Mixing of the projector's colours, 3 x 3."]
    channels: Channels
    stored: StoredForm
    dtype: Annotated[str, "Type of the values; of a compressed T its parts and error."]
    entries: Annotated[int, "Number of nonzero or stored entries."]
    nbytes: Annotated[int, "Bytes in memory."]
    first_bounce_from: Annotated[Literal["file", "diagonal"], "Source of F."]
    solution_error: Annotated[float, "Relative error of solutions by compression, or 0."]
    first_bounce: Annotated[tuple[float, float] | None, "Range of direct light of a square T."]
    dark_pixels: Annotated[int | None, "Pixels without direct light of a square T."]


@dataclass(kw_only=True)
class GoodFile(FileFacts):
    """A transport or an inverse."""

    verdict: VerdictReport


@dataclass(kw_only=True)
class BadFile(ErrorReport):
    """A file that is missing, damaged, or not a transport."""

    file: Annotated[Path, "Path of the file."]


@dataclass(kw_only=True)
class ConvertReport(FileFacts):
    """`ltcl convert`."""

    source: Annotated[Path, "File that was read."]


@dataclass(kw_only=True)
class SeriesTerms(Report):
    """Errors after a number of terms."""

    n: Annotated[int, "Number of terms."]
    next_bounce: Annotated[int, "Bounce n + 1 in the inverse."]
    forward: Annotated[float, "Error bound, forward series."]
    inverse: Annotated[float | None, "Error bound, inverse series; null if unknown."]


@dataclass(kw_only=True)
class EnergyChecks(Report):
    """Checks of the conservation of energy."""

    bounce_lowest: Annotated[float, "Smallest row sum; unphysical below 0."]
    bounce_highest: Annotated[float, "Largest row sum; unphysical from 1."]
    albedo_from_columns: Annotated[float, "Albedo by column sums of R."]
    negative_entries: Annotated[float, "Share of entries below 0."]
    negative_light: Annotated[float, "Their share of all light."]


@dataclass(kw_only=True)
class ChannelAnalysisReport(Report):
    """Analysis of a colour channel: the attributes of `ltcl.analysis.ChannelAnalysis`."""

    norm_one: Annotated[float, "1-norm of R."]
    norm_inf: Annotated[float, "Largest row sum of R."]
    norm_frobenius: Annotated[float, "Frobenius norm of R."]
    spectral_radius: Annotated[float, "Spectral radius of R; the paper's iteration needs below 1."]
    spectral_radius_change: Annotated[float, "Last change in its iteration."]
    spectral_radius_bounds: Annotated[
        tuple[float, float], "Lower and upper bound on the spectral radius."
    ]
    spectral_radius_certificate: Annotated[str, "Source of the bounds."]
    albedo: Annotated[float, "Uniform albedo of such a closed scene."]
    bounds: Annotated[tuple[float, float], "Bounds on the spectrum of S."]
    products: Annotated[
        dict[str, float],
        "Products to `rtol`, by method; null: none forecast, or it diverges.",
    ]
    certificates: Annotated[dict[str, str], "Sources of these forecasts."]
    series: Annotated[list[SeriesTerms], "Errors of the series."]
    first_bounce: Annotated[
        tuple[float, float, float], "Smallest, median and largest direct light."
    ]
    reciprocity_defect: Annotated[float, "0 for matt scenes without noise."]
    negative_bounce: Annotated[float, "Negative share of a bounce."]
    energy: Annotated[EnergyChecks, "Checks of conservation of energy."]


@dataclass(kw_only=True)
class AnalysisReport(Report):
    """The attributes of `ltcl.Analysis`."""

    shape: Shape
    grid: ProjectorGrid
    rtol: Annotated[float, "Relative residual of the forecasts."]
    nbytes: Annotated[int, "Bytes of T."]
    masked: Annotated[int, "Projector pixels that stay unlit."]
    channels: Annotated[list[ChannelAnalysisReport], "By colour channel."]
    verdict: VerdictReport


@dataclass(kw_only=True)
class AnalyzedFile(AnalysisReport):
    """Analysis of a file."""

    file: Annotated[Path, "Path of the file."]
    device: Annotated[str, "Name of the OpenCL device."]


@dataclass(kw_only=True)
class TrialReport(Report):
    """A basis that was tried."""

    basis: Annotated[str, "Name of the basis of R."]
    format: Annotated[Literal["tiles", "csr"], "Format of the core."]
    width: Annotated[int, "Width of a tile."]
    precision: Annotated[str, "Precision of the numbers."]
    kept: Annotated[float, "Numbers kept in a row, on average."]
    nbytes: Annotated[int, "Bytes of the core."]
    error: Annotated[
        float | None,
        "Bound on the 2-norm of the dropped part of R; null if pictures "
        "decided, or the basis was abandoned.",
    ]
    left: Annotated[str, "Reason why it was abandoned, if it was."]


@dataclass(kw_only=True)
class PictureErrorReport(Report):
    """Loss of pictures, measured on pictures that compression has not seen."""

    error: Annotated[float, "Largest loss."]
    share: Annotated[float, "Share of pictures that lose no more."]
    confidence: Annotated[float, "Confidence in this share."]
    count: Annotated[int, "Number of pictures."]


@dataclass(kw_only=True)
class ChannelCompressionReport(TrialReport):
    """Compression of a colour channel: the attributes of `ltcl.compression.ChannelCompression`."""

    threshold: Annotated[float, "Largest size of dropped numbers."]
    dropped: Annotated[float, "Frobenius norm of the dropped part."]
    quantisation: Annotated[float, "Change of the core by rounding."]
    inverse_norm: Annotated[float, "Bound on the norm of S^-1."]
    solution_error: SolutionError
    error_bound: ErrorBound
    pictures: Annotated[PictureErrorReport | None, "Loss of pictures."]
    confidence: Annotated[float, "Confidence in all bounds."]
    trials: Annotated[list[TrialReport], "The bases that were tried."]


@dataclass(kw_only=True)
class CompressionReport(Report):
    """The attributes of `ltcl.Compression`."""

    rtol: Annotated[float | str, "Requested error, or `noise`."]
    norm: Annotated[Literal["pictures", "worst"], "Requested norm."]
    budget: Annotated[int | None, "Requested limit, in bytes."]
    uncompressed: Annotated[int, "Bytes of T before."]
    window: Annotated[tuple[int, int], "Pixels of trials."]
    seconds: Annotated[float, "Duration of the compression."]
    channels: Annotated[list[ChannelCompressionReport], "By channel."]


@dataclass(kw_only=True)
class CompressReport(Heading):
    """`ltcl compress`."""

    out: Annotated[Path, "File that was written."]
    bytes: Annotated[int, "Bytes of T before."]
    bytes_compressed: Annotated[int, "Bytes of T in memory."]
    bytes_on_disk: Annotated[int, "Bytes of the file."]
    solution_error: SolutionError
    error_bound: ErrorBound
    compression: CompressionReport


@dataclass(kw_only=True)
class InvertReport(Heading):
    """`ltcl invert`."""

    out: Annotated[Path, "File that was written."]
    bytes: Annotated[int, "Bytes in memory."]
    bytes_on_disk: Annotated[int, "Bytes of the file."]
    errors: Annotated[list[float], "Error bounds, by channel."]
    confidence: Annotated[float, "Confidence in all bounds."]


@dataclass(kw_only=True)
class NoiseReport(Report):
    """Standard deviations of an entry of T."""

    source: Annotated[str, "Source of the noise of T."]
    before: Annotated[list[float], "Noise of an entry, by channel."]
    after: Annotated[list[float], "Noise left in pictures, by channel."]


@dataclass(kw_only=True)
class AlignReport(Heading):
    """`ltcl align`."""

    out: Annotated[Path, "File that was written."]
    seen: Annotated[float, "Share of the projector's pixels that the camera sees."]
    decoded: Annotated[float, "Share of the camera's pixels whose place is known."]
    pictures: Annotated[list[Path], "Aligned pictures, in their order."]


@dataclass(kw_only=True)
class CombineReport(Report):
    """`ltcl combine`."""

    out: Annotated[Path, "File that was written."]
    scans: Annotated[list[Path], "Transports of the projectors, in their order."]
    grids: Annotated[list[list[int]], "Pixels of each pattern: height, width."]
    camera_grid: Annotated[tuple[int, int], "Height and width of the camera's pictures."]
    channels: Channels
    fed: Annotated[
        list[list[int]], "Height and width of the codes of each projector; empty without scans."
    ]
    contrast: Annotated[
        float | None, "Light of white over that of black; null if not known, or infinite."
    ]
    contrast_uniform: Annotated[float | None, "The same with black lifted to one level."]
    differences: Annotated[
        list[float], "Deviation of the colours of each projector from their mean, relative."
    ]


@dataclass(kw_only=True)
class DenoiseReport(Heading):
    """`ltcl denoise`."""

    out: Annotated[Path, "File that was written."]
    noise: Annotated[NoiseReport, "Noise before and after."]
