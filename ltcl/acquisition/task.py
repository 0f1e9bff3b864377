# SPDX-License-Identifier: BSD-3-Clause
"""`acquire`: from a rig to a transport, by photographs alone; it can be stopped at any time, and goes on.

First the set-up is measured (`calibrate`) and committed as a whole; then T is scanned (`scanning`), batch by
batch, each committed before the next is taken. Columns go into the store as they are decoded; of an adaptive
scan the store is a log of pictures, which the transport replaces in the end.
"""

from __future__ import annotations

import logging
import os
import tempfile
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ltcl import checks
from ltcl.acquisition import calibrate, session
from ltcl.acquisition.calibrate import Progress
from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.geometry import Correspondence
from ltcl.acquisition.radiometry import Response
from ltcl.acquisition.rig import Rig, Shots, exact
from ltcl.acquisition.scanning import adaptive, columns, plan
from ltcl.acquisition.scanning.pictures import Log, Picture, Pictures
from ltcl.acquisition.session import check_same, check_same_rig
from ltcl.errors import AcquisitionError, FileError, InputError, InputTypeError
from ltcl.files import as_path
from ltcl.store import BlockStore, Parts, StoredRows, load
from ltcl.store.block_store import check_place
from ltcl.transport import Transport

logger = logging.getLogger(__name__)
_SAME_VIEW = 0.03  # of full scale, mean over the cells of a digest: lamps and exposures vary less


@dataclass(frozen=True)
class Settings:
    """The arguments of `acquire` that decide which photographs are taken, and what is made of them."""

    geometry: Any
    strategy: str
    exposures: tuple[float, ...] | None
    response: Response | None
    frames: int
    block: int
    order: int
    threshold: float
    sigmas: float

    @classmethod
    def of(cls, shots: Shots, *values: Any, **named: Any) -> Settings:
        """Checked for the rig of `shots`; InputError, InputTypeError where one is unusable."""
        settings = cls(*values, **named)
        geometry, response, times = settings.geometry, settings.response, settings.exposures
        if not isinstance(geometry, Correspondence) and str(geometry) not in ("graycode", "aligned"):
            name = repr(geometry) if isinstance(geometry, str) else f"a {type(geometry).__name__}"
            raise InputError(f"geometry is {name}; it must be 'graycode', 'aligned' or a Correspondence")
        if not isinstance(response, Response | None):
            raise InputTypeError(f"response is a {type(response).__name__}; it must be a Response, or None")
        if response is None and shots.exposures is not None and len(shots.exposures) == 1:
            raise InputError("rig.exposures has one exposure, which determines no response; give response=")
        if times is not None:
            seconds = checks.finite("exposures", checks.real("exposures", times))
            if seconds.ndim != 1 or seconds.size == 0 or seconds.min() <= 0:
                raise InputError(f"exposures is {times!r}; it must be a sequence of positive seconds")
            times = tuple(exact("exposures", t, shots.exposures) for t in seconds.astype(float).tolist())
        if checks.count("order", settings.order) & (settings.order + 1):
            raise InputError(f"order is {settings.order}; it must be 2^k - 1: 1, 3, 7, 15, ...")
        checks.one_of("strategy", settings.strategy, ("auto", *plan.STRATEGIES))
        return replace(
            settings,
            exposures=times,
            frames=checks.count("frames", settings.frames),
            block=checks.count("block", settings.block, least=2),
            threshold=checks.number("threshold", settings.threshold, above=0.0, below=1.0),
            sigmas=checks.number("sigmas", settings.sigmas, least=0.0),
        )

    def to_json(self) -> dict[str, Any]:
        """As plain JSON; of a geometry or a response that is measured, nothing but that."""
        named = {name: value for name, value in vars(self).items() if name != "response"}
        named["geometry"] = self.geometry if isinstance(self.geometry, str) else "given"
        return named | {"exposures": self.exposures and list(self.exposures)}


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
        resumed. Until the set-up is measured its photographs are in the folder STORE.calibration, whatever
        ends it; to begin anew, remove both.
    resume : bool
        Go on with what is in the store; else the store must not exist.
    progress : function of (str, int, int), optional
        Called with "calibration" or "scan", how many of its photographs or patterns are done, those of an
        earlier run included, and of how many at most.
    exposures : sequence of float, optional
        Seconds of the photographs of each pattern, which the rig must have; by default chosen.
    response : Response, optional
        Of the camera, where it is known.
    frames : int
        Photographs of black and of white that are averaged; those of a person are shared by the camera pixels
        that see one projector pixel.
    block, order : int
        Side of the blocks of "block"; pixels lit together by "hadamard", 2^k - 1.
    threshold, sigmas : float
        Part of what a camera pixel sees under white, above which a cell is divided by "adaptive"; standard
        deviations above which an entry or a sum of entries is light and not noise, 0 keeps all.
    device : Device or str, optional
        As in `Transport`.

    Returns
    -------
    Transport
        On the projector's pixels (blocks of them, of "block"), for light relative to white less black, in
        linear sensor values a second. Pixels without a first bounce are masked. `Setup.of(store)` has the
        codes that the projector is fed for linear light, and the ambient light on these pixels.

    Raises
    ------
    InputError, InputTypeError
        Bad arguments; a store that was made with others, or with another rig.
    AcquisitionError
        The rig fails, or photographs contradict each other; `PhotographMissing`: call again with it.
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
    progress, shots = progress or (lambda step, done, total: None), Shots(rig)
    settings = Settings.of(
        shots, geometry, strategy, exposures, response, frames, block, order, threshold, sigmas
    )
    if store is None:
        with tempfile.TemporaryDirectory(prefix="ltcl-") as folder:
            path = Path(folder) / "T.zarr"
            scan(_calibrate(path, shots, settings, None, progress), shots, settings, progress)
            T = load(path, on_dark="mask", device=device)
            if not isinstance(T.matrices[0], StoredRows):
                return T
            matrices: Any = [rows.tocsr() for rows in T.matrices]
            matrices = matrices if len(matrices) == 3 else matrices[0]
            return Transport(matrices, T.grid, T.first_bounce, device=device, on_dark="mask", mixing=T.mixing)
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

    `progress` is that of `ltcl.acquire`. FileError for a store that is missing, damaged or not made by
    `ltcl.acquire`; AcquisitionError where photographs are missing.

    Examples
    --------
    >>> import tempfile, ltcl
    >>> from ltcl.acquisition import VirtualRig
    >>> rig, store = VirtualRig(np.eye(64) / 2, (8, 8), bits=12), f"{tempfile.mkdtemp()}/T.zarr"
    >>> T = ltcl.acquire(rig, geometry="aligned", strategy="pixel", store=store)
    >>> finalize(store)
    """
    opened = BlockStore.open(store, "a")
    if "strategy" not in opened.attributes:
        raise FileError(f"{opened.path}: holds no whole calibration of ltcl.acquire, so no transport either")
    if opened.final:
        return
    rig: Any = _NoRig(opened.path, Calibration.of(opened).resampling.grid, opened.layout.channels)
    settings = Settings(**opened.attributes["settings"], response=None)
    scan(opened, Shots(rig), settings, progress or (lambda step, done, total: None))


class _NoRig(NamedTuple):
    """In place of the rig that took the photographs: a scan may ask for more of them."""

    path: Path
    projector_grid: tuple[int, int]
    channels: int

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        raise AcquisitionError(f"{self.path}: the next batch of patterns is not photographed")


def _is_empty(path: Path) -> bool:
    return not os.path.exists(path) or (path.is_dir() and not any(path.iterdir()))


def _open(path: Path, resume: bool) -> BlockStore | None:
    """The store of an earlier run whose calibration was committed."""
    for place in (session.calibration_folder(path), path):
        if not resume and not _is_empty(place):
            raise InputError(f"resume is False, but {place} exists; remove it, or give another store")
    if _is_empty(path):
        return None
    store = BlockStore.open(path, "a")
    if "acquisition" not in store.provenance:
        raise InputError(f"store is {path}, which ltcl.acquire did not make; give another one")
    return store if "strategy" in store.attributes else None


def _check_begun(store: BlockStore, shots: Shots, settings: Settings) -> None:
    """Refuse to go on with a store that was begun with another rig or with other settings.

    The same rig has the same pixels and describes itself as before; without `describe()` it must show black
    and white as before.
    """
    facts, path, described = store.attributes, store.path, store.provenance["acquisition"]
    before = facts.get("settings")
    if facts["strategy"] not in plan.STRATEGIES or not isinstance(before, dict):
        raise FileError(
            f"{path}: its scan is {facts['strategy']!r:.40} of {before!r:.40}; ltcl makes none such"
        )
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
            raise InputError(
                f"{name} differs by {difference:.1%} of full scale from that of {path}; rig "
                "and scene must be the same"
            )


def _calibrate(path: Path, shots: Shots, settings: Settings, log: Any, progress: Progress) -> BlockStore:
    """Measure the set-up, choose a strategy, and make the store."""
    side = settings.block if settings.strategy == "block" else 1
    asked = {name: getattr(settings, name) for name in ("geometry", "response", "exposures", "frames")}
    calibration = calibrate.measure(shots, **asked, side=side, progress=progress, log=log)
    asked = {name: getattr(settings, name) for name in ("block", "order", "threshold")}
    asked |= {"channels": shots.channels, "calibration": shots.count}
    light = plan.measured(calibration)
    plans = plan.plans(shots.grid, calibration.exposures, calibration.noise, light, **asked)
    strategy, why = settings.strategy, "as asked for"
    if strategy == "auto":
        strategy, why = plan.choose(plans)
    logger.info("%s (%s)", plans[strategy], why)
    pictures = Pictures(shots, calibration, side)
    h, w = pictures.grid
    rows, sizes = adaptive.AT_ONCE, {"shape": (h * w, h * w), "grid": (h, w)}
    if strategy == "adaptive":
        most = adaptive.most_patterns(adaptive.Cells((h, w)))
        sizes = {"shape": (h * w, most), "grid": (1, most), "camera_grid": (h, w)}
    else:
        rows = columns.code_of(strategy, (h, w), settings.order).size
    store = BlockStore.create(
        path,
        **sizes,
        block_rows=rows,
        channels=pictures.channels,
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
        core = adaptive.scan(pictures, log, settings.threshold, settings.sigmas)
        store.update(patterns=log.done)
        for name, variance in adaptive.variances(core).items():
            store.extra(name, variance)
        store.finalize(compressed=Parts(adaptive.arrays(core, calibration.mixing, settings.sigmas)))
        progress("scan", log.done, log.done)
        return
    h, w = pictures.grid
    code, done = columns.code_of(strategy, (h, w), settings.order), 0
    total = columns.patterns(code, h * w)

    def count(patterns: int) -> None:
        nonlocal done
        done += patterns
        progress("scan", done, total)

    columns.scan(pictures, code, store, settings.sigmas, count)
    white = pictures.white
    if columns.SUMS not in store.extras:  # of a run that was killed after it
        sums = np.stack([columns.sums(store, c) for c in range(pictures.channels)])
        columns.check_row_sums(str(store.path), sums, white)
        store.extra(columns.SUMS, sums)
    store.update(patterns=total)

    def add_up(c: int, first: int, matrix: Any, variance: Any) -> tuple[Any, Any]:
        rows = slice(first, first + matrix.shape[0])
        return columns.balance(matrix, variance, Picture(white.value[c, rows], white.variance[c, rows]))

    store.finalize(sigmas=settings.sigmas, change=add_up)
