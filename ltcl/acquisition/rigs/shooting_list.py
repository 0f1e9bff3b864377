# SPDX-License-Identifier: BSD-3-Clause
"""The list of a folder rig: which number has which codes, seconds and repeat.

`shots.json` is what the rig itself reads; `shots.csv` says the same to the person who photographs. Both are
replaced whole or not at all. A shot is known by a hash of its codes, its seconds and how often the same was
asked for before, so a run that is started again finds its numbers. No file name is taken from the list.
"""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ltcl import checks
from ltcl.acquisition.rigs.arrivals import photo_name
from ltcl.errors import FileError, InputError
from ltcl.files import input_file, replace_file

_FORMAT = "ltcl shooting list 1"
_DIGEST = re.compile(r"[0-9a-f]{32}")


@dataclass(frozen=True)
class Shot:
    """One photograph to take: hash of its codes, exposure, and how many alike come before it."""

    codes: str
    seconds: float
    repeat: int


class ShootingList:
    """Shots by number, from 1; and for each the number of its pattern, which shots with the same codes share.

    Parameters
    ----------
    path : Path
        Of the .json file; the .csv file is beside it. Neither needs to exist.
    rig : mapping
        What all shots have in common (grid, channels, bits); a list made for other values is refused.

    Raises
    ------
    FileError
        The file is damaged, or no shooting list.
    InputError
        It was made for another rig.
    """

    def __init__(self, path: Path, rig: Mapping[str, Any]) -> None:
        self._path, self._rig = path, dict(rig)
        self._numbers: dict[Shot, int] = {}
        self._patterns: dict[str, int] = {}
        self._saved = 0
        if path.exists():
            self._load()

    def __len__(self) -> int:
        return len(self._numbers)

    def has_pattern(self, codes: str) -> bool:
        """Whether a shot on the list has these codes."""
        return codes in self._patterns

    def pattern(self, codes: str) -> int:
        """The number of the pattern with these codes; the next one where there is none."""
        return self._patterns.get(codes, len(self._patterns) + 1)

    def add(self, shot: Shot) -> int:
        """The number of a shot, which is put at the end of the list (in memory) if it is not there."""
        self._patterns.setdefault(shot.codes, len(self._patterns) + 1)
        return self._numbers.setdefault(shot, len(self._numbers) + 1)

    def save(self) -> None:
        """Write both files if there is anything new.

        Raises
        ------
        FileError
            They cannot be written: a full disk, no permission.
        """
        table = self._path.with_suffix(".csv")
        if self._saved == len(self) and self._path.exists() and table.exists():
            return
        self._save_table(table)
        shots = [{"codes": s.codes, "seconds": s.seconds, "repeat": s.repeat} for s in self._numbers]
        content = {"format": _FORMAT, "rig": self._rig, "shots": shots}
        with replace_file(self._path) as temporary:
            temporary.write_text(json.dumps(content, indent=0, allow_nan=False), encoding="utf-8")
        self._saved = len(self)

    def _save_table(self, path: Path) -> None:
        with replace_file(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            rows = csv.writer(file)
            rows.writerow(["number", "project", "seconds", "save as"])
            for number, shot in enumerate(self._numbers, 1):
                pattern = f"patterns/{pattern_name(self._patterns[shot.codes])}"
                rows.writerow([number, pattern, f"{shot.seconds:.6g}", f"photographs/{photo_name(number)}"])

    def _load(self) -> None:
        checks.fits_host("the shooting list", 10 * input_file(self._path).stat().st_size)
        try:
            content = json.loads(self._path.read_text(encoding="utf-8"))
            known, rig = content["format"] == _FORMAT, content["rig"]
            shots = [_shot(entry) for entry in content["shots"]]
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            raise FileError(f"{self._path}: is no shooting list, or a damaged one ({reason})") from None
        except OSError as error:
            raise FileError(f"{self._path}: cannot be read: {error.strerror}") from error
        if not known or len(set(shots)) < len(shots):
            raise FileError(f"{self._path}: is no shooting list of this version, or holds a shot twice")
        if rig != self._rig:
            raise InputError(
                f"{self._path}: was made for {rig}; this rig is {self._rig}, so take a new folder"
            )
        for shot in shots:
            self.add(shot)
        self._saved = len(self)


def pattern_name(number: int) -> str:
    """The file of a pattern.

    >>> pattern_name(7)
    'pattern_000007.png'
    """
    return f"pattern_{number:06d}.png"


def _shot(entry: Any) -> Shot:
    codes, seconds, repeat = entry["codes"], entry["seconds"], entry["repeat"]
    if not (isinstance(codes, str) and _DIGEST.fullmatch(codes)):
        raise ValueError("codes is no hash")
    return Shot(codes, checks.number("seconds", seconds, above=0.0), checks.count("repeat", repeat, least=0))
