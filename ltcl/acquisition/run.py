# SPDX-License-Identifier: BSD-3-Clause
"""A scan with its store: begun with a calibration, resumed with the one in the store, and run to its end.

Columns go into the store as they are found. Of an adaptive scan the store is a log of pictures, which the
transport takes the place of when it is found. What decides the photographs, `Settings`, is kept with both.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ltcl.acquisition import kept, measuring, unchanged
from ltcl.acquisition.calibration import PREFIX, Calibration
from ltcl.acquisition.geometry import Correspondence
from ltcl.acquisition.radiometry import Response
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.scanning import adaptive, balance, columns, core, plan
from ltcl.acquisition.scanning.cells import Cells
from ltcl.acquisition.scanning.columns import Code
from ltcl.acquisition.scanning.log import Log
from ltcl.acquisition.scanning.pictures import Picture, Pictures
from ltcl.acquisition.scanning.sums import compare
from ltcl.acquisition.settings import Settings
from ltcl.errors import FileError, InputError
from ltcl.store import BlockStore, zarr_folder
from ltcl.store.blocks import creating
from ltcl.store.compressed import Parts

logger = logging.getLogger(__name__)
_NOISY = 0.05  # of white: columns may mostly be as far beside it

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Run:
    """A scan that has begun."""

    store: BlockStore
    pictures: Pictures
    wanted: Settings
    strategy: str

    @property
    def code(self) -> Code:
        """How batches are lit, where columns are scanned."""
        return columns.code_of(self.strategy, self.pictures.grid, self.wanted.order)


def begin(
    path: Path,
    shots: Shots,
    wanted: Settings,
    geometry: str | Correspondence,
    response: Response | None,
    keep: bool,
) -> Run:
    """Measure the set-up and make the store; `keep` photographs until it is there."""
    creating.check(path, overwrite=True)
    with kept.keeping(path, shots) if keep else contextlib.nullcontext():
        return _begun(path, shots, wanted, geometry, response)


def _begun(
    path: Path, shots: Shots, wanted: Settings, geometry: str | Correspondence, response: Response | None
) -> Run:
    """The store is one to be resumed from the last line on."""
    told = measuring.measure(
        shots,
        geometry=geometry,
        response=response,
        exposures=wanted.exposures,
        frames=wanted.frames,
        side=wanted.block if wanted.strategy == "block" else 1,
        tell=lambda what: logger.info("calibration: %s, from photograph %d", what, shots.count + 1),
    )
    plans = _plans(shots, told, wanted)
    strategy, why = (wanted.strategy, "as asked for")
    if strategy == "auto":
        strategy, why = plan.choose(plans)
    logger.info("%s (%s)", plans[strategy], why)
    pictures = Pictures(shots, told, wanted.block if strategy == "block" else 1)
    store = _create(path, pictures, strategy, wanted)
    told.write(store)
    if told.mixing is not None:
        store.extra("mixing", told.mixing)
    facts = {"settings": _plain(wanted), "why": why, "plan": asdict(plans[strategy])}
    store.update(**facts, strategy=strategy)  # from here on it is resumed
    return Run(store, pictures, wanted, strategy)


def refuse_other(found: BlockStore, shots: Shots, wanted: Settings) -> None:
    """Refuse to go on with what was begun with another rig, or with other settings."""
    (made, planned, strategy), asked = _state(found), _plain(wanted)
    if strategy not in plan.STRATEGIES or type(planned.get("patterns")) is not int:
        raise FileError(
            f"{found.path}: its scan is {strategy!r:.40} of {planned!r:.40}; that is none of ltcl"
        )
    other = [name for name in asked if made.get(name) != asked[name]]
    if other:
        name = other[0]
        raise unchanged.changed(name, asked[name], found.path, made.get(name))
    grid, channels = found.extra(PREFIX + "resampling.coverage").shape, found.layout.channels
    if (grid, channels) != (shots.grid, shots.channels):
        raise InputError(
            f"rig has {shots.grid} pixels and {shots.channels} channel(s), but {found.path} was begun with "
            f"{grid} and {channels}; it must be that rig, or another store"
        )
    told = found.provenance["acquisition"]
    unchanged.refuse_other_rig(told.get("rig") if isinstance(told, dict) else None, shots, found.path)


def _state(found: BlockStore) -> tuple[dict[str, Any], dict[str, Any], Any]:
    """Settings and plan, empty where there are none, and the strategy."""
    told = found.attributes
    made, planned = (part if isinstance(part, dict) else {} for part in map(told.get, ("settings", "plan")))
    return made, planned, told["strategy"]


def resumed(found: BlockStore, shots: Shots, wanted: Settings) -> Run:
    """Go on with the calibration that is in the store."""
    told = Calibration.of(found)
    strategy = found.attributes["strategy"]
    pictures = Pictures(shots, told, wanted.block if strategy == "block" else 1)
    return Run(found, pictures, wanted, strategy)


def _plans(shots: Shots, told: Calibration, wanted: Settings) -> dict[str, plan.Plan]:
    """Of all strategies, with noise and light as they were measured."""
    return plan.plans(
        shots.grid,
        told.exposures,
        told.noise,
        plan.measured(told),
        channels=shots.channels,
        block=wanted.block,
        order=wanted.order,
        threshold=wanted.threshold,
    )


def _create(path: Path, pictures: Pictures, strategy: str, wanted: Settings) -> BlockStore:
    h, w = pictures.grid
    told = {"acquisition": {**pictures.shots.describe(), **_plain(wanted)}}
    common: dict[str, Any] = {
        "channels": pictures.channels,
        "orientation": "columns",
        "provenance": told,
        "overwrite": True,  # what a run left that ended before its calibration was committed
    }
    if strategy == "adaptive":
        most = adaptive.most_patterns(Cells((h, w)))
        sizes = {"shape": (h * w, most), "grid": (1, most), "camera_grid": (h, w)}
        return BlockStore.create(path, **sizes, block_rows=adaptive.AT_ONCE, **common)
    rows = columns.code_of(strategy, (h, w), wanted.order).size
    return BlockStore.create(path, shape=(h * w, h * w), grid=(h, w), block_rows=rows, **common)


def scan(run: Run, progress: Progress) -> None:
    """Photograph what is missing, and finish the store."""
    if run.strategy == "adaptive":
        _scan_cells(run, progress)
        return
    h, w = run.pictures.grid
    total, done = columns.patterns(run.code, h * w), 0

    def tell(patterns: int) -> None:
        nonlocal done
        done += patterns
        progress(done, total)

    columns.scan(run.pictures, run.code, run.store, run.wanted.sigmas, tell)
    _finish(run, total)


def _finish(run: Run, patterns: int) -> None:
    """Columns as rows that add up to white; what they added up to before is kept for the report."""
    store, white = run.store, run.pictures.white
    if balance.SUMS not in store.extras:  # of a run that was killed behind it
        sums = np.stack([balance.sums(store, c) for c in range(run.pictures.channels)])
        off = balance.mostly_beside(sums, white)
        compare(f"{store.path}: columns of T", off, "what white showed", much=_NOISY)
        store.extra(balance.SUMS, sums)
    store.update(patterns=patterns)

    def add_up(c: int, first: int, matrix: Any, variance: Any) -> tuple[Any, Any]:
        here = slice(first, first + matrix.shape[0])
        return balance.rows(matrix, variance, Picture(white.value[c, here], white.variance[c, here]))

    store.finalize(sigmas=run.wanted.sigmas, change=add_up)


def _scan_cells(run: Run, progress: Progress) -> None:
    """Scan with the store as a log of pictures, which the transport then takes the place of."""
    total = int(run.store.attributes["plan"]["patterns"])
    progress(0, total)
    log = Log(run.store, run.pictures, lambda done: progress(done, max(done, total)))
    found = adaptive.scan(run.pictures, log, run.wanted.threshold, run.wanted.sigmas)
    mixing = run.pictures.calibration.mixing
    arrays = core.arrays(found.core, mixing, run.wanted.sigmas)
    run.store.update(patterns=log.done, levels=[told._asdict() for told in found.levels])
    zarr_folder.conclude(run.store, Parts(arrays), core.variances(found.core))
    progress(log.done, log.done)


def _plain(wanted: Settings) -> dict[str, Any]:
    """As JSON gives it back."""
    return {name: list(v) if isinstance(v, tuple) else v for name, v in asdict(wanted).items()}
