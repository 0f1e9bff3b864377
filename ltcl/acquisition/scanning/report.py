# SPDX-License-Identifier: BSD-3-Clause
"""What came of a scan, from its store: coverage, saturation, conflicts, noise, reciprocity."""

from __future__ import annotations

import json
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

_SAMPLE = 512  # pixels that the reciprocity of cells is told by


@dataclass(frozen=True)
class Report:
    """Of a scan that has ended.

    Attributes
    ----------
    strategy, why : str
        How it was scanned, and why so.
    grid : (h, w)
    channels : int
    patterns, photographs : int
        Of the scan, those of the calibration left out.
    exposures : list of float
        Seconds.
    coverage : float
        Part of the projector's pixels that the camera sees.
    doubtful : float
        Part of them that few and dark camera pixels see, of which errors of photographs and map would be most
        (`acquisition.geometry.resample`): not counted as seen, and masked.
    sharpness : float
        Part of what comes out at a pixel that is its own light, and not that of its neighbours
        (`acquisition.geometry.sharpness`); NaN of a camera that is aligned, where nothing tells it.
    blur : float
        How far a picture of noise is off by that, relative to it; NaN where it is not told.
    masked : float
        Part of the pixels that have no first bounce in some channel.
    saturated : float
        Part of the camera's pixels that no exposure tells under white.
    entries : int
        Kept, of all channels.
    unknown : float
        Part of them that no photograph tells, such as pixels that all exposures saturate; they are 0.
    noise_direct, noise_sum : float
        Median relative standard deviation of the first bounce, and of what white shows.
    beside_white : float
        Root mean square of what a scan by columns had added up to beside white, relative to white: noise,
        thresholds, and all that is wrong with the response. NaN of an adaptive scan, which begins with white.
    defect : float
        How far T is from reciprocal, of the worst channel (`ltcl.diagnostics`); NaN where it is not told.
    levels : list of dict
        Of an adaptive scan: cells that were divided on each level, their entries, colours (cells of one
        colour do not conflict), patterns.

    Examples
    --------
    >>> import tempfile, ltcl
    >>> from ltcl.acquisition import VirtualRig
    >>> rig, store = VirtualRig(np.eye(64) / 2, (8, 8), bits=12), f"{tempfile.mkdtemp()}/T.zarr"
    >>> T = ltcl.acquire(rig, geometry="aligned", strategy="adaptive", store=store)
    >>> told = Report.of(store)
    >>> told.patterns, told.coverage, [level["colours"] for level in told.levels]
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
        """The report of a store, or of the folder of one.

        Raises
        ------
        FileError
            The scan has not ended, or the store is none that `ltcl.acquire` made.
        """
        found = store if isinstance(store, BlockStore) else BlockStore.open(store)
        found.verify()
        told = found.attributes
        if not found.final or "strategy" not in told:
            state = "is still being scanned" if "strategy" in told else "was not made by ltcl.acquire"
            raise FileError(f"{found.path}: {state}; a report is of a scan that has ended")
        exposures = np.asarray(found.extra("calibration.exposures")).tolist()
        part = _of_cells(found) if found.layout.kind == "compressed" else _of_blocks(found)
        sharp = Seen.of(found).sharpness
        return cls(
            strategy=told["strategy"],
            why=told["why"],
            grid=found.layout.grid,
            channels=found.layout.channels,
            patterns=int(told["patterns"]),
            photographs=int(told["patterns"]) * len(exposures),
            exposures=exposures,
            coverage=float(np.mean(found.extra("calibration.resampling.coverage") > 0)),
            doubtful=float(np.mean(found.extra("calibration.resampling.doubtful"))),
            sharpness=sharp.own if sharp else float("nan"),
            blur=sharp.blur if sharp else float("nan"),
            saturated=1.0 - float(np.mean(found.extra("calibration.white.valid"))),
            levels=told.get("levels", []),
            **part,
        )

    def to_json(self) -> str:
        """One line of JSON; NaN as null."""
        plain = {
            k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in asdict(self).items()
        }
        return json.dumps(plain)

    def __str__(self) -> str:
        h, w = self.grid
        lines = [
            f"{self.strategy} ({self.why}), {h} x {w} pixels, {self.channels} channel(s)",
            f"{self.photographs} photographs: {self.patterns} patterns at "
            + ", ".join(f"{t:.3g} s" for t in self.exposures),
            f"seen {self.coverage:.1%}, masked {self.masked:.2%}, saturated {self.saturated:.2%}"
            + (f"; {self.doubtful:.2%} too dark beside bright pixels to be told" if self.doubtful else ""),
            "sharpness not told"
            if np.isnan(self.sharpness)
            else f"{self.sharpness:.0%} of a pixel is its own light; fine patterns: off by {self.blur:.1%}",
            f"{self.entries} entries kept, {self.unknown:.2%} of them not told by any photograph",
            f"noise of the first bounce {self.noise_direct:.2%}, of what white shows {self.noise_sum:.2%}"
            + ("" if np.isnan(self.beside_white) else f"; columns were {self.beside_white:.2%} beside it"),
            "reciprocity not told" if np.isnan(self.defect) else f"reciprocity defect {self.defect:.2g}",
        ]
        lines += [
            f"level {one['level']}: {one['cells']} cells with {one['entries']} entries divided, in "
            f"{one['colours']} group(s) without conflict, {one['patterns']} patterns"
            for one in self.levels
        ]
        return "\n".join(lines)


def _of_blocks(store: BlockStore) -> dict[str, Any]:
    """By rows: every entry has its own variance, and the sum that of white as well."""
    F, white = np.asarray(store.extra("first_bounce")), Seen.of(store).white
    direct, sums, entries, unknown, defects = [], [], 0, 0, []
    for c in range(store.layout.channels):
        for b in range(store.layout.blocks()):
            start, stop = store.layout.span(b)
            T, variance = store.read(c, b), store.variance(c, b)
            assert variance is not None  # noqa: S101 - columns.py writes it with every block
            entries, unknown = entries + T.nnz, unknown + int(np.isnan(variance).sum())
            V = scipy.sparse.csr_array((np.nan_to_num(variance), T.indices, T.indptr), shape=T.shape)
            direct.append(_relative(V.diagonal(start), F[c, start:stop]))
            own, u = V.sum(axis=1), white.variance[c, start:stop]
            sums.append(_relative(own * u / np.maximum(own + u, 1e-300), T.sum(axis=1)))
        defects.append(_defect(StoredRows(store, c), F[c]))
    beside = balance.beside(np.asarray(store.extra(balance.SUMS)), white)
    return _noise(direct, sums, entries, unknown, F, max(defects)) | {"beside_white": beside}


def _of_cells(store: BlockStore) -> dict[str, Any]:
    """By cells: a pixel has the error of the cells that it is in, and sums that of all pixels of each."""
    F, cells = np.asarray(store.extra("first_bounce")), Cells(store.layout.grid)
    areas = np.concatenate([cells.areas(level) for level in range(cells.top + 1)])
    pixels = np.sort(np.random.default_rng(0).permutation(len(F[0]))[:_SAMPLE])
    direct, sums, entries, defects = [], [], 0, []
    stored = core.Stored.of(store)
    for c, (C, V) in enumerate(zip(stored.matrices, stored.variances, strict=True)):
        entries += C.nnz
        direct.append(_relative(core.diagonal(cells, V), F[c]))
        sums.append(_relative(V @ areas**2, C @ areas))
        defects.append(_defect(core.between(cells, C, pixels), F[c][pixels]))
    return _noise(direct, sums, entries, 0, F, max(defects))


def _noise(
    direct: list[np.ndarray], sums: list[np.ndarray], entries: int, unknown: int, F: np.ndarray, defect: float
) -> dict[str, Any]:
    return {
        "masked": float(np.mean((F <= 0).any(axis=0))),
        "entries": entries,
        "unknown": unknown / max(entries, 1),
        "noise_direct": _median(direct),
        "noise_sum": _median(sums),
        "beside_white": float("nan"),
        "defect": defect,
    }


def _relative(variance: np.ndarray, value: np.ndarray) -> np.ndarray:
    lit = value > 0
    return np.sqrt(variance[lit]) / value[lit]


def _median(parts: list[np.ndarray]) -> float:
    values = np.concatenate(parts)
    return float(np.median(values)) if values.size else float("nan")


def _defect(T: Any, F: np.ndarray) -> float:
    return diagnostics.reciprocity_defect(T, np.maximum(F, 0.0), entries=diagnostics.QUICK)
