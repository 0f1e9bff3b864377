# SPDX-License-Identifier: BSD-3-Clause
"""`FolderRig`: a person with any projector and any camera photographs; files go both ways.

    folder/patterns/pattern_000001.png      what to project
    folder/shots.csv                        the shooting list: number, pattern, seconds, photograph
    folder/photographs/photo_000001.*       what the person puts there
    folder/shots.json                       the same list, for the rig itself

A photograph that is not there yet raises `PhotographMissing`. Whoever knows the shots beforehand calls
`prepare`, so that the list is complete in one go. A shot is known by a hash of its codes, its seconds and the
number of equal ones before it, so a run that is started again finds its photographs. Files are written whole
or not at all; no file name is taken from the list, and links out of the folder are refused.
"""

from __future__ import annotations

import csv
import hashlib
import json
import logging
import os
import re
import shutil
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ltcl import checks, images
from ltcl.acquisition.rig import as_codes, as_seconds
from ltcl.acquisition.rigs import photographs
from ltcl.acquisition.rigs.display import enlarge
from ltcl.errors import AcquisitionError, FileError, InputError, PhotographMissing
from ltcl.files import as_path, input_file, replace_file, unknown_extension

_log = logging.getLogger(__name__)
_FORMAT = "ltcl shooting list 1"
_DIGEST = re.compile(r"[0-9a-f]{32}")
_PHOTO = re.compile(r"photo_(\d{1,9})", re.IGNORECASE | re.ASCII)
_FULL, _FEW = 1.001, 0.01  # full scale with what rounding adds; part of the pixels that may be defects


class Shot(NamedTuple):
    """A photograph to take: what to project, for how long to expose, and where to put it (any extension)."""

    number: int
    pattern: str
    seconds: float
    save_as: str


class FolderRig:
    """A projector and a camera that somebody works by hand, through a folder.

    Photographs are PNG, TIFF, JPEG, BMP, EXR or camera RAW (extra `camera`); their codes are not changed.
    Full scale of float ones (EXR, TIFF) is 1, what the sensor holds at most, at every exposure: what is above
    counts as saturated, and a warning says so once. A rig of one channel takes the green one of colour
    photographs.

    Parameters
    ----------
    folder : path
        Made when there is something to write. Links out of it are refused.
    projector_grid : (h, w)
    channels : 1 or 3
    pattern_bits : 8 or 16
        Of the PNG patterns.
    camera_bits : int, optional
        In use in photographs of 16 bits; None: all. RAW is scaled to 16.
    exposures : sequence of float, optional
        The seconds that the camera offers, ascending; None: any.
    projector : (H, W), optional
        Pixels of the projector: patterns have so many, with square blocks for the pixels of the grid, as
        large as fit, in the middle, without smoothing. None: a pixel for each of the grid.

    Raises
    ------
    InputError, FileError
        An unusable argument, or one unlike that of the list in the folder; the list is damaged.

    Examples
    --------
    >>> import tempfile
    >>> rig = FolderRig(tempfile.mkdtemp(), projector_grid=(2, 2))
    >>> white = np.ones((2, 2))
    >>> rig.prepare([(white, 0.5)])
    >>> rig.missing()
    (1,)
    >>> images.write(rig.folder / "photographs/photo_000001.png", white / 2, encoding="linear")
    >>> rig.photograph(white, 0.5)
    array([[128, 128],
           [128, 128]], dtype=uint8)
    """

    keeps_photographs = True

    def __init__(
        self,
        folder: str | os.PathLike[str],
        projector_grid: tuple[int, int],
        channels: int = 1,
        *,
        pattern_bits: int = 8,
        camera_bits: int | None = None,
        exposures: Any = None,
        projector: tuple[int, int] | None = None,
    ) -> None:
        self.folder = as_path(folder)
        self.projector_grid = checks.grid("projector_grid", projector_grid)
        self.channels = checks.one_of("channels", channels, (1, 3))
        self.bits = camera_bits and checks.count("camera_bits", camera_bits, least=9, most=16)
        self.exposures = None if exposures is None else tuple(exposures)
        self.number = 0
        if self.folder.exists() and not self.folder.is_dir():
            raise FileError(f"{self.folder}: is a file; it must be a folder")
        self._facts: dict[str, Any] = {
            "projector_grid": [*self.projector_grid],
            "channels": channels,
            "bits": checks.one_of("pattern_bits", pattern_bits, (8, 16)),
        }
        self._size = self.projector_grid if projector is None else checks.grid("projector", projector)
        if projector is not None:
            enlarge(np.zeros(self.projector_grid), self._size)  # refuses what does not fit
            self._facts["projector"] = [*self._size]
        self._list = ShootingList(self.folder, self._facts)
        self._asked: Counter[tuple[str, float]] = Counter()
        self._files: dict[int, list[Path]] = {}
        self._warned = False

    def prepare(self, shots: Iterable[tuple[Any, float]]) -> None:
        """Write the patterns and the list of the (codes, seconds) that will be asked for next, in order.

        Those on the list already keep their numbers; a shot that comes twice is two photographs. InputError
        for unusable codes or seconds, FileError where a file cannot be written.
        """
        asked = self._asked.copy()
        for codes, seconds in shots:
            _, key = self._enter(codes, seconds, asked)
            asked[key] += 1
        self._list.save()

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        """The photograph of a shot, as the camera stored it: uint8, uint16 or float32, (H, W) or (H, W, 3).

        Errors as of `prepare`, and

        Raises
        ------
        PhotographMissing
            It is not there yet; its pattern and its line in the list are: the error's `shot`.
        AcquisitionError
            It is there twice, damaged, a link out of the folder, of another size or kind than the first, or
            was exposed 5 % longer or shorter than the list asks.
        """
        shot, key = self._enter(codes, seconds, self._asked)
        self._list.save()
        path = self._find(shot)
        name = f"photograph {shot.number} ({path.name})"
        image = photographs.photograph(name, path, self.channels, shot.seconds)
        self._warn_of_scale(name, image)
        self._asked[key] += 1
        self.number = shot.number
        return image

    def file_name(self, number: int) -> str | None:
        """The file of a photograph; None where it is not there."""
        return self._files[number][0].name if number in self._files else None

    def missing(self) -> tuple[int, ...]:
        """Numbers on the list whose photographs are not there yet."""
        self._files, _ = find_photographs(self.folder, len(self._list))
        return tuple(n for n in range(1, len(self._list) + 1) if n not in self._files)

    def take(self, files: Iterable[str | os.PathLike[str]]) -> None:
        """Copy the camera's own files, IMG_0412.NEF and so on, to the photographs that are missing.

        The order of the numbers in their names must be that of the list. InputError where there are more or
        fewer of them than photographs are missing, FileError for one of an unknown kind: nothing is copied.
        """
        numbers, paths = self.missing(), sorted(map(as_path, files), key=natural_order)
        if len(paths) != len(numbers):
            raise InputError(f"files holds {len(paths)} names; {len(numbers)} photographs are missing")
        for path in map(input_file, paths):
            if path.suffix.lower() not in photographs.SUFFIXES:
                raise FileError(f"{path}: {unknown_extension(path)}; {_KINDS}")
        for number, path in zip(numbers, paths, strict=True):
            target = inside(self.folder, _photo_name(number) + path.suffix.lower())
            with replace_file(target) as temporary:
                shutil.copyfile(path, temporary)

    def describe(self) -> dict[str, Any]:
        """The rig as plain JSON."""
        facts = {("pattern_bits" if key == "bits" else key): value for key, value in self._facts.items()}
        exposures = None if self.exposures is None else list(self.exposures)
        return {"kind": "folder", **facts, "camera_bits": self.bits, "exposures": exposures}

    def _enter(self, codes: Any, seconds: float, asked: Counter[Any]) -> tuple[Shot, tuple[str, float]]:
        """Put a shot on the list and its pattern in the folder, unless they are there; its line and key."""
        codes, seconds = as_codes(codes, self.projector_grid, self.channels), as_seconds(seconds)
        # Of what is projected: shots that differ by less than a level are the same.
        bits = self._facts["bits"]
        stored = np.rint(codes * ((1 << bits) - 1)).astype("<u2")
        digest = hashlib.blake2b(repr(stored.shape).encode() + stored.tobytes(), digest_size=16).hexdigest()
        is_new = digest not in self._list.patterns
        shot = self._list.add(digest, seconds, asked[digest, seconds])
        path = inside(self.folder, shot.pattern)
        if is_new or not path.exists():
            images.write(path, enlarge(codes, self._size), encoding="linear", bits=bits)
        return shot, (digest, seconds)

    def _find(self, shot: Shot) -> Path:
        """The file of a photograph; PhotographMissing, with the next step, where it is not there."""
        number, others = shot.number, []
        try:
            if number not in self._files or not all(path.exists() for path in self._files[number]):
                self._files, others = find_photographs(self.folder, len(self._list))
            files = self._files.get(number, [])
            if len(files) > 1:
                names = " and ".join(path.name for path in files)
                raise AcquisitionError(f"photograph {number} is there as {names}; keep one of them")
            if files:
                return inside(self.folder, "photographs", files[0].name)
        except FileError as error:
            raise AcquisitionError(f"photograph {number} cannot be used: {error}") from error
        count = len(self.missing())
        text = f"photograph {number} is missing" + (f" (and {count - 1} more)" if count > 1 else "")
        text += f": project {shot.pattern}, expose for {shot.seconds:.6g} s, save as {shot.save_as}"
        text += f" in {self.folder}"
        if others:
            path, reason = others[0], "is the name of no photograph on the list"
            if path.suffix.lower() not in photographs.SUFFIXES and _PHOTO.fullmatch(path.stem):
                reason = f"cannot be read; {_KINDS}"
            text += f"; {path.name!r} there {reason}"
        raise PhotographMissing(text, number, shot, count)

    def _warn_of_scale(self, name: str, codes: np.ndarray) -> None:
        """Once, of float codes that cannot have 1 for what the sensor holds at most."""
        if self._warned or codes.dtype.kind != "f" or (part := float(np.mean(codes > _FULL))) <= _FEW:
            return
        self._warned = True
        message = f"{name} reaches {codes.max():.4g}; full scale of float photographs is 1, so {part:.0%}"
        _log.warning("%s of its pixels count as saturated: divide all by the camera's largest value", message)


class ShootingList:
    """Shots by number, from 1, in shots.json and shots.csv; shots with equal codes share a pattern.

    A list made for another `rig` (grid, channels, bits) is refused; None reads any.
    """

    def __init__(self, folder: Path, rig: dict[str, Any] | None = None) -> None:
        self.patterns: dict[str, int] = {}
        self._keys: dict[tuple[str, float, int], Shot] = {}
        self._folder, self._path, self._saved = folder, inside(folder, "shots.json"), 0
        self._rig = self._load() if self._path.exists() else rig
        if rig is not None and rig != self._rig:
            raise InputError(f"{self._path}: was made for {self._rig}; this rig, {rig}, needs another folder")

    def __len__(self) -> int:
        return len(self._keys)

    @property
    def shots(self) -> list[Shot]:
        """In the order of their numbers."""
        return list(self._keys.values())

    def add(self, digest: str, seconds: float, repeat: int) -> Shot:
        """The line of a shot, which is put at the end of the list (in memory) if it is not there."""
        key = digest, seconds, repeat
        if key not in self._keys:
            pattern = f"patterns/pattern_{self.patterns.setdefault(digest, len(self.patterns) + 1):06d}.png"
            self._keys[key] = Shot(len(self) + 1, pattern, seconds, _photo_name(len(self) + 1))
        return self._keys[key]

    def save(self) -> None:
        """Write both files, and make the folder of the photographs; FileError where that fails."""
        table = inside(self._folder, "shots.csv")
        if self._saved < len(self) or not (self._path.exists() and table.exists()):
            with replace_file(table) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
                rows = csv.writer(file)
                rows.writerow(["number", "project", "seconds", "save as"])
                rows.writerows([s.number, s.pattern, f"{s.seconds:.6g}", s.save_as] for s in self.shots)
            shots = [dict(zip(("codes", "seconds", "repeat"), key, strict=True)) for key in self._keys]
            content = {"format": _FORMAT, "rig": self._rig, "shots": shots}
            with replace_file(self._path) as temporary:
                temporary.write_text(json.dumps(content, indent=0, allow_nan=False), encoding="utf-8")
            self._saved = len(self)
        path = inside(self._folder, "photographs")
        try:
            path.mkdir(exist_ok=True)
        except OSError as error:
            raise FileError(f"{path}: cannot be made: {error.strerror}") from error

    def _load(self) -> Any:
        checks.fits_host("the shooting list", 10 * input_file(self._path).stat().st_size)
        try:
            content = json.loads(self._path.read_text(encoding="utf-8"))
            if content["format"] != _FORMAT:
                raise ValueError(f"format {content['format']!r:.40}")
            for entry in content["shots"]:
                seconds = checks.number("seconds", entry["seconds"], above=0.0)
                if not _DIGEST.fullmatch(entry["codes"]):
                    raise ValueError("codes is no hash")
                self.add(entry["codes"], seconds, checks.count("repeat", entry["repeat"], least=0))
            if len(self) < len(content["shots"]):
                raise ValueError("a shot is listed twice")
        except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            raise FileError(f"{self._path}: is no shooting list, or a damaged one ({reason})") from None
        self._saved = len(self)
        return content["rig"]


def find_photographs(folder: Path, count: int) -> tuple[dict[int, list[Path]], list[Path]]:
    """Files of the photographs 1 to `count` by their numbers, and files that are none of these."""
    files: dict[int, list[Path]] = {}
    others = []
    place = inside(folder, "photographs")
    for path in sorted(place.iterdir()) if place.is_dir() else ():
        match = _PHOTO.fullmatch(path.stem)
        number = int(match[1]) if match else 0
        if path.suffix.lower() in photographs.SUFFIXES and 1 <= number <= count:
            files.setdefault(number, []).append(path)
        elif not path.name.startswith("."):
            others.append(path)
    return files, others


def inside(folder: Path, *parts: str) -> Path:
    """A path in the folder; FileError where a link on the way leads out of it.

    >>> inside(Path("scan"), "..", "elsewhere")
    Traceback (most recent call last):
    ltcl.errors.FileError: scan/../elsewhere: leads out of the folder; it must stay inside
    """
    path = folder.joinpath(*parts)
    if not Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder)):
        raise FileError(f"{path}: leads out of the folder; it must stay inside")
    return path


_KINDS = f"photographs are {', '.join(photographs.SUFFIXES)}"


def _photo_name(number: int) -> str:
    return f"photographs/photo_{number:06d}"


def natural_order(path: Path) -> list[tuple[int, str]]:
    """Names in the order of the numbers in them: IMG_9 before IMG_10."""
    parts = re.findall(r"\d+|\D+", path.name)
    return [(int(part), "") if part.isascii() and part.isdigit() else (-1, part) for part in parts]
