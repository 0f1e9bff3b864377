# SPDX-License-Identifier: BSD-3-Clause
"""`CaptureSession`: the photographs of a calibration, checked on arrival; black and white are used again."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ltcl.acquisition import agreement
from ltcl.acquisition.agreement import Sensor
from ltcl.acquisition.exposure import acquisition_error
from ltcl.acquisition.radiometry import Radiance, merge
from ltcl.acquisition.rig import Shots
from ltcl.errors import AcquisitionError, PhotographMissing

_BITS = range(9, 15)  # of cameras whose files have 16
_CLIPPED = 0.01  # of the pixels: as many at one code are saturated

Request = tuple[np.ndarray, float]
"""Codes (h, w[, 3]) and seconds."""


class Photograph(NamedTuple):
    """Codes (H, W[, 3]) in [0, 1] of full scale, seconds, and its number."""

    image: np.ndarray
    seconds: float
    number: int


class CaptureSession:
    """A rig for a calibration.

    Attributes
    ----------
    shots : Shots
    by_hand : bool
        A person takes the photographs: as few as possible.
    count : int
        Photographs so far.
    black, white : (h, w)
        Codes. What was photographed of these is remembered: the n-th photograph of one of them at an exposure
        is the same whoever asks for it.
    record : Record
        All photographs, to be compared when the noise of the camera is known.
    """

    def __init__(self, shots: Shots, progress: Callable[[int], None], by_hand: bool) -> None:
        self.shots, self.exposures, self.by_hand = shots, shots.exposures, by_hand
        self.count, self._progress = 0, progress
        self.black = np.zeros(shots.grid, np.float32)
        self.white = np.ones(shots.grid, np.float32)
        self.record = agreement.Record()
        self._remembered: dict[tuple[float, float], list[Photograph]] = {}

    @property
    def levels(self) -> int | None:
        """As of `Shots`."""
        return self.shots.levels

    def announce(self, requests: Sequence[Request]) -> None:
        """Tell the rig which photographs come next, so that a person can take all of them in one go."""
        numbered = Counter()
        missing = []
        for codes, seconds in requests:
            key = _key(codes, seconds)
            if key is None or numbered[key] >= len(self._remembered.get(key, ())):
                missing.append((codes, seconds))
            numbered[key] += 1
        self.shots.prepare(missing)

    def take(self, requests: Sequence[Request]) -> list[Photograph]:
        """A photograph of each request, in order."""
        self.announce(requests)
        numbered: Counter[tuple[float, float]] = Counter()
        photographs = []
        for codes, seconds in requests:
            key = _key(codes, seconds)
            if key is None:
                photographs.append(self._photograph(codes, seconds))
                continue
            remembered = self._remembered.setdefault(key, [])
            if numbered[key] == len(remembered):
                remembered.append(self._photograph(codes, seconds))
                self._check_bits()
            photographs.append(remembered[numbered[key]])
            numbered[key] += 1
        return photographs

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        """The image of one request: a session is what a camera is to `geometry.measure`."""
        return self.take([(codes, seconds)])[0].image

    def merge(self, photographs: Sequence[Photograph], sensor: Sensor) -> Radiance:
        """Photographs of one pattern as radiance, ambient light included; AcquisitionError where none is."""
        images, seconds, numbers = zip(*photographs, strict=True)
        with acquisition_error(f"photographs {min(numbers)} to {max(numbers)}"):
            return merge(
                images, seconds, sensor.response, sensor.noise, levels=self.levels, black=sensor.offset
            )

    @contextlib.contextmanager
    def naming_photographs(self, sensor: Sensor) -> Iterator[None]:
        """Name photographs that deviate, where what comes of them in the block cannot be used."""
        try:
            yield
        except PhotographMissing:
            raise
        except AcquisitionError:
            self.record.check(sensor, self.shots.name)
            raise

    def _photograph(self, codes: np.ndarray, seconds: float) -> Photograph:
        image = self.shots.photograph(codes, seconds)
        self.record.add(codes, seconds, image, self.shots.number)
        self.count += 1
        self._progress(self.count)
        return Photograph(image, seconds, self.shots.number)

    def _check_bits(self) -> None:
        """Refuse white that ends at the same code, of fewer bits than the camera's, at two exposures."""
        levels, ends = self.levels or 0, {}
        for (code, seconds), photographs in self._remembered.items():
            image = photographs[-1].image
            last = round(float(image.max()) * (levels - 1))
            clipped = code == 1.0 and last.bit_length() in _BITS and last + 1 == 1 << last.bit_length()
            if clipped and last + 1 < levels and np.mean(image == image.max()) > _CLIPPED:
                ends.setdefault(last, set()).add(seconds)
            if len(ends.get(last, ())) > 1:
                bits = last.bit_length()
                raise AcquisitionError(
                    f"photograph {photographs[-1].number}, of white, ends at code {last} of {levels - 1}, as "
                    f"one of another exposure does: the camera has {bits} bits; bits of the rig, or "
                    f"camera_bits of a folder, must be {bits}"
                )


def _key(codes: np.ndarray, seconds: float) -> tuple[float, float] | None:
    """Of a uniform black or white pattern; None of any other."""
    code = float(codes.flat[0])
    return (code, seconds) if code in (0.0, 1.0) and np.all(codes == code) else None
