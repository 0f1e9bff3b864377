# SPDX-License-Identifier: BSD-3-Clause
"""`StoredRadiance`: a picture of radiance in a temporary file, read by rows, pixels or channels.

One of 45 megapixels in colour is 1.2 gigabytes: value and variance in float32, and what is valid.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ltcl.acquisition.geometry import Resampling
from ltcl.acquisition.radiometry import Radiance
from ltcl.acquisition.scratch import ImageFile, StoredImage, row_strips

# Values that determine the median of a picture.
MAX_VALUES = 1 << 24


class RadiancePicture(Protocol):
    """A picture of radiance, in memory (`Radiance`) or in a file (`StoredRadiance`)."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(H, W[, 3])."""
        ...

    @property
    def value(self) -> np.ndarray:
        """Radiance; 0 where not valid."""
        ...

    @property
    def variance(self) -> np.ndarray:
        """Variance of the value; infinite where not valid."""
        ...

    @property
    def valid(self) -> np.ndarray:
        """True where the pixel is known."""
        ...

    def rows(self, rows: slice) -> Radiance:
        """The picture in some rows."""
        ...

    def part(self, name: str, rows: slice) -> np.ndarray:
        """Value, variance or valid in some rows."""
        ...


@dataclass(frozen=True, kw_only=True)
class StoredRadiance:
    """A picture of radiance in a file.

    Parameters
    ----------
    values, variances, validity : StoredImage
        The arrays of a `Radiance`, of one shape.

    Examples
    --------
    >>> picture = StoredRadiance.reserve(ImageFile(), (2, 3))
    >>> ones = np.ones((2, 3), np.float32)
    >>> picture.write(0, Radiance(ones, ones, ones > 0))
    >>> picture.value.tolist()
    [[1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]
    """

    values: StoredImage
    variances: StoredImage
    validity: StoredImage

    @classmethod
    def reserve(cls, file: ImageFile, shape: tuple[int, ...]) -> StoredRadiance:
        """Room for a picture in a file, to be written by rows."""
        return cls(
            values=file.reserve(shape, np.float32),
            variances=file.reserve(shape, np.float32),
            validity=file.reserve(shape, bool),
        )

    def write(self, top: int, rows: Radiance) -> None:
        """Write rows of the picture, from the row `top` on."""
        self.values.write(top, rows.value)
        self.variances.write(top, rows.variance)
        self.validity.write(top, rows.valid)

    @property
    def shape(self) -> tuple[int, ...]:
        """(H, W[, 3])."""
        return self.values.shape

    @property
    def value(self) -> np.ndarray:
        """Radiance, read as a whole."""
        return self.values.read()

    @property
    def variance(self) -> np.ndarray:
        """Variance of the value, read as a whole."""
        return self.variances.read()

    @property
    def valid(self) -> np.ndarray:
        """True where a pixel is known, read as a whole."""
        return self.validity.read()

    def rows(self, rows: slice) -> Radiance:
        """The picture in some rows."""
        value = self.values.read(rows)
        return Radiance(value, self.variances.read(rows), self.validity.read(rows))

    def part(self, name: str, rows: slice) -> np.ndarray:
        """Value, variance or valid in some rows."""
        arrays = {"value": self.values, "variance": self.variances, "valid": self.validity}
        return arrays[name].read(rows)


def difference(first: RadiancePicture, second: RadiancePicture, file: ImageFile) -> StoredRadiance:
    """Difference of two pictures, in a file; variances add."""
    result = StoredRadiance.reserve(file, first.shape)
    for rows in row_strips(first.shape):
        result.write(rows.start, first.rows(rows) - second.rows(rows))
    return result


def completed(
    first: RadiancePicture,
    second: RadiancePicture,
    file: ImageFile,
    *,
    where: RadiancePicture | None = None,
) -> StoredRadiance:
    """A picture, and where it is not valid, but `where` is, another one, in a file."""
    result = StoredRadiance.reserve(file, first.shape)
    for rows in row_strips(first.shape):
        own = first.rows(rows)
        other = second.rows(rows)
        is_other = ~own.valid & other.valid
        if where is not None:
            is_other &= where.rows(rows).valid
        strip = Radiance(
            np.where(is_other, other.value, own.value),
            np.where(is_other, other.variance, own.variance),
            own.valid | is_other,
        )
        result.write(rows.start, strip)
    return result


def strips(picture: RadiancePicture) -> Iterator[Radiance]:
    """All rows of a picture, strip by strip."""
    for rows in row_strips(picture.shape):
        yield picture.rows(rows)


def values_at(picture: RadiancePicture, pixels: np.ndarray, name: str) -> np.ndarray:
    """Value, variance or valid of a picture at pixels, (n, c).

    They are numbered row by row, in ascending order.
    """
    width = picture.shape[1]
    channels = _channels(picture)
    dtype = bool if name == "valid" else np.float32
    values = np.empty((len(pixels), channels), dtype)
    for rows in row_strips(picture.shape):
        first, last = np.searchsorted(pixels, [rows.start * width, rows.stop * width])
        if first < last:
            strip = picture.part(name, rows).reshape(-1, channels)
            values[first:last] = strip[pixels[first:last] - rows.start * width]
    return values


def plane(picture: RadiancePicture, name: str, channel: int) -> np.ndarray:
    """A channel (H, W) of value, variance or valid of a picture, float32; 0 where not valid."""
    H, W = picture.shape[:2]
    result = np.zeros((H, W), np.float32)
    for rows in row_strips(picture.shape):
        array = picture.part(name, rows).reshape(-1, W, _channels(picture))[..., channel]
        valid = array
        if name != "valid":
            valid = picture.part("valid", rows).reshape(-1, W, _channels(picture))[..., channel]
        np.copyto(result[rows], array, where=valid)
    return result


def planes(picture: RadiancePicture, name: str) -> Iterator[np.ndarray]:
    """The channels of `plane`, one by one."""
    for channel in range(_channels(picture)):
        yield plane(picture, name, channel)


def on_projector(picture: RadiancePicture, name: str, resampling: Resampling) -> np.ndarray:
    """Value or valid of a picture on the projector's grid, (h, w[, c])."""
    channels = [resampling.apply(values) for values in planes(picture, name)]
    if len(picture.shape) == 2:
        return channels[0]
    return np.stack(channels, axis=-1)


def valid_values(picture: RadiancePicture) -> np.ndarray:
    """Values that are valid, (n,); of a large picture every few rows of them."""
    step = -(-math.prod(picture.shape) // MAX_VALUES)
    chosen = []
    for row in range(0, picture.shape[0], step):
        line = picture.rows(slice(row, row + 1))
        chosen.append(line.value[line.valid])
    return np.concatenate(chosen)


def valid_share(picture: RadiancePicture) -> float:
    """Share of the values that are valid."""
    count = 0
    for rows in row_strips(picture.shape):
        count += int(np.count_nonzero(picture.part("valid", rows)))
    return count / math.prod(picture.shape)


def _channels(picture: RadiancePicture) -> int:
    return picture.shape[2] if len(picture.shape) == 3 else 1
