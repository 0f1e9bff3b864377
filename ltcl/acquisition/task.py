# SPDX-License-Identifier: BSD-3-Clause
"""`acquire`: from a rig to a transport, by photographs alone; it can be stopped at any time, and goes on.

First the set-up is measured (`calibrate`) and committed as a whole; then T is scanned (`scanning`),
batch by batch: columns of T, or pictures of an adaptive scan, which the transport replaces in the
end.
"""

from __future__ import annotations

import json
import logging
import math
import os
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition import calibrate, session
from ltcl.acquisition.calibrate import Progress
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.geometry import Correspondence
from ltcl.acquisition.radiometry import Response
from ltcl.acquisition.rig import Rig, Shots
from ltcl.acquisition.scanning import adaptive, columns, plan
from ltcl.acquisition.scanning.pictures import Log, Picture, Pictures
from ltcl.acquisition.session import check_same, check_same_rig
from ltcl.acquisition.settings import STRATEGIES, ScanSettings
from ltcl.errors import AcquisitionError, FileError, InputError, InputTypeError, ScanRefused
from ltcl.files import as_path
from ltcl.store import BlockStore, CompressedRecord, StoredRows, load
from ltcl.store.block_store import check_place
from ltcl.transport.transport import Transport

logger = logging.getLogger(__name__)
_REFUSED = 0.3  # of white: relative deviation of row sums
_SAME_VIEW = 0.03  # of full scale, mean over the cells of a digest: lamps and exposures vary less


def acquire(
    rig: Rig,
    *,
    geometry: str | Correspondence = ScanSettings.geometry,
    strategy: str = ScanSettings.strategy,
    store: str | os.PathLike[str] | None = None,
    resume: bool = True,
    progress: Progress | None = None,
    exposures: Sequence[float] | None = ScanSettings.exposures,
    response: Response | None = ScanSettings.response,
    frames: int = ScanSettings.frames,
    block: int = ScanSettings.block,
    order: int = ScanSettings.order,
    threshold: float = ScanSettings.threshold,
    sigmas: float = ScanSettings.sigmas,
    device: Any = None,
) -> Transport:
    """Measure the transport of what a projector lights and a camera sees; or go on where that was stopped.

    Parameters
    ----------
    rig : Rig
        A projector and a camera: anything with projector_grid, channels and photograph(codes,
        seconds).
    geometry : "graycode", "aligned" or Correspondence
        Which projector pixel each camera pixel sees: measured; the same; or as measured before.
    strategy : "auto", "adaptive", "pixel", "block" or "hadamard"
        Cells that are divided where needed; one pixel at a time; blocks of pixels, which makes a
        coarser transport; many pixels at once. "auto" decides by the noise of the camera
        (`scanning.plan`).
    store : path, optional
        Folder of the transport, which keeps what was photographed, to be resumed. Until the set-up
        is measured its photographs are in the folder STORE.calibration; to begin anew, remove both.
    resume : bool
        Go on with what is in the store; else the store must not exist.
    progress : function of (str, int, int), optional
        Called with "calibration" or "scan", how many of its photographs or patterns are done, those
        of an earlier run included, and of how many at most.
    exposures : sequence of float, optional
        Seconds of the photographs of each pattern, which the rig must have; by default chosen.
    response : Response, optional
        Of the camera, where it is known.
    frames : int
        Photographs of black and of white that are averaged; those of a person are shared by the
        camera pixels that see one projector pixel.
    block, order : int
        Side of the blocks of "block"; pixels lit together by "hadamard", 2^k - 1.
    threshold, sigmas : float
        Part of what a camera pixel sees under white, above which a cell is divided by "adaptive";
        standard deviations above which an entry or a sum of entries is light and not noise, 0 keeps
        all.
    device : Device or str, optional
        As in `Transport`; opened before the first photograph.

    Returns
    -------
    Transport
        On the projector's pixels (blocks of them, of "block"), for light relative to white less
        black, in linear sensor values a second. Pixels without a first bounce are masked.
        `Setup.of(store)` has the codes that the projector is fed for linear light, and the ambient
        light on these pixels.

    Raises
    ------
    InputError, InputTypeError, DeviceError
        Bad arguments; a store that was made with others, or with another rig; no such device.
    AcquisitionError
        The rig fails, or photographs contradict each other; `PhotographMissing`: call again with
        it.
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
        raise InputTypeError(
            f"progress is {progress!r}; it must be a function of (str, int, int), or None"
        )
    progress, shots = progress or (lambda step, done, total: None), Shots(rig)
    settings = ScanSettings(
        geometry=geometry,
        strategy=strategy,
        exposures=exposures,
        response=response,
        frames=frames,
        block=block,
        order=order,
        threshold=threshold,
        sigmas=sigmas,
    ).for_rig(shots)
    if device is not None:
        device = Transport(np.eye(1), (1, 1), device=device).device
    if store is None:
        with tempfile.TemporaryDirectory(prefix="ltcl-") as folder:
            path = Path(folder) / "T.zarr"
            scan(_calibrate(path, shots, settings, None, progress), shots, settings, progress)
            T = load(path, on_dark="mask", device=device)
            if not isinstance(T.matrices[0], StoredRows):
                return T
            matrices = [rows.tocsr() for rows in T.matrices]
            others: Any = {"device": device, "mixing": T.mixing, "noise": T.measured_noise}
            return Transport(matrices, T.grid, T.first_bounce, on_dark="mask", **others)
    path = as_path(store, "store")
    existing = _open(path, resume)
    if existing is None:
        check_place(path, overwrite=True)
        with session.photograph_log(path, shots) as log:
            existing = _calibrate(path, shots, settings, log, progress)
    else:
        _check_begun(existing, shots, settings)
        session.remove_photographs(path)
    if existing.final:
        existing.finalize()  # removes what a process that was killed at the very end has left
    else:
        scan(existing, shots, settings, progress)
    return load(path, on_dark="mask", device=device)


def finalize(store: str | os.PathLike[str], progress: Progress | None = None) -> None:
    """Make the transport from the photographs in a store; nothing happens where that was done before.

    `progress` is that of `ltcl.acquire`. FileError for a store that is missing, damaged or not made
    by `ltcl.acquire`; AcquisitionError where photographs are missing.

    >>> finalize("nowhere.zarr")
    Traceback (most recent call last):
    ltcl.errors.FileError: nowhere.zarr: no such folder
    """
    opened = BlockStore.open(store)
    if "strategy" not in opened.attributes:
        raise FileError(
            f"{opened.path}: holds no whole calibration of ltcl.acquire, so no transport either"
        )
    if opened.final:
        return opened.finalize()  # removes what a process that was killed at the very end has left

    def photograph(codes: np.ndarray, seconds: float) -> np.ndarray:
        raise AcquisitionError(f"{opened.path}: the next batch of patterns is not photographed")

    grid, channels = Calibration.of(opened).resampling.grid, opened.layout.channels
    rig: Any = SimpleNamespace(projector_grid=grid, channels=channels, photograph=photograph)
    settings = ScanSettings.from_json(opened.attributes["settings"])
    scan(opened, Shots(rig), settings, progress or (lambda step, done, total: None))


def _open(path: Path, resume: bool) -> BlockStore | None:
    """The store of an earlier run whose calibration was committed."""
    places = [p for p in (session.calibration_folder(path), path) if os.path.exists(p)]
    places = [p for p in places if not p.is_dir() or any(p.iterdir())]
    if places and not resume:
        raise InputError(
            f"resume is False, but {places[0]} exists; remove it, or give another store"
        )
    if path not in places:
        return None
    store = BlockStore.open(path)
    if "acquisition" not in store.provenance:
        raise InputError(f"store is {path}, which ltcl.acquire did not make; give another one")
    return store if "strategy" in store.attributes else None


def _check_begun(store: BlockStore, shots: Shots, settings: ScanSettings) -> None:
    """Refuse to go on with another rig or other settings; without `describe()` black and white are shown."""
    facts, path, described = store.attributes, store.path, store.provenance["acquisition"]
    before = facts.get("settings")
    if facts["strategy"] not in STRATEGIES or not isinstance(before, dict):
        scan = f"{facts['strategy']!r:.40} of {before!r:.40}"
        raise FileError(f"{path}: its scan is {scan}; ltcl makes none such")
    for name, value in settings.to_json().items():
        check_same(name, value, before.get(name), path)
    check_same("rig.projector_grid", shots.grid, Calibration.of(store).resampling.grid, path)
    check_same("rig.channels", shots.channels, store.layout.channels, path)
    check_same_rig(described["rig"], shots, path)
    if described.get("camera_grid"):  # which the first photograph shows
        shots.expected = tuple(described["camera_grid"]), described["levels"]
    if hasattr(shots.rig, "describe") or store.final:
        return
    for name, digest in described.get("digest", {}).items():
        shots.photograph(np.full(shots.grid, float(name == "white")), digest["seconds"])
        difference = np.mean(np.abs(np.subtract(shots.digest[name]["cells"], digest["cells"])))
        if difference > _SAME_VIEW:
            text = f"{name} differs by {difference:.1%} of full scale from that of {path}"
            raise InputError(f"{text}; rig and scene must be the same")


def _calibrate(
    path: Path, shots: Shots, settings: ScanSettings, log: Any, progress: Progress
) -> BlockStore:
    """Measure the set-up, choose a strategy, and make the store."""
    side = settings.block if settings.strategy == "block" else 1
    options = {
        name: getattr(settings, name) for name in ("geometry", "response", "exposures", "frames")
    }
    calibration = calibrate.measure(shots, **options, side=side, progress=progress, log=log)
    options = {name: getattr(settings, name) for name in ("block", "order", "threshold")}
    options |= {"channels": shots.channels, "calibration": shots.count}
    light = plan.measured(calibration)
    plans = plan.plans(shots.grid, calibration.exposures, calibration.noise, light, **options)
    strategy, why = settings.strategy, "as asked for"
    if strategy == "auto":
        strategy, why = plan.choose(plans)
    logger.info("%s (%s)", plans[strategy], why)
    pictures = Pictures(shots, calibration, side)
    grid, pixels = pictures.grid, math.prod(pictures.grid)
    sizes: dict[str, Any] = {"channels": pictures.channels, "shape": (pixels, pixels), "grid": grid}
    if strategy == "adaptive":
        most = adaptive.most_patterns(adaptive.Cells(grid))
        sizes |= {"shape": (pixels, most), "grid": (1, most), "camera_grid": grid}
        sizes["block_rows"] = adaptive.AT_ONCE
    else:
        sizes["block_rows"] = columns.code_of(strategy, grid, settings.order).size
    facts = json.loads(json.dumps(shots.describe(), default=str))
    # Overwrites what a run left that ended before its calibration was committed.
    store = BlockStore.create(path, **sizes, provenance={"acquisition": facts}, overwrite=True)
    calibration.write(store)
    if calibration.mixing is not None:
        store.extra("mixing", calibration.mixing)
    store.update(
        settings=settings.to_json(), why=why, plan=asdict(plans[strategy]), strategy=strategy
    )
    return store  # which is resumed from here on


def scan(store: BlockStore, shots: Shots, settings: ScanSettings, progress: Progress) -> None:
    """Photograph what is missing in a store with its calibration, and make the transport of it."""
    calibration, strategy = Calibration.of(store), store.attributes["strategy"]
    pictures = Pictures(shots, calibration, settings.block if strategy == "block" else 1)
    if strategy == "adaptive":
        most = int(store.attributes["plan"]["patterns"])
        progress("scan", 0, most)
        log = Log(store, pictures, lambda done: progress("scan", done, max(done, most)))
        core = adaptive.scan(pictures, log, settings.threshold, settings.sigmas)
        store.update(patterns=log.done)
        for c, V in enumerate(core.matrices("variance")):
            store.extra(f"core_variance_{c}", V.data)
        arrays = adaptive.arrays(core, calibration.mixing, settings.sigmas) | pictures.noise(
            core.variances
        )
        store.finalize(compressed=CompressedRecord(arrays))
        progress("scan", log.done, log.done)
        return
    code, done = columns.code_of(strategy, pictures.grid, settings.order), 0
    total = columns.patterns(code, math.prod(pictures.grid))

    def count(patterns: int) -> None:
        nonlocal done
        done += patterns
        progress("scan", done, total)

    columns.scan(pictures, code, store, settings.sigmas, count)
    white, sums = (
        pictures.white,
        np.stack([columns.sums(store, c) for c in range(pictures.channels)]),
    )
    # They do of a camera of one exposure that changes it by itself; others are refused in a batch.
    if (relative := columns.deviation(sums, white)) > _REFUSED:
        raise ScanRefused(
            f"{store.path}: row sums of T deviate by {relative:.0%} from white (allowed: {_REFUSED:.0%}); "
            "the scene, the light or the exposure changed during the scan: acquire into another store"
        )
    store.extra(columns.SUMS, sums)
    store.update(patterns=total)
    for name, array in pictures.noise(partial(columns.variances, store)).items():
        store.extra(name, array)

    def add_up(c: int, first: int, matrix: Any, variance: Any) -> tuple[Any, Any]:
        rows = slice(first, first + matrix.shape[0])
        return columns.balance(
            matrix, variance, Picture(white.value[c, rows], white.variance[c, rows])
        )

    store.finalize(sigmas=settings.sigmas, change=add_up)
