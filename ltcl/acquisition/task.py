# SPDX-License-Identifier: BSD-3-Clause
"""`acquire`: from a rig to a transport, with photographs alone; it can be stopped at any time and goes on.

First the set-up is measured (`measuring`), which is committed as a whole, its photographs being `kept` until
then; then T is scanned (`scanning`), of which every batch of photographs is committed before the next is
taken. What is in the store is read back, and nothing that was committed is photographed again.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ltcl import checks
from ltcl.acquisition import kept, run
from ltcl.acquisition.geometry import Correspondence
from ltcl.acquisition.radiometry import Response
from ltcl.acquisition.rig import Rig, Shots
from ltcl.acquisition.run import Progress
from ltcl.acquisition.scanning import plan
from ltcl.acquisition.settings import Settings
from ltcl.errors import InputError, InputTypeError
from ltcl.files import as_path
from ltcl.store import BlockStore, StoredRows, load
from ltcl.transport import Transport


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
        resumed, and all is held in memory. Until the set-up is measured its photographs are in a folder
        beside it, STORE.calibration; to begin anew, remove both.
    resume : bool
        Go on with what is in the store; else the store must not be there yet.
    progress : function of two ints, optional
        Told after each pattern how many have been photographed, and of how many in all at most; those
        of an earlier run count at once.
    exposures : sequence of float, optional
        Seconds of the photographs of each pattern, which the rig must have; left out, they are chosen.
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
        `ltcl.acquisition.Setup.of(store)` has the codes that the projector is fed for linear light, and the
        ambient light on these pixels.

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
        raise InputTypeError(f"progress is {progress!r}; it must be a function of two ints, or None")
    shots = Shots(rig)
    wanted = Settings.of(
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
        found = _found(path, resume)
        if found is not None:
            run.refuse_other(found, shots, wanted)
            kept.forget(path)
        if found is not None and found.final:
            found.finalize()  # removes what a process that was killed at the very end had left
        else:
            begun = found and run.resumed(found, shots, wanted)
            begun = begun or run.begin(path, shots, wanted, geometry, response, keep=store is not None)
            run.scan(begun, progress or (lambda done, total: None))
        T = load(path, on_dark="mask", device=device)
        return T if store is not None else _in_memory(T, device)


@contextlib.contextmanager
def _place(store: str | os.PathLike[str] | None) -> Iterator[Path]:
    if store is not None:
        yield as_path(store, "store")
        return
    with tempfile.TemporaryDirectory(prefix="ltcl-") as folder:
        yield Path(folder) / "T.zarr"


def _found(path: Path, resume: bool) -> BlockStore | None:
    """The store of an earlier run whose calibration was committed."""
    if not resume and kept.count(path):
        raise InputError(
            f"resume is False, but {kept.place(path)} holds {kept.count(path)} photographs of a calibration "
            "that has not ended; remove it, or give another store"
        )
    if not os.path.exists(path) or (path.is_dir() and not any(path.iterdir())):
        return None
    if not resume:
        raise InputError(f"resume is False, but {path} is there already; give another store")
    found = BlockStore.open(path, "a")
    if "acquisition" not in found.provenance:
        raise InputError(f"store is {path}, which ltcl.acquire did not make; give another one")
    return found if "strategy" in found.attributes else None


def _in_memory(T: Transport, device: Any) -> Transport:
    """The same without files behind it."""
    matrices = [part.tocsr() if isinstance(part, StoredRows) else part for part in T.matrices]
    if all(a is b for a, b in zip(matrices, T.matrices, strict=True)):
        return T
    given: Any = matrices if len(matrices) == 3 else matrices[0]
    return Transport(given, T.grid, T.first_bounce, device=device, on_dark="mask", mixing=T.mixing)
