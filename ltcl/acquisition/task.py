# SPDX-License-Identifier: BSD-3-Clause
"""`acquire`: from a rig to a transport, by photographs alone; `finalize`: from photographs taken.

First the set-up is measured (`calibrate`) and committed as a whole; then T is scanned (`scanning`),
batch by batch: columns of T, or pictures of an adaptive scan, which the transport replaces in the
end. It can be stopped at any time, and goes on.
"""

from __future__ import annotations

import json
import logging
import math
import os
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition import calibrate, session
from ltcl.acquisition.calibration import Calibration, is_calibrated
from ltcl.acquisition.estimation import windows
from ltcl.acquisition.geometry import Correspondence
from ltcl.acquisition.radiometry import Response
from ltcl.acquisition.rig import Rig, RigError, Shots
from ltcl.acquisition.scanning import adaptive, columns, direct, plan, sketch
from ltcl.acquisition.scanning.picture_log import BATCH_SIZE, PictureLog
from ltcl.acquisition.scanning.pictures import LAMP_GAIN, LIT, ScanCamera, ScanGrid
from ltcl.acquisition.scanning.sketch_pictures import keep_stripes
from ltcl.acquisition.session import (
    ProgressFunction,
    check_same,
    check_same_rig,
    ignore_progress,
)
from ltcl.acquisition.settings import STRATEGIES, ScanSettings
from ltcl.device import open_device
from ltcl.errors import AcquisitionError, FileError, InputError, InputTypeError
from ltcl.files import as_path
from ltcl.store import ArrayLog, BlockStore, StoredRows, load
from ltcl.store.block_store import check_place
from ltcl.transport.transport import Transport

logger = logging.getLogger(__name__)

# Strategies whose pictures are kept until T is made of all of them.
PICTURE_STRATEGIES = ("sketch", "adaptive", "direct")
# Error of a sketch from which on its light is too rough for one.
NOTABLE_ERROR = 0.02
# Part of the light that is indirect, from which on a scan of direct light warns that it is left
# out.
NOTABLE_INDIRECT = 0.02
# Mean difference of black or white, relative to full scale, of the cells of a digest: lamps and
# exposures vary less.
MAX_VIEW_DIFFERENCE = 0.03


def acquire(
    rig: Rig,
    *,
    geometry: str | Correspondence = ScanSettings.geometry,
    strategy: str = ScanSettings.strategy,
    store: str | os.PathLike[str] | None = None,
    resume: bool = True,
    progress: ProgressFunction | None = None,
    exposures: Sequence[float] | None = ScanSettings.exposures,
    response: Response | None = ScanSettings.response,
    frames: int = ScanSettings.frames,
    block: int = ScanSettings.block,
    order: int = ScanSettings.order,
    threshold: float = ScanSettings.threshold,
    sigmas: float = ScanSettings.sigmas,
    rtol: float | None = ScanSettings.rtol,
    photographs: int | None = ScanSettings.photographs,
    device: Any = None,
) -> Transport:
    """Measure the transport between a projector and a camera, or go on where that was stopped.

    Parameters
    ----------
    rig : Rig
        A projector and a camera: anything with projector_grid, channels and photograph(codes,
        seconds).
    geometry : "graycode", "aligned" or Correspondence
        Which projector pixel each camera pixel sees: measured; the same; or as measured before.
    strategy : "auto", "sketch", "adaptive", "direct", "pixel", "block" or "hadamard"
        Some tens of patterns of all scales, from which T is estimated; cells that are divided where
        needed; a few fine patterns, which show direct light alone; one pixel at a time; blocks of
        pixels, which makes a coarser transport; many pixels at once. "auto" decides between those
        that measure all light by the pixels and the noise of the camera (`scanning.plan`).
    store : path, optional
        Folder of the transport, which keeps the photographs, to be resumed. Until the set-up is
        measured they are in the folder STORE.calibration; to begin again, remove both.
    resume : bool
        Go on with the content of the store; else the store must not exist.
    progress : function of (str, int, int), optional
        Called with "calibration" or "scan", how many of its photographs or patterns are done, those
        of an earlier run included, and of how many at most; for "sketch" and "direct" then with
        "fit", rows of T that are estimated, and all.
    exposures : sequence of float, optional
        Seconds of the photographs of each pattern, which the rig must have; by default chosen.
    response : Response, optional
        Response of the camera, if it is known.
    frames : int
        Photographs of black and of white that are averaged; those of a person are shared by the
        camera pixels that see one projector pixel.
    block, order : int
        Side of the blocks of "block"; pixels lit together by "hadamard", 2^k - 1.
    threshold, sigmas : float
        Share of a camera pixel's light under white, above which a cell is divided by "adaptive";
        standard deviations above which an entry or a sum of entries is light and not noise, 0 keeps
        all.
    rtol : float, optional
        Relative error of T p, for pictures that judge it, down to which a sketch goes on with
        rounds of 16 more patterns, as long as they help. Only a sketch takes it, as `photographs`.
    photographs : int, optional
        Photographs that a sketch takes at most, those of the set-up included; without `rtol` it
        takes them all, but for less than a round of 4 patterns.
    device : Device or str, optional
        As in `Transport`; opened before the first photograph.

    Returns
    -------
    Transport
        On the projector's pixels (for "block" on blocks of them), for light relative to white less
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
    if progress is None:
        progress = ignore_progress
    if not callable(progress):
        raise InputTypeError(
            f"progress is {progress!r}; it must be a function of (str, int, int), or None"
        )
    shots = Shots(rig)
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
        rtol=rtol,
        photographs=photographs,
    ).for_rig(shots)
    if device is not None:
        device = open_device(device)
    if store is None:
        return _acquire_in_memory(shots, settings, progress, device)
    path = as_path(store, "store")
    opened = _open_calibrated(path, resume)
    if opened is None:
        check_place(path, overwrite=True)
        with session.photograph_log(path, shots) as log:
            opened = _calibrate(path, shots, settings, log, progress)
    else:
        _check_same_scan(opened, shots, settings)
        session.remove_photographs(path)
    if opened.final:
        # Removes the log that a process which was killed at the very end has left.
        opened.finalize()
    else:
        _scan(opened, shots, settings, progress)
    return load(path, on_dark="mask", device=device)


def finalize(store: str | os.PathLike[str], progress: ProgressFunction | None = None) -> None:
    """Make the transport from the photographs in a store, if that was not done before.

    Parameters
    ----------
    store : path
        Folder of `ltcl.acquire` with all photographs of a scan.
    progress : function of (str, int, int), optional
        As in `ltcl.acquire`.

    Raises
    ------
    FileError
        The store is missing, damaged, or not made by `ltcl.acquire`.
    AcquisitionError
        Photographs are missing.

    Examples
    --------
    >>> finalize("nowhere.zarr")
    Traceback (most recent call last):
    ltcl.errors.FileError: nowhere.zarr: no such folder
    """
    if progress is None:
        progress = ignore_progress
    opened = BlockStore.open(store)
    if not is_calibrated(opened):
        raise FileError(
            f"{opened.path}: holds no whole calibration of ltcl.acquire, so no transport either"
        )
    if opened.final:
        # Removes the log that a process which was killed at the very end has left.
        opened.finalize()
        return
    _check_known_scan(opened)
    grid = ScanGrid.of(opened)
    settings = ScanSettings.from_json(opened.attributes["settings"])
    strategy = opened.attributes["strategy"]
    if strategy in PICTURE_STRATEGIES:
        _run_pictures(opened, grid, None, settings, progress)
        return
    if opened.missing():
        raise AcquisitionError(f"{opened.path}: the next batch of patterns is not photographed")
    code = columns.choose_code(strategy, grid.grid, settings.order)
    patterns = columns.count_patterns(code, math.prod(grid.grid))
    progress("scan", patterns, patterns)
    columns.finish(opened, grid, patterns, settings.sigmas)


def _acquire_in_memory(
    shots: Shots, settings: ScanSettings, progress: ProgressFunction, device: Any
) -> Transport:
    """Scan into a temporary store, and read the transport from it whole."""
    with tempfile.TemporaryDirectory(prefix="ltcl-") as folder:
        path = Path(folder) / "T.zarr"
        store = _calibrate(path, shots, settings, None, progress)
        _scan(store, shots, settings, progress)
        T = load(path, on_dark="mask", device=device)
        if not isinstance(T.matrices[0], StoredRows):
            return T
        return Transport(
            [rows.tocsr() for rows in T.matrices],
            T.grid,
            T.first_bounce,
            on_dark="mask",
            device=device,
            mixing=T.mixing,
            noise=T.measured_noise,
        )


def _open_calibrated(path: Path, resume: bool) -> BlockStore | None:
    """The store of an earlier run, if its calibration was committed."""
    occupied = []
    for place in (session.calibration_folder(path), path):
        if os.path.exists(place) and not _is_empty_folder(place):
            occupied.append(place)
    if occupied and not resume:
        raise InputError(
            f"resume is False, but {occupied[0]} exists; remove it, or give another store"
        )
    if path not in occupied:
        return None
    store = BlockStore.open(path)
    if "acquisition" not in store.provenance:
        raise InputError(f"store is {path}, which ltcl.acquire did not make; give another one")
    return store if is_calibrated(store) else None


def _is_empty_folder(path: Path) -> bool:
    return path.is_dir() and not any(path.iterdir())


def _check_known_scan(store: BlockStore) -> None:
    """Refuse a store whose strategy or settings make no sense."""
    strategy = store.attributes["strategy"]
    settings = store.attributes.get("settings")
    if strategy not in STRATEGIES or not isinstance(settings, dict):
        raise FileError(
            f"{store.path}: its scan is {strategy!r:.40} with settings {settings!r:.40}, "
            "which ltcl does not know"
        )


def _check_same_scan(store: BlockStore, shots: Shots, settings: ScanSettings) -> None:
    """Refuse to go on with another rig or other settings."""
    _check_known_scan(store)
    path = store.path
    before = store.attributes["settings"]
    for name, value in settings.to_json().items():
        check_same(name, value, before.get(name), path)
    facts = store.provenance["acquisition"]
    grid = Calibration.of(store).resampling.grid
    channels = store.layout.channels
    check_same("rig.projector_grid", shots.grid, grid, path, RigError)
    check_same("rig.channels", shots.channels, channels, path, RigError)
    check_same_rig(facts["rig"], shots, path)
    if facts.get("camera_grid"):
        # The first photograph shows whether they are the same.
        shots.expected = tuple(facts["camera_grid"]), facts["levels"]
    if not hasattr(shots.rig, "describe") and not store.final:
        _check_same_view(shots, facts.get("digest", {}), path)


def _check_same_view(shots: Shots, digests: dict[str, Any], path: Path) -> None:
    """Refuse a rig without a description that shows another black or white than before."""
    for name, digest in digests.items():
        code = 1.0 if name == "white" else 0.0
        shots.photograph(np.full(shots.grid, code), digest["seconds"])
        change = np.subtract(shots.digest[name]["cells"], digest["cells"])
        difference = np.mean(np.abs(change))
        if difference > MAX_VIEW_DIFFERENCE:
            raise RigError(
                f"{name} differs by {difference:.1%} of full scale from that of {path}; "
                "rig and scene must be the same"
            )


def _calibrate(
    path: Path,
    shots: Shots,
    settings: ScanSettings,
    log: ArrayLog | None,
    progress: ProgressFunction,
) -> BlockStore:
    """Measure the set-up, choose a strategy, and make the store, which is resumed from here on."""
    side = settings.block if settings.strategy == "block" else 1
    if settings.strategy == "direct":
        direct.check_memory(shots.grid, shots.channels)
    elif plan.is_sketched(settings.strategy, shots.grid):
        windows.check_memory(shots.grid, shots.channels)
        _check_photographs(shots, settings)
    if not plan.is_sketched(settings.strategy, shots.grid):
        _check_no_goal(shots, settings)
    calibration = calibrate.measure(
        shots,
        sparing=plan.is_sparing(settings.strategy, shots.grid),
        direct=settings.strategy == "direct",
        geometry=settings.geometry,
        response=settings.response,
        exposures=settings.exposures,
        frames=settings.frames,
        side=side,
        progress=progress,
        log=log,
    )
    chosen, reason = _choose_plan(calibration, shots, settings)
    logger.info("%s (%s)", chosen, reason)
    grid = ScanGrid(calibration, side)
    description = json.dumps(shots.describe(), default=str)
    # Overwrites the store of a run that ended before its calibration was committed.
    store = BlockStore.create(
        path,
        **_store_sizes(chosen, grid, settings, len(calibration.exposures)),
        provenance={"acquisition": json.loads(description)},
        overwrite=True,
    )
    calibration.write(store)
    if calibration.mixing is not None:
        store.extra("mixing", calibration.mixing)
    lit = getattr(shots.rig, "lit", None)
    if lit is not None:
        store.extra(LIT, np.asarray(lit, np.float32))
    if chosen.strategy == "sketch":
        store.update(stripes=keep_stripes(store, grid))
    store.update(
        settings=settings.to_json(), why=reason, plan=asdict(chosen), strategy=chosen.strategy
    )
    return store


def _check_photographs(shots: Shots, settings: ScanSettings) -> None:
    """Refuse fewer photographs than a sketch takes."""
    if settings.photographs is None:
        return
    planned = plan.plans(
        shots.grid,
        (1.0,),
        channels=shots.channels,
        frames=settings.frames,
        aligned=settings.geometry != "graycode",
        by_hand=shots.keeps_photographs,
    )
    least = planned["sketch"].photographs
    if settings.photographs < least:
        height, width = shots.grid
        raise InputError(
            f"photographs is {settings.photographs}; a sketch of {height} x {width} pixels takes "
            f"about {least}, so it must be as many or more"
        )


def _check_no_goal(shots: Shots, settings: ScanSettings) -> None:
    """Refuse an error or a number of photographs that only a sketch would keep to."""
    for name in ("rtol", "photographs"):
        value = getattr(settings, name)
        if value is None:
            continue
        maker = f"strategy is {settings.strategy!r}"
        if settings.strategy == "auto":
            height, width = shots.grid
            maker += f", which makes no sketch of {height} x {width} pixels"
        raise InputError(
            f"{name} is {value:g}, but {maker}; it must be 'sketch', or {name} be left out"
        )


def _choose_plan(
    calibration: Calibration, shots: Shots, settings: ScanSettings
) -> tuple[plan.Plan, str]:
    """The plan of the strategy that was asked for, or of the best one; and why."""
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
        stripes=len(calibration.stripes),
        fixed_exposures=True,
    )
    if settings.strategy != "auto":
        return plans[settings.strategy], "as asked for"
    strategy, reason = plan.choose(plans)
    return plans[strategy], reason


def _store_sizes(
    chosen: plan.Plan, grid: ScanGrid, settings: ScanSettings, exposures: int
) -> dict[str, Any]:
    """Sizes of the store of a scan: columns of T, or pictures."""
    strategy = chosen.strategy
    pixels = math.prod(grid.grid)
    if strategy in PICTURE_STRATEGIES:
        if strategy == "sketch":
            first = chosen.photographs
            sizes = sketch.round_sizes(settings.photographs, settings.rtol, first, exposures)
            stripes = len(grid.calibration.stripes)
            most = sketch.most_patterns(grid.grid, len(sizes), stripes)
        elif strategy == "direct":
            most = direct.most_patterns(grid.grid)
        else:
            most = adaptive.most_patterns(adaptive.Cells(grid.grid))
        return {
            "channels": grid.channels,
            "shape": (pixels, most),
            "grid": (1, most),
            "camera_grid": grid.grid,
            "block_rows": BATCH_SIZE,
        }
    return {
        "channels": grid.channels,
        "shape": (pixels, pixels),
        "grid": grid.grid,
        "block_rows": columns.choose_code(strategy, grid.grid, settings.order).size,
    }


def _scan(
    store: BlockStore, shots: Shots, settings: ScanSettings, progress: ProgressFunction
) -> None:
    """Photograph what is missing in a store with its calibration, and make the transport of it."""
    calibration = Calibration.of(store)
    strategy = store.attributes["strategy"]
    side = settings.block if strategy == "block" else 1
    camera = ScanCamera(shots, calibration, side)
    camera.lamp_gain = store.attributes.get(LAMP_GAIN, 1.0)
    if strategy in PICTURE_STRATEGIES:
        _run_pictures(store, camera, camera, settings, progress)
        return
    code = columns.choose_code(strategy, camera.grid, settings.order)
    total = columns.count_patterns(code, math.prod(camera.grid))
    done = 0

    def count(patterns: int) -> None:
        nonlocal done
        done += patterns
        progress("scan", done, total)

    columns.ColumnScan(camera, code, store, settings.sigmas).run(count)
    columns.finish(store, camera, total, settings.sigmas)


def _run_pictures(
    store: BlockStore,
    grid: ScanGrid,
    camera: ScanCamera | None,
    settings: ScanSettings,
    progress: ProgressFunction,
) -> None:
    """Run a scan through its pictures in the store, and photograph the missing ones.

    Without a camera a missing one is an AcquisitionError.
    """
    planned = int(store.attributes["plan"]["patterns"])
    progress("scan", 0, planned)

    def count(done: int) -> None:
        progress("scan", done, max(done, planned))

    log = PictureLog(store, camera, count)
    strategy = store.attributes["strategy"]
    if strategy == "sketch":
        # Scans of earlier versions photograph them as all patterns.
        stripes_by = store.attributes.get("stripes", ())
        rounds = _rounds(store, settings)
        sketched = sketch.scan(grid, log, progress, rounds, stripes_by)
        store.update(patterns=log.done)
        sketch.finish(store, sketched)
        if sketched.error > NOTABLE_ERROR:
            _advise_another_scan(grid, sketched.error)
    elif strategy == "direct":
        scanned = direct.scan(grid, log, progress)
        store.update(patterns=log.done)
        direct.finish(store, grid, scanned, settings.sigmas)
        _tell_left_out(scanned.left_out)
    else:
        core = adaptive.scan(grid, log, settings.threshold, settings.sigmas)
        store.update(patterns=log.done)
        adaptive.finish(store, grid, core, grid.calibration.mixing, settings.sigmas)
    progress("scan", log.done, log.done)


def _rounds(store: BlockStore, settings: ScanSettings) -> sketch.Rounds:
    """The rounds of a sketch after its first patterns, as the settings ask for them."""
    planned = store.attributes["plan"]
    exposures = len(Calibration.of(store).exposures)
    first = int(planned["photographs"])
    sizes = sketch.round_sizes(settings.photographs, settings.rtol, first, exposures)
    return sketch.Rounds(sizes=sizes, rtol=settings.rtol)


def _tell_left_out(share: float) -> None:
    """Say how much light a scan of direct light has left out."""
    level = logging.WARNING if share >= NOTABLE_INDIRECT else logging.INFO
    logger.log(
        level,
        "T is direct light alone: indirect light was left out, %.1f %% of the light of the median "
        "pixel under white",
        100 * share,
    )


def _advise_another_scan(grid: ScanGrid, error: float) -> None:
    """Say what a scan costs that divides the picture where there is light."""
    known = grid.calibration
    candidates = plan.plans(
        grid.grid, known.exposures, known.noise, plan.measured(known), channels=grid.channels
    )
    adaptive_scan = candidates["adaptive"]
    logger.warning(
        "pictures T p by this sketch are off by %.1f %%: light changes abruptly in this scene; "
        "strategy 'adaptive' finds where, with up to %d photographs, %.2g minutes of exposures",
        100 * error,
        adaptive_scan.photographs,
        adaptive_scan.seconds / 60.0,
    )
