# SPDX-License-Identifier: BSD-3-Clause
"""`FolderRig`: a person with any projector and any camera photographs; files go both ways.

    folder/patterns/pattern_000001.png      what to project, at the projector's resolution
    folder/shots.csv                        the shooting list: number, pattern, seconds, photograph
    folder/photographs/photo_000001.*       what the person puts there
    folder/shots.json                       the same list, for the rig itself

A photograph that is not there yet raises `PhotographMissing`. Whoever knows the shots beforehand calls
`prepare`, so that the list is complete in one go; a run that is started again finds the photographs by their
numbers.
"""

from __future__ import annotations

import hashlib
import logging
import os
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks, images
from ltcl.acquisition.rig import as_codes, as_seconds
from ltcl.acquisition.rigs import photographs
from ltcl.acquisition.rigs.arrivals import Arrivals, inside, photo_name
from ltcl.acquisition.rigs.photographs import Photograph
from ltcl.acquisition.rigs.sequence import Sequence
from ltcl.acquisition.rigs.shooting_list import ShootingList, Shot, pattern_name
from ltcl.errors import AcquisitionError, FileError, InputError, MemoryLimitError, PhotographMissing
from ltcl.files import as_path

_log = logging.getLogger(__name__)
_GREEN = 1
_FULL, _FEW = 1.001, 0.01  # full scale with what rounding adds; share of pixels that may be defects


class FolderRig:
    """A projector and a camera that somebody works by hand, through a folder.

    Photographs are PNG, TIFF, JPEG, BMP, EXR or camera RAW (extra `camera`); their codes are taken as they
    stand. Full scale of float ones (EXR, TIFF) is 1, what the sensor holds at most, at every exposure: what
    is above counts as saturated, and a warning says so once. Values in another unit, or divided by the
    seconds as HDR programs do, are to be scaled back first.

    A rig of one channel takes the green one of colour photographs: its pixels are the most on a sensor, and a
    mean of channels with curves of their own would follow none.

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
    in_order : bool
        Whether a photograph taken before the one with the number before it (by EXIF) is refused. False allows
        to take some again later.

    Raises
    ------
    InputError
        A grid, a number of channels or of bits that is unusable, or unlike that of the list in the folder.
    FileError
        The list in the folder is damaged, or `folder` is a file.

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
        in_order: bool = True,
    ) -> None:
        self.folder = as_path(folder)
        self.projector_grid = checks.grid("projector_grid", projector_grid)
        if pattern_bits not in (8, 16):
            raise InputError(f"pattern_bits is {pattern_bits!r}; it must be 8 or 16")
        self.channels = checks.one_of("channels", channels, (1, 3))
        self.bits = (
            None if camera_bits is None else checks.count("camera_bits", camera_bits, least=9, most=16)
        )
        self.exposures = None if exposures is None else tuple(exposures)
        self._pattern_bits = pattern_bits
        if self.folder.exists() and not self.folder.is_dir():
            raise FileError(f"{self.folder}: is a file; it must be a folder")
        common = {"projector_grid": list(self.projector_grid), "channels": channels, "bits": pattern_bits}
        self._list = ShootingList(inside(self.folder, "shots.json"), common)
        self._asked: Counter[tuple[str, float]] = Counter()
        self._arrivals = Arrivals(self.folder)
        self.number = 0
        self._sequence = Sequence(in_order=checks.flag("in_order", in_order))
        self._warned = False

    def prepare(self, shots: Iterable[tuple[Any, float]]) -> None:
        """Write the patterns and the list of all that will be asked for next, in order.

        Parameters
        ----------
        shots : iterable of (codes, seconds)
            As for `photograph`. Those on the list already keep their numbers; a shot that comes twice is two
            photographs.

        Raises
        ------
        InputError
            Unusable codes or seconds.
        FileError
            A file cannot be written: a full disk, a link out of the folder.
        """
        asked = Counter(self._asked)
        for codes, seconds in shots:
            key, _ = self._enter(codes, seconds, asked)
            asked[key] += 1
        self._save()

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        """The photograph of a shot, as the camera stored it: uint8, uint16 or float32, (H, W) or (H, W, 3).

        Raises
        ------
        PhotographMissing
            It is not there yet; its pattern and its line in the list are.
        AcquisitionError
            It is there twice, damaged, a link out of the folder, of another size or kind than the first, was
            exposed 5 % longer or shorter than the list asks, or was taken before one with a lower number.
        InputError, FileError
            As in `prepare`.
        """
        key, number = self._enter(codes, seconds, self._asked)
        self._save()
        try:
            path = self._arrivals.find(number)
        except FileError as error:
            raise AcquisitionError(f"photograph {number} cannot be used: {error}") from error
        if path is None:
            raise self._missing(number, *key)
        name = f"photograph {number} ({path.name})"
        photograph = self._read(name, path)
        self._sequence.check(name, number, key[1], photograph)
        self._warn_of_scale(name, photograph.codes)
        self._asked[key] += 1
        self.number = number
        return photograph.codes

    def missing(self) -> tuple[int, ...]:
        """Numbers on the list whose photographs are not there yet."""
        return self._arrivals.missing(len(self._list))

    def take(self, files: Iterable[str | os.PathLike[str]]) -> None:
        """Copy the camera's own files, IMG_0412.NEF and so on, to the photographs that are missing.

        Parameters
        ----------
        files : iterable of paths
            As many as are missing; the natural order of their names must be that of the list.

        Raises
        ------
        InputError
            There are more or fewer of them than photographs are missing. Nothing is copied then.
        FileError
            One of them is no file or of an unknown kind; or a copy cannot be written, and earlier ones stay.
        """
        self._arrivals.take(files, self.missing())

    def describe(self) -> dict[str, Any]:
        """The rig as plain JSON."""
        return {
            "kind": "folder",
            "folder": self.folder.name,
            "projector_grid": list(self.projector_grid),
            "channels": self.channels,
            "pattern_bits": self._pattern_bits,
            "camera_bits": self.bits,
            "exposures": None if self.exposures is None else list(self.exposures),
            "shots": len(self._list),
        }

    def _enter(self, codes: Any, seconds: float, asked: Counter[Any]) -> tuple[tuple[str, float], int]:
        """Put a shot on the list and its pattern in the folder, unless they are there; its key and number."""
        codes, seconds = as_codes(codes, self.projector_grid, self.channels), as_seconds(seconds)
        stored = np.rint(codes * ((1 << self._pattern_bits) - 1)).astype("<u2")
        # Of what is projected: shots that differ by less than a level are the same.
        digest = hashlib.blake2b(repr(stored.shape).encode() + stored.tobytes(), digest_size=16).hexdigest()
        path = inside(self.folder, "patterns", pattern_name(self._list.pattern(digest)))
        if not self._list.has_pattern(digest) or not path.exists():
            images.write(path, codes, encoding="linear", bits=self._pattern_bits)
        return (digest, seconds), self._list.add(Shot(digest, seconds, asked[digest, seconds]))

    def _save(self) -> None:
        inside(self.folder, "shots.csv")
        self._list.save()
        self._arrivals.make()

    def _missing(self, number: int, digest: str, seconds: float) -> PhotographMissing:
        others = len(self.missing()) - 1
        more = f" (and {others} more)" if others else ""
        text = (
            f"photograph {number} is missing{more}: project "
            f"patterns/{pattern_name(self._list.pattern(digest))}, expose for {seconds:.6g} s, "
            f"save as photographs/{photo_name(number)} in {self.folder}"
        )
        strange = self._arrivals.strange()
        return PhotographMissing(f"{text}; {strange}" if strange else text, number)

    def _warn_of_scale(self, name: str, codes: np.ndarray) -> None:
        """Once, of float codes that cannot have 1 for what the sensor holds at most."""
        if self._warned or codes.dtype.kind != "f" or not (share := float(np.mean(codes > _FULL))) > _FEW:
            return
        self._warned = True
        _log.warning(
            "%s reaches %.4g; full scale of float photographs is 1, so %.0f%% of its pixels count as "
            "saturated: divide all photographs by the largest value that the camera can give",
            name,
            float(codes.max()),
            100 * share,
        )

    def _read(self, name: str, path: Path) -> Photograph:
        try:
            codes, taken = photographs.read(path)
        except (FileError, MemoryLimitError) as error:
            raise AcquisitionError(f"{name} cannot be used: {error}") from error
        if codes.ndim == 3 and self.channels == 1:
            codes = np.ascontiguousarray(codes[..., _GREEN])
        if codes.ndim == 2 and self.channels == 3:
            raise AcquisitionError(f"{name} is grey; a rig of three channels needs RGB")
        return Photograph(codes, taken)
