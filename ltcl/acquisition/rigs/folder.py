# SPDX-License-Identifier: BSD-3-Clause
"""`FolderRig`: a person with any projector and any camera photographs; files go both ways.

    folder/patterns/pattern_000001.png      pattern to project
    folder/shots.csv, shots.json            the shooting list
    folder/photographs/photo_000001.*       photograph that the person saves

Codes of photographs are not changed.
"""

from __future__ import annotations

import contextlib
import filecmp
import os
import re
import shutil
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks, images
from ltcl.acquisition.rig import as_exposures, as_shot, shot_key
from ltcl.acquisition.rigs.memory_card import in_order_of_capture
from ltcl.acquisition.rigs.photographs import (
    PHOTOGRAPH_KINDS,
    PHOTOGRAPH_SUFFIXES,
    read_photograph,
)
from ltcl.acquisition.rigs.shooting_list import ShootingList, Shot, ShotKey
from ltcl.errors import AcquisitionError, FileError, InputError, LtclError, PhotographMissing
from ltcl.files import as_path, input_file, make_folders, replace_file

PHOTOGRAPH_NAME = re.compile(r"photo_(\d{1,9})", re.IGNORECASE | re.ASCII)

# Exposures below, in seconds, are also shown as fractions, as cameras do.
MAX_FRACTION_SECONDS = 0.3


class FolderRig:
    """A projector and a camera that a person operates by hand, through a folder.

    Photographs are PNG, TIFF, JPEG, BMP, EXR (full scale 1) or camera RAW (extra `camera`, scaled
    to 16 bits); one channel is the green one.

    Parameters
    ----------
    folder : path
        Folder of patterns, photographs and the shooting list; it may be new.
    projector_grid : (int, int)
        Height and width of the patterns.
    channels : 1 or 3
        Channels of photographs.
    pattern_bits : 8 or 16
        Bits of the pattern files.
    camera_bits : int, optional
        Bits in use in photographs of 16 bits; None for all.
    white_level : float, optional
        Code of photographs from which on pixels are saturated; None for the largest code.
    exposures : sequence of float, optional
        Seconds that the camera offers, ascending; None for any.
    projector : (int, int), optional
        Height and width of the projector in pixels. Pixels of the grid become square blocks, as
        large as fit, in the middle.

    Raises
    ------
    InputError
        An argument cannot be used.
    FileError
        The folder is a file, or its list is damaged.

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
        white_level: float | None = None,
        exposures: Any = None,
        projector: tuple[int, int] | None = None,
    ) -> None:
        self.folder = as_path(folder)
        if self.folder.exists() and not self.folder.is_dir():
            raise FileError(f"{self.folder}: is a file; it must be a folder")
        self.projector_grid = checks.grid("projector_grid", projector_grid)
        self.channels = checks.one_of("channels", channels, (1, 3))
        self.bits = camera_bits
        if camera_bits is not None:
            self.bits = checks.count("camera_bits", camera_bits, least=9, most=16)
        self.white_level = white_level
        if white_level is not None:
            checks.number("white_level", white_level, above=0.0)
        self.exposures = as_exposures("exposures", exposures)
        self.number = 0
        self._pattern_bits = checks.one_of("pattern_bits", pattern_bits, (8, 16))
        self._projector = projector
        if projector is not None:
            self._projector = checks.grid("projector", projector)
        enlarge(np.zeros(self.projector_grid), self._projector)  # refuses a grid that does not fit
        self._list = ShootingList(self.folder)
        # Patterns that are on the disk as they should be.
        self._intact_patterns: set[str] = set()
        self._files: dict[int, list[Path]] = {}
        self._photographed: Counter[ShotKey] = Counter()

    @property
    def shots(self) -> list[Shot]:
        """The shooting list, in order."""
        return self._list.shots

    def prepare(self, shots: Iterable[tuple[Any, float]]) -> None:
        """Put the (codes, seconds) that come next on the list, in order; InputError, FileError."""
        repeats = self._photographed.copy()
        for codes, seconds in shots:
            _, key = self._enter(codes, seconds, repeats)
            repeats[key] += 1
        self._save()

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        """Photograph of a shot, as the camera stored it.

        Parameters
        ----------
        codes : (h, w) or (h, w, 3) array_like
            Codes in [0, 1].
        seconds : float
            Exposure.

        Returns
        -------
        (H, W) or (H, W, 3) array
            uint8, uint16 or float.

        Raises
        ------
        InputError, FileError
            As in `prepare`.
        PhotographMissing
            The photograph is missing; the error names the first missing one of the list.
        AcquisitionError
            There are two files of the photograph, it is damaged or above full scale, or its
            exposure deviates by 5 %.
        """
        shot, key = self._enter(codes, seconds, self._photographed)
        self._save()
        path = self._find_photograph(shot)
        name = f"photograph {shot.number} ({path.name})"
        image = read_photograph(
            name, path, self.channels, shot.seconds, white_level=self.white_level
        )
        self._photographed[key] += 1
        self.number = shot.number
        return image

    def file_name(self, number: int) -> str | None:
        """File name of a photograph; None if it is missing."""
        if number not in self._files:
            return None
        return self._files[number][0].name

    def missing(self) -> tuple[int, ...]:
        """Numbers on the list whose photographs are still missing."""
        self._files = self._list_photographs()
        numbers = [shot.number for shot in self.shots]
        return tuple(number for number in numbers if number not in self._files)

    def photographed_grid(self) -> tuple[int, int] | None:
        """(H, W) of the first photograph in the folder; None if there is none that can be read."""
        self._files = self._list_photographs()
        for number in sorted(self._files):
            path = self._files[number][0]
            with contextlib.suppress(LtclError):
                image = read_photograph(path.name, path, self.channels, None)
                return image.shape[0], image.shape[1]
        return None

    def take(
        self,
        files: Iterable[str | os.PathLike[str]],
        *,
        known: Iterable[str | os.PathLike[str]] = (),
    ) -> None:
        """Copy the camera's own files, IMG_0412.NEF and so on, in place of those that are missing.

        They are taken in the order in which they were photographed (`memory_card`). Files that were
        copied before are left out: a memory card need not be emptied. Nothing is copied on an
        error.

        Parameters
        ----------
        files : iterable of paths
            As many new files as photographs are missing.
        known : iterable of paths
            Copies of further files that are left out, such as the photographs of another scan.

        Raises
        ------
        InputError
            The number of files is another, or their order is not known.
        FileError
            One is not a photograph.
        """
        numbers = self.missing()
        unique_files = dict.fromkeys(map(input_file, files))
        paths = self._new_files(unique_files, map(input_file, known))
        if len(paths) != len(numbers):
            raise InputError(
                f"files holds {_describe_files(paths)}, but {_describe_missing(numbers)}; "
                "give just these, or save them by the names on the list"
            )
        for number, path in zip(numbers, paths, strict=True):
            shot = self.shots[number - 1]
            target = self.folder / (shot.save_as + path.suffix.lower())
            with replace_file(target) as temporary:
                shutil.copyfile(path, temporary)

    def describe(self) -> dict[str, Any]:
        """The rig as plain JSON."""
        return {
            "kind": "folder",
            "projector_grid": self.projector_grid,
            "projector": self._projector,
            "pattern_bits": self._pattern_bits,
            "camera_bits": self.bits,
            "white_level": self.white_level,
            "exposures": self.exposures,
            "channels": self.channels,
        }

    def _enter(self, codes: Any, seconds: float, repeats: Counter[ShotKey]) -> tuple[Shot, ShotKey]:
        """Put a shot on the list and its pattern in the folder, unless they are there, intact."""
        codes, seconds = as_shot(self, codes, seconds)
        # The hash is that of the projected levels: shots that differ by less are the same.
        largest_level = (1 << self._pattern_bits) - 1
        levels = np.rint(codes * largest_level).astype("<u2")
        size = () if self._projector is None else self._projector
        key = ShotKey(shot_key(levels, *size), seconds)
        shot = self._list.add(key, repeats[key])
        path = self.folder / shot.pattern
        if shot.pattern not in self._intact_patterns or not path.exists():
            pattern = enlarge(codes, self._projector)
            if not _holds(path, pattern, 1 / largest_level):
                images.write(path, pattern, encoding="linear", bits=self._pattern_bits)
            self._intact_patterns.add(shot.pattern)
        return shot, key

    def _save(self) -> None:
        """Write the list, and make the folder of the photographs."""
        self._list.save()
        make_folders(self.folder / "photographs")

    def _list_photographs(self) -> dict[int, list[Path]]:
        """Files in the folder of photographs, by number."""
        folder = self.folder / "photographs"
        files: dict[int, list[Path]] = {}
        if not folder.is_dir():
            return files
        for path in sorted(folder.iterdir()):
            match = PHOTOGRAPH_NAME.fullmatch(path.stem)
            if match and path.suffix.lower() in PHOTOGRAPH_SUFFIXES:
                files.setdefault(int(match[1]), []).append(path)
        return files

    def _find_photograph(self, shot: Shot) -> Path:
        """The one file of a shot; the folder is read again if it was not there before."""
        files = self._files.get(shot.number, [])
        if len(files) == 1 and files[0].exists():
            return files[0]
        missing = self.missing()
        files = self._files.get(shot.number, [])
        if not files:
            raise self._missing_error(missing)
        if len(files) > 1:
            names = " and ".join(path.name for path in files)
            raise AcquisitionError(
                f"photograph {shot.number} is there as {names}; keep one of them"
            )
        return files[0]

    def _missing_error(self, missing: tuple[int, ...]) -> PhotographMissing:
        """Error that tells a person how to take the first missing photograph."""
        shot = self.shots[missing[0] - 1]
        time = f"{shot.seconds:.6g} s"
        if shot.seconds < MAX_FRACTION_SECONDS:
            time += f" (1/{1 / shot.seconds:.3g})"
        text = (
            f"photograph {shot.number} is missing ({len(missing)} in all): project {shot.pattern}, "
            f"expose for {time}, save as {shot.save_as} in {self.folder}, as {PHOTOGRAPH_KINDS}"
        )
        return PhotographMissing(text, shot.number, shot, len(missing))

    def _new_files(self, files: Iterable[Path], known: Iterable[Path]) -> list[Path]:
        """Files that were not copied before, in order; FileError for one of another kind."""
        copied = [path for paths in self._files.values() for path in paths]
        copied.extend(known)
        for path in files:
            if path.suffix.lower() not in PHOTOGRAPH_SUFFIXES:
                raise FileError(f"{path}: is not a photograph; it must be {PHOTOGRAPH_KINDS}")
        new = []
        for path in in_order_of_capture(list(files)):
            twin = _find_equal(path, copied)
            if twin is None:
                new.append(path)
            else:
                # Two photographs of black may be equal: each copy stands for one file.
                copied.remove(twin)
        return new


def _describe_files(paths: Sequence[Path]) -> str:
    """New photographs by their number and names: "3 new photographs, IMG_1.png to IMG_3.png"."""
    if len(paths) == 1:
        return f"1 new photograph, {paths[0].name}"
    text = f"{len(paths)} new photographs"
    if paths:
        text += f", {paths[0].name} to {paths[-1].name}"
    return text


def _describe_missing(numbers: Sequence[int]) -> str:
    """Numbers on the list whose photographs are missing, from the first to the last one."""
    if len(numbers) == 1:
        return f"1 is missing, number {numbers[0]}"
    text = f"{len(numbers)} are missing"
    if numbers:
        text += f", {numbers[0]} to {numbers[-1]}"
    return text


def _holds(path: Path, pattern: np.ndarray, step: float) -> bool:
    """True if a file holds a pattern, to half a step of its codes."""
    try:
        stored = images.read(path, encoding="linear")
    except FileError:
        return False
    if stored.shape[:2] != pattern.shape[:2]:
        return False
    difference = np.atleast_3d(stored) - np.atleast_3d(pattern)
    return bool(np.abs(difference).max() < 0.51 * step)


def enlarge(picture: np.ndarray, size: tuple[int, int] | None) -> np.ndarray:
    """A picture (h, w[, c]) in square blocks, as large as fit, centred in `size` (H, W)."""
    h, w = picture.shape[:2]
    H, W = (h, w) if size is None else size
    side = min(H // h, W // w)
    if side < 1:
        raise InputError(f"grid is {w} x {h} pixels; the projector has {W} x {H}")
    blocks = picture.repeat(side, axis=0).repeat(side, axis=1)
    margins = [_margins(H - side * h), _margins(W - side * w)]
    if picture.ndim == 3:
        margins.append((0, 0))
    return np.pad(blocks, margins)


def _margins(pixels: int) -> tuple[int, int]:
    """Margins before and after a centred picture."""
    before = pixels // 2
    return before, pixels - before


def _find_equal(path: Path, files: list[Path]) -> Path | None:
    """The first of the files that equals another in every byte."""
    for file in files:
        if filecmp.cmp(path, file, shallow=False):
            return file
    return None
