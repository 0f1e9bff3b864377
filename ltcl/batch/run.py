# SPDX-License-Identifier: BSD-3-Clause
"""The loop over batches: read ahead, solve, write, note down, in this order."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ltcl.batch.manifest import Manifest, OtherRun, Record
from ltcl.batch.output import Output
from ltcl.batch.reading import Reader, ahead, batched
from ltcl.batch.result import CompensatedFrames
from ltcl.compensation import compensate
from ltcl.errors import ConvergenceError, LtclError
from ltcl.images.frames import Frame
from ltcl.transport import Transport

_WRITERS = 4  # threads: files are compressed and flushed side by side


@dataclass(frozen=True, eq=False)
class Batch:
    """Frames, their digests, and their pictures; without these where all are done."""

    frames: list[Frame]
    digests: list[str]
    pictures: list[np.ndarray]


@dataclass(eq=False)
class Run:
    """What there is to do, and the numbers of the frames that are `passed`, done now or in an earlier run."""

    T: Transport
    reader: Reader
    output: Output
    kept: Manifest
    size: int
    options: dict[str, Any]
    passed: list[int] = field(default_factory=list)
    solved: int = 0

    def solve(self, gain: float | str, loss: float | None) -> Iterator[None]:
        """All batches; yields before the first one that is not done yet, after each, and at the end."""
        begun = False
        for batch in ahead(self._batches()):
            if batch.pictures:
                if not begun:
                    yield
                    begun = True
                self._solve(batch, self._gain(gain, loss))
            self.passed += [frame.number for frame in batch.frames]
            if batch.pictures:
                yield
        if not begun:
            yield

    def result(self, video: Path | None, seconds: float) -> CompensatedFrames:
        """What came out of it."""
        assert self.kept.gain is not None  # noqa: S101 - a source has a frame, or refuses
        records = tuple(self.kept.records[number] for number in self.passed)
        told = (self.options.get("exact") or self.T).error
        return CompensatedFrames(
            self.output.folder, video, self.kept.gain, records, self.solved, seconds, told
        )

    def _batches(self) -> Iterator[Batch]:
        for frames in batched(self.reader.frames(), self.size):
            digests = [frame.digest() for frame in frames]
            done = self._done(frames, digests)
            yield Batch(frames, digests, [] if done else [self.reader.picture(frame) for frame in frames])

    def _done(self, frames: list[Frame], digests: list[str]) -> bool:
        """Whether an earlier run has done these frames, all of them."""
        records = [self.kept.records.get(frame.number) for frame in frames]
        for frame, digest, record in zip(frames, digests, records, strict=True):
            if record is not None and record.digest != digest:
                raise OtherRun(
                    f"{self.reader.source.place(frame.number)} is not what it was when its pattern was made; "
                    f"give the same frames to go on, or another folder than {self.output.folder}"
                )
        files = (file for frame in frames for file in self.output.files(frame.number))
        return None not in records and all(file.is_file() for file in files)

    def _gain(self, gain: float | str, loss: float | None) -> float:
        """The one of all frames, found once."""
        if self.kept.gain is None and isinstance(gain, str):
            sample = self.reader.sample(self.size)
            colour = any(picture.ndim == 3 for picture in sample)
            alike = [np.stack([p] * 3, axis=-1) if colour and p.ndim == 2 else p for p in sample]
            self.kept.gain = compensate(self.T, np.stack(alike), gain=gain, loss=loss, **self.options).gain
        elif self.kept.gain is None:
            self.kept.gain = float(gain)
        return self.kept.gain

    def _solve(self, batch: Batch, gain: float) -> None:
        """Patterns of a batch, on the disk, and then their records; grey and coloured frames apart."""
        kinds = [[place for place, p in enumerate(batch.pictures) if p.ndim == n] for n in (2, 3)]
        records = [record for places in kinds if places for record in self._solve_alike(batch, places, gain)]
        self.kept.add(records)
        self.solved += len(records)

    def _solve_alike(self, batch: Batch, places: list[int], gain: float) -> list[Record]:
        frames = [batch.frames[place] for place in places]
        with _of(frames):
            pictures = np.stack([batch.pictures[place] for place in places])
            done = compensate(self.T, pictures, gain=gain, **self.options)
        appearances = done.appearance if self.output.appearance else done.pattern  # not written then
        with ThreadPoolExecutor(_WRITERS) as writers:
            written = [
                writers.submit(self.output.write, frame.number, pattern, seen, gain)
                for frame, pattern, seen in zip(frames, done.pattern, appearances, strict=True)
            ]
        for each in written:
            each.result()
        found = zip(frames, places, done.frame_errors, done.frame_clipped, strict=True)
        return [
            Record(frame.number, frame.name, batch.digests[place], float(error), float(clipped))
            for frame, place, error, clipped in found
        ]


@contextmanager
def staying(kept: Manifest) -> Iterator[None]:
    """Refusals of the block end in how many frames are done, and how to go on."""
    try:
        yield
    except OtherRun:
        raise
    except LtclError as error:
        if not kept.records:
            raise
        raise _worded(
            error,
            f"{error}; {len(kept.records)} frame(s) are done and stay in {kept.path.parent}, "
            "resume=True goes on from there",
        ) from error


@contextmanager
def _of(frames: list[Frame]) -> Iterator[None]:
    """Refusals of the block begin with the frames."""
    try:
        yield
    except LtclError as error:
        first, last = frames[0].number, frames[-1].number
        which = f"frame {first}" if first == last else f"frames {first} to {last}"
        raise _worded(error, f"{which}: {error}") from error


def _worded(error: LtclError, text: str) -> LtclError:
    return (
        ConvergenceError(text, error.solution) if isinstance(error, ConvergenceError) else type(error)(text)
    )
