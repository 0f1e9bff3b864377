# SPDX-License-Identifier: BSD-3-Clause
"""What a folder of patterns says of itself: from which T, with which settings, which frames are done.

The file is replaced whole after every batch, when its patterns are safe on the disk. So it never lists a
frame that is not there, and whatever ends a run early costs the batch it was at.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ltcl import report
from ltcl.batch import identity
from ltcl.errors import FileError, InputError
from ltcl.files import input_file, replace_file

NAME = "frames.json"
_FORMAT = 1


class OtherRun(InputError):
    """What is to be resumed is not what was begun."""


@dataclass(frozen=True)
class Record:
    """One frame that is done.

    Attributes
    ----------
    number : int
        From 1; of the pattern, too.
    name : str
        Of the frame that was read.
    digest : str
        SHA-256 of what it holds.
    error, clipped : float
        Of this frame, as in `ltcl.Compensation`: with T, or with `exact` where that is among the settings.
    """

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
    _lines: dict[int, str] = field(default_factory=dict)  # all of them are written after every batch

    def add(self, records: Iterable[Record]) -> None:
        """Take these frames as done, on the disk, too."""
        self._take(records)
        known = {"settings": self.settings, "transport": self.transport, "gain": self.gain}
        head = report.dumps({"format": _FORMAT, "versions": report.versions(), **known})
        lines = ",\n".join(self._lines[number] for number in sorted(self._lines))
        with replace_file(self.path) as temporary:
            temporary.write_text(f'{head[:-2]},\n  "frames": [\n{lines}\n  ]\n}}\n', encoding="utf-8")

    def take_up(self) -> None:
        """Go on with the run whose file is there, if one is.

        Raises
        ------
        FileError
            The file is damaged.
        OtherRun
            That run had other settings, or another T.
        """
        if not self.path.exists():
            return
        earlier, records = _read(self.path)
        for name in sorted({*self.settings, *earlier["settings"]}):
            had, has = (of.get(name) for of in (earlier["settings"], self.settings))
            if had != has:
                raise OtherRun(
                    f"{self.path}: that run had {name}={had!r}, this one has {has!r}; "
                    "give the same to go on with it, or another folder"
                )
        if not identity.same_transport(earlier["transport"], self.transport):
            raise OtherRun(
                f"{self.path}: that run was with another T; give the same to go on with it, or another folder"
            )
        self.gain = earlier["gain"]
        self._take(records)

    def _take(self, records: Iterable[Record]) -> None:
        for record in records:
            self.records[record.number] = record
            self._lines[record.number] = f"    {json.dumps(dataclasses.asdict(record))}"


def refuse_earlier(path: Path) -> None:
    """Refuse to begin anew where a run has left frames: they may be worth hours."""
    if path.exists():
        _, records = _read(path)
        raise InputError(
            f"{path.parent}: holds {len(records)} frame(s) of an earlier run; "
            "give resume=True to go on with it, or another folder"
        )


def _read(path: Path) -> tuple[dict[str, Any], list[Record]]:
    try:
        found = json.loads(input_file(path).read_text(encoding="utf-8"))
        if found["format"] != _FORMAT:
            raise ValueError(f"format {found['format']!r}")
        records = [Record(**entry) for entry in found["frames"]]
        head = {key: found[key] for key in ("settings", "transport", "gain")}
        kinds = [*zip(head.values(), (dict, dict, float), strict=True), *((r.number, int) for r in records)]
        if not all(isinstance(value, kind) for value, kind in kinds):
            raise ValueError("values of other types")
    except FileError:
        raise
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise FileError(f"{path}: is no list of frames of ltcl, or a damaged one ({reason})") from None
    return head, records
