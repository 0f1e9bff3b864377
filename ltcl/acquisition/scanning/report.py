# SPDX-License-Identifier: BSD-3-Clause
"""`Report` of a finished scan, from its store: coverage, saturation, noise."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np
import scipy.sparse

from ltcl.acquisition.scanning import adaptive, columns
from ltcl.acquisition.scanning.pictures import Seen
from ltcl.errors import FileError
from ltcl.store import BlockStore


@dataclass(frozen=True, repr=False)
class Report:
    """Of a finished scan: how it was scanned, and what follows; NaN (null in JSON) is unknown.

    Attributes
    ----------
    patterns, photographs : of the scan, without those of the calibration and of the blocks after
    each batch
    exposures : seconds
    coverage, doubtful, masked : parts of the projector's pixels
        Seen by the camera; too dark next to bright ones, and so masked; without a first bounce.
    saturated : part of the camera's pixels that saturate in all exposures under white
    sharpness, blur : of light at a pixel, the part that is its own; relative error of a picture of
    noise
        By `acquisition.geometry.sharpness`; NaN of an aligned camera.
    entries, unknown : stored, of all channels; part of them without a valid photograph, which are 0
    noise_direct, noise_sum : median relative standard deviation of the first bounce, and of row
    sums
    sum_deviation : relative deviation (rms) of sums of measured columns from white; NaN of an
    adaptive scan

    Examples
    --------
    >>> import tempfile, ltcl
    >>> from ltcl.acquisition import VirtualRig
    >>> rig, store = VirtualRig(np.eye(64) / 2, (8, 8), bits=12), f"{tempfile.mkdtemp()}/T.zarr"
    >>> T = ltcl.acquire(rig, geometry="aligned", strategy="adaptive", store=store)
    >>> report = Report.of(store)
    >>> report.patterns, report.coverage
    (12, 1.0)
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

    @classmethod
    def of(cls, store: str | os.PathLike[str] | BlockStore) -> Report:
        """The report of a store; FileError where the scan is not finished, or not by `ltcl.acquire`."""
        scan = store if isinstance(store, BlockStore) else BlockStore.open(store)
        scan.verify()
        if "strategy" not in scan.attributes or not scan.final:
            started = "strategy" in scan.attributes
            state = "is still being scanned" if started else "was not made by ltcl.acquire"
            raise FileError(f"{scan.path}: {state}; it must be a finished scan")
        facts, seen, measured = scan.attributes, Seen.of(scan), scan.layout.kind != "compressed"
        calibration, F, white = seen.calibration, np.asarray(scan.extra("first_bounce")), seen.white
        entries, unknown, variance, cells = 0, 0, np.zeros(F.shape), membership(scan)
        for c in range(len(F)):
            for rows, V in stored_variances(scan, c):
                entries, unknown = entries + V.nnz, unknown + int(np.isnan(V.data).sum())
                variance[c, rows] = np.nan_to_num(V.multiply(cells[rows]).sum(axis=1))
        return cls(
            strategy=facts["strategy"],
            why=facts["why"],
            grid=scan.layout.grid,
            channels=len(F),
            patterns=int(facts["patterns"]),
            photographs=int(facts["patterns"]) * len(calibration.exposures),
            exposures=list(calibration.exposures),
            coverage=float(np.mean(calibration.resampling.coverage > 0)),
            doubtful=float(np.mean(scan.extra("calibration.resampling.doubtful"))),
            sharpness=seen.sharpness.own if seen.sharpness else math.nan,
            blur=seen.sharpness.blur if seen.sharpness else math.nan,
            masked=float(np.mean((F <= 0).any(axis=0))),
            saturated=1.0 - float(np.mean(calibration.white.valid)),
            entries=entries,
            unknown=unknown / max(entries, 1),
            noise_direct=_noise(variance, F, F > 0),
            noise_sum=_noise(white.variance, white.value, white.known & (white.value > 0)),
            sum_deviation=columns.deviation(scan.extra(columns.SUMS), white)
            if measured
            else math.nan,
        )

    def to_json(self) -> str:
        """One line of JSON; NaN as null."""
        return json.dumps({k: None if v != v else v for k, v in asdict(self).items()})

    def __repr__(self) -> str:
        (h, w), noise = self.grid, f"noise of row sums {self.noise_sum:.2%}"
        return f"<ltcl Report {self.strategy}, {h} x {w} pixels, {self.photographs} photographs, {noise}>"

    def __str__(self) -> str:
        h, w = self.grid
        times = ", ".join(f"{t:.3g} s" for t in self.exposures)
        masked = f"masked {self.masked:.2%} ({self.doubtful:.2%} too dark next to bright pixels)"
        lines = [
            f"{self.strategy} ({self.why}), {h} x {w} pixels, {self.channels} channel(s)",
            f"{self.photographs} photographs: {self.patterns} patterns at {times}",
            f"seen {self.coverage:.1%}, {masked}, saturated {self.saturated:.2%}",
            f"{self.entries} entries stored, {self.unknown:.2%} of them without a valid photograph",
            f"noise of the first bounce {self.noise_direct:.2%}, of row sums {self.noise_sum:.2%}",
        ]
        if not math.isnan(self.sharpness):
            own = f"{self.sharpness:.0%} of a pixel is its own light"
            lines.append(f"{own}: relative error of fine patterns {self.blur:.1%}")
        if not math.isnan(self.sum_deviation):
            photographs = "patterns" if self.strategy == "hadamard" else f"single {self.strategy}s"
            within = f"{100 * self.sum_deviation:.2g} % (good: below 0.5 %, acceptable: below 3 %)"
            lines.append(f"photographs of {photographs} add up to white within {within}")
        return "\n".join(lines)


def _noise(variance: np.ndarray, value: np.ndarray, known: np.ndarray) -> float:
    return float(np.median(np.sqrt(variance[known]) / value[known])) if known.any() else math.nan


def membership(store: BlockStore) -> scipy.sparse.csr_array:
    """Which cells a pixel is in, (N, cells); columns of T are cells of one pixel."""
    if store.layout.kind == "compressed":
        return adaptive.Cells(store.layout.grid).W.T.tocsr()
    return scipy.sparse.csr_array(scipy.sparse.eye_array(store.layout.shape[1]))


def stored_variances(store: BlockStore, c: int) -> Iterator[tuple[slice, scipy.sparse.csr_array]]:
    """Variances of the entries of a channel, (rows, cells), by blocks of rows; NaN is unknown."""
    if store.layout.kind == "compressed":
        names = f"core_variance_{c}", f"system_{c}.R.core.indices", f"system_{c}.R.core.indptr"
        arrays, shape = tuple(map(store.extra, names)), membership(store).shape
        yield slice(None), scipy.sparse.csr_array(arrays, shape=shape)
        return
    for number in range(store.layout.blocks()):
        T, variance = store.block(c, number)
        V = scipy.sparse.csr_array((variance, T.indices, T.indptr), shape=T.shape)
        yield slice(*store.layout.span(number)), V
