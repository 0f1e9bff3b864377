# SPDX-License-Identifier: BSD-3-Clause
"""`fit`: a transport from any pairs of pictures and their photographs.

    pairs       the pictures, their checks
    view        which projector pixel a camera pixel sees
    windows     the functions in which each row of T is written
    regression  rows of T from the pictures, with a prior that is learned

Some pairs are held out, the error of T is that of their photographs; then they are used, too.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.acquisition.estimation.pairs import Pairs, gains
from ltcl.acquisition.estimation.regression import ROUNDS, Prior, Rows, learn_prior, solve_rows
from ltcl.acquisition.estimation.view import find_view
from ltcl.acquisition.estimation.windows import (
    Windows,
    functions_of_row,
    hat_matrix,
    sums_under_hats,
)
from ltcl.acquisition.geometry import Correspondence, Resampling
from ltcl.errors import InputError, InputTypeError
from ltcl.transport import stored
from ltcl.transport.first_bounce import drop_uncertain
from ltcl.transport.matrices import check_mixing
from ltcl.transport.noise import Noise
from ltcl.transport.transport import Transport

logger = logging.getLogger(__name__)

# Stretches of neighbouring pairs that are held out: frames of a film are like those beside them.
HELD_OUT_STRETCHES = 4
# Change of brightness from the first pair to the last that is corrected.
NOTABLE_DRIFT = 0.005
# Change of an entry of the mixing after which rows are solved once more.
NOTABLE_MIXING = 0.002
# Condition of the products of colours up to which patterns tell them apart.
MAX_COLOUR_CONDITION = 1e4
# The functions of `windows`, as a basis of `ltcl.operators`.
BASIS = "hats"
# Standard deviations by which a first bounce must be above 0.
FIRST_BOUNCE_SIGMAS = 5.0
# Least factor of the variances of entries.
LEAST_SCALE = 1e-4
# Rows of T that are looked at together.
ENTRY_ROWS = 256
# Bytes of a function of a row while it is learned: mean, variance, node, and what is made of them.
ROW_BYTES = 40
# Light of a function that is left out, relative to that of the camera pixel.
NEGLIGIBLE_LIGHT = 1e-6


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Fit:
    """A transport that was fitted to pairs of patterns and photographs.

    Attributes
    ----------
    transport : Transport
        On the pixels of the photographs, in a basis of hat functions; fitted to all pairs.
    error : float
        Error of T p for pairs that the fit had not seen, relative to their photographs: the root
        mean square over them.
    errors : (held out,)
        That of each of them.
    held_out : (held out,)
        Their numbers.
    drift : float
        Change of brightness over all pairs, which was corrected.
    noise : float
        What T leaves of a photograph at a pixel, relative to its light: noise of the camera, and
        light that varies faster than the functions do.
    pairs : Pairs
        Those that were given.

    Examples
    --------
    >>> import ltcl, numpy
    >>> patterns = numpy.random.default_rng(0).random((40, 3, 4))
    >>> photographs = 0.5 * patterns + 0.01 * patterns.sum(axis=(1, 2), keepdims=True)
    >>> result = ltcl.fit(patterns[:20], photographs[:20])
    >>> result = result.add(patterns[20:], photographs[20:])
    >>> len(result.pairs), bool(result.error < 0.01)
    (40, True)
    """

    transport: Transport
    error: float
    errors: np.ndarray
    held_out: np.ndarray
    drift: float
    noise: float
    pairs: Pairs
    options: dict[str, Any]

    def __repr__(self) -> str:
        h, w = self.pairs.grid
        return f"<ltcl Fit {h} x {w} pixels, {len(self.pairs)} pairs, error {self.error:.2%}>"

    def add(
        self,
        patterns: Any,
        photographs: Any,
        progress: Callable[[str, int, int], object] | None = None,
    ) -> Fit:
        """Fit to these pairs, too, which come after those before.

        Parameters and errors are those of `ltcl.fit`.
        """
        more = Pairs.of(patterns, photographs)
        return _fit(self.pairs.joined(more), **self.options, progress=progress)


def fit(
    patterns: Any,
    photographs: Any,
    *,
    geometry: str | Correspondence = "aligned",
    mixing: Any = None,
    held_out: float = 0.2,
    device: Any = None,
    progress: Callable[[str, int, int], object] | None = None,
) -> Fit:
    """Find the transport that turned these patterns into these photographs.

    Any pictures do, such as 50 to 500 photographs of nature, or a film and its recording: direct
    light must vary from picture to picture at every pixel. T is written in functions that widen
    with the distance from each camera pixel, and estimated with a prior that is learned from the
    pairs (`ltcl.acquisition.estimation`).

    Parameters
    ----------
    patterns : (frames, h, w) or (frames, h, w, 3)
        Linear light that the projector sent, at least 10 frames. Grey ones light all channels.
    photographs : (frames, h, w) or (frames, h, w, 3)
        Linear light that the camera saw of each, without ambient light.
    geometry : "aligned", "pairs" or Correspondence
        Which projector pixel each camera pixel sees: the same; found from the pairs, where their
        details allow it; or as measured before.
    mixing : (3, 3), optional
        Mixing of the projector's colours, as in `Transport`; None: found from the pairs.
    held_out : float
        Share of the pairs that judge the fit, in (0, 0.5].
    device : Device or str, optional
        As in `Transport`.
    progress : function of (str, int, int), optional
        Called with "fit", rows that are done, and all rows.

    Returns
    -------
    Fit

    Raises
    ------
    InputError, InputTypeError
        Shapes that do not fit together, NaN, too few pairs, patterns that are all the same,
        photographs that are saturated.
    MemoryLimitError
        More pixels than the host has memory for.
    AcquisitionError
        Photographs in another order than the patterns; pairs that do not show the geometry.

    Examples
    --------
    >>> import ltcl, numpy
    >>> truth = ltcl.scenes.dihedral(6, albedo=0.6).transport()
    >>> patterns = numpy.random.default_rng(0).random((60, *truth.grid))
    >>> photographs = numpy.stack([truth @ pattern for pattern in patterns])
    >>> result = ltcl.fit(patterns, photographs)
    >>> bool(result.error < 0.01)
    True
    """
    pairs = Pairs.of(patterns, photographs)
    share = checks.number("held_out", held_out, above=0.0, most=0.5)
    if progress is not None and not callable(progress):
        raise InputTypeError(
            f"progress is {progress!r}; it must be a function of (str, int, int), or None"
        )
    if mixing is not None:
        mixing = check_mixing(mixing, pairs.channels, has_blocks=False)
    return _fit(
        pairs,
        geometry=_check_geometry(geometry, pairs),
        mixing=mixing,
        held_out=share,
        device=device,
        progress=progress,
    )


def _check_geometry(geometry: Any, pairs: Pairs) -> str | Correspondence:
    if isinstance(geometry, Correspondence):
        if geometry.grid != pairs.grid or geometry.valid.shape != pairs.camera_grid:
            raise InputError(
                f"geometry is of {geometry.valid.shape} camera pixels and a projector of "
                f"{geometry.grid}; photographs is of {pairs.camera_grid}, patterns of {pairs.grid}"
            )
        return geometry
    checks.one_of("geometry", geometry, ("aligned", "pairs"))
    if geometry == "aligned" and pairs.camera_grid != pairs.grid:
        raise InputError(
            f"photographs is of {pairs.camera_grid} pixels, patterns of {pairs.grid}; give "
            "geometry='pairs', or photographs on the pixels of the projector"
        )
    return geometry


def _fit(
    given: Pairs,
    *,
    geometry: str | Correspondence,
    mixing: np.ndarray | None,
    held_out: float,
    device: Any,
    progress: Callable[[str, int, int], object] | None,
) -> Fit:
    pairs = given
    if geometry == "aligned":
        pairs.check_order()
    else:
        mapping = geometry if isinstance(geometry, Correspondence) else find_view(pairs)
        pairs = given.resampled(Resampling.of(mapping))
        pairs.check_order()
    judges = _held_out(len(pairs), held_out)
    is_judge = np.zeros(len(pairs), bool)
    is_judge[judges] = True

    # 1. The prior and the colours, from the pairs that are not held out.
    estimator = _Estimator(pairs.grid, pairs.channels, mixing, progress)
    estimator.learn(pairs.select(~is_judge))
    explained = estimator.explain(pairs.patterns)
    pairs.check_partners(explained)

    # 2. The lamp, and the error of the pairs that were held out.
    trend = _trend(judges, gains(pairs.photographs[judges], explained[judges]), len(pairs))
    drift = float(trend[-1] - trend[0])
    steady = pairs
    if abs(drift) > NOTABLE_DRIFT:
        logger.warning("brightness changes by %.1f %% over the pairs: corrected", 100 * drift)
        photographs = pairs.photographs / trend[:, None, None]
        steady = replace(pairs, photographs=photographs)
        estimator.solve(steady.select(~is_judge))
        explained = estimator.explain(pairs.patterns)
    left = steady.photographs[judges] - explained[judges]
    errors = _norms(left) / np.maximum(_norms(steady.photographs[judges]), np.finfo(float).tiny)

    error = float(np.sqrt(np.mean(errors**2)))
    scales = estimator.scale_of_variance(pairs.patterns[judges], left)

    # 3. The transport, from all pairs.
    estimator.solve(steady)
    return Fit(
        transport=Transport.from_arrays(estimator.arrays(scales), device=device),
        error=error,
        errors=errors,
        held_out=judges,
        drift=drift,
        noise=estimator.noise,
        pairs=given,
        options={"geometry": geometry, "mixing": mixing, "held_out": held_out, "device": device},
    )


class _Estimator:
    """Priors and rows of all channels, for pixels of a grid."""

    def __init__(
        self,
        grid: tuple[int, int],
        channels: int,
        mixing: np.ndarray | None,
        progress: Callable[[str, int, int], object] | None,
    ) -> None:
        self.grid = grid
        _check_memory(grid, channels)
        self.windows = Windows.of(grid)
        self.W = hat_matrix(grid)
        self.W_squared: Any = scipy.sparse.csr_array(self.W.multiply(self.W))
        self.channels = channels
        self.finds_mixing = mixing is None and channels == 3
        self.mixing = np.eye(channels) if mixing is None else mixing
        self.priors: list[Prior] = []
        self.rows: list[Rows] = []
        self._progress = progress
        self._done = 0

    def learn(self, pairs: Pairs) -> None:
        """Learn the priors, and the mixing of the colours if it is asked for; solve the rows."""
        self.finds_mixing = self.finds_mixing and _shows_colours(pairs)
        if self.finds_mixing:
            self.mixing = _first_mixing(pairs)
        self.priors = []
        for channel in range(self.channels):
            pictures = pairs.photographs[:, :, channel].T
            light = _light(pairs.patterns @ self.mixing[channel], pairs.photographs[:, :, channel])
            sums = self._sums(pairs.patterns, channel)
            self.priors.append(learn_prior(self.windows, sums, pictures, light, self._count))
        self.solve(pairs)
        if not self.finds_mixing:
            return
        found = self._find_mixing(pairs)
        change = np.abs(found - self.mixing).max()
        self.mixing = found
        if change > NOTABLE_MIXING:
            self.solve(pairs)
            self.mixing = self._find_mixing(pairs)

    def solve(self, pairs: Pairs) -> None:
        """Solve the rows of all channels."""
        self.rows = []
        for channel in range(self.channels):
            sums = self._sums(pairs.patterns, channel)
            pictures = pairs.photographs[:, :, channel].T
            prior = self.priors[channel]
            self.rows.append(solve_rows(self.windows, sums, pictures, prior, self._count))

    def explain(self, patterns: np.ndarray) -> np.ndarray:
        """T p of patterns, (frames, N, channels)."""
        channels = []
        for channel in range(self.channels):
            sums = self._sums(patterns, channel)
            channels.append((self._core(channel) @ sums[:-1]).T)
        return np.stack(channels, axis=2)

    @property
    def noise(self) -> float:
        """The median of what rows leave of a photograph, relative to the light of the pixel."""
        return float(np.sqrt(np.median([prior.noise for prior in self.priors])))

    def scale_of_variance(self, patterns: np.ndarray, left: np.ndarray) -> np.ndarray:
        """Factors of the variances of all entries, under which T p errs as it did, (channels,).

        `left` is what T left of photographs, (frames, N, channels). Errors of entries in a row go
        together, which their variances do not tell.
        """
        scales = []
        for channel in range(self.channels):
            prior = self.priors[channel]
            squares = (patterns @ self.mixing[channel]) ** 2
            sums = self.W_squared @ squares.T
            expected = (self._variances(channel) @ sums).sum()
            noise = len(patterns) * (prior.noise * prior.light**2).sum()
            measured = max((left[:, :, channel] ** 2).sum() - noise, 0.0)
            scales.append(max(measured / expected, LEAST_SCALE))
        return np.array(scales)

    def arrays(self, scales: np.ndarray) -> dict[str, np.ndarray]:
        """The arrays of the transport (`ltcl.transport.stored`), with the noise of its entries."""
        pixels = len(self.windows.nodes)
        samples = [self._entries(channel, scales[channel]) for channel in range(self.channels)]
        noise = Noise.fit((pixels, pixels), samples, "acquired")
        return self._transport_arrays() | noise.to_arrays()

    def _entries(self, channel: int, scale: float) -> Iterator[tuple[np.ndarray, ...]]:
        """Rows, columns, light and variances of entries of T, some rows at a time."""
        C: Any = self._core(channel)
        V: Any = self._variances(channel) * scale
        for start in range(0, C.shape[0], ENTRY_ROWS):
            rows = slice(start, start + ENTRY_ROWS)
            light = (C[rows] @ self.W).toarray()
            variance = (V[rows] @ self.W_squared).toarray()
            # A pixel that the camera does not see has none.
            i, j = np.nonzero(variance)
            yield i + start, j, light[i, j], variance[i, j]

    def _transport_arrays(self) -> dict[str, np.ndarray]:
        cores = []
        diagonals = []
        first_bounce = []
        own = np.arange(len(self.windows.nodes))
        for channel in range(self.channels):
            C = self._core(channel)
            products: Any = C.multiply(self.W.T)
            diagonals.append(products.sum(axis=1) - 1.0)
            identity = scipy.sparse.eye_array(len(own), self.windows.absent, format="csr")
            cores.append(scipy.sparse.csr_array(C - identity))
            is_own = self.windows.nodes == own[:, None]
            rows = self.rows[channel]
            direct = np.where(is_own, rows.mean, 0.0).sum(axis=1)
            variance = np.where(is_own, rows.variance, 0.0).sum(axis=1)
            first_bounce.append(drop_uncertain(direct, variance, FIRST_BOUNCE_SIGMAS))
        mixing = self.mixing if self.channels == 3 else None
        return stored.arrays_of_scan(
            self.grid, cores, np.stack(diagonals), np.stack(first_bounce), mixing, BASIS
        )

    def _core(self, channel: int) -> scipy.sparse.csr_array:
        """C (N, nodes) of T = C W."""
        return self._in_nodes(channel, self.rows[channel].mean)

    def _variances(self, channel: int) -> scipy.sparse.csr_array:
        """Variances of C, in the same pattern."""
        return self._in_nodes(channel, self.rows[channel].variance)

    def _in_nodes(self, channel: int, values: np.ndarray) -> scipy.sparse.csr_array:
        """Values of functions of each row, (N, q), at their nodes, where T has light."""
        mean = self.rows[channel].mean
        area = self.windows.area[self.windows.group]
        light = self.priors[channel].light[:, None]
        is_there = self.windows.nodes != self.windows.absent
        matters = is_there & (np.abs(mean) * area > NEGLIGIBLE_LIGHT * light)
        row, function = np.nonzero(matters)
        column = self.windows.nodes[row, function]
        shape = len(mean), self.windows.absent
        return scipy.sparse.csr_array((values[row, function], (row, column)), shape=shape)

    def _sums(self, patterns: np.ndarray, channel: int) -> np.ndarray:
        """Sums under all hats of the light that a channel answers to."""
        return sums_under_hats(self.W, list(patterns @ self.mixing[channel]))

    def _find_mixing(self, pairs: Pairs) -> np.ndarray:
        """The mixing that explains the photographs best, given the rows."""
        found = np.empty_like(self.mixing)
        for channel in range(self.channels):
            C = self._core(channel)
            answers = []
            for colour in range(3):
                sums = sums_under_hats(self.W, list(pairs.patterns[:, :, colour]))
                answers.append((C @ sums[:-1]).ravel())
            answer = np.stack(answers, axis=1)
            pictures = pairs.photographs[:, :, channel].T.ravel()
            shares = np.linalg.lstsq(answer, pictures, rcond=1e-6)[0]
            found[channel] = shares / shares.sum()
        return found

    def _count(self, rows: int) -> None:
        """Tell the progress that some rows were solved."""
        self._done += rows
        if self._progress is not None:
            # The prior, the rows for those that judge, and at last all pairs.
            expected = (ROUNDS + 2) * self.channels * len(self.windows.nodes)
            self._progress("fit", self._done, max(self._done, expected))


def _check_memory(grid: tuple[int, int], channels: int) -> None:
    """Refuse a grid whose rows do not fit the memory of the host."""
    height, width = grid
    numbers = height * width * functions_of_row(grid) * (channels + 1)
    checks.fits_host(f"fitting {height} x {width} pixels", numbers * ROW_BYTES)


def _light(patterns: np.ndarray, photographs: np.ndarray) -> np.ndarray:
    """Light of each camera pixel under a pattern of ones, about, (N,)."""
    mean = photographs.mean(axis=0) / max(patterns.mean(), np.finfo(float).tiny)
    return np.maximum(mean, mean.max() * 1e-6)


def _held_out(count: int, share: float) -> np.ndarray:
    """Numbers of the pairs that are held out: stretches, evenly spread."""
    length = math.ceil(count * share / HELD_OUT_STRETCHES)
    middles = (np.arange(HELD_OUT_STRETCHES) + 0.5) * count / HELD_OUT_STRETCHES
    first = (middles - length / 2).astype(int)
    numbers = first[:, None] + np.arange(length)
    return np.unique(np.clip(numbers, 0, count - 1))


def _trend(numbers: np.ndarray, gain: np.ndarray, count: int) -> np.ndarray:
    """A straight line through the gains of some pairs, at all of them, 1 on average."""
    line = np.polynomial.Polynomial.fit(numbers, gain, 1)(np.arange(count))
    return line / line.mean()


def _first_mixing(pairs: Pairs) -> np.ndarray:
    """The mixing that the changes of each pixel show, from its own light alone, (3, 3)."""
    changes, products = _products_of_colours(pairs)
    answers = np.einsum("fic,fid->cd", pairs.photographs, changes)
    shares = np.linalg.solve(products, answers.T).T
    return shares / shares.sum(axis=1, keepdims=True)


def _shows_colours(pairs: Pairs) -> bool:
    """Return True if the patterns tell colours apart; grey ones do not."""
    _, products = _products_of_colours(pairs)
    return bool(np.linalg.cond(products) < MAX_COLOUR_CONDITION)


def _products_of_colours(pairs: Pairs) -> tuple[np.ndarray, np.ndarray]:
    """Patterns less their means, (frames, N, 3), and the products of their colours, (3, 3)."""
    changes = pairs.patterns - pairs.patterns.mean(axis=0)
    return changes, np.einsum("fic,fid->cd", changes, changes)


def _norms(pictures: np.ndarray) -> np.ndarray:
    return np.linalg.norm(pictures.reshape(len(pictures), -1), axis=1)
