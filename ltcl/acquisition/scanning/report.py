# SPDX-License-Identifier: BSD-3-Clause
"""`Report` of a finished scan, from its store: coverage, saturation, noise, reciprocity."""

from __future__ import annotations

import json
import math
import os
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import diagnostics
from ltcl.acquisition.scanning import balance, core
from ltcl.acquisition.scanning.cells import Cells
from ltcl.acquisition.scanning.pictures import Seen
from ltcl.errors import FileError
from ltcl.store import BlockStore, StoredRows

_SAMPLE = 512  # pixels from which the reciprocity of cells is measured


@dataclass(frozen=True, repr=False)
class Report:
    """Of a finished scan. Figures that are unknown are NaN, null in JSON.

    Attributes
    ----------
    strategy, why, grid, channels, exposures
        As scanned, exposures in seconds.
    patterns, photographs : int
        Of the scan, without those of the calibration.
    coverage, doubtful, masked : float
        Parts of the projector's pixels: that the camera sees; that are too dark next to bright ones, and
        so masked (`acquisition.geometry.resample`); that have no first bounce in some channel.
    saturated : float
        Part of the camera's pixels that saturate in all exposures under white.
    sharpness, blur : float
        Part of what comes out at a pixel that is its own light; relative error of a picture of noise by that
        (`acquisition.geometry.sharpness`). NaN of an aligned camera.
    entries, unknown : int, float
        Stored, of all channels; part of them without a valid photograph, which are 0.
    noise_direct, noise_sum : float
        Median relative standard deviation of the first bounce, and of row sums.
    beside_white : float
        Relative deviation (rms) of the sums of the measured columns from white: noise, thresholds, response.
        NaN of an adaptive scan, which begins with white.
    defect : float
        Deviation of T from reciprocity, of the worst channel (`ltcl.diagnostics`); NaN where it is unknown.
    levels : list of dict
        Of an adaptive scan: cells divided on each level, their entries, colours without conflict, patterns.

    Examples
    --------
    >>> import tempfile, ltcl
    >>> from ltcl.acquisition import VirtualRig
    >>> rig, store = VirtualRig(np.eye(64) / 2, (8, 8), bits=12), f"{tempfile.mkdtemp()}/T.zarr"
    >>> T = ltcl.acquire(rig, geometry="aligned", strategy="adaptive", store=store)
    >>> report = Report.of(store)
    >>> report.patterns, report.coverage, [level["colours"] for level in report.levels]
    (12, 1.0, [1, 1, 1])
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
    beside_white: float
    defect: float
    levels: list[dict[str, int]]

    @classmethod
    def of(cls, store: str | os.PathLike[str] | BlockStore) -> Report:
        """The report of a store; FileError where the scan is not finished, or not by `ltcl.acquire`."""
        scan = store if isinstance(store, BlockStore) else BlockStore.open(store)
        scan.verify()
        facts = scan.attributes
        if not scan.final or "strategy" not in facts:
            state = "is still being scanned" if "strategy" in facts else "was not made by ltcl.acquire"
            raise FileError(f"{scan.path}: {state}; a report needs a finished scan")
        exposures = np.asarray(scan.extra("calibration.exposures")).tolist()
        F, seen = np.asarray(scan.extra("first_bounce")), Seen.of(scan)
        measure = _of_cells if scan.layout.kind == "compressed" else _of_blocks
        noise = [measure(scan, seen, c, F[c]) for c in range(scan.layout.channels)]
        entries, unknown, direct, sums, defects = zip(*noise, strict=True)
        beside = math.nan
        if scan.layout.kind != "compressed":
            beside = balance.deviation(np.asarray(scan.extra(balance.SUMS)), seen.white)
        return cls(
            strategy=facts["strategy"],
            why=facts["why"],
            grid=scan.layout.grid,
            channels=scan.layout.channels,
            patterns=int(facts["patterns"]),
            photographs=int(facts["patterns"]) * len(exposures),
            exposures=exposures,
            coverage=float(np.mean(scan.extra("calibration.resampling.coverage") > 0)),
            doubtful=float(np.mean(scan.extra("calibration.resampling.doubtful"))),
            sharpness=seen.sharpness.own if seen.sharpness else math.nan,
            blur=seen.sharpness.blur if seen.sharpness else math.nan,
            masked=float(np.mean((F <= 0).any(axis=0))),
            saturated=1.0 - float(np.mean(scan.extra("calibration.white.valid"))),
            entries=sum(entries),
            unknown=sum(unknown) / max(sum(entries), 1),
            noise_direct=_median(direct),
            noise_sum=_median(sums),
            beside_white=beside,
            defect=max(defects),
            levels=facts.get("levels", []),
        )

    def to_json(self) -> str:
        """One line of JSON; NaN as null."""
        finite = {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in asdict(self).items()}
        return json.dumps(finite)

    def __repr__(self) -> str:
        h, w = self.grid
        return (
            f"<ltcl Report {self.strategy}, {h} x {w} pixels, {self.photographs} photographs, "
            f"{self.coverage:.1%} seen, noise of row sums {self.noise_sum:.2%}>"
        )

    def __str__(self) -> str:
        h, w = self.grid
        lines = [
            f"{self.strategy} ({self.why}), {h} x {w} pixels, {self.channels} channel(s)",
            f"{self.photographs} photographs: {self.patterns} patterns at "
            + ", ".join(f"{t:.3g} s" for t in self.exposures),
            f"seen {self.coverage:.1%}, masked {self.masked:.2%}, saturated {self.saturated:.2%}",
            f"{self.entries} entries stored, {self.unknown:.2%} of them without a valid photograph",
            f"noise of the first bounce {self.noise_direct:.2%}, of row sums {self.noise_sum:.2%}",
        ]
        if self.doubtful:
            lines.append(f"{self.doubtful:.2%} too dark next to bright pixels to be measured: masked")
        if not math.isnan(self.sharpness):
            own = f"{self.sharpness:.0%} of a pixel is its own light"
            lines.append(f"{own}: relative error of fine patterns {self.blur:.1%}")
        if not math.isnan(self.beside_white):
            photographs = "patterns" if self.strategy == "hadamard" else f"single {self.strategy}s"
            within = f"{100 * self.beside_white:.2g} % (good: below 0.5 %)"
            lines.append(f"photographs of {photographs} add up to white within {within}")
        defect = "unknown" if math.isnan(self.defect) else f"defect {self.defect:.2g}"
        lines.append(f"reciprocity {defect}")
        return "\n".join(lines) + "".join(
            f"\nlevel {level['level']}: {level['cells']} cells with {level['entries']} entries divided, in "
            f"{level['colours']} group(s) without conflict, {level['patterns']} patterns"
            for level in self.levels
        )


def _of_blocks(store: BlockStore, seen: Seen, c: int, F: np.ndarray) -> tuple[int, int, Any, Any, float]:
    """By rows: every entry has its own variance, and the sum that of white as well."""
    direct, sums, entries, unknown = [], [], 0, 0
    for b in range(store.layout.blocks()):
        start, stop = store.layout.span(b)
        T, variance = store.read(c, b), store.variance(c, b)
        assert variance is not None  # noqa: S101 - columns.py writes it with every block
        entries, unknown = entries + T.nnz, unknown + int(np.isnan(variance).sum())
        V = scipy.sparse.csr_array((np.nan_to_num(variance), T.indices, T.indptr), shape=T.shape)
        direct.append(_relative(V.diagonal(start), F[start:stop]))
        own, u = V.sum(axis=1), seen.white.variance[c, start:stop]
        sums.append(_relative(own * u / np.maximum(own + u, 1e-300), T.sum(axis=1)))
    return entries, unknown, np.concatenate(direct), np.concatenate(sums), _defect(StoredRows(store, c), F)


def _of_cells(store: BlockStore, _: Seen, c: int, F: np.ndarray) -> tuple[int, int, Any, Any, float]:
    """By cells: a pixel has the error of the cells that it is in, and sums that of all pixels of each."""
    cells, stored = Cells(store.layout.grid), core.Stored.of(store)
    C, V = stored.matrices[c], stored.variances[c]
    areas = np.concatenate([cells.areas(level) for level in range(cells.top + 1)])
    pixels = np.sort(np.random.default_rng(0).permutation(len(F))[:_SAMPLE])
    direct, sums = _relative(core.diagonal(cells, V), F), _relative(V @ areas**2, C @ areas)
    return C.nnz, 0, direct, sums, _defect(core.between(cells, C, pixels), F[pixels])


def _relative(variance: np.ndarray, value: np.ndarray) -> np.ndarray:
    lit = value > 0
    return np.sqrt(variance[lit]) / value[lit]


def _median(parts: tuple[np.ndarray, ...]) -> float:
    values = np.concatenate(parts)
    return float(np.median(values)) if values.size else math.nan


def _defect(T: Any, F: np.ndarray) -> float:
    return diagnostics.reciprocity_defect(T, np.maximum(F, 0.0), entries=diagnostics.QUICK)
