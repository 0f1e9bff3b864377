# SPDX-License-Identifier: BSD-3-Clause
"""`FolderRig`: a person with any projector and any camera photographs; files go both ways.

    folder/patterns/pattern_000001.png      what to project
    folder/shots.csv                        the shooting list: number, pattern, seconds, photograph
    folder/photographs/photo_000001.*       what the person puts there
    folder/shots.json                       the same list, for the rig itself

A shot is known by a hash of what is projected, its seconds and the number of equal ones before it,
so a run that is started again finds its photographs. Their codes are not changed.
"""

from __future__ import annotations

import csv
import filecmp
import json
import os
import re
import shutil
import warnings
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, UnidentifiedImageError

from ltcl import checks, images
from ltcl.acquisition.rig import as_exposures, as_shot, load_extra, shot_key
from ltcl.errors import AcquisitionError, FileError, InputError, MemoryLimitError, PhotographMissing
from ltcl.files import as_path, input_file, replace_file

RAW = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")
_SUFFIXES = (*images.BITS, *RAW)
_KINDS = "camera RAW, TIFF, PNG, EXR, BMP or JPEG"
_FORMAT = "ltcl shooting list 1"
_PHOTO = re.compile(r"photo_(\d{1,9})", re.IGNORECASE | re.ASCII)
_FULL, _DEFECTS = (
    1.001,
    0.01,
)  # full scale of floats with what rounding adds; share of pixels above it
_EXIF, _EXPOSURE = 34665, 33434  # tags of EXIF 2.32
# EXIF holds nominal values, 1/30 s for 1/32 s; neighbouring thirds of a stop differ by 26 %
_ROUNDING = 0.05
_Key = tuple[str, float]  # hash of a pattern, seconds


class Shot(NamedTuple):
    """A photograph to take: what to project, how long to expose, and where to put it (any extension)."""

    number: int
    pattern: str
    seconds: float
    save_as: str


class FolderRig:
    """A projector and a camera that somebody works by hand, through a folder; `shots` are on the list there.

    Photographs are PNG, TIFF, JPEG, BMP, EXR (full scale 1) or camera RAW (extra `camera`); one
    channel is the green one. `pattern_bits`, 8 or 16, are of the patterns, `camera_bits` those in
    use in photographs of 16 bits (None: all; RAW is scaled to 16). `exposures` are the seconds that
    the camera offers, ascending (None: any). For a `projector` of (H, W) pixels the grid's pixels
    become square blocks, as large as fit, in the middle. InputError, FileError for an unusable
    argument or a damaged list.

    Examples
    --------
    >>> import tempfile, numpy as np
    >>> from ltcl import images
    >>> from ltcl.acquisition import FolderRig
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
        if self.folder.exists() and not self.folder.is_dir():
            raise FileError(f"{self.folder}: is a file; it must be a folder")
        self.projector_grid = checks.grid("projector_grid", projector_grid)
        self.channels = checks.one_of("channels", channels, (1, 3))
        self.bits = camera_bits and checks.count("camera_bits", camera_bits, least=9, most=16)
        self.exposures = as_exposures("exposures", exposures)
        self.number = 0
        self._bits = checks.one_of("pattern_bits", pattern_bits, (8, 16))
        self._projector = None if projector is None else checks.grid("projector", projector)
        enlarge(np.zeros(self.projector_grid), self._projector)  # refuses what does not fit
        self._shots: dict[tuple[_Key, int], Shot] = {}  # by the number of equal ones before
        self._patterns: dict[str, int] = {}
        before: Counter[_Key] = Counter()
        for key in _read_list(self.folder / "shots.json"):
            self._add(key, before[key])
            before[key] += 1
        self._saved = len(self._shots)
        self._files: dict[int, list[Path]] = {}
        self._asked: Counter[_Key] = Counter()

    @property
    def shots(self) -> list[Shot]:
        """The list, in order."""
        return list(self._shots.values())

    def prepare(self, shots: Iterable[tuple[Any, float]]) -> None:
        """Put the (codes, seconds) that come next on the list, in order; InputError, FileError."""
        asked = self._asked.copy()
        for codes, seconds in shots:
            asked[self._enter(codes, seconds, asked)[1]] += 1
        self._save()

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        """The photograph of a shot, as the camera stored it: uint8, uint16 or float, (H, W) or (H, W, 3).

        Errors as of `prepare`. `PhotographMissing`, of the first of the list, where it is not there
        yet. AcquisitionError where it is there twice, damaged, above full scale, or its exposure
        deviates by 5 %.
        """
        shot, key = self._enter(codes, seconds, self._asked)
        self._save()
        files = self._files.get(shot.number, [])
        if len(files) != 1 or not files[0].exists():
            missing, files = self.missing(), self._files.get(shot.number, [])
            if not files:
                first, place = self.shots[missing[0] - 1], f"{self.folder}, as {_KINDS}"
                time = f"{first.seconds:.6g} s" + f" (1/{1 / first.seconds:.3g})" * (
                    first.seconds < 0.3
                )
                text = f"project {first.pattern}, expose for {time}, save as {first.save_as} in {place}"
                text = f"photograph {first.number} is missing ({len(missing)} in all): {text}"
                raise PhotographMissing(text, first.number, first, len(missing))
            if len(files) > 1:
                names = " and ".join(path.name for path in files)
                raise AcquisitionError(
                    f"photograph {shot.number} is there as {names}; keep one of them"
                )
        name = f"photograph {shot.number} ({files[0].name})"
        image = read_photograph(name, files[0], self.channels, shot.seconds)
        self._asked[key] += 1
        self.number = shot.number
        return image

    def file_name(self, number: int) -> str | None:
        """The file of a photograph; None where it is not there."""
        return self._files[number][0].name if number in self._files else None

    def missing(self) -> tuple[int, ...]:
        """Numbers on the list whose photographs are not there yet."""
        self._files, place = {}, self.folder / "photographs"
        for path in sorted(place.iterdir()) if place.is_dir() else ():
            match = _PHOTO.fullmatch(path.stem)
            if match and path.suffix.lower() in _SUFFIXES:
                self._files.setdefault(int(match[1]), []).append(path)
        return tuple(shot.number for shot in self.shots if shot.number not in self._files)

    def take(self, files: Iterable[str | os.PathLike[str]]) -> None:
        """Copy the camera's own files, IMG_0412.NEF and so on, in the order of the numbers in their names.

        Files that were copied before are left out: a card need not be emptied. Nothing is copied
        where as many are not missing (InputError), or one is no photograph (FileError).
        """
        numbers, paths = self.missing(), []
        copied = [path for paths in self._files.values() for path in paths]
        order = {
            p: re.sub("[0-9]+", lambda n: n[0].zfill(20), p.name) for p in map(input_file, files)
        }
        for path in sorted(order, key=order.__getitem__):
            if path.suffix.lower() not in _SUFFIXES:
                raise FileError(f"{path}: is no photograph; it must be {_KINDS}")
            if same := [old for old in copied if filecmp.cmp(path, old, shallow=False)]:
                copied.remove(same[0])  # two of black may be equal: each accounts for one
            else:
                paths.append(path)
        if len(paths) != len(numbers):
            which = f", {numbers[0]} to {numbers[-1]}" if numbers else ""
            text = (
                f"files holds {len(paths)} new photographs, but {len(numbers)} are missing{which}"
            )
            raise InputError(f"{text}; give just these, or save them by the names on the list")
        for number, path in zip(numbers, paths, strict=True):
            target = self.folder / (self.shots[number - 1].save_as + path.suffix.lower())
            with replace_file(target) as temporary:
                shutil.copyfile(path, temporary)

    def describe(self) -> dict[str, Any]:
        """The rig as plain JSON."""
        facts = {
            "kind": "folder",
            "projector_grid": self.projector_grid,
            "projector": self._projector,
        }
        facts |= {"pattern_bits": self._bits, "camera_bits": self.bits, "exposures": self.exposures}
        return facts | {"channels": self.channels}

    def _enter(self, codes: Any, seconds: float, asked: Counter[_Key]) -> tuple[Shot, _Key]:
        """Put a shot on the list and its pattern in the folder, unless they are there."""
        codes, seconds = as_shot(self, codes, seconds)
        # Of what is projected: shots that differ by less than a level are the same.
        levels = np.rint(codes * ((1 << self._bits) - 1)).astype("<u2")
        key = shot_key(levels, *(self._projector or ())), seconds
        is_new, shot = key[0] not in self._patterns, self._add(key, asked[key])
        path = self.folder / shot.pattern
        if is_new or not path.exists():
            images.write(path, enlarge(codes, self._projector), encoding="linear", bits=self._bits)
        return shot, key

    def _add(self, key: _Key, before: int) -> Shot:
        """The shot after so many equal ones, put at the end of the list in memory where it is new."""
        if (key, before) not in self._shots:
            number = len(self._shots) + 1
            pattern = self._patterns.setdefault(key[0], len(self._patterns) + 1)
            names = f"patterns/pattern_{pattern:06d}.png", f"photographs/photo_{number:06d}"
            self._shots[key, before] = Shot(number, names[0], key[1], names[1])
        return self._shots[key, before]

    def _save(self) -> None:
        """Write both files of the list, and make the folder of the photographs."""
        table, path = self.folder / "shots.csv", self.folder / "shots.json"
        if self._saved < len(self._shots) or not (path.exists() and table.exists()):
            with (
                replace_file(table) as temporary,
                temporary.open("w", newline="", encoding="utf-8") as file,
            ):
                rows = [(s.number, s.pattern, f"{s.seconds:.6g}", s.save_as) for s in self.shots]
                csv.writer(file).writerows([("number", "project", "seconds", "save as"), *rows])
            shots = [{"codes": digest, "seconds": seconds} for (digest, seconds), _ in self._shots]
            with replace_file(path) as temporary:
                temporary.write_text(json.dumps({"format": _FORMAT, "shots": shots}, indent=0))
            self._saved = len(self._shots)
        (self.folder / "photographs").mkdir(exist_ok=True)


def enlarge(picture: np.ndarray, size: tuple[int, int] | None) -> np.ndarray:
    """A picture (h, w[, c]) in square blocks of whole pixels, as large as fit, centred in `size` (H, W)."""
    (h, w), (H, W) = picture.shape[:2], size or picture.shape[:2]
    side = min(H // h, W // w)
    if side < 1:
        raise InputError(f"grid is {w} x {h} pixels; the projector has {W} x {H}")
    margins = [(rest // 2, rest - rest // 2) for rest in (H - side * h, W - side * w)]
    blocks = picture.repeat(side, axis=0).repeat(side, axis=1)
    return np.pad(blocks, [*margins, (0, 0)][: picture.ndim])


def read_photograph(name: str, path: Path, channels: int, seconds: float | None) -> np.ndarray:
    """The codes of a file for a rig of so many channels, exposed for `seconds` as far as its EXIF says.

    One channel of a colour photograph is the green one: a mean of channels with different response
    curves would follow none. AcquisitionError begins with `name`.
    """
    try:
        raw = path.suffix.lower() in RAW
        codes, exposed = _develop(path) if raw else (images.read_codes(path), _exposure(path))
    except (FileError, MemoryLimitError) as error:
        raise AcquisitionError(f"{name} cannot be used: {error}") from error
    if exposed and seconds is not None and abs(exposed / seconds - 1.0) > _ROUNDING:
        raise AcquisitionError(
            f"{name} was exposed for {exposed:.4g} s by its EXIF, not {seconds:.4g} s"
        )
    if codes.dtype.kind == "f" and np.mean(codes > _FULL) > _DEFECTS:
        text = "full scale of float photographs is 1: divide all by the largest value of the camera"
        raise AcquisitionError(f"{name} reaches {codes.max():.4g}; {text}")
    return np.ascontiguousarray(codes[..., 1]) if codes.ndim == 3 and channels == 1 else codes


def _develop(path: Path) -> tuple[np.ndarray, float]:
    """Linear codes of camera RAW, of which nothing is automatic, and the seconds in its header.

    The black level stays, as subtracting it would clip noise; 65535 is the sensor's white level.
    """
    rawpy = load_extra("rawpy", "camera", f"{path}, camera RAW instead of 16-bit TIFF,")
    try:
        with rawpy.imread(str(path)) as raw:
            codes = raw.postprocess(
                gamma=(1, 1),
                no_auto_bright=True,
                # else full scale follows the brightest pixel of each photograph
                adjust_maximum_thr=0.0,
                user_wb=[1.0, 1.0, 1.0, 1.0],
                output_color=rawpy.ColorSpace.raw,
                output_bps=16,
                user_flip=0,
                user_black=0,
                user_cblack=[0, 0, 0, 0],
                demosaic_algorithm=rawpy.DemosaicAlgorithm.LINEAR,
            )
            return codes, raw.other.shutter_speed
    except (rawpy.LibRawError, rawpy.NotSupportedError, ValueError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise FileError(f"{path}: is no readable camera RAW file: {reason}") from error


def _exposure(path: Path) -> float | None:
    """ExposureTime; None where Pillow reads no header: of EXR, float TIFF, more than 179 million pixels."""
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as picture:
            exif = picture.getexif()
            seconds = exif.get_ifd(_EXIF).get(_EXPOSURE, exif.get(_EXPOSURE))
            return None if seconds is None else float(seconds)
    except (UnidentifiedImageError, Image.DecompressionBombError, ZeroDivisionError):
        return None
    except Exception as error:  # whatever hostile tags raise
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise FileError(f"{path}: has an EXIF header that cannot be read ({reason})") from error


def _read_list(path: Path) -> list[_Key]:
    """The shots of a list in order, none where there is none; FileError for a damaged one."""
    if not path.exists():
        return []
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["format"] != _FORMAT:
            raise ValueError(f"format {content['format']!r:.40}")
        shots = [(str(shot["codes"]), shot["seconds"]) for shot in content["shots"]]
        return [(codes, checks.number("seconds", seconds, above=0.0)) for codes, seconds in shots]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise FileError(f"{path}: is no shooting list, or a damaged one ({reason})") from None
