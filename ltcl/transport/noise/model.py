# SPDX-License-Identifier: BSD-3-Clause
"""Standard deviations of the entries of a measured T, by a few numbers a row and a column.

    variance of T_c[i, j] = rows_c[i] columns_c[j] (photons_c max(T_c[i, j], 0) + floor_c^2)

for channel c, times `direct_c` on the diagonal of a square T, whose light came straight from the
projector. Entries are independent of each other; but where the rows of T were made to add up to a
measured white, whose variance is `white`, errors of a row are those that add up to it (`covariance`
in `ltcl.transport.uncertainty`). Paths of a path tracer that miss a column meet its neighbours:
errors of a row are e (1 - c G) / ||1 - c G||, e independent, G the binomial mean of 3 x 3 columns,
c = `neighbours`, by row sums.

Known limits: pictures of a scan by S-matrices share their noise, so that all entries of a batch are
as noisy as its brightest; the model spreads that over the row. First bounce and sums are right,
errors of smooth pictures up to 2.4 times smaller. Cells of an adaptive scan count as one pixel.
Errors of a path-traced T are 0.5 of those of the model where one wall is lit alone, and 1.3 times
those where a patch is.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import scipy.ndimage
import scipy.optimize
import scipy.sparse

from ltcl import checks
from ltcl.errors import InputError

SOURCES = ("given", "acquired", "measured twice", "estimated")
Samples = Iterable[Sequence[np.ndarray]]
_PASSES, _LIGHTS, _ENTRIES = (
    6,
    32,
    256,
)  # of a fit: passes; octaves of light; samples of a row, about
_CLIPPED, _MEAN = (
    9.0,
    0.995,
)  # variances of a sample at most, and the mean of normal ones so clipped
_AT_ONCE, _FIRST = (
    1 << 22,
    64,
)  # samples; first bounces at least, whose variance has a factor of its own
_BINOMIAL, _CENTRE, _G = [0.25, 0.5, 0.25], 0.25, 0.375  # G along an axis; G_00; ||G||
_CHANCE = 3.0  # standard deviations of row sums that mean nothing
_LARGEST, _UNITS, _EXPOSURE = (
    1e36,
    1e6,
    1.2,
)  # at most: numbers, deviations over light, ratio of two T


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
        "acquired", "measured twice", "given", or "estimated" from T alone.
    direct : (channels,) float64
        Factor of the variance of the first bounce: far below 1 of a path-traced T.
    neighbours : (channels,) float64
        Share c of its neighbours that an entry's error lacks, 0 to 1; 0 where errors are
        independent.

    InputError for other shapes, NaN, negative numbers, and finite ones above 1e36.

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
        n = np.size(self.photons)
        checks.one_of("noise.source", self.source, SOURCES)
        for name in (f.name for f in fields(self) if f.name != "source"):
            value = checks.real(f"noise.{name}", getattr(self, name)).astype(np.float64)
            if name in ("direct", "neighbours") and value.size == 1:
                value = np.full(n, value.ravel())
            ndim = 2 if name in ("rows", "columns", "white") else 1
            if value.ndim != ndim or len(value) != n:
                raise InputError(
                    f"noise.{name} has shape {value.shape}; it must be {ndim}-D, {n} channel(s)"
                )
            largest = 1.0 if name == "neighbours" else _LARGEST
            valid = (value >= 0) & ((value <= largest) | (name == "white") & np.isinf(value))
            if not valid.all():
                raise InputError(
                    f"noise.{name} is {value[~valid][0]:g}; it must be from 0 to {largest:g}"
                )
            object.__setattr__(self, name, value)
        checks.shape("noise.white", self.white, self.rows.shape)

    @classmethod
    def uniform(
        cls, shape: tuple[int, int], floor: Any, photons: Any = 0.0, source: str = "given"
    ) -> Self:
        """The same for all entries of a T (M, N); `floor` and `photons` are floats, or one a channel."""
        f, p = np.broadcast_arrays(np.atleast_1d(floor), np.atleast_1d(photons))
        rows, columns = (np.ones((len(f), n)) for n in checks.grid("shape", shape))
        return cls(p, f, rows, columns, np.full(rows.shape, np.inf), source)

    def __repr__(self) -> str:
        floor = ", ".join(f"{value:.2g}" for value in self.floor)
        return f"<ltcl Noise {self.source}, floor {floor}, {self.rows.shape[1]} x {self.columns.shape[1]}>"

    def variance(self, entries: Any, channel: int = 0) -> np.ndarray:
        """Of the entries (M, N) of a channel, float64."""
        light = self.photons[channel] * np.maximum(entries, 0.0) + self.floor[channel] ** 2
        variance = self.rows[channel][:, None] * self.columns[channel] * light
        if variance.shape[0] == variance.shape[1]:
            np.einsum("ii->i", variance)[:] *= self.direct[channel]
        return variance

    def diagonal(self, F: Any) -> np.ndarray:
        """Standard deviation (channels, N) of the diagonal F (channels, N) or (N,) of a square T."""
        light = self.photons[:, None] * np.maximum(np.atleast_2d(F), 0.0) + self.floor[:, None] ** 2
        return np.sqrt(self.direct[:, None] * self.rows * self.columns * light)

    def less_direct(self, F: Any) -> np.ndarray:
        """By how much the variance of F is below that of bounced light as bright, (channels, N)."""
        light = self.photons[:, None] * np.maximum(np.atleast_2d(F), 0.0) + self.floor[:, None] ** 2
        return (1.0 - self.direct[:, None]) * self.rows * self.columns * light

    def filtered(self, pictures: np.ndarray, grid: tuple[int, int], channel: int = 0) -> np.ndarray:
        """`pictures` (N, ...) or (3 N, ...) as independent errors see them: (1 - c G) a / ||1 - c G||."""
        if not self.neighbours[channel]:
            return pictures
        c, mean = self.neighbours[channel], pictures.reshape(-1, *grid, *pictures.shape[1:])
        for axis in (1, 2):
            mean = scipy.ndimage.correlate1d(mean, _BINOMIAL, axis=axis, mode="nearest")
        return (pictures - c * mean.reshape(pictures.shape)) / _norm2(c) ** 0.5

    def relative_variance(self, bases: Sequence[np.ndarray], channel: int = 0) -> np.ndarray:
        """||`filtered` b||^2, (N,) float32, of pictures b: products of orthonormal bases (h, h), (w, w)."""
        c = self.neighbours[channel]
        means = [scipy.ndimage.correlate1d(A, _BINOMIAL, axis=1, mode="nearest") for A in bases]
        same = np.kron(*(np.sum(A * mean, axis=1) for A, mean in zip(bases, means, strict=True)))
        seen = np.kron(*(np.sum(mean**2, axis=1) for mean in means))
        return ((1.0 - 2.0 * c * same + c**2 * seen) / _norm2(c)).astype(np.float32)

    @classmethod
    def fit(
        cls, shape: tuple[int, int], samples: Sequence[Samples], source: str, white: Any = np.inf
    ) -> Self:
        """The noise of a T (M, N) by samples of its variance: rows, columns, light, and squares (n,).

        Each channel has an iterable of parts of them; of a large T some on each row and column
        count. Where T was acquired the squares are variances, and sums over rows and columns are
        kept: errors of pictures are right, whatever the model misses. Else they are squares of
        errors, which count up to 9 variances.
        """
        values = [_fit(shape, each, exact=source == "acquired") for each in samples]
        photons, floor, rows, columns, direct = (np.stack(v) for v in zip(*values, strict=True))
        return cls(
            photons, floor, rows, columns, np.broadcast_to(white, rows.shape), source, direct
        )

    @classmethod
    def measured_twice(cls, matrices: Sequence[Any], others: Sequence[Any]) -> Self:
        """Of a T (M, N) and of a second measurement, equally noisy: (T_1 - T_2)^2 / 2 has its variance.

        What changed smoothly between both, as a lamp does, counts as noise. InputError where
        entries are the same, or do not show, or one T is 1.2 times as bright; entries that are 0 in
        both do not count.
        """
        pairs = list(zip(matrices, others, strict=True))
        for T in (T for pair in pairs for T in pair if not hasattr(T, "rows")):
            if not isinstance(T, np.ndarray) and not scipy.sparse.issparse(T):
                text = "noise is a second T, but one of both is compressed, or an operator without entries"
                raise InputError(
                    f"{text}; compare those that they were made from, which keeps the noise"
                )
        noise = cls.fit(
            matrices[0].shape, [_differences(*pair) for pair in pairs], "measured twice"
        )
        if not np.any(noise.floor + noise.photons):
            raise InputError(
                "noise has the same entries as matrix; it must be a second measurement"
            )
        shares, exposures = zip(*(_compared(*pair) for pair in pairs), strict=True)
        if (
            not 1.0 / _EXPOSURE
            <= (ratio := max(exposures, key=lambda x: abs(np.log(x))))
            <= _EXPOSURE
        ):
            text = f"noise is a second T, {ratio:.3g} times as bright as matrix"
            raise InputError(f"{text}; both must be measured with the same exposure and light")
        return replace(noise, neighbours=shares)

    def check_fits(self, channels: int, shape: tuple[int, int], brightest: Any = 0.0) -> None:
        """InputError where this is no noise of such a T (M, N), `brightest` (channels,), or 0 if unknown."""
        n, own = len(self.floor), (self.rows.shape[1], self.columns.shape[1])
        if (n, own) != (channels, shape):
            raise InputError(f"noise is of {n} channel(s) {own}; T has {channels} {shape}")
        light = np.maximum(brightest, 0.0).astype(np.float64)
        v = (
            (self.photons * light + self.floor**2)
            * self.rows.max(axis=1)
            * self.columns.max(axis=1)
        )
        if np.any((light > 0.0) & (v > (_UNITS * light) ** 2)):
            text = f"noise reaches {v.max() ** 0.5:.3g}, more than {_UNITS:g} times the light of T"
            raise InputError(f"{text}; it must be in the units of T")

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Numbers for files, by names that begin with ``noise_``."""
        arrays = {f"noise_{f.name}": np.asarray(getattr(self, f.name)) for f in fields(self)}
        return arrays | {"noise_source": np.array(SOURCES.index(self.source))}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> Self | None:
        """What `to_arrays` gave; None where nothing of it is there. Older files have no neighbours."""
        names = [f.name for f in fields(cls)]
        values = {name: arrays[f"noise_{name}"] for name in names if f"noise_{name}" in arrays}
        if missing := values and set(names) - values.keys() - {"neighbours"}:
            raise InputError(
                f"noise_{min(missing)} is missing; noise is the arrays of {', '.join(names)}"
            )
        number = np.asarray(values.get("source", 0)).tolist()
        source = SOURCES[int(checks.one_of("noise_source", number, range(len(SOURCES))))]
        return cls(**{**values, "source": source}) if values else None


def _fit(shape: tuple[int, int], samples: Samples, exact: bool) -> tuple[Any, ...]:
    """Photons, floor, rows (M,), columns (N,) and direct: means in octaves of light, and factors."""
    stride = max(1, min(shape) // _ENTRIES)
    parts = [[x[(i - j) % stride == 0] for x in (i, j, *rest)] for i, j, *rest in samples]
    i, j, light, square = map(np.concatenate, zip(*parts, strict=True))
    own = (i == j) & (shape[0] == shape[1])
    first = [x[own] for x in (i, light, square)]
    i, j, light, square = (x if exact else x[~own] for x in (i, j, light, square))
    factors, photons = [np.ones(n) for n in shape], 0.0
    top, floor2, scale = (
        light.max(initial=0.0) or 1.0,
        float(square.mean()) if len(square) else 0.0,
        1.0,
    )
    octave = np.clip(_LIGHTS - 2 + np.frexp(light / top)[1], 1, _LIGHTS - 2)
    for step in range(_PASSES if floor2 > 0 else 0):
        model = photons * np.maximum(light, 0.0) + floor2
        expected = factors[0][i] * factors[1][j] * model
        z = square / expected if exact else np.minimum(square / expected, _CLIPPED) / _MEAN
        w = expected if exact else np.ones(len(z))
        scale = float(w @ z / w.sum())
        for factor, at in zip(factors, (i, j), strict=True):
            own, due = np.bincount(at, w * z, len(factor)), np.bincount(at, w, len(factor))
            factor *= np.where(due > 0, own, scale) / np.where(due > 0, due, 1.0)
            factor /= factor.mean()
        if step == _PASSES - 1:
            break
        k = np.where(
            light**2 < _CLIPPED * floor2, 0, octave
        )  # 0: only the mean of this light is known
        k[(i == j) & exact] = _LIGHTS - 1
        counts = np.bincount(k, minlength=_LIGHTS)
        count = counts[seen := counts > 0].astype(float)
        mean, lights = (np.bincount(k, x, _LIGHTS)[seen] / count for x in (z * model, light))
        A = np.stack([np.maximum(lights, 0.0) / top, np.ones(len(count))], axis=1)
        root, x = np.sqrt(count), np.array([photons * top, floor2])
        root[-1] = np.sqrt(len(z)) if exact else root[-1]  # all say the same of the first bounce
        for _ in range(_PASSES):  # by relative errors
            weight = root / np.maximum(A @ x, 1e-6 * mean.max())
            x = scipy.optimize.nnls(A * weight[:, None], mean * weight)[0]
        photons, floor2 = x[0] / top, max(x[1], 1e-6 * mean.max())
    photons, floor2, direct = scale * photons, scale * floor2, 1.0
    if len(first[0]) >= (1 if exact else _FIRST):
        model = (
            factors[0][first[0]]
            * factors[1][first[0]]
            * (photons * np.maximum(first[1], 0.0) + floor2)
        )
        z = first[2] / np.maximum(model, 1e-300)
        direct = float(
            np.average(np.minimum(z, _CLIPPED * z.mean()), weights=model if exact else None)
        )
    return photons, floor2**0.5, *factors, direct


def _differences(first: Any, second: Any) -> Iterator[tuple[np.ndarray, ...]]:
    """Rows, columns, light and half of the squared difference of the entries of two T (M, N)."""
    for start, A, B in _rows(first, second):
        i, j = np.nonzero((A != 0) | (B != 0))
        a, b = A[i, j], B[i, j]
        yield i + start, j, (a + b) / 2, (a - b) ** 2 / 2


def _compared(first: Any, second: Any) -> tuple[float, float]:
    """c by the differences of two T (M, N), but for their diagonal; and how much brighter the second is."""
    sums, ratios = list[float](), list[float]()
    for start, A, B in _rows(first, second):
        norms = np.linalg.norm([B, A], axis=2)
        ratios.extend(np.divide(*norms[:, norms.all(axis=0)]))
        E = A - B
        if first.shape[0] == first.shape[1]:
            np.fill_diagonal(E[:, start:], 0.0)
        noisy = E[E.any(axis=1)]
        sums.extend(np.sum(noisy, axis=1) ** 2 / np.sum(noisy**2, axis=1))
    return cancellation(float(np.mean(sums or [1.0])), len(sums)), float(np.median(ratios or [1.0]))


def _norm2(c: float) -> float:
    """||1 - c G||^2."""
    return 1.0 - 2.0 * _CENTRE * c + (_G * c) ** 2


def cancellation(ratio: float, rows: int) -> float:
    """c, so that (1 - c)^2 / `_norm2` is the variance of row sums over that of independent errors.

    0 where it may be below 1 by chance, of so many rows.
    """
    certain = ratio * (1.0 + _CHANCE * (2.0 / max(rows, 1)) ** 0.5) < 1.0
    a, b = 1.0 - _G**2 * ratio, 1.0 - _CENTRE * ratio  # of a c^2 - 2 b c + 1 - ratio = 0
    return (b - (b * b - a * (1.0 - ratio)) ** 0.5) / a if certain else 0.0


def _rows(*matrices: Any) -> Iterator[tuple[Any, ...]]:
    """First row and rows of T (M, N), some at a time, float64."""
    M, N = matrices[0].shape
    for start in range(0, M, step := max(1, _AT_ONCE // N)):
        stop = min(start + step, M)
        some = (T.rows(start, stop) if hasattr(T, "rows") else T[start:stop] for T in matrices)
        yield (
            start,
            *(np.asarray(A.toarray() if scipy.sparse.issparse(A) else A, np.float64) for A in some),
        )
