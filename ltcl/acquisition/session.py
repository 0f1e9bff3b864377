# SPDX-License-Identifier: BSD-3-Clause
"""`CaptureSession`: the photographs of a calibration; and the folder that holds them until it has ended.

The photographs of a calibration decide on the next one. So one that was stopped is run again from
its start, with the photographs in STORE.calibration, until it asks for a new one: known by codes,
seconds, and how often a list of requests had the same before.
"""

from __future__ import annotations

import contextlib
import json
import logging
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ltcl.acquisition import agreement
from ltcl.acquisition.agreement import CameraModel
from ltcl.acquisition.radiometry import Radiance, Response, merge
from ltcl.acquisition.rig import Shots, shot_key
from ltcl.errors import AcquisitionError, FileError, InputError, PhotographMissing
from ltcl.files import locked, sweep
from ltcl.store import ArrayLog

logger = logging.getLogger(__name__)
VOLATILE_KEYS = frozenset({"survey", "seed", "mitsuba", "source", "backend", "index", "driver"})
"""Keys of `describe()`, on any level, that may differ when a scan is resumed."""
_RIG, _SHOT = "rig", "shot_"  # names in the log: what the rig said of itself, photographs

Request = tuple[np.ndarray, float]  # codes (h, w[, 3]) and seconds


class Photograph(NamedTuple):
    """Codes (H, W[, 3]) in [0, 1] of full scale, seconds, and its number."""

    image: np.ndarray
    seconds: float
    number: int


class CaptureSession:
    """A rig for a calibration, and what is known of its camera so far.

    `sensor` is its response, noise and offset, `hot` (H, W) its defective pixels; `record` has all
    photographs, to be compared when the noise is known.
    """

    def __init__(self, shots: Shots, log: ArrayLog | None, progress: Callable[[int], None]) -> None:
        self.sensor, self.hot = CameraModel(Response.identity()), np.zeros((1, 1), bool)
        self.shots, self.record = shots, agreement.AgreementRecord()
        self._log, self._progress = log, progress
        self._uniform: dict[str, Photograph] = {}

    def prepare(self, requests: Iterable[Request]) -> None:
        """Announce photographs to the rig, so that a person can take all of them in one go."""
        self.shots.prepare([r for name, r in _named(requests) if name not in self._uniform])

    def take(self, groups: Sequence[Sequence[Request]]) -> list[list[Photograph]]:
        """Photographs of requests, in order; those of uniform patterns are used again."""
        requests = [request for group in groups for request in group]
        self.prepare(requests)
        photographs = iter(
            [self._uniform.get(name) or self._take(name, r) for name, r in _named(requests)]
        )
        return [[next(photographs) for _ in group] for group in groups]

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        """The image of one request: codes, or light as soon as the response is known."""
        return self.sensor.response.linear(self.take([[(codes, seconds)]])[0][0].image)

    def merge(self, photographs: Sequence[Photograph]) -> Radiance:
        """Photographs of one pattern as radiance, ambient light included; AcquisitionError where none is."""
        images, seconds, numbers = zip(*photographs, strict=True)
        response, noise, offset = self.sensor
        with acquisition_error(f"photographs {min(numbers)} to {max(numbers)}"):
            return merge(images, seconds, response, noise, levels=self.shots.levels, black=offset)

    @contextlib.contextmanager
    def naming_photographs(self) -> Iterator[None]:
        """Name photographs that deviate, where the block cannot use them."""
        try:
            yield
        except AcquisitionError as error:
            if not isinstance(error, PhotographMissing):
                self.record.check(self.sensor, self.shots.name)
            raise

    def _take(self, name: str, request: Request) -> Photograph:
        stored = None
        with contextlib.suppress(FileError, KeyError):  # missing or damaged: it is taken again
            stored = self._log and self._log.get(name)["image"]
        image = self.shots.photograph(*request, stored)
        if self._log and stored is None:
            self._log.put(name, image=self.shots.image)
        photograph = Photograph(image, request[1], self.shots.number)
        self.record.add(*request, image, photograph.number)
        if request[0].min() == request[0].max():
            self._uniform[name] = photograph
        self._progress(self.shots.count)
        return photograph


def _named(requests: Iterable[Request]) -> Iterator[tuple[str, Request]]:
    counts: Counter[str] = Counter()
    for codes, seconds in requests:
        key = shot_key(codes, seconds)
        yield f"{_SHOT}{key}_{counts[key]}", (codes, seconds)
        counts[key] += 1


@contextlib.contextmanager
def acquisition_error(subject: str) -> Iterator[None]:
    """Raise an InputError about photographs as an AcquisitionError about `subject`."""
    try:
        yield
    except InputError as error:
        raise AcquisitionError(f"{subject}: {error}") from error


def calibration_folder(store: Path) -> Path:
    """T.zarr.calibration for T.zarr."""
    return store.with_name(f"{store.name}.calibration")


def calibration_photographs(store: Path) -> int:
    """How many photographs there are."""
    return sum(name.startswith(_SHOT) for name in ArrayLog(calibration_folder(store)).names)


def remove_photographs(store: Path) -> None:
    """Remove them after the calibration was committed, also those that a killed run left."""
    names = ArrayLog(calibration_folder(store)).names
    if names and all(name == _RIG or name.startswith(_SHOT) for name in names):
        shutil.rmtree(calibration_folder(store), ignore_errors=True)


@contextlib.contextmanager
def photograph_log(store: Path, shots: Shots) -> Iterator[ArrayLog | None]:
    """The folder for a session, which is removed where the block ends well.

    None where the rig stores its photographs itself. InputError where those in it are of another
    rig; FileError where it cannot be written, or another process is at work there.
    """
    if getattr(shots.rig, "keeps_photographs", False):
        yield None
        return
    log = ArrayLog(calibration_folder(store))
    if log.path.is_dir():
        sweep(log.path)
    if not log.names and log.path.exists() and any(log.path.iterdir()):
        raise FileError(f"{log.path}: was not made by ltcl; it will not be replaced")
    if not log.names:
        log.put(_RIG, json=np.array(json.dumps(shots.describe()["rig"], default=str)))
    with locked(log.path, wait=False):
        check_same_rig(json.loads(str(log.get(_RIG)["json"])), shots, log.path)
        if count := calibration_photographs(store):
            logger.info("calibration: %d photographs of an earlier run are used again", count)
        try:
            yield log
        except AcquisitionError:
            logger.warning("%s has the photographs so far; to take them anew, remove it", log.path)
            raise
    remove_photographs(store)


def check_same_rig(description: Any, shots: Shots, path: Path) -> None:
    """Refuse a rig that describes itself otherwise than that of the photographs in `path`."""
    check_same("rig", _identity(shots.describe()["rig"]), _identity(description), path)


def check_same(name: str, now: Any, before: Any, path: Path) -> None:
    """Refuse to go on with `path` where a setting, or what a rig says of itself, has another value."""
    if isinstance(now, dict) and isinstance(before, dict):
        for key in sorted(now.keys() | before.keys()):
            check_same(f"{name}.{key}", now.get(key), before.get(key), path)
    elif now != before:
        text = f"{path} was begun with {before!r:.80}; it must be that, or another store"
        raise InputError(f"{name} is {now!r:.80}, but {text}")


def _identity(description: Any) -> dict[str, Any]:
    """What a rig says of itself as plain JSON, numbers to four digits, without `VOLATILE_KEYS`.

    >>> _identity({"camera": {"kind": "opencv", "source": 0}, "period": 1 / 60, "seed": 3})
    {'camera': {'kind': 'opencv'}, 'period': 0.01667}
    """
    return json.loads(
        json.dumps(description, default=str),
        parse_float=lambda digits: float(f"{float(digits):.4g}"),
        object_pairs_hook=lambda pairs: {
            key: value for key, value in pairs if key not in VOLATILE_KEYS
        },
    )
