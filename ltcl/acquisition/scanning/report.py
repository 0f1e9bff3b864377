# SPDX-License-Identifier: BSD-3-Clause
"""`Report` of a finished scan, from its store: coverage, saturation, noise."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field

import numpy as np
import scipy.sparse

from ltcl.acquisition.radiance import valid_share
from ltcl.acquisition.scanning import adaptive, columns
from ltcl.acquisition.scanning.pictures import ScanGrid
from ltcl.errors import FileError
from ltcl.store import BlockStore


@dataclass(frozen=True, repr=False, kw_only=True)
class Report:
    """Report of a finished scan; NaN (null in JSON) is unknown.

    Attributes
    ----------
    strategy, why : str
        The strategy, and the reason for it.
    grid, channels : tuple of int, int
        Pixels (h, w) and channels of T.
    patterns, photographs : int
        Of the scan, without those of the calibration and of the blocks after each batch.
    exposures : list of float
        Seconds.
    coverage, doubtful, masked : float
        Parts of the projector's pixels: seen by the camera; too dark next to bright ones, and so
        masked; without a first bounce.
    saturated : float
        Part of the camera's pixels that saturate in all exposures under white.
    sharpness, blur : float
        Part of the light at a pixel that is its own, and relative error of a picture of noise, by
        `acquisition.geometry.sharpness`; NaN with an aligned camera.
    entries, unknown : int, float
        Stored entries of all channels; part of them without a valid photograph, which are 0.
    noise_direct, noise_sum : float
        Median relative standard deviation of the first bounce, and of row sums.
    sum_deviation : float
        Relative deviation (rms) of sums of measured columns from white; NaN for a scan that takes
        no columns.
    judged_error, judged_bound : float
        Relative error of T p for the pictures that judge a sketch, to which it was not fitted, or
        of the direct light of those that judge a scan of it; and what that of others is below, with
        a probability of 95 %. NaN for another scan.
    left_out : float
        Indirect light that a scan of direct light left out, relative to all light of the median
        pixel under white; NaN for another scan.
    wrong_patterns : list of int
        Patterns of a sketch, from 1 on, whose pictures contradict all others, and are not used.

    Examples
    --------
    >>> import tempfile, ltcl
    >>> from ltcl.acquisition import VirtualRig
    >>> rig, store = VirtualRig(np.eye(64) / 2, (8, 8), bits=12), f"{tempfile.mkdtemp()}/T.zarr"
    >>> T = ltcl.acquire(rig, geometry="aligned", strategy="adaptive", store=store)
    >>> report = Report.of(store)
    >>> report.patterns < 64, report.coverage  # one pixel at a time: 64
    (True, 1.0)
    """

    strategy: str
    why: str
    grid: tuple[int, int]
    channels: int
    patterns: int
    photographs: int
    exposures: list[float]
    coverage: float
    doubtful: float
    sharpness: float
    blur: float
    masked: float
    saturated: float
    entries: int
    unknown: float
    noise_direct: float
    noise_sum: float
    sum_deviation: float
    judged_error: float = math.nan
    judged_bound: float = math.nan
    left_out: float = math.nan
    wrong_patterns: list[int] = field(default_factory=list)

    @classmethod
    def of(cls, store: str | os.PathLike[str] | BlockStore) -> Report:
        """Read the report of a store.

        FileError if the scan is not finished, or was not made by `ltcl.acquire`.
        """
        scan = BlockStore.of(store)
        scan.verify()
        _check_finished(scan)
        grid = ScanGrid.of(scan)
        calibration = grid.calibration
        white = grid.white
        first_bounce = np.asarray(scan.extra("first_bounce"))
        entries = _count_entries(scan, first_bounce.shape)
        patterns = int(scan.attributes["patterns"])
        stripes = len(scan.attributes.get("stripes", ()))
        sharpness = math.nan
        blur = math.nan
        if grid.sharpness is not None:
            sharpness = grid.sharpness.own
            blur = grid.sharpness.blur
        sum_deviation = math.nan
        strategy = scan.attributes["strategy"]
        is_direct = strategy == "direct"
        if scan.layout.kind != "compressed" and not is_direct:
            sum_deviation = columns.deviation(scan.extra(columns.ROW_SUMS), white)
        judgement = scan.attributes.get("direct" if is_direct else "sketch", {})
        return cls(
            strategy=strategy,
            why=scan.attributes["why"],
            grid=scan.layout.grid,
            channels=len(first_bounce),
            patterns=patterns,
            photographs=(patterns - stripes) * len(calibration.exposures),
            exposures=list(calibration.exposures),
            coverage=float(np.mean(calibration.resampling.coverage > 0)),
            doubtful=float(np.mean(scan.extra("calibration.resampling.doubtful"))),
            sharpness=sharpness,
            blur=blur,
            masked=float(np.mean((first_bounce <= 0).any(axis=0))),
            saturated=1.0 - valid_share(calibration.white),
            entries=entries.count,
            unknown=entries.unknown / max(entries.count, 1),
            noise_direct=_relative_noise(entries.variance, first_bounce),
            noise_sum=_relative_noise(white.variance, white.value, white.known),
            sum_deviation=sum_deviation,
            judged_error=_number(judgement.get("error")),
            judged_bound=_number(judgement.get("bound")),
            left_out=_number(judgement.get("left_out")),
            wrong_patterns=judgement.get("wrong_patterns", []),
        )

    def to_json(self) -> str:
        """The report in one line of JSON, with null for NaN."""
        content = asdict(self)
        for name, value in content.items():
            if isinstance(value, float) and math.isnan(value):
                content[name] = None
        return json.dumps(content)

    def __repr__(self) -> str:
        h, w = self.grid
        return (
            f"<ltcl Report {self.strategy}, {h} x {w} pixels, {self.photographs} photographs, "
            f"noise of row sums {self.noise_sum:.2%}>"
        )

    def __str__(self) -> str:
        h, w = self.grid
        times = ", ".join(f"{t:.3g} s" for t in self.exposures)
        lines = [
            f"{self.strategy} ({self.why}), {h} x {w} pixels, {self.channels} channel(s)",
            f"{self.photographs} photographs: {self.patterns} patterns at {times}",
            f"seen {self.coverage:.1%}, masked {self.masked:.2%} "
            f"({self.doubtful:.2%} too dark next to bright pixels), "
            f"saturated {self.saturated:.2%}",
            f"{self.entries} entries stored, {self.unknown:.2%} of them without a valid photograph",
            f"noise of the first bounce {self.noise_direct:.2%}, of row sums {self.noise_sum:.2%}",
        ]
        if not math.isnan(self.sharpness):
            lines.append(
                f"{self.sharpness:.0%} of a pixel is its own light: "
                f"relative error of fine patterns {self.blur:.1%}"
            )
        if not math.isnan(self.left_out):
            lines.append(
                "T is direct light alone: indirect light is left out, "
                f"{self.left_out:.1%} of the light of the median pixel under white"
            )
        if not math.isnan(self.judged_error):
            judged = "T p"
            if self.strategy == "direct":
                judged = "the direct light"
            lines.append(
                f"error of {judged} {self.judged_error:.2%} for pictures that it was not fitted "
                f"to; for others at most {self.judged_bound:.2%}, with a probability of 95 %"
            )
        for number in self.wrong_patterns:
            lines.append(f"the picture of pattern {number} contradicts all others: it is left out")
        if not math.isnan(self.sum_deviation):
            photographs = f"single {self.strategy}s"
            if self.strategy == "hadamard":
                photographs = "patterns"
            lines.append(
                f"photographs of {photographs} add up to white within "
                f"{100 * self.sum_deviation:.2g} % (good: below 0.5 %, acceptable: below 3 %)"
            )
        return "\n".join(lines)


def _number(value: float | None) -> float:
    """A number from JSON, which has no NaN."""
    return math.nan if value is None else float(value)


def _check_finished(scan: BlockStore) -> None:
    if "strategy" not in scan.attributes:
        state = "was not made by ltcl.acquire"
    elif not scan.final:
        state = "is still being scanned"
    else:
        return
    raise FileError(f"{scan.path}: {state}; it must be a finished scan")


@dataclass(frozen=True, kw_only=True)
class _StoredEntries:
    """Number of entries and of unknown ones; variance of each pixel's own light, (channels, N)."""

    count: int
    unknown: int
    variance: np.ndarray


def _count_entries(scan: BlockStore, shape: tuple[int, ...]) -> _StoredEntries:
    """Read the variances of all entries in a finished scan."""
    if scan.attributes["strategy"] == "sketch":
        cores = [scan.extra(f"system_{channel}.R.core.indices") for channel in range(shape[0])]
        variance = np.asarray(scan.extra("own_variance"))
        return _StoredEntries(count=sum(map(len, cores)), unknown=0, variance=variance)
    membership = _cells_of_pixels(scan)
    variance = np.zeros(shape)
    count = 0
    unknown = 0
    for channel in range(shape[0]):
        for rows, V in _stored_variances(scan, channel):
            count += V.nnz
            unknown += int(np.isnan(V.data).sum())
            own = V.multiply(membership[rows]).sum(axis=1)
            variance[channel, rows] = np.nan_to_num(own)
    return _StoredEntries(count=count, unknown=unknown, variance=variance)


def _relative_noise(
    variance: np.ndarray, value: np.ndarray, known: np.ndarray | bool = True
) -> float:
    """Median relative standard deviation of known positive values; NaN if there are none."""
    is_used = known & (value > 0)
    if not is_used.any():
        return math.nan
    return float(np.median(np.sqrt(variance[is_used]) / value[is_used]))


def _cells_of_pixels(store: BlockStore) -> scipy.sparse.csr_array:
    """Membership of pixels in cells, (N, cells); columns of T are cells of one pixel."""
    if store.layout.kind == "compressed":
        return adaptive.Cells(store.layout.grid).W.T.tocsr()
    return scipy.sparse.csr_array(scipy.sparse.eye_array(store.layout.shape[1]))


def _stored_variances(
    store: BlockStore, channel: int
) -> Iterator[tuple[slice, scipy.sparse.csr_array]]:
    """Variances of the entries of a channel, (rows, cells), by blocks of rows; NaN is unknown."""
    if store.layout.kind == "compressed":
        variance = store.extra(f"core_variance_{channel}")
        indices = store.extra(f"system_{channel}.R.core.indices")
        indptr = store.extra(f"system_{channel}.R.core.indptr")
        shape = _cells_of_pixels(store).shape
        yield slice(None), scipy.sparse.csr_array((variance, indices, indptr), shape=shape)
        return
    for number in range(store.layout.blocks()):
        T, variance = store.block(channel, number)
        V = scipy.sparse.csr_array((variance, T.indices, T.indptr), shape=T.shape)
        yield slice(*store.layout.span(number)), V
