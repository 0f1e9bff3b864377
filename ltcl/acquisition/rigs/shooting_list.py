# SPDX-License-Identifier: BSD-3-Clause
"""The shooting list of a folder: patterns, exposures, and names of the photographs.

    folder/shots.csv     for a person: number, pattern, seconds, photograph
    folder/shots.json    the same list, for the rig

A shot is known by a hash of the projected codes, its seconds and the number of equal ones before
it, so that a run that is started again finds its photographs.
"""

from __future__ import annotations

import csv
import json
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from ltcl import checks
from ltcl.errors import FileError
from ltcl.files import replace_file

FORMAT = "ltcl shooting list 1"
CSV_HEADER = ("number", "project", "seconds", "save as")


class Shot(NamedTuple):
    """A photograph to take: the pattern to project, the exposure, and where to save it.

    `save_as` has no extension: any that a photograph can have may follow.
    """

    number: int
    pattern: str
    seconds: float
    save_as: str


class ShotKey(NamedTuple):
    """Equal shots have equal keys."""

    pattern_hash: str
    seconds: float


class ShootingList:
    """Shots in the order in which they were added; FileError for a damaged list in the folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        # By the key and the number of equal shots before.
        self._shots: dict[tuple[ShotKey, int], Shot] = {}
        self._pattern_numbers: dict[str, int] = {}
        repeats: Counter[ShotKey] = Counter()
        for key in _read_keys(self._json_path):
            self.add(key, repeats[key])
            repeats[key] += 1
        self._saved = len(self._shots)

    @property
    def shots(self) -> list[Shot]:
        """The list, in order."""
        return list(self._shots.values())

    @property
    def _csv_path(self) -> Path:
        return self.folder / "shots.csv"

    @property
    def _json_path(self) -> Path:
        return self.folder / "shots.json"

    def add(self, key: ShotKey, repeats: int) -> Shot:
        """The shot after `repeats` equal ones, put at the end of the list if it is new."""
        shot = self._shots.get((key, repeats))
        if shot is None:
            number = len(self._shots) + 1
            next_pattern = len(self._pattern_numbers) + 1
            pattern_number = self._pattern_numbers.setdefault(key.pattern_hash, next_pattern)
            shot = Shot(
                number=number,
                pattern=f"patterns/pattern_{pattern_number:06d}.png",
                seconds=key.seconds,
                save_as=f"photographs/photo_{number:06d}",
            )
            self._shots[key, repeats] = shot
        return shot

    def save(self) -> None:
        """Write both files if shots were added or a file is missing."""
        is_saved = self._saved == len(self._shots)
        if is_saved and self._json_path.exists() and self._csv_path.exists():
            return
        self._write_csv()
        self._write_json()
        self._saved = len(self._shots)

    def _write_csv(self) -> None:
        with (
            replace_file(self._csv_path) as temporary,
            temporary.open("w", newline="", encoding="utf-8") as file,
        ):
            writer = csv.writer(file)
            writer.writerow(CSV_HEADER)
            for shot in self.shots:
                writer.writerow((shot.number, shot.pattern, f"{shot.seconds:.6g}", shot.save_as))

    def _write_json(self) -> None:
        shots = []
        for key, _ in self._shots:
            shots.append({"codes": key.pattern_hash, "seconds": key.seconds})
        content = json.dumps({"format": FORMAT, "shots": shots}, indent=0)
        with replace_file(self._json_path) as temporary:
            temporary.write_text(content)


def _read_keys(path: Path) -> list[ShotKey]:
    """Keys of a list in order, none if there is no file; FileError for a damaged one."""
    if not path.exists():
        return []
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != FORMAT:
            raise ValueError(f"format {content['format']!r:.40}")
        keys = []
        for shot in content["shots"]:
            seconds = checks.number("seconds", shot["seconds"], above=0.0)
            keys.append(ShotKey(str(shot["codes"]), seconds))
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise FileError(f"{path}: is not a shooting list, or a damaged one ({reason})") from None
    return keys
