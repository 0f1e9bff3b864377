# SPDX-License-Identifier: BSD-3-Clause
"""`FilmRun`: the loop over the batches of a film, and `BatchSolver`, which its workers get once.

A batch is read ahead, solved here or on workers, written, and then recorded, in this order.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields
from itertools import chain, islice, repeat, tee
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ltcl import images
from ltcl.batch import manifest
from ltcl.batch.manifest import FrameRecord, OtherRun, identity
from ltcl.errors import FileError, InputError, LtclError
from ltcl.files import read_ahead
from ltcl.images.encoding import from_linear
from ltcl.images.frames import Frame, Source
from ltcl.solvers import Inverse
from ltcl.solvers.auto import SMALL, survey
from ltcl.tasks.compensation import Compensator, compensate
from ltcl.tasks.compensation.codes import LINEAR, SRGB
from ltcl.transport.transport import Transport

# Broken frames that an error names.
MAX_NAMED = 5
# Options of `compensate` that prepared frames have, too.
PREPARED_OPTIONS = {"bounds", "background", "weights", "rtol", "inverse", "clamp"}
# Threads that compress and flush files, side by side.
WRITERS = 4


class ReadFrame(NamedTuple):
    """A frame, the SHA-256 of what was read, and its picture on the camera's grid."""

    frame: Frame
    digest: str
    picture: np.ndarray


class SolvedBatch(NamedTuple):
    """Patterns and appearances of the frames of a batch, with their errors and clipped shares.

    Patterns are light, or uint16 codes of sRGB with white at the upper bound.
    """

    pattern: np.ndarray
    appearance: np.ndarray | None
    errors: list[float]
    clipped: list[float]


class WrittenBatch(NamedTuple):
    """A batch whose files are being written, and the digests that come of it."""

    batch: Sequence[ReadFrame]
    solved: SolvedBatch
    digests: Iterator[str]


@dataclass(eq=False, kw_only=True)
class BatchSolver:
    """Solve a batch of pictures; it is sent to each worker once.

    On workers `reload` reads T from its file, instead of a T that was sent. Frames go one by one
    through a prepared `Compensator`, cold, so that none depends on those before; where options ask
    for what that has not, `compensate` takes the whole batch.
    """

    T: Transport
    options: dict[str, Any]
    needs_appearance: bool
    needs_codes: bool = False
    identity: dict[str, Any]
    reload: Callable[[], Transport] | None = None
    gain: Any = None  # of all frames, when it is known

    def __call__(self, batch: tuple[list[int], np.ndarray]) -> SolvedBatch:
        """Solve the pictures (k, h, w[, 3]) of frames with these numbers."""
        numbers, pictures = batch
        try:
            pictures = _unambiguous(pictures, self.T)
            compensator = self._compensator()
            if compensator is None:
                return self._solve_together(pictures)
            solved = []
            for picture in pictures:
                solved.append(self._solve_prepared(compensator, picture))
        except LtclError as error:
            error.args = (f"frames {numbers[0]} to {numbers[-1]}: {error}",)
            raise
        return _joined(solved)

    def _solve_together(self, pictures: np.ndarray) -> SolvedBatch:
        """Solve pictures (k, h, w[, 3]) at once."""
        self._survey()
        solved = compensate(self.T, pictures, gain=self.gain, **self.options)
        pattern = solved.pattern
        if self.needs_codes:
            pattern = from_linear(pattern / self._white(), "srgb", 16, is_float=False)
        appearance = None
        if self.needs_appearance:
            appearance = solved.appearance
        return SolvedBatch(
            pattern=pattern,
            appearance=appearance,
            errors=solved.frame_errors.tolist(),
            clipped=solved.frame_clipped.tolist(),
        )

    def _solve_prepared(self, compensator: Compensator, picture: np.ndarray) -> SolvedBatch:
        """Solve one picture; together with its error, which decides whether that was enough."""
        pattern = compensator(picture)
        facts = compensator.judge()
        if facts.clipped == 0.0 and facts.error > compensator.rtol:
            # Fixed steps were too few for this one.
            return self._solve_together(picture[None])
        appearance = None
        if self.needs_appearance:
            light = compensator.light()
            appearance = self.T @ light
            background = self.options.get("background")
            if background is not None:
                if np.ndim(background) == 2 and appearance.ndim == 3:
                    background = np.asarray(background)[..., None]
                appearance = appearance + background
            appearance = appearance[None].astype(np.float32)
        return SolvedBatch(
            pattern=pattern[None],
            appearance=appearance,
            errors=[facts.error],
            clipped=[facts.clipped],
        )

    def _compensator(self) -> Compensator | None:
        """The compensator of all frames, made at the first one; None if options ask for more."""
        if self._is_prepared or not PREPARED_OPTIONS.issuperset(self._given_options()):
            return self._prepared
        self._is_prepared = True
        options: dict[str, Any] = {}
        for name in self._given_options():
            options[name] = self.options[name]
        options.pop("method", None)
        dtype = "uint16" if self.needs_codes else "float32"
        encode = SRGB if self.needs_codes else LINEAR
        try:
            self._prepared = Compensator(
                self.T, gain=self.gain, dtype=dtype, encode=encode, warm=False, **options
            )
        except InputError:
            if not options.get("clamp"):
                raise
        return self._prepared

    def _given_options(self) -> set[str]:
        """Names of the options that are not the default."""
        names = {name for name, value in self.options.items() if value is not None}
        if self.options.get("method") == "auto":
            names.remove("method")
        return names - {"callback"}

    def _white(self) -> np.float32:
        """Light that is white in .png."""
        _, high = self.options.get("bounds") or (0.0, 1.0)
        return np.float32(high if high > 0 else 1.0)

    def _survey(self) -> None:
        """Let "auto" see one survey of S in every batch, so that all choose the same method."""
        is_auto = self.options.get("method", "auto") == "auto"
        if is_auto and self.T.is_square and self.T.shape[0] > SMALL:
            for S in self.T.systems:
                survey(S)

    def __post_init__(self) -> None:
        # Not fields: they stay with their device.
        self._prepared: Compensator | None = None
        self._is_prepared = False

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what `_on_worker` takes: T only if it has no file there."""
        state = {attribute.name: getattr(self, attribute.name) for attribute in fields(self)}
        state["options"] = {**self.options}
        state["options"].pop("callback", None)
        if self.reload is not None:
            state["T"] = None
        return _on_worker, (state,)


def _joined(solved: Sequence[SolvedBatch]) -> SolvedBatch:
    """Several batches as one."""
    patterns = []
    appearances = []
    errors: list[float] = []
    clipped: list[float] = []
    for batch in solved:
        patterns.append(batch.pattern)
        if batch.appearance is not None:
            appearances.append(batch.appearance)
        errors += batch.errors
        clipped += batch.clipped
    appearance = None
    if appearances:
        appearance = np.concatenate(appearances)
    return SolvedBatch(np.concatenate(patterns), appearance, errors, clipped)


def _on_worker(state: dict[str, Any]) -> BatchSolver:
    """Make the solver of a worker, with T from its file if it has one."""
    reload = state["reload"]
    if reload is not None:
        state["T"] = reload()
        if identity(state["T"]) != state["identity"]:
            raise InputError("the file of T holds another T there; give all workers the same")
    for value in (state["T"], *state["options"].values()):
        # A worker opens its own device.
        if isinstance(value, (Transport, Inverse)):
            value.forget_device()
    return BatchSolver(**state)


@dataclass(eq=False, kw_only=True)
class FilmRun:
    """A run over the frames of a film, into a folder."""

    solver: BatchSolver
    stream: Callable[..., Iterator[Any]]  # results of the solver, here or by workers
    source: Source
    limit: int | None
    folder: Path
    head: dict[str, Any]  # of the manifest
    white: float  # light that is white in .png
    codes: Callable[[np.ndarray], np.ndarray] | None
    records: dict[int, FrameRecord] = field(default_factory=dict)  # by number, of all runs
    done: set[int] = field(default_factory=set)  # numbers of frames, of earlier runs, too
    broken: dict[int, str] = field(default_factory=dict)  # frames left out, and why
    read_count: int = 0  # frames of the right size
    solved_count: int = 0

    def __post_init__(self) -> None:
        settings = self.head["settings"]
        self.batch_size: int = settings["batch"]
        self.format: str = settings["format"]
        self.resize: str | None = settings["resize"]

    @property
    def count(self) -> int | None:
        """Number of frames, as far as the source tells."""
        if not self.source.count or self.limit is None:
            return self.source.count
        return min(self.source.count, self.limit)

    def solve(self, gain: float | str, loss: float | None) -> Generator[int, None, None]:
        """Solve all batches; yields how many frames are done, at first and after each batch."""
        # The next batch is read while one is solved.
        ahead = read_ahead(lambda batches: next(batches, None), repeat(self._batches()), 1)
        batches = iter(lambda: next(ahead), None)
        first = list(islice(batches, 1))
        yield len(self.done)
        if first and self.head["gain"] is None:
            self.head["gain"] = self._find_gain(gain, loss, first[0])
        self.solver.gain = self.head["gain"]

        to_solve, to_write = tee(chain(first, batches))
        with ThreadPoolExecutor(WRITERS) as writers:
            results = self.stream(self.solver, map(_task, to_solve))
            # A batch is written while the next one is solved.
            on_the_way: WrittenBatch | None = None
            try:
                for solved, batch in zip(results, to_write, strict=True):
                    before = on_the_way
                    on_the_way = self._begin_writing(batch, solved, writers)
                    if before is not None:
                        self._record(before)
                        yield len(self.done)
            finally:
                if on_the_way is not None:
                    self._record(on_the_way)
            if on_the_way is not None:
                yield len(self.done)
        self._name_broken()

    def _begin_writing(
        self, batch: Sequence[ReadFrame], solved: SolvedBatch, writers: ThreadPoolExecutor
    ) -> WrittenBatch:
        """Let the writers write the files of a batch."""
        numbers = [read.frame.number for read in batch]
        light = [solved.pattern]
        if solved.appearance is not None:
            light.append(solved.appearance)
        return WrittenBatch(batch, solved, writers.map(self._write, numbers, *light))

    def _record(self, written: WrittenBatch) -> None:
        """Wait for the files of a batch, and record it."""
        batch, solved, digests = written
        results = zip(batch, digests, solved.errors, solved.clipped, strict=True)
        for read, output_digest, error, clipped in results:
            record = FrameRecord(
                number=read.frame.number,
                name=read.frame.name,
                digest=read.digest,
                output_digest=output_digest,
                error=error,
                clipped=clipped,
            )
            self.records[record.number] = record
            self.done.add(record.number)
        manifest.write(self.folder, self.head, self.records)
        self.solved_count += len(batch)

    def _name_broken(self) -> None:
        """FileError that names frames which were left out."""
        if not self.broken:
            return
        reasons = [f"{number} ({self.broken[number]})" for number in sorted(self.broken)]
        named = ", ".join(reasons[:MAX_NAMED])
        if len(reasons) > MAX_NAMED:
            named += f" and {len(reasons) - MAX_NAMED} more"
        raise FileError(f"{self.source.path}: frames were left out: {named}")

    def _find_gain(self, gain: float | str, loss: float | None, first: list[ReadFrame]) -> float:
        """Return the gain of all frames, which "auto" derives from a sample.

        The sample is the first frames if the number of frames is unknown.
        """
        if not isinstance(gain, str):
            return float(gain)
        count = self.count or self.batch_size
        places = np.linspace(1, count, min(self.batch_size, count))
        numbers = set(np.rint(places).astype(int).tolist())
        sample = []
        for frame in islice(self.source, max(numbers)):
            if frame.number in numbers:
                sample += self._read(frame)
        T = self.solver.T
        pictures = _unambiguous(stack(sample or first), T)
        return compensate(T, pictures, gain=gain, loss=loss, **self.solver.options).gain

    def _batches(self) -> Iterator[list[ReadFrame]]:
        """The frames that no earlier run has done, without broken ones."""
        frames = islice(self.source, self.limit)
        while True:
            group = list(islice(frames, self.batch_size))
            if not group:
                return
            batch = []
            for frame in group:
                batch += self._read(frame)
            if batch:
                yield batch

    def _read(self, frame: Frame) -> list[ReadFrame]:
        """Read a frame onto the camera's grid.

        The list is empty if the frame is done, or broken, which is noted.
        """
        place = f"{self.source.path}: frame {frame.number} ({frame.name})"
        try:
            digest = frame.digest()
            if self._is_done(frame, digest, place):
                self.done.add(frame.number)
                return []
            picture = frame.picture()
            self._check_size(picture, place)
        except InputError as error:
            is_first_size = self.read_count == 0 and not isinstance(error, FileError)
            if isinstance(error, OtherRun) or is_first_size:
                raise  # perhaps all frames are of another size
            self.broken[frame.number] = str(error)
            return []
        self.read_count += 1
        grid = self.solver.T.camera_grid
        if self.resize is not None:
            picture = images.resize(picture, grid, self.resize)
        return [ReadFrame(frame, digest, picture)]

    def _is_done(self, frame: Frame, digest: str, place: str) -> bool:
        """True if a frame has its files as written; OtherRun if it has changed since then."""
        record = self.records.get(frame.number)
        if record is None:
            return False
        if record.digest != digest:
            advice = f"give the same frames to go on, or another folder than {self.folder}"
            raise OtherRun(f"{place} has changed since its pattern was made; {advice}")
        with contextlib.suppress(OSError):
            return files_digest(self._files(frame.number)) == record.output_digest
        return False

    def _check_size(self, picture: np.ndarray, place: str) -> None:
        h, w = self.solver.T.camera_grid
        if self.resize is not None or picture.shape[:2] == (h, w):
            return
        size = f"{picture.shape[0]} x {picture.shape[1]} pixels, but the camera has {h} x {w}"
        advice = "give resize='crop', 'letterbox' or 'stretch' (--resize) to scale all frames"
        raise InputError(f"{place} is {size}; {advice}")

    def patterns(self) -> Iterator[np.ndarray]:
        """Patterns as they were written, white at 1; codes as the light that sRGB makes of them."""
        for number in sorted(self.done):
            pattern = images.read(self._files(number)[0])
            if self.format == "exr":
                if self.codes is None:
                    pattern = pattern / np.float32(self.white)
                else:
                    pattern = images.from_srgb(self.codes(pattern))
            yield pattern

    def _files(self, number: int) -> list[Path]:
        """Files of a frame: its pattern and, where asked for, its appearance."""
        files = [self.folder / f"pattern_{number:06}.{self.format}"]
        if self.solver.needs_appearance:
            files.append(self.folder / f"appearance/appearance_{number:06}.{self.format}")
        return files

    def _write(self, number: int, pattern: np.ndarray, appearance: np.ndarray | None = None) -> str:
        """Write the files of a frame; return their digest."""
        files = self._files(number)
        pattern_file, *appearance_file = files
        if pattern.dtype == np.uint16:
            images.write_codes(pattern_file, pattern)
        elif self.codes is not None and self.format == "png":
            images.write(pattern_file, self.codes(pattern), bits=16, encoding="linear")
        else:
            self._write_light(pattern_file, pattern, self.white)
        if appearance is not None:
            # Divided by the gain it is as bright as the picture that was asked for.
            self._write_light(appearance_file[0], appearance, self.head["gain"])
        return files_digest(files)

    def _write_light(self, file: Path, light: np.ndarray, white: float) -> None:
        """Write light as it is in .exr, in .png with white at `white`."""
        if self.format == "exr":
            images.write(file, light)
        else:
            images.write(file, light / np.float32(white), bits=16)


def files_digest(files: Sequence[Path]) -> str:
    """SHA-256 of the bytes of files, one behind the other."""
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _task(batch: Sequence[ReadFrame]) -> tuple[list[int], np.ndarray]:
    """Numbers and pictures of a batch, as a `BatchSolver` takes them."""
    return [read.frame.number for read in batch], stack(batch)


def stack(batch: Sequence[ReadFrame]) -> np.ndarray:
    """The pictures of a batch: (k, h, w), or (k, h, w, 3) where one of them is in colour."""
    pictures = [np.atleast_3d(read.picture) for read in batch]
    stacked = np.stack(np.broadcast_arrays(*pictures))
    return stacked if stacked.shape[-1] == 3 else stacked[..., 0]


def _unambiguous(pictures: np.ndarray, T: Transport) -> np.ndarray:
    """Pictures of frames; three grey ones in colour, as (3, h, w) may be the colours of one."""
    if T.channels == 3 and pictures.ndim == 3 and len(pictures) == 3:
        return np.repeat(pictures[..., None], 3, axis=-1)
    return pictures
