# SPDX-License-Identifier: BSD-3-Clause
"""The error of a measured T, drawn: as often as is asked for, T is scanned again, in numbers.

Under each pattern p of the scan the camera would see T p, with the noise that its calibration tells; decoded
as the scan was, with its batches, its balance with white, or its cells, this gives T' = T + E. E itself is
never kept, but its products with some columns and its diagonal, which is all that a forecast takes:

    E W, (N, k) for W (N, k),    diag(E)

So errors that are in many entries alike are drawn as they are, which variances of entries do not tell: of the
ambient light that is subtracted from all pictures, and of sums of entries, which scans know better. What
cells of an adaptive scan leave smooth is no noise; it is taken for what twice the threshold would lose more.

Not drawn: what `thresholds` drop, and what `Calibration` takes for true: response, black offset, projector.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import scipy.sparse

from ltcl.acquisition.calibration import Calibration
from ltcl.acquisition.radiometry import Radiance, Response
from ltcl.acquisition.scanning import adaptive, columns, core
from ltcl.acquisition.scanning.columns import Code
from ltcl.acquisition.scanning.pictures import UNKNOWN, Picture, Seen
from ltcl.store import BlockStore, StoredRows

_TABLE = 4096  # radiances that variances are tabulated at
_COARSER = 2.0  # times the threshold: loses as much again as the threshold has, in proportion to it


class Errors(NamedTuple):
    """Of one channel: E W (draws, N, k), and diag(E) (draws, N)."""

    product: np.ndarray
    diagonal: np.ndarray


def errors(store: BlockStore, W: list[np.ndarray], draws: int, seed: int = 0) -> list[Errors]:
    """Draws of the error of the transport in a store, of each channel.

    Parameters
    ----------
    store : BlockStore
        Of a scan that has ended.
    W : (N, k) of each channel
    """
    rng, told = np.random.default_rng(seed), store.attributes
    if told["strategy"] == "adaptive":
        return _of_cells(store, W, draws, rng)
    seen = Retaken.of(store)
    code = columns.code_of(told["strategy"], seen.grid, told["settings"]["order"])
    return [_of_columns(seen, code, StoredRows(store, c), W[c], draws, rng) for c in range(seen.channels)]


class Retaken(Seen):
    """The scan's camera with the noise that it has, at light that is given."""

    def __init__(self, calibration: Calibration, side: int = 1) -> None:
        super().__init__(calibration, side)
        ones = np.ones(calibration.white.value.shape, np.float32)
        one = self._on_grid(Radiance(ones, ones, ones > 0))
        self._part = np.where(one.variance < UNKNOWN, one.variance, 0.0)  # left where pixels are averaged
        top = max(2.0 * float(np.max(self.white.value * self._scale + self._dark.value)), 1e-6)
        self._lights = top * np.linspace(0.0, 1.0, _TABLE) ** 2
        self._table = [merged_variance(calibration, self._lights, c) for c in range(self.channels)]

    def variance(self, light: np.ndarray, c: int) -> np.ndarray:
        """Of a picture of channel c, (..., M) light relative to white; 0 where nothing is seen."""
        L = light * self._scale[c] + self._dark.value[c]
        found = np.interp(L, self._lights, self._table[c]) * self._part[c] / self._scale[c] ** 2
        return np.where(self.seen, found, 0.0)

    def dark(self, rng: np.random.Generator) -> np.ndarray:
        """What is wrong with the ambient light (channels, M) that every picture is taken less of."""
        return rng.standard_normal(self.ambient.shape) * np.sqrt(self.ambient)

    def brighter(self, rng: np.random.Generator) -> np.ndarray:
        """What is wrong with white (channels, M), without what is wrong with the ambient light."""
        own = np.where(self.white.variance < 1e-3 * UNKNOWN, self.white.variance, 0.0) - self.ambient
        return rng.standard_normal(own.shape) * np.sqrt(np.maximum(own, 0.0))


def merged_variance(told: Calibration, radiance: np.ndarray, c: int) -> np.ndarray:
    """Of radiance merged from the scan's exposures in channel c: 1 / sum_k t_k^2 / V(L t_k).

    Where all exposures saturate it is that of the shortest alone.
    """
    one = Response(told.response.values[c % told.response.channels])
    precision = np.zeros(radiance.shape)
    for t in told.exposures:
        x = radiance * t
        slope = one.derivative(one.codes(x + told.offset[c]))
        good = (x + told.offset[c] < told.noise.saturation) | (t == min(told.exposures))
        precision += good * t**2 / told.noise.variance(x, slope)
    return 1.0 / precision


def _of_columns(
    seen: Retaken, code: Code, rows: StoredRows, W: np.ndarray, draws: int, rng: np.random.Generator
) -> Errors:
    """Batch by batch, then the balance with white: of sums, which are a product with ones."""
    T, c, N = scipy.sparse.csc_array(rows.tocsr()), rows.channel, len(W)
    W = np.concatenate([W, np.ones((N, 1))], axis=1)
    dark = [seen.dark(rng)[c] for _ in range(draws)]
    product, diagonal = np.zeros((draws, *W.shape)), np.zeros((draws, N))
    moved, own = np.zeros(W.shape), np.zeros(N)
    for start in range(0, N, code.size):
        here = slice(start, min(start + code.size, N))
        light = code.patterns(here.stop - start).astype(np.float32) @ T[:, here].toarray().T
        v = seen.variance(light, c)
        parts = [*_columns(code, v, seen.ambient[c], dark, rng), code.decode(v, v, seen.ambient[c])[1]]
        *drawn, s = [part[: here.stop - start] for part in parts]
        for d, E in enumerate(drawn):
            product[d] += E.T @ W[here]
            diagonal[d, here] = E[:, here].diagonal()
        moved += s.T @ W[here]
        own[here] = s[:, here].diagonal()
    share = 1.0 / np.maximum(moved[:, -1] + seen.white.variance[c], 1e-300)
    for d in range(draws):
        rest = share * (seen.brighter(rng)[c] - dark[d] - product[d, :, -1])
        product[d] += rest[:, None] * moved
        diagonal[d] += rest * own
    return Errors(product[..., :-1], diagonal)


def _columns(
    code: Code, v: np.ndarray, ambient: np.ndarray, dark: list[np.ndarray], rng: np.random.Generator
) -> Iterator[np.ndarray]:
    """What noise of variance v (patterns, M) makes of the columns of a batch, for each draw."""
    root = np.sqrt(v).astype(np.float32)
    for error in dark:
        yield code.decode(root * rng.standard_normal(v.shape, np.float32) - error, v, ambient)[0]


class _Simulated(Retaken):
    """A camera that looks at what a core says (`adaptive.Source`); without noise where `rng` is None."""

    def __init__(self, calibration: Calibration, found: core.Stored, rng: np.random.Generator | None) -> None:
        super().__init__(calibration)
        self._found, self._rng = found, rng
        self._error = np.zeros(self.ambient.shape) if rng is None else self.dark(rng)
        own = 0.0 if rng is None else self.brighter(rng)
        white = found.product(np.ones(self.grid)) + own - self._error
        self.white = Picture(np.where(self.seen, white, 0.0), self.white.variance)

    def announce(self, patterns: Iterable[np.ndarray]) -> None:
        """Nobody has to prepare anything."""

    def take(self, patterns: list[np.ndarray]) -> list[Picture]:
        """As the camera sees them."""
        return [self._picture(self._found.product(pattern)) for pattern in patterns]

    def _picture(self, light: np.ndarray) -> Picture:
        v = np.stack([self.variance(part, c) for c, part in enumerate(light)])
        noise = 0.0 if self._rng is None else np.sqrt(v) * self._rng.standard_normal(v.shape)
        value = light + noise - self._error
        return Picture(np.where(self.seen, value, 0.0), np.where(self.seen, v, UNKNOWN))


def _of_cells(store: BlockStore, W: list[np.ndarray], draws: int, rng: np.random.Generator) -> list[Errors]:
    """Every scan chooses its cells anew; to which comes, with either sign, what cells leave smooth."""
    told, found, settings = Calibration.of(store), core.Stored.of(store), store.attributes["settings"]

    def scanned(rng: np.random.Generator | None, coarser: float = 1.0) -> list[Errors]:
        camera = _Simulated(told, found, rng)
        scan = adaptive.scan(camera, camera, coarser * settings["threshold"], settings["sigmas"])
        other = core.Stored(found.cells, scan.core.matrices())
        return [_difference(other, found, c, w) for c, w in enumerate(W)]

    smooth = scanned(None, _COARSER)
    drawn = [scanned(rng) for _ in range(draws)]
    sign = rng.choice([-1.0, 1.0], draws)
    return [
        Errors(
            np.stack([one[c].product for one in drawn]) + sign[:, None, None] * smooth[c].product,
            np.stack([one[c].diagonal for one in drawn]) + sign[:, None] * smooth[c].diagonal,
        )
        for c in range(len(W))
    ]


def _difference(other: core.Stored, found: core.Stored, c: int, W: np.ndarray) -> Errors:
    sums = np.stack([found.cells.sums(w) for w in W.T], axis=1)
    product = other.matrices[c] @ sums - found.matrices[c] @ sums
    F, was = (core.diagonal(found.cells, part.matrices[c]) for part in (other, found))
    return Errors(product, F - was)
