# SPDX-License-Identifier: BSD-3-Clause
"""Reports of commands on transport files: info, analyze, convert, compress, invert, denoise."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from ltcl.cli.reports.parts import Channels, ErrorReport, Heading, VerdictReport
from ltcl.cli.reports.report import Report


@dataclass(kw_only=True)
class FileFacts(Report):
    """Contents of a transport file or of an inverse."""

    file: Annotated[Path, "Path of the file."]
    shape: Annotated[tuple[int, int], "Number of camera pixels and of projector pixels."]
    grid: Annotated[tuple[int, int] | None, "Projector pixels, if the file has them."]
    camera_grid: Annotated[tuple[int, int] | None, "Camera pixels, if the file has them."]
    mixing: Annotated[
        list[list[float]] | None, "Mixing of the projector's colours, 3 x 3, if the file has it."
    ]
    channels: Annotated[Channels, "1, or 3 for red, green and blue."]
    stored: Annotated[
        Literal["dense", "sparse", "row blocks", "compressed", "inverse"], "Form of storage."
    ]
    dtype: Annotated[
        str, "Type of the values; for a compressed T the kinds of its parts and its error."
    ]
    entries: Annotated[int, "Number of entries that are not 0, or are stored."]
    nbytes: Annotated[int, "Bytes in memory."]
    first_bounce_from: Annotated[Literal["file", "diagonal"], "Source of the direct light."]
    solution_error: Annotated[
        float, "Relative error of solutions by compression; 0 if T is not compressed."
    ]
    first_bounce: Annotated[
        tuple[float, float] | None, "Smallest and largest direct light; null if T is not square."
    ]
    dark_pixels: Annotated[
        int | None, "Number of projector pixels without direct light; null if T is not square."
    ]


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
    next_bounce: Annotated[int, "Coefficient of bounce n + 1 in the inverse."]
    forward: Annotated[float, "Bound on the error of the forward series."]
    inverse: Annotated[
        float | None, "Bound on the error of the inverse series; null if none is known."
    ]


@dataclass(kw_only=True)
class EnergyChecks(Report):
    """Checks of the conservation of energy."""

    bounce_lowest: Annotated[float, "Smallest row sum of a bounce; below 0 it is unphysical."]
    bounce_highest: Annotated[float, "Largest row sum of a bounce; from 1 on it is unphysical."]
    albedo_from_columns: Annotated[float, "Albedo by the largest column sum of R."]
    negative_entries: Annotated[float, "Share of the entries of T that are below 0."]
    negative_light: Annotated[float, "Share of these entries in all light."]


@dataclass(kw_only=True)
class ChannelAnalysisReport(Report):
    """Analysis of a colour channel: the attributes of `ltcl.analysis.ChannelAnalysis`."""

    norm_one: Annotated[float, "1-norm of R."]
    norm_inf: Annotated[float, "Largest row sum of R; below 1 the series converges."]
    norm_frobenius: Annotated[float, "Frobenius norm of R."]
    spectral_radius: Annotated[
        float, "Spectral radius of R; the paper's iteration converges below 1."
    ]
    spectral_radius_change: Annotated[float, "Last relative change in the power iteration."]
    spectral_radius_bounds: Annotated[
        tuple[float, float], "Lower and upper bound on the spectral radius."
    ]
    spectral_radius_certificate: Annotated[str, "Basis of these bounds."]
    albedo: Annotated[float, "Uniform albedo of a closed scene with this spectral radius."]
    bounds: Annotated[tuple[float, float], "Lower and upper bound on the spectrum of S."]
    products: Annotated[
        dict[str, float],
        "Products by method, to `rtol`; null: it diverges, or there is no forecast.",
    ]
    certificates: Annotated[dict[str, str], "Basis of the forecast, by method."]
    series: Annotated[list[SeriesTerms], "Errors of the series after some terms."]
    first_bounce: Annotated[
        tuple[float, float, float], "Smallest, median and largest direct light."
    ]
    reciprocity_defect: Annotated[float, "0 for a Lambertian scene without noise."]
    negative_bounce: Annotated[float, "Negative share of a bounce; above 0.005 for glossy scenes."]
    energy: Annotated[EnergyChecks, "Checks of the conservation of energy."]


@dataclass(kw_only=True)
class AnalysisReport(Report):
    """The attributes of `ltcl.Analysis`."""

    shape: Annotated[tuple[int, int], "Number of camera pixels and of projector pixels."]
    grid: Annotated[tuple[int, int], "Projector pixels: height, width."]
    rtol: Annotated[float, "Relative residual of the forecasts."]
    nbytes: Annotated[int, "Bytes of T."]
    masked: Annotated[int, "Number of projector pixels that stay unlit."]
    channels: Annotated[list[ChannelAnalysisReport], "One entry for each colour channel."]
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
        "Bound on the 2-norm of the dropped part of R; null if pictures decided, or the basis was "
        "abandoned.",
    ]
    left: Annotated[str, "Reason for which the basis was abandoned; else empty."]


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

    threshold: Annotated[float, "Threshold below which numbers were dropped."]
    dropped: Annotated[float, "Bound on the Frobenius norm of the dropped part."]
    quantisation: Annotated[float, "Change of the core by rounding."]
    inverse_norm: Annotated[float, "Bound on the 2-norm of the inverse of S."]
    solution_error: Annotated[float, "Bound on the relative error of solutions, by `--norm`."]
    error_bound: Annotated[float, "Bound on the relative error of solutions for any light."]
    pictures: Annotated[PictureErrorReport | None, "Loss of pictures; null with `--norm worst`."]
    confidence: Annotated[float, "Confidence in all bounds."]
    trials: Annotated[list[TrialReport], "The bases that were tried."]


@dataclass(kw_only=True)
class CompressionReport(Report):
    """The attributes of `ltcl.Compression`."""

    rtol: Annotated[float | str, "Requested error: a number, or `noise`."]
    norm: Annotated[Literal["pictures", "worst"], "Requested norm."]
    budget: Annotated[int | None, "Requested limit, in bytes."]
    uncompressed: Annotated[int, "Bytes of T before."]
    window: Annotated[tuple[int, int], "Pixels on which bases were tried: height, width."]
    seconds: Annotated[float, "Duration of the compression."]
    channels: Annotated[list[ChannelCompressionReport], "One entry for each colour channel."]


@dataclass(kw_only=True)
class CompressReport(Heading):
    """`ltcl compress`."""

    out: Annotated[Path, "File that was written."]
    bytes: Annotated[int, "Bytes of T before."]
    bytes_compressed: Annotated[int, "Bytes of T in memory, with its first bounce."]
    bytes_on_disk: Annotated[int, "Bytes of the file."]
    solution_error: Annotated[float, "Bound on the relative error of solutions, by `--norm`."]
    error_bound: Annotated[float, "Bound on the relative error of solutions for any light."]
    compression: CompressionReport


@dataclass(kw_only=True)
class InvertReport(Heading):
    """`ltcl invert`."""

    out: Annotated[Path, "File that was written."]
    bytes: Annotated[int, "Bytes in memory."]
    bytes_on_disk: Annotated[int, "Bytes of the file."]
    errors: Annotated[list[float], "Bounds on the relative error of solutions, by channel."]
    confidence: Annotated[float, "Confidence in all bounds."]


@dataclass(kw_only=True)
class NoiseReport(Report):
    """Standard deviations of an entry of T."""

    source: Annotated[str, "Source of the noise of T."]
    before: Annotated[list[float], "Standard deviation of an entry of T, by channel."]
    after: Annotated[list[float], "Remaining standard deviation in pictures, by channel."]


@dataclass(kw_only=True)
class DenoiseReport(Heading):
    """`ltcl denoise`."""

    out: Annotated[Path, "File that was written."]
    noise: Annotated[NoiseReport, "Noise before and after."]
