# SPDX-License-Identifier: BSD-3-Clause
"""`CaptureSession`: the photographs of a calibration, and the folder that keeps them until its end.

Each photograph of a calibration may decide on the next one. So a calibration that was stopped is
run again from its start, with the photographs in STORE.calibration, until it asks for a new one.
A photograph is identified by its codes, its seconds, and how often a list of requests had the same
before.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ltcl.acquisition.agreement import (
    ADVICE,
    AgreementRecord,
    CameraModel,
    name_by_number,
    sample,
)
from ltcl.acquisition.contradictions import Contradictions, first_of_fewer_bits
from ltcl.acquisition.radiance import StoredRadiance
from ltcl.acquisition.radiometry import Radiance, Response, merge
from ltcl.acquisition.radiometry.exposures import exposure_stack
from ltcl.acquisition.radiometry.merge import Merger
from ltcl.acquisition.radiometry.noise import choose_levels
from ltcl.acquisition.radiometry.strips import in_strips
from ltcl.acquisition.rig import RigError, Shots, largest_code, scale_codes, shot_key
from ltcl.acquisition.scratch import ImageFile, StoredImage
from ltcl.errors import AcquisitionError, FileError, InputError, PhotographMissing
from ltcl.files import locked, sweep
from ltcl.store import ArrayLog

logger = logging.getLogger(__name__)
# Keys of `describe()`, on any level, that may differ when a scan is resumed.
VOLATILE_KEYS = frozenset(("survey", "seed", "mitsuba", "source", "backend", "index", "driver"))
# Names in the log: the description of the rig, and the beginning of those of photographs.
RIG_ENTRY = "rig"
SHOT_PREFIX = "shot_"

# Pixels of a photograph that determine what is common to all, such as noise.
MAX_SAMPLED_PIXELS = 1 << 13
# Values of all photographs that are merged at once.
MERGED_VALUES = 1 << 19

# Codes (h, w[, 3]) and seconds.
Request = tuple[np.ndarray, float]
# Called with a step, how much of it is done, and of how much.
ProgressFunction = Callable[[str, int, int], None]


def ignore_progress(step: str, done: int, total: int) -> None:
    """Progress that nobody asked for."""


@dataclass(frozen=True, kw_only=True)
class Photograph:
    """A photograph of a rig, in a temporary file, with its seconds and its number."""

    stored: StoredImage
    rig: Any
    seconds: float
    number: int

    @classmethod
    def of(cls, shots: Shots, seconds: float, file: ImageFile) -> Photograph:
        """The last photograph of a rig, which is appended to a file."""
        stored = file.append(shots.image)
        return cls(stored=stored, rig=shots.rig, seconds=seconds, number=shots.number)

    @property
    def image(self) -> np.ndarray:
        """(H, W[, 3]) in [0, 1] of full scale."""
        return self.read(slice(None))

    @property
    def grid(self) -> tuple[int, int]:
        """(H, W)."""
        height, width = self.stored.shape[:2]
        return height, width

    @property
    def step(self) -> int:
        """Distance of sampled pixels along both sides: about `MAX_SAMPLED_PIXELS` at most."""
        return self.step_of(MAX_SAMPLED_PIXELS)

    def step_of(self, pixels: int) -> int:
        """Distance along both sides of about so many pixels at most."""
        height, width = self.stored.shape[:2]
        return math.ceil(math.sqrt(height * width / pixels))

    @property
    def sampled(self) -> np.ndarray:
        """The image at sampled pixels."""
        return self.at_step(self.step)

    def at_step(self, step: int) -> np.ndarray:
        """The image at pixels of this distance along both sides."""
        return self.read(slice(None, None, step))[:, ::step]

    def read(self, rows: slice) -> np.ndarray:
        """The image in some rows."""
        return scale_codes(self.stored.read(rows), self.rig)

    def at(self, pixels: np.ndarray) -> np.ndarray:
        """The image at pixels, numbered row by row in ascending order: (n, c)."""
        return scale_codes(self.stored.at(pixels), self.rig)

    def linear(self, response: Response) -> Callable[[slice], np.ndarray]:
        """Function that reads some rows in linear values, by a table if codes are integers."""
        dtype = self.stored.dtype
        if dtype.kind == "f":
            return lambda rows: response.linear(self.read(rows))
        codes = np.arange(largest_code(dtype, self.rig) + 1).astype(dtype)
        unit = scale_codes(codes, self.rig)
        tables = [Response(table).linear(unit) for table in response.values]
        return lambda rows: _look_up(tables, self.stored.read(rows))


def _look_up(tables: list[np.ndarray], codes: np.ndarray) -> np.ndarray:
    """Values of integer codes (..., [3]) by a table, or one for each channel."""
    if len(tables) == 1:
        return _take(tables[0], codes)
    planes = [_take(table, codes[..., c]) for c, table in enumerate(tables)]
    return np.stack(planes, axis=-1)


def _take(table: np.ndarray, codes: np.ndarray) -> np.ndarray:
    if codes.dtype == np.uint8 and len(table) == 256:
        return cv2.LUT(np.ascontiguousarray(codes), table).reshape(codes.shape)
    return table.take(codes)


def merge_photographs(
    photographs: Sequence[Photograph], camera: CameraModel, levels: int | None, file: ImageFile
) -> StoredRadiance:
    """Photographs of one pattern as radiance in a file, strip by strip of rows.

    Their order by seconds is checked at the pixels of `Photograph.sampled`. AcquisitionError if
    they determine no radiance.
    """
    with _about(photographs):
        stack = exposure_stack(
            [photograph.sampled for photograph in photographs],
            [photograph.seconds for photograph in photographs],
            choose_levels(levels, camera.noise),
        )
        shape = photographs[0].stored.shape
        channels = math.prod(shape[2:])
        merger = Merger(
            stack.seconds,
            camera.response,
            camera.noise,
            levels=stack.levels,
            black=camera.offset,
            channels=channels,
        )
    ascending = sorted(photographs, key=lambda photograph: photograph.seconds)
    readers = [photograph.linear(camera.response) for photograph in ascending]
    merged = StoredRadiance.reserve(file, shape)

    def merge_rows(rows: slice) -> None:
        exposed = [read(rows) for read in readers]
        light = np.stack(exposed).reshape(len(readers), -1, channels)
        pixels = light.shape[1]
        value = np.empty((pixels, channels), np.float32)
        variance = np.empty((pixels, channels), np.float32)
        valid = np.empty((pixels, channels), bool)
        for c in range(channels):
            value[:, c], variance[:, c], valid[:, c] = merger.merge(light[..., c], c)
        strip_shape = (rows.stop - rows.start, *shape[1:])
        strip = Radiance(
            value.reshape(strip_shape), variance.reshape(strip_shape), valid.reshape(strip_shape)
        )
        merged.write(rows.start, strip)

    in_strips(shape[0], MERGED_VALUES // (len(readers) * math.prod(shape[1:])), merge_rows)
    return merged


@contextlib.contextmanager
def _about(photographs: Sequence[Photograph]) -> Iterator[None]:
    """Name photographs in an AcquisitionError that the block raises as an InputError."""
    numbers = [photograph.number for photograph in photographs]
    names = [name_by_number(number) for number in numbers]
    with acquisition_error(f"photographs {min(numbers)} to {max(numbers)}", names):
        yield


class CaptureSession:
    """A rig during a calibration, and what is known of its camera so far.

    Attributes
    ----------
    shots : Shots
        The rig.
    camera : CameraModel
        Response, noise and offset.
    hot : ndarray of bool
        Defective pixels (H, W).
    record : AgreementRecord
        All photographs, to be compared when the noise is known.
    file : ImageFile
        The photographs.
    """

    def __init__(self, shots: Shots, log: ArrayLog | None, progress: Callable[[int], None]) -> None:
        self.shots = shots
        self.camera = CameraModel(response=Response.identity())
        self.hot = np.zeros((1, 1), bool)
        self.record = AgreementRecord()
        self.file = ImageFile(None if log is None else log.path)
        self._log = log
        self._progress = progress
        self._uniform: dict[str, Photograph] = {}

    def prepare(self, requests: Iterable[Request]) -> None:
        """Announce photographs to the rig, so that a person can take all of them in one go."""
        missing = []
        for name, request in _named(requests):
            if name not in self._uniform:
                missing.append(request)
        self.shots.prepare(missing)

    def take(self, groups: Sequence[Sequence[Request]]) -> list[list[Photograph]]:
        """Photographs of requests, in order; those of uniform patterns are used again."""
        requests = [request for group in groups for request in group]
        self.prepare(requests)
        photographs = []
        for name, request in _named(requests):
            photograph = self._uniform.get(name)
            if photograph is None:
                photograph = self._take(name, request)
            photographs.append(photograph)
        grouped = []
        first = 0
        for group in groups:
            end = first + len(group)
            grouped.append(photographs[first:end])
            first = end
        return grouped

    def photograph(self, codes: np.ndarray, seconds: float) -> Photograph:
        """The photograph of one request."""
        [[photograph]] = self.take([[(codes, seconds)]])
        return photograph

    def linear(self, photograph: Photograph) -> Callable[[slice], np.ndarray]:
        """Function that reads some rows in linear values, as far as the response is known."""
        return photograph.linear(self.camera.response)

    def name(self, photograph: Photograph) -> str:
        """Name of a photograph in messages."""
        return self.shots.name(photograph.number)

    def merge(self, photographs: Sequence[Photograph]) -> StoredRadiance:
        """Photographs of one pattern as radiance, ambient light included.

        AcquisitionError if they determine none.
        """
        return merge_photographs(photographs, self.camera, self.shots.levels, self.file)

    def merge_sampled(self, photographs: Sequence[Photograph]) -> Radiance:
        """The radiance at the pixels of `Photograph.sampled`."""
        with _about(photographs):
            return merge(
                [photograph.sampled for photograph in photographs],
                [photograph.seconds for photograph in photographs],
                self.camera.response,
                self.camera.noise,
                levels=self.shots.levels,
                black=self.camera.offset,
            )

    def check_agreement(self) -> None:
        """Raise AcquisitionError with the names of photographs that deviate, if any."""
        finding = self.record.first_finding(self.camera, self.shots.name)
        if finding is None:
            return
        text = finding.text
        photographs = self.record.photographs
        coarse = first_of_fewer_bits(photographs, self.shots.levels)
        if coarse is not None:
            text = coarse.describe(self.shots.name)
        elif not finding.is_exchange:
            explanation = Contradictions(photographs, self.camera).explain()
            if explanation.suspects != set(finding.suspects):
                text = explanation.describe(self.shots.name) or text
        raise AcquisitionError(f"{text}; {ADVICE}")

    @contextlib.contextmanager
    def naming_photographs(self) -> Iterator[None]:
        """Name photographs that deviate, if the block cannot use them."""
        try:
            yield
        except AcquisitionError as error:
            if not isinstance(error, PhotographMissing):
                self.check_agreement()
            raise

    def _take(self, name: str, request: Request) -> Photograph:
        """Take one photograph, or read it from the log."""
        codes, seconds = request
        stored = self._stored_image(name)
        self.shots.expose(codes, seconds, stored)
        if self._log is not None and stored is None:
            self._log.put(name, image=self.shots.image)
        photograph = Photograph.of(self.shots, seconds, self.file)
        pixels = scale_codes(sample(self.shots.image), self.shots.rig)
        self.record.add_sample(codes, seconds, pixels, photograph.number)
        # It is in the file now.
        self.shots.image = np.zeros((0, 0))
        if codes.min() == codes.max():
            self._uniform[name] = photograph
        self._progress(self.shots.count)
        return photograph

    def _stored_image(self, name: str) -> np.ndarray | None:
        """Image of an earlier run; None if it is missing or damaged, and must be taken again."""
        if self._log is None:
            return None
        try:
            return self._log.get(name)["image"]
        except (FileError, KeyError):
            return None


def _named(requests: Iterable[Request]) -> Iterator[tuple[str, Request]]:
    """Requests with their names in the log; equal ones are counted."""
    counts: Counter[str] = Counter()
    for codes, seconds in requests:
        key = shot_key(codes, seconds)
        yield f"{SHOT_PREFIX}{key}_{counts[key]}", (codes, seconds)
        counts[key] += 1


@contextlib.contextmanager
def acquisition_error(subject: str, names: Sequence[str] = ()) -> Iterator[None]:
    """Raise an InputError about photographs as an AcquisitionError about `subject`.

    `names` replace images[0], images[1] and so on.
    """
    try:
        yield
    except InputError as error:
        text = str(error)
        for k, name in enumerate(names):
            text = text.replace(f"images[{k}]", name)
        raise AcquisitionError(f"{subject}: {text}") from error


def calibration_folder(store: Path) -> Path:
    """Folder of the photographs, T.zarr.calibration for T.zarr."""
    return store.with_name(f"{store.name}.calibration")


def calibration_photographs(store: Path) -> int:
    """Number of photographs in the folder."""
    names = ArrayLog(calibration_folder(store)).names
    return sum(name.startswith(SHOT_PREFIX) for name in names)


def remove_photographs(store: Path) -> None:
    """Remove the folder after the calibration was committed, also one that a killed run left."""
    names = ArrayLog(calibration_folder(store)).names
    foreign = [name for name in names if name != RIG_ENTRY and not name.startswith(SHOT_PREFIX)]
    if names and not foreign:
        shutil.rmtree(calibration_folder(store), ignore_errors=True)


@contextlib.contextmanager
def photograph_log(store: Path, shots: Shots) -> Iterator[ArrayLog | None]:
    """The folder of a session, which is removed when the block ends well.

    None if the rig stores its photographs itself. InputError if the folder has photographs of
    another rig; FileError if it cannot be written, or another process is at work there.
    """
    if shots.keeps_photographs:
        yield None
        return
    log = _open_log(calibration_folder(store), shots)
    with locked(log.path, wait=False):
        description = json.loads(str(log.get(RIG_ENTRY)["json"]))
        check_same_rig(description, shots, log.path)
        count = calibration_photographs(store)
        if count:
            logger.info("calibration: %d photographs of an earlier run are used again", count)
        try:
            yield log
        except AcquisitionError:
            logger.warning("%s has the photographs so far; to take them again, remove it", log.path)
            raise
    remove_photographs(store)


def _open_log(path: Path, shots: Shots) -> ArrayLog:
    """The log in a folder; a new one begins with the description of the rig."""
    log = ArrayLog(path)
    if path.is_dir():
        sweep(path)
    if log.names:
        return log
    if path.exists() and any(path.iterdir()):
        raise FileError(f"{path}: was not made by ltcl; it will not be replaced")
    description = json.dumps(shots.describe()["rig"], default=str)
    log.put(RIG_ENTRY, json=np.array(description))
    return log


def check_same_rig(description: Any, shots: Shots, path: Path) -> None:
    """Refuse a rig with another description than that of the photographs in `path`."""
    now = shots.describe()["rig"]
    check_same("rig", _identity(now), _identity(description), path, RigError)


def check_same(
    name: str, now: Any, before: Any, path: Path, error: type[InputError] = InputError
) -> None:
    """Refuse to go on with `path` if a setting, or a fact about a rig, has another value."""
    if isinstance(now, dict) and isinstance(before, dict):
        for key in sorted(now.keys() | before.keys()):
            check_same(f"{name}.{key}", now.get(key), before.get(key), path, error)
    elif now != before:
        raise error(
            f"{name} is {now!r:.80}, but {path} was begun with {before!r:.80}; "
            "it must be that, or another store"
        )


def _identity(description: Any) -> dict[str, Any]:
    """Description of a rig as plain JSON, numbers to four digits, without `VOLATILE_KEYS`.

    >>> _identity({"camera": {"kind": "opencv", "source": 0}, "period": 1 / 60, "seed": 3})
    {'camera': {'kind': 'opencv'}, 'period': 0.01667}
    """

    def four_digits(digits: str) -> float:
        return float(f"{float(digits):.4g}")

    def without_volatile(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        return {key: value for key, value in pairs if key not in VOLATILE_KEYS}

    text = json.dumps(description, default=str)
    return json.loads(text, parse_float=four_digits, object_pairs_hook=without_volatile)
