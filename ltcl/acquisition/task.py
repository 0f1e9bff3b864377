# SPDX-License-Identifier: BSD-3-Clause
"""`acquire`: from a rig to a transport, with photographs alone; it can be stopped at any time and goes on.

First the set-up is measured (`measuring`), which is committed as a whole, then T is scanned
(`scanning`), of which every batch of photographs is committed before the next is taken. What is in the store
is read back and never photographed again.
"""

from __future__ import annotations

import contextlib
import logging
import os
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ltcl import checks
from ltcl.acquisition import measuring
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.geometry import Correspondence
from ltcl.acquisition.radiometry import Response
from ltcl.acquisition.rig import Rig, Shots
from ltcl.acquisition.scanning import adaptive, columns, core, plan
from ltcl.acquisition.scanning.cells import Cells
from ltcl.acquisition.scanning.columns import Code
from ltcl.acquisition.scanning.hadamard import Hadamard
from ltcl.acquisition.scanning.log import Log
from ltcl.acquisition.scanning.pictures import Pictures
from ltcl.acquisition.scanning.pixel import Pixels
from ltcl.errors import InputError
from ltcl.files import as_path
from ltcl.store import BlockStore, StoredRows, load, zarr_folder
from ltcl.store.compressed import Parts
from ltcl.transport import Transport

logger = logging.getLogger(__name__)

Progress = Callable[[int, int], None]
_EXTRA = "calibration."


def acquire(
    rig: Rig,
    *,
    geometry: str | Correspondence = "graycode",
    strategy: str = "auto",
    store: str | os.PathLike[str] | None = None,
    resume: bool = True,
    progress: Progress | None = None,
    exposures: Any = None,
    response: Response | None = None,
    frames: int = 16,
    block: int = 2,
    order: int = 63,
    threshold: float = plan.THRESHOLD,
    sigmas: float = 3.0,
    device: Any = None,
) -> Transport:
    """Measure the transport of what a projector lights and a camera sees.

    Parameters
    ----------
    rig : Rig
        A projector and a camera: anything with projector_grid, channels and photograph(codes, seconds).
    geometry : "graycode", "aligned" or Correspondence
        Which projector pixel each camera pixel sees: measured; the same; or as measured before.
    strategy : "auto", "adaptive", "pixel", "block" or "hadamard"
        One pixel at a time; blocks of pixels, which makes a coarser transport; many pixels at once; cells
        that are divided where it tells. "auto" decides by the noise of the camera (`scanning.plan`).
    store : path, optional
        Folder of the transport on disk, which keeps what was photographed; without one nothing can be
        resumed, and all is held in memory.
    resume : bool
        Go on with what is in the store; else the store must not be there yet.
    progress : function of two ints, optional
        Told how many patterns have been photographed, and of how many in all at most.
    exposures : sequence of float, optional
        Seconds of the photographs of each pattern; left out, they are chosen.
    response : Response, optional
        Of the camera, where it is known.
    frames : int
        Photographs to average for black.
    block : int
        Side of the blocks of "block".
    order : int
        Pixels lit together by "hadamard", 2^k - 1.
    threshold : float
        Part of what a camera pixel sees under white, that a cell is divided for by "adaptive".
    sigmas : float
        Standard deviations, of an entry or of a sum of entries, that are light and not noise; 0 keeps all.
    device : Device or str, optional
        As in `Transport`.

    Returns
    -------
    Transport
        On the projector's pixels (blocks of them, of "block"), for light relative to white less black. Its
        unit is that of the camera: linear sensor value a second. Pixels without a first bounce are masked.

    Raises
    ------
    InputError, InputTypeError
        Bad arguments; a store that was made with others.
    AcquisitionError
        The rig fails; `PhotographMissing` where a person has yet to take one: call again then.
    FileError
        The store is damaged, or cannot be written.

    Examples
    --------
    >>> import ltcl
    >>> from ltcl.acquisition import VirtualRig
    >>> truth = ltcl.scenes.dihedral(4, albedo=0.6).transport()
    >>> rig = VirtualRig(truth, truth.grid, bits=12, ambient=0.01)
    >>> T = acquire(rig, geometry="aligned", strategy="pixel")
    >>> p = np.full(truth.grid, 0.5)
    >>> bool(abs(T @ p - truth @ p).max() < 0.02)
    True
    """
    wanted = Settings(
        checks.one_of("strategy", strategy, ("auto", *plan.STRATEGIES)),
        geometry if isinstance(geometry, str) else "given",
        None if exposures is None else tuple(float(t) for t in exposures),
        checks.count("block", block, least=2),
        Hadamard(order).size,
        checks.number("threshold", threshold, above=0.0, below=1.0),
        checks.number("sigmas", sigmas, least=0.0),
        checks.count("frames", frames),
    )
    checks.flag("resume", resume)
    shots = Shots(rig)
    with _place(store) as path:
        found = _found(path, resume)
        if found is not None:
            _refuse_other(found, shots, wanted)
        if found is None or not found.final:
            run = _begin(path, shots, wanted, geometry, response, found)
            _scan(run, progress or (lambda done, total: None))
        T = load(path, on_dark="mask", device=device)
        return T if store is not None else _in_memory(T, device)


@dataclass(frozen=True)
class Settings:
    """What decides which photographs are taken, and what becomes of them."""

    strategy: str
    geometry: str
    exposures: tuple[float, ...] | None
    block: int
    order: int
    threshold: float
    sigmas: float
    frames: int


@dataclass(frozen=True)
class _Scan:
    """A scan that has begun."""

    store: BlockStore
    pictures: Pictures
    wanted: Settings
    strategy: str

    @property
    def code(self) -> Code:
        return _code(self.strategy, self.wanted, self.pictures.grid)


@contextlib.contextmanager
def _place(store: str | os.PathLike[str] | None) -> Iterator[Path]:
    if store is not None:
        yield as_path(store)
        return
    with tempfile.TemporaryDirectory(prefix="ltcl-") as folder:
        yield Path(folder) / "T.zarr"


def _found(path: Path, resume: bool) -> BlockStore | None:
    """The store of an earlier run whose calibration was committed."""
    if not path.exists():
        return None
    if not resume:
        raise InputError(f"resume is False, but {path} is there already; give another store")
    found = BlockStore.open(path, "a")
    if "acquisition" not in found.provenance:
        raise InputError(f"store is {path}, which ltcl.acquire did not make; give another one")
    return found if "strategy" in found.attributes else None


def _begin(
    path: Path,
    shots: Shots,
    wanted: Settings,
    geometry: str | Correspondence,
    response: Response | None,
    found: BlockStore | None,
) -> _Scan:
    if found is not None:
        return _resumed(found, shots, wanted)
    told = measuring.measure(
        shots,
        geometry=geometry,
        response=response,
        exposures=wanted.exposures,
        frames=wanted.frames,
        tell=lambda what: logger.info("calibration: %s", what),
    )
    plans = _plans(shots, told, wanted)
    strategy, why = (wanted.strategy, "as asked for")
    if strategy == "auto":
        strategy, why = plan.choose(plans)
    logger.info("%s (%s)", plans[strategy], why)
    pictures = Pictures(shots, told, wanted.block if strategy == "block" else 1)
    store = _create(path, pictures, strategy, wanted)
    for name, array in told.to_arrays().items():
        store.extra(_EXTRA + name, array)
    if told.mixing is not None:
        store.extra("mixing", told.mixing)
    facts = {"settings": _plain(wanted), "why": why, "plan": asdict(plans[strategy])}
    store.update(**facts, strategy=strategy)  # from here on it is resumed
    return _Scan(store, pictures, wanted, strategy)


def _refuse_other(found: BlockStore, shots: Shots, wanted: Settings) -> None:
    """Refuse to go on with what was begun with another rig, or with other settings."""
    made, asked = found.attributes["settings"], _plain(wanted)
    other = [name for name in asked if made.get(name) != asked[name]]
    if other:
        name = other[0]
        raise InputError(
            f"{name} is {asked[name]!r}, but {found.path} was begun with {made.get(name)!r}; it must be "
            "that, or another store"
        )
    grid, channels = found.extra(_EXTRA + "resampling.coverage").shape, found.layout.channels
    if (grid, channels) != (shots.grid, shots.channels):
        raise InputError(
            f"rig has {shots.grid} pixels and {shots.channels} channel(s), but {found.path} was begun with "
            f"{grid} and {channels}; it must be that rig, or another store"
        )


def _resumed(found: BlockStore, shots: Shots, wanted: Settings) -> _Scan:
    arrays = {
        name.removeprefix(_EXTRA): found.extra(name) for name in found.extras if name.startswith(_EXTRA)
    }
    told = Calibration.from_arrays(arrays)
    strategy = found.attributes["strategy"]
    pictures = Pictures(shots, told, wanted.block if strategy == "block" else 1)
    return _Scan(found, pictures, wanted, strategy)


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


def _code(strategy: str, wanted: Settings, grid: tuple[int, int]) -> Code:
    """Two batches at least, so that no pattern is white, which the calibration has photographed already."""
    half = max(1, grid[0] * grid[1] // 2)
    if strategy == "hadamard":
        return Hadamard(min(wanted.order, (1 << half.bit_length() - 1) - 1 or 1))
    return Pixels(min(Pixels().size, half))


def _create(path: Path, pictures: Pictures, strategy: str, wanted: Settings) -> BlockStore:
    h, w = pictures.grid
    told = {"acquisition": {**pictures.shots.describe(), **_plain(wanted)}}
    common: dict[str, Any] = {
        "channels": pictures.channels,
        "orientation": "columns",
        "provenance": told,
        "overwrite": path.exists(),  # a run that ended before its calibration was committed
    }
    if strategy == "adaptive":
        most = adaptive.most_patterns(Cells((h, w)))
        sizes = {"shape": (h * w, most), "grid": (1, most), "camera_grid": (h, w)}
        return BlockStore.create(path, **sizes, block_rows=adaptive.AT_ONCE, **common)
    rows = _code(strategy, wanted, (h, w)).size
    return BlockStore.create(path, shape=(h * w, h * w), grid=(h, w), block_rows=rows, **common)


def _scan(run: _Scan, progress: Progress) -> None:
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
    run.store.update(patterns=total)
    run.store.finalize()


def _scan_cells(run: _Scan, progress: Progress) -> None:
    """Scan with the store as a log of pictures, which the transport then takes the place of."""
    total = int(run.store.attributes["plan"]["patterns"])
    log = Log(run.store, run.pictures, lambda done: progress(done, max(done, total)))
    found = adaptive.scan(run.pictures, log, run.wanted.threshold, run.wanted.sigmas)
    mixing = run.pictures.calibration.mixing
    arrays = core.arrays(found.core, mixing)
    beside = {name: run.store.extra(name) for name in run.store.extras if name.startswith(_EXTRA)}
    facts = run.store.attributes | {
        "patterns": log.done,
        "levels": [told._asdict() for told in found.levels],
    }
    zarr_folder.write(
        run.store.path, Parts(arrays), extras=beside, attributes=facts, provenance=run.store.provenance
    )


def _in_memory(T: Transport, device: Any) -> Transport:
    """The same without files behind it."""
    matrices = [part.tocsr() if isinstance(part, StoredRows) else part for part in T.matrices]
    if all(a is b for a, b in zip(matrices, T.matrices, strict=True)):
        return T
    given: Any = matrices if len(matrices) == 3 else matrices[0]
    return Transport(given, T.grid, T.first_bounce, device=device, on_dark="mask", mixing=T.mixing)


def _plain(wanted: Settings) -> dict[str, Any]:
    """As JSON gives it back."""
    return {name: list(v) if isinstance(v, tuple) else v for name, v in asdict(wanted).items()}
