# SPDX-License-Identifier: BSD-3-Clause
"""What a folder of patterns says of itself: from which T, with which settings, which frames are done.

Replaced whole after every batch, when its patterns are on the disk: what ends a run early costs one batch.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import files, report
from ltcl.acquisition.rig import fingerprint
from ltcl.errors import FileError, InputError
from ltcl.files import input_file, replace_file
from ltcl.transport import Transport

NAME = "frames.json"
_FORMAT = 2
_FEW = 8  # numbers are shown as they are, more by a digest
_LEVELS = 9  # of light, at which the curves of projectors are compared


class OtherRun(InputError):
    """What is to be resumed is not what was begun."""


@dataclass(frozen=True)
class Record:
    """A frame: number, from 1, name, SHA-256 of what was read; error and clipped as of a Compensation."""

    number: int
    name: str
    digest: str
    error: float
    clipped: float


@dataclass(eq=False)
class Manifest:
    """The settings and records of a run; `gain` is None until it is known."""

    path: Path
    settings: dict[str, Any]
    transport: dict[str, Any]
    gain: float | None = None
    records: dict[int, Record] = field(default_factory=dict)

    def add(self, records: Iterable[Record]) -> None:
        """Take these frames as done, on the disk, too."""
        self.records |= {record.number: record for record in records}
        known = {"settings": self.settings, "transport": self.transport, "gain": self.gain}
        head = report.dumps({"format": _FORMAT, "versions": report.versions(), **known})
        ordered = (dataclasses.asdict(self.records[number]) for number in sorted(self.records))
        lines = ",\n".join(f"    {json.dumps(record)}" for record in ordered)
        with replace_file(self.path) as temporary:
            temporary.write_text(f'{head[:-2]},\n  "frames": [\n{lines}\n  ]\n}}\n', encoding="utf-8")

    def begin(self, resume: bool) -> None:
        """Go on with the run whose file is there, if any; refuse other settings, another T, no `resume`."""
        if not self.path.exists():
            return
        try:
            content = json.loads(input_file(self.path).read_text(encoding="utf-8"))
            if content["format"] != _FORMAT:
                raise ValueError(f"format {content['format']!r}")
            records = {int(entry["number"]): Record(**entry) for entry in content["frames"]}
            settings, transport = dict(content["settings"]), {**content["transport"], "error": None}
            gain = float(content["gain"])
        except FileError:
            raise
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            reason = " ".join(str(error).split())
            raise FileError(f"{self.path}: is no list of frames of ltcl, or damaged ({reason})") from None
        if not resume:
            count, folder = len(records), self.path.parent
            advice = "give resume=True to go on with it, or another folder"
            raise InputError(f"{folder}: holds {count} frame(s) of an earlier run; {advice}")
        advice = "give the same to go on with it, or another folder"
        for name in sorted({*self.settings, *settings}):
            before, now = settings.get(name), self.settings.get(name)
            if before != now:
                raise OtherRun(f"{self.path}: that run had {name}={before!r}, this one has {now!r}; {advice}")
        if transport != {**self.transport, "error": None}:  # depends on the first bounce, patterns do not
            raise OtherRun(f"{self.path}: that run was with another T; {advice}")
        self.gain, self.records = gain, records


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Make the folder, and refuse other runs in it until the block ends; an empty one is removed again."""
    created = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = "is a file; a folder cannot be written there" if folder.is_file() else error.strerror
        raise FileError(f"{folder}: {reason}") from error
    try:
        with files.locked(folder, wait=False):
            yield
    finally:
        for place in created:
            with contextlib.suppress(OSError):  # something is in it
                place.rmdir()


def identity(T: Transport) -> dict[str, Any]:
    """Sizes, error and fingerprint of T; not the first bounce, on which compensation does not depend."""
    matrices = T.matrices if T.blocks is None else [block for row in T.blocks for block in row]
    mixing = [] if T.mixing is None else [T.mixing]
    sizes = {"grid": list(T.grid), "camera_grid": list(T.camera_grid), "channels": T.channels}
    return {**sizes, "error": T.error, "digest": fingerprint(T.masked, *mixing, *matrices)}


def setting(value: Any) -> Any:
    """A setting in the types of JSON: pictures and transports by a digest, other objects by their repr."""
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    if isinstance(value, Transport):
        return f"Transport, sha256 {identity(value)['digest']}"
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        text = repr(value)
        return type(value).__name__ if " at 0x" in text else text  # an address is of one run
    if array.size <= _FEW:
        return array.tolist()
    return f"{' x '.join(map(str, array.shape))}, sha256 {fingerprint(array.astype(np.float64))}"


def curve(codes: Callable[[np.ndarray], np.ndarray], grid: tuple[int, int]) -> str:
    """By what a projector's curve is known again: its codes for some levels of light, and for a ramp."""
    ramp = np.linspace(0.0, 1.0, grid[0] * grid[1], dtype=np.float32).reshape(grid)
    levels = [np.full(grid, level, np.float32) for level in np.linspace(0.0, 1.0, _LEVELS)]
    return f"sha256 {fingerprint(*(np.rint(65535 * np.asarray(codes(light))) for light in (*levels, ramp)))}"
