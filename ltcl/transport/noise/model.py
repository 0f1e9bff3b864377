# SPDX-License-Identifier: BSD-3-Clause
"""Standard deviations of the entries of a measured T (M, N), by a few numbers a row and a column.

    variance of T_c[i, j] = rows_c[i] columns_c[j] (photons_c max(T_c[i, j], 0) + floor_c^2)

for channel c. On the diagonal of a square T, whose light came straight from the projector, it is
`direct_c` times that.

Errors of entries are independent, with two exceptions:

- Rows that were made to add up to a measured white, of variance `white`, have errors that add up to
  its error (`ltcl.transport.covariance`).
- Errors of a path-traced T lack a share `neighbours` of the errors of neighbouring columns
  (`ltcl.transport.noise.neighbours`).

Known limits: pictures of a scan by S-matrices share their noise, so that all entries of a batch are
as noisy as its brightest; the model spreads that over the row. First bounce and sums are right,
errors of smooth pictures up to 2.4 times smaller. Cells of an adaptive scan count as one pixel.
Errors of a path-traced T are 0.5 of those of the model if one wall is lit alone, and 1.3 times
those if a patch is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np

from ltcl import checks
from ltcl.errors import InputError
from ltcl.transport.noise.comparison import compare, differences, shows_rows
from ltcl.transport.noise.fit import ChannelNoise, Samples, fit_channel
from ltcl.transport.noise.neighbours import filter_pictures, filtered_variance

SOURCES = ("given", "acquired", "measured twice", "estimated", "unknown")
# Largest finite number of a noise.
MAX_NUMBER = 1e36
# Largest standard deviation, times the brightest light: above, the units must be wrong.
MAX_NOISE_RATIO = 1e6
# Largest exposure of one measurement to another of the same scene.
MAX_EXPOSURE_RATIO = 1.2


@dataclass(frozen=True, repr=False, eq=False)
class Noise:
    """Noise of a transport (M, N) of 1 or 3 channels.

    Attributes
    ----------
    photons, floor : (channels,) float64
        Variance for each unit of light, and standard deviation without light; in the units of T.
    rows, columns : (channels, M), (channels, N) float64
        Factors of the variance, about 1.
    white : (channels, M) float64
        Variance of row sums, infinite where rows were not made to add up to a measured white.
    source : str
        "acquired", "measured twice", "given", or "estimated" from T alone; "unknown" if T does not
        show it: then the noise is at least the one stated.
    direct : (channels,) float64
        Factor of the variance of the first bounce: far below 1 for a path-traced T.
    neighbours : (channels,) float64
        Share c of its neighbours that an entry's error lacks, 0 to 1; 0 if errors are independent.

    Raises
    ------
    InputError
        Other shapes, NaN, negative numbers, and finite ones above 1e36.

    Examples
    --------
    >>> noise = Noise.uniform((4, 4), floor=0.01)
    >>> noise.variance(np.zeros((4, 4)))[0, 0].round(6)
    np.float64(0.0001)
    """

    photons: np.ndarray
    floor: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    white: np.ndarray
    source: str = "given"
    direct: Any = 1.0
    neighbours: Any = 0.0

    def __post_init__(self) -> None:
        checks.one_of("noise.source", self.source, SOURCES)
        for name in self._array_names():
            value = _check_numbers(name, getattr(self, name), np.size(self.photons))
            # The dataclass is frozen.
            object.__setattr__(self, name, value)
        checks.shape("noise.white", self.white, self.rows.shape)

    @classmethod
    def _array_names(cls) -> list[str]:
        return [field.name for field in fields(cls) if field.name != "source"]

    @classmethod
    def uniform(
        cls, shape: tuple[int, int], floor: Any, photons: Any = 0.0, source: str = "given"
    ) -> Self:
        """The same noise for all entries of a T (M, N); numbers for all channels, or one each."""
        floor, photons = np.broadcast_arrays(np.atleast_1d(floor), np.atleast_1d(photons))
        M, N = checks.grid("shape", shape)
        channels = len(floor)
        return cls(
            photons=photons,
            floor=floor,
            rows=np.ones((channels, M)),
            columns=np.ones((channels, N)),
            white=np.full((channels, M), np.inf),
            source=source,
        )

    @classmethod
    def fit(
        cls, shape: tuple[int, int], samples: Sequence[Samples], source: str, white: Any = np.inf
    ) -> Self:
        """The noise of a T (M, N) by samples: rows, columns, light, and squares (n,).

        Each channel has an iterable of parts of them; in a large T some on each row and column
        count. If T was acquired the squares are variances, and sums over rows and columns are kept:
        errors of pictures are right, whatever the model misses. Else they are squares of errors,
        which count up to 9 variances.
        """
        is_exact = source == "acquired"
        channels = [fit_channel(shape, parts, is_exact) for parts in samples]
        return cls.from_channels(channels, source, white)

    @classmethod
    def from_channels(
        cls, channels: Sequence[ChannelNoise], source: str, white: Any = np.inf
    ) -> Self:
        """The noise of all channels; `white` is broadcast to (channels, M)."""
        values: dict[str, np.ndarray] = {}
        for name in ("photons", "floor", "rows", "columns", "direct", "neighbours"):
            values[name] = np.stack([getattr(channel, name) for channel in channels])
        white = np.broadcast_to(white, values["rows"].shape)
        return cls(**values, white=white, source=source)

    @classmethod
    def measured_twice(cls, matrices: Sequence[Any], others: Sequence[Any]) -> Self:
        """The noise of a T (M, N) by a second measurement that is equally noisy.

        (T_1 - T_2)^2 / 2 has its variance. A smooth change between both, as of a lamp, counts as
        noise, and entries that are 0 in both do not count. InputError if entries are the same, or
        cannot be read, or one T is 1.2 times as bright as the other.
        """
        pairs = list(zip(matrices, others, strict=True))
        for first, second in pairs:
            if not (shows_rows(first) and shows_rows(second)):
                raise InputError(
                    "noise is a second T, but one of the two is compressed, or an operator "
                    "without entries; compare the originals, and the noise is kept with T"
                )
        samples = [differences(first, second) for first, second in pairs]
        noise = cls.fit(matrices[0].shape, samples, "measured twice")
        if not np.any(noise.floor + noise.photons):
            raise InputError(
                "noise has the same entries as matrix; it must be a second measurement"
            )
        neighbours = []
        exposures = []
        for first, second in pairs:
            share, exposure = compare(first, second)
            neighbours.append(share)
            exposures.append(exposure)
        worst = max(exposures, key=lambda exposure: abs(np.log(exposure)))
        if not 1.0 / MAX_EXPOSURE_RATIO <= worst <= MAX_EXPOSURE_RATIO:
            raise InputError(
                f"noise is a second T, {worst:.3g} times as bright as matrix; both must be "
                "measured with the same exposure and light"
            )
        return replace(noise, neighbours=neighbours)

    @property
    def is_measured(self) -> bool:
        """False if T alone tells the noise, or does not tell it."""
        return self.source not in ("estimated", "unknown")

    def __repr__(self) -> str:
        floor = ", ".join(f"{value:.2g}" for value in self.floor)
        M = self.rows.shape[1]
        N = self.columns.shape[1]
        return f"<ltcl Noise {self.source}, floor {floor}, {M} x {N}>"

    def variance(self, entries: Any, channel: int = 0) -> np.ndarray:
        """Variance of the entries (M, N) of a channel, float64."""
        light = self.photons[channel] * np.maximum(entries, 0.0)
        light = light + self.floor[channel] ** 2
        variance = self.rows[channel][:, None] * self.columns[channel] * light
        if variance.shape[0] == variance.shape[1]:
            np.einsum("ii->i", variance)[:] *= self.direct[channel]
        return variance

    def entry_variance(
        self, channel: int, i: np.ndarray, j: np.ndarray, light: np.ndarray
    ) -> np.ndarray:
        """Variance of entries of a channel off the diagonal, by rows, columns and light, (n,)."""
        variance = self.photons[channel] * np.maximum(light, 0.0) + self.floor[channel] ** 2
        return self.rows[channel][i] * self.columns[channel][j] * variance

    def diagonal(self, F: Any) -> np.ndarray:
        """Standard deviation (channels, N) of the diagonal F, (channels, N) or (N,)."""
        light = self._light_variance(F)
        return np.sqrt(self.direct[:, None] * self.rows * self.columns * light)

    def less_direct(self, F: Any) -> np.ndarray:
        """Variance (channels, N) of bounced light as bright as F, less that of F itself."""
        light = self._light_variance(F)
        return (1.0 - self.direct[:, None]) * self.rows * self.columns * light

    def _light_variance(self, F: Any) -> np.ndarray:
        """photons F + floor^2, (channels, N)."""
        photons = self.photons[:, None] * np.maximum(np.atleast_2d(F), 0.0)
        return photons + self.floor[:, None] ** 2

    def filtered(self, pictures: np.ndarray, grid: tuple[int, int], channel: int = 0) -> np.ndarray:
        """Pictures a, (N, ...) or (3 N, ...), for independent errors: (1 - c G) a / ||1 - c G||."""
        c = self.neighbours[channel]
        if not c:
            return pictures
        return filter_pictures(pictures, grid, c)

    def relative_variance(self, bases: Sequence[np.ndarray], channel: int = 0) -> np.ndarray:
        """||`filtered` b||^2, (N,) float32, of products b of orthonormal `bases` (h, h), (w, w)."""
        return filtered_variance(bases, self.neighbours[channel])

    def check_fits(self, channels: int, shape: tuple[int, int], brightest: Any = 0.0) -> None:
        """Refuse a T of another shape; `brightest` (channels,) are its entries, 0 if unknown."""
        noise_shape = (self.rows.shape[1], self.columns.shape[1])
        if len(self.floor) != channels or noise_shape != shape:
            raise InputError(
                f"noise has {len(self.floor)} channel(s) of {noise_shape}; "
                f"T has {channels} of {shape}"
            )
        light = np.maximum(brightest, 0.0).astype(np.float64)
        variance = self.photons * light + self.floor**2
        variance = variance * self.rows.max(axis=1) * self.columns.max(axis=1)
        is_too_large = variance > (MAX_NOISE_RATIO * light) ** 2
        if np.any((light > 0.0) & is_too_large):
            raise InputError(
                f"noise reaches {variance.max() ** 0.5:.3g}, more than "
                f"{MAX_NOISE_RATIO:g} times the light of T; it must be in the units of T"
            )

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Numbers for files, by names that begin with ``noise_``."""
        arrays = {"noise_source": np.array(SOURCES.index(self.source))}
        for name in self._array_names():
            arrays[f"noise_{name}"] = np.asarray(getattr(self, name))
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> Self | None:
        """The noise of the arrays of `to_arrays`; None if `arrays` has none of them."""
        names = [field.name for field in fields(cls)]
        values: dict[str, Any] = {}
        for name in names:
            if f"noise_{name}" in arrays:
                values[name] = arrays[f"noise_{name}"]
        if not values:
            return None
        missing = set(names) - values.keys()
        if missing:
            raise InputError(f"noise_{min(missing)} is missing; a noise has {', '.join(names)}")
        number = np.asarray(values.pop("source")).tolist()
        checks.one_of("noise_source", number, range(len(SOURCES)))
        return cls(**values, source=SOURCES[int(number)])


def _check_numbers(name: str, value: Any, channels: int) -> np.ndarray:
    """The checked float64 array of one attribute of `Noise`."""
    value = checks.real(f"noise.{name}", value).astype(np.float64)
    if name in ("direct", "neighbours") and value.size == 1:
        value = np.full(channels, value.ravel())
    ndim = 2 if name in ("rows", "columns", "white") else 1
    if value.ndim != ndim or len(value) != channels:
        raise InputError(
            f"noise.{name} has shape {value.shape}; it must be {ndim}-D, {channels} channel(s)"
        )
    largest = 1.0 if name == "neighbours" else MAX_NUMBER
    is_valid = (value >= 0) & (value <= largest)
    if name == "white":
        is_valid |= np.isinf(value) & (value > 0)
    if not is_valid.all():
        raise InputError(
            f"noise.{name} is {value[~is_valid][0]:g}; it must be from 0 to {largest:g}"
        )
    return value
