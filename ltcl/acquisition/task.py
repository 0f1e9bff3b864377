# SPDX-License-Identifier: BSD-3-Clause
"""`acquire`: from a rig to a transport, by photographs alone; it can be stopped at any time, and goes on.

First the set-up is measured (`calibrate`) and committed as a whole, its photographs being `kept` until then;
then T is scanned (`scanning`), each batch of photographs being committed before the next is taken. Nothing
that is committed is photographed again. Columns go into the store as they are decoded; of an adaptive scan
the store is a log of pictures, which the transport replaces in the end.
"""

from __future__ import annotations

import contextlib
import logging
import os
import tempfile
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition import calibrate, kept
from ltcl.acquisition.calibrate import Progress
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.geometry import Correspondence
from ltcl.acquisition.radiometry import Response
from ltcl.acquisition.rig import Rig, Shots
from ltcl.acquisition.scanning import adaptive, balance, codes, columns, core, plan
from ltcl.acquisition.scanning.cells import Cells
from ltcl.acquisition.scanning.log import Log
from ltcl.acquisition.scanning.pictures import Picture, Pictures
from ltcl.acquisition.settings import Settings, check_same
from ltcl.errors import InputError, InputTypeError
from ltcl.files import as_path
from ltcl.store import BlockStore, StoredRows, load, zarr_folder
from ltcl.store.block_store import check_place
from ltcl.store.record import Parts
from ltcl.transport import Transport

logger = logging.getLogger(__name__)


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
    """Measure the transport of what a projector lights and a camera sees; or go on where that was stopped.

    Parameters
    ----------
    rig : Rig
        A projector and a camera: anything with projector_grid, channels and photograph(codes, seconds).
    geometry : "graycode", "aligned" or Correspondence
        Which projector pixel each camera pixel sees: measured; the same; or as measured before.
    strategy : "auto", "adaptive", "pixel", "block" or "hadamard"
        Cells that are divided where needed; one pixel at a time; blocks of pixels, which makes a coarser
        transport; many pixels at once. "auto" decides by the noise of the camera (`scanning.plan`).
    store : path, optional
        Folder of the transport on disk, which keeps what was photographed; without one nothing can be
        resumed, and all is held in memory. Until the set-up is measured its photographs are in the folder
        STORE.calibration, whatever ends it; to begin anew, remove both.
    resume : bool
        Go on with what is in the store; else the store must not exist.
    progress : function of (str, int, int), optional
        Called with a step, "calibration" or "scan", and how many photographs or patterns of it are done, and
        of how many at most; those of an earlier run count.
    exposures : sequence of float, optional
        Seconds of the photographs of each pattern, which the rig must have; by default chosen.
    response : Response, optional
        Of the camera, where it is known.
    frames : int
        Photographs of black and of white that are averaged; those of a person are shared by the camera pixels
        that see one projector pixel.
    block : int
        Side of the blocks of "block".
    order : int
        Pixels lit together by "hadamard", 2^k - 1.
    threshold : float
        Part of what a camera pixel sees under white, above which a cell is divided by "adaptive".
    sigmas : float
        Standard deviations above which an entry or a sum of entries is light and not noise; 0 keeps all.
    device : Device or str, optional
        As in `Transport`.

    Returns
    -------
    Transport
        On the projector's pixels (blocks of them, of "block"), for light relative to white less black. Its
        unit is that of the camera: linear sensor value a second. Pixels without a first bounce are masked.
        `ltcl.acquisition.Setup.of(store)` has the codes that the projector is fed for linear light, and the
        ambient light on these pixels.

    Raises
    ------
    InputError, InputTypeError
        Bad arguments; a store that was made with others, or with another rig.
    AcquisitionError
        The rig fails, or photographs contradict each other; `PhotographMissing` where a person has yet to
        take one: call again then.
    FileError
        The store is damaged, or cannot be written.

    Examples
    --------
    >>> import ltcl, numpy
    >>> from ltcl.acquisition import VirtualRig
    >>> truth = ltcl.scenes.dihedral(4, albedo=0.6).transport()
    >>> rig = VirtualRig(truth, truth.grid, bits=12, ambient=0.01)
    >>> T = acquire(rig, geometry="aligned", strategy="pixel")
    >>> p = numpy.full(truth.grid, 0.5)
    >>> bool(abs(T @ p - truth @ p).max() < 0.02)
    True
    """
    checks.flag("resume", resume)
    if progress is not None and not callable(progress):
        raise InputTypeError(f"progress is {progress!r}; it must be a function of (str, int, int), or None")
    progress = progress or (lambda step, done, total: None)
    shots = Shots(rig)
    settings = Settings.of(
        shots,
        geometry=geometry,
        strategy=strategy,
        exposures=exposures,
        response=response,
        frames=frames,
        block=block,
        order=order,
        threshold=threshold,
        sigmas=sigmas,
    )
    with _place(store) as path:
        begun = _begun(path, resume)
        if begun is not None:
            check_same(begun, shots, settings)
            kept.forget(path)
        else:
            check_place(path, overwrite=True)
            with kept.keeping(path, shots) if store is not None else contextlib.nullcontext():
                begun = _begin(path, shots, settings, geometry, response, progress)
        if begun.final:
            begun.finalize()  # removes what a process that was killed at the very end has left
        else:
            scan(begun, shots, settings, progress)
        T = load(path, on_dark="mask", device=device)
        return T if store is not None else _in_memory(T, device)


@contextlib.contextmanager
def _place(store: str | os.PathLike[str] | None) -> Iterator[Path]:
    if store is not None:
        yield as_path(store, "store")
        return
    with tempfile.TemporaryDirectory(prefix="ltcl-") as folder:
        yield Path(folder) / "T.zarr"


def _begun(path: Path, resume: bool) -> BlockStore | None:
    """The store of an earlier run whose calibration was committed."""
    if not resume and kept.count(path):
        raise InputError(
            f"resume is False, but {kept.place(path)} holds {kept.count(path)} photographs of a calibration "
            "that has not ended; remove it, or give another store"
        )
    if not os.path.exists(path) or (path.is_dir() and not any(path.iterdir())):
        return None
    if not resume:
        raise InputError(f"resume is False, but {path} exists; give another store")
    store = BlockStore.open(path, "a")
    if "acquisition" not in store.provenance:
        raise InputError(f"store is {path}, which ltcl.acquire did not make; give another one")
    return store if "strategy" in store.attributes else None


def _begin(
    path: Path,
    shots: Shots,
    settings: Settings,
    geometry: str | Correspondence,
    response: Response | None,
    progress: Progress,
) -> BlockStore:
    """Measure the set-up, choose a strategy, and make the store."""
    calibration = calibrate.measure(
        shots,
        geometry=geometry,
        response=response,
        exposures=settings.exposures,
        frames=settings.frames,
        side=settings.block if settings.strategy == "block" else 1,
        progress=progress,
    )
    plans = plan.plans(
        shots.grid,
        calibration.exposures,
        calibration.noise,
        plan.measured(calibration),
        channels=shots.channels,
        block=settings.block,
        order=settings.order,
        threshold=settings.threshold,
        calibration=shots.count,
    )
    strategy, why = settings.strategy, "as asked for"
    if strategy == "auto":
        strategy, why = plan.choose(plans)
    logger.info("%s (%s)", plans[strategy], why)
    pictures = Pictures(shots, calibration, settings.block if strategy == "block" else 1)
    h, w = pictures.grid
    if strategy == "adaptive":
        most = adaptive.most_patterns(Cells((h, w)))
        sizes: dict[str, Any] = {"shape": (h * w, most), "grid": (1, most), "camera_grid": (h, w)}
        sizes["block_rows"] = adaptive.AT_ONCE
    else:
        rows = codes.code_of(strategy, (h, w), settings.order).size
        sizes = {"shape": (h * w, h * w), "grid": (h, w), "block_rows": rows}
    store = BlockStore.create(
        path,
        **sizes,
        channels=pictures.channels,
        orientation="columns",
        provenance={"acquisition": {**shots.describe(), **settings.to_json()}},
        overwrite=True,  # what a run left that ended before its calibration was committed
    )
    calibration.write(store)
    if calibration.mixing is not None:
        store.extra("mixing", calibration.mixing)
    store.update(settings=settings.to_json(), why=why, plan=asdict(plans[strategy]), strategy=strategy)
    return store  # which is resumed from here on


def scan(store: BlockStore, shots: Shots, settings: Settings, progress: Progress) -> None:
    """Photograph what is missing in a store with its calibration, and make the transport of it."""
    calibration, strategy = Calibration.of(store), store.attributes["strategy"]
    pictures = Pictures(shots, calibration, settings.block if strategy == "block" else 1)
    if strategy == "adaptive":
        most = int(store.attributes["plan"]["patterns"])
        progress("scan", 0, most)
        log = Log(store, pictures, lambda done: progress("scan", done, max(done, most)))
        cells = adaptive.scan(pictures, log, settings.threshold, settings.sigmas)
        store.update(patterns=log.done, levels=[level._asdict() for level in cells.levels])
        arrays = core.arrays(cells.core, calibration.mixing, settings.sigmas)
        zarr_folder.conclude(store, Parts(arrays), core.variances(cells.core))
        progress("scan", log.done, log.done)
        return
    h, w = pictures.grid
    code, done = codes.code_of(strategy, (h, w), settings.order), 0
    total = codes.patterns(code, h * w)

    def tell(patterns: int) -> None:
        nonlocal done
        done += patterns
        progress("scan", done, total)

    columns.scan(pictures, code, store, settings.sigmas, tell)
    _balance(store, pictures, settings.sigmas, total)


def _balance(store: BlockStore, pictures: Pictures, sigmas: float, patterns: int) -> None:
    """Columns as rows that add up to white; their sums before that are kept for the report."""
    white = pictures.white
    if balance.SUMS not in store.extras:  # of a run that was killed after it
        sums = np.stack([balance.sums(store, c) for c in range(pictures.channels)])
        balance.check_row_sums(str(store.path), sums, white)
        store.extra(balance.SUMS, sums)
    store.update(patterns=patterns)

    def add_up(c: int, first: int, matrix: Any, variance: Any) -> tuple[Any, Any]:
        rows = slice(first, first + matrix.shape[0])
        return balance.rows(matrix, variance, Picture(white.value[c, rows], white.variance[c, rows]))

    store.finalize(sigmas=sigmas, change=add_up)


def _in_memory(T: Transport, device: Any) -> Transport:
    """The same without files."""
    matrices = [part.tocsr() if isinstance(part, StoredRows) else part for part in T.matrices]
    if all(a is b for a, b in zip(matrices, T.matrices, strict=True)):
        return T
    every: Any = matrices if len(matrices) == 3 else matrices[0]
    return Transport(every, T.grid, T.first_bounce, device=device, on_dark="mask", mixing=T.mixing)
