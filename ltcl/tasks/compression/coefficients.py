# SPDX-License-Identifier: BSD-3-Clause
"""Bases in which R is written, by name, and C = W_out R W_in^T between them without its small numbers.

Where the host has room for all of C, one threshold is taken of it. Else blocks of rows stream
through W_in, what is below a first threshold is dropped, and blocks of columns stream through
W_out. Both bases are orthonormal: the error of R in the Frobenius norm is at most the sum of what
both passes drop.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse

from ltcl import checks
from ltcl.device import Device, open_device
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import Basis, Compressed, SubsetBasis, Tiles, Wavelet, basis, smallest
from ltcl.operators.bases import multiresolution_order, restrict_to_support
from ltcl.operators.stored import basis_of
from ltcl.operators.tiles import Packed
from ltcl.operators.wavelets import filters
from ltcl.tasks.compression.losses import estimate_norm
from ltcl.tasks.compression.sources import COLUMNS, Rows, cut, source

Transform = Callable[
    [np.ndarray], np.ndarray
]  # (N, k) float32 -> (N, k) float32, k a multiple of COLUMNS
Progress = Callable[[float], object]
_CACHED = 512  # rows of a dense block that stay in the cache while they are looked at several times
_SHIFT = 16  # bits of a float32 that a bin of `threshold_within` leaves open
_PIECE = 1 << 22  # numbers counted at once
PIXELS, ROWS = "pixels", " rows"
INVERSE_NAMES = ("db2", "haar", "db4", PIXELS)  # compared where none is named, in this order
_SIGNS = 32  # pictures of random signs
_own_device = functools.cache(open_device)  # of a worker, which keeps it


def basis_names(names: Any, *, for_inverse: bool = False) -> list[str]:
    """Names of one basis or of several, as a list."""
    names = [names] if isinstance(names, str) else names
    if (
        not isinstance(names, (list, tuple))
        or not all(isinstance(name, str) for name in names)
        or not names
    ):
        raise InputTypeError(
            f"basis is {names!r}; it must be a name, such as db2, or a list of at least one"
        )
    for name in names:
        if for_inverse and name.endswith(ROWS):
            raise InputError(
                f"basis is {name!r}; an inverse needs one basis on both sides, such as 'db2'"
            )
        try:
            if name != PIXELS:
                filters(name.removesuffix(ROWS))
        except InputError as error:
            known = "pixels, or an orthonormal wavelet such as haar, db2 or db4, with ' rows' for rows alone"
            raise InputError(f"basis is {name!r}; it must be {known}") from error
    return list(names)


@dataclass(frozen=True)
class Bases:
    """R = out^T C into; None is pixels.

    `weights` (N,) of columns, at least 1, are the root of 1 + N e: the squares that a number which
    is dropped costs a single pixel, and light of energies e.
    """

    device: Device
    name: str
    out: Basis | None
    into: Basis | None
    weights: np.ndarray

    @classmethod
    def named(cls, device: Device, grid: tuple[int, int], name: str, light: Any = None) -> Bases:
        """Those of a name, on a grid, with weights by `light` (N, k) of norm 1."""
        W = basis(device, grid, name.removesuffix(ROWS))
        if isinstance(W, Wavelet):  # large coefficients then lie side by side, in fewer tiles
            order = multiresolution_order(grid, W.levels)
            W = SubsetBasis(device, grid, order, of=W)
        weights = np.sqrt(1.0 + (0.0 if light is None else len(light) * energies(W, light)))
        weights = np.broadcast_to(weights, grid[0] * grid[1])
        return cls(device, name, None if name.endswith(ROWS) else W, W, weights)

    def compressed(self, core: Any, allowance: float) -> Compressed:
        """R~ of a core with weights, rounded by `allowance` in the 2-norm, about: see `quantize`.

        Where both sides have one basis, it is without coefficients that the core does not touch.
        """
        data = (core.data / self.weights[core.indices]).astype(core.dtype)
        core = scipy.sparse.csr_array((data, core.indices, core.indptr), core.shape)
        out, into = self.out, self.into
        if into is not None and out is into:
            core, into = restrict_to_support(core, into)
            out = into
        return Compressed(Tiles(self.device, quantize(core, allowance)), out, into, 0.0)

    def gather(
        self, R: Rows, progress: Progress = lambda share: None, **limits: Any
    ) -> Coefficients:
        """The numbers of R, times the weights, within the `limits` of `coefficients`."""
        into = Analysis(self.into, self.weights[:, None].astype(np.float32))
        return coefficients(R, self.out and Analysis(self.out), into, progress=progress, **limits)

    def noise(self, variances: Any) -> list[np.ndarray]:
        """Standard deviations of rows and columns of weighted numbers, of random signs: each within 13 %."""
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (variances.shape[1], _SIGNS))
        sides = zip((self.out, self.into), variances, (1.0, self.weights), strict=True)
        return [
            weights * np.sqrt(energies(W, np.sqrt(each)[:, None] * signs))
            for W, each, weights in sides
        ]


def energies(W: Basis | None, x: np.ndarray) -> np.ndarray:
    """Mean squares of the coefficients of light x (N, k), k a multiple of `COLUMNS`; None is pixels."""
    return np.mean(
        np.square(x if W is None else Analysis(W)(x.astype(np.float32)), dtype=np.float64), axis=1
    )


@dataclass(frozen=True)
class Analysis:
    """W x of light x (N, k) on the host in float32, times weights; None is pixels. Pickles find a device."""

    W: Basis | None
    weights: np.ndarray | None = None

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Of columns."""
        y = x if self.W is None else self.W.apply(self.W.device.upload(x)).get()
        return y if self.weights is None else self.weights * y

    def __reduce__(self) -> tuple[Any, ...]:
        return _analysis, (self.W and self.W.to_arrays(), self.weights)


def _analysis(arrays: Any, weights: np.ndarray | None) -> Analysis:
    return Analysis(arrays and basis_of(_own_device(), arrays), weights)


def quantize(C: scipy.sparse.csr_array, allowance: float) -> Packed:
    """C in the tiles of fewest bytes whose rounding has a 2-norm of at most about `allowance`.

    That norm is estimated; who hands out the tiles measures what they are worth.
    """
    size = float(np.linalg.norm(C.data.astype(np.float64)))
    frobenius = allowance * math.sqrt(
        len(C.indptr) - 1
    )  # or less: the 2-norm of rounding is far below
    while True:
        packed = smallest(C, frobenius / size if size else 0.0)
        fits = packed.precision == "float32" or packed.difference[1] <= allowance
        if fits or estimate_norm(scipy.sparse.csr_array(packed.matrix() - C))[0] <= allowance:
            return packed
        frobenius = 0.5 * packed.difference[0]


def drop_below(X: Any, threshold: float) -> tuple[scipy.sparse.csr_array, float]:
    """The numbers of X, dense or CSR, of at least `threshold`, and the sum of squares of the others."""
    if scipy.sparse.issparse(X):
        keep = np.abs(X.data) >= threshold
        small = X.data[~keep].astype(np.float64)
        ends = np.concatenate([[0], np.cumsum(keep)]).astype(X.indptr.dtype)[X.indptr]
        return scipy.sparse.csr_array((X.data[keep], X.indices[keep], ends), X.shape), float(
            small @ small
        )
    counts, indices, values, squares = [np.zeros(1, np.int64)], [], [], []
    for start, stop in cut(len(X), _CACHED):
        block = np.ascontiguousarray(X[start:stop])
        keep = (np.abs(block) >= threshold) & (block != 0.0)
        places = np.flatnonzero(keep)
        counts.append(np.count_nonzero(keep, axis=1))
        indices.append((places % block.shape[1]).astype(np.int32))
        values.append(block.flat[places])
        rest = block.astype(np.float64)
        rest.flat[places] = 0.0
        squares.append(float(np.vdot(rest, rest)))
    arrays = (np.concatenate(values), np.concatenate(indices), np.cumsum(np.concatenate(counts)))
    return scipy.sparse.csr_array(arrays, X.shape), math.fsum(squares)


def threshold_within(frobenius: float, *arrays: np.ndarray, most: float = math.inf) -> float:
    """The largest threshold below which float32 arrays have at most this norm; more, to leave `most` numbers.

    Without sorting: numbers are counted in bins of less than a percent, the same exponent and first
    seven bits behind it, and the threshold is an edge of a bin.
    """
    bins = 1 << (32 - _SHIFT - 1)
    counts, squares = np.zeros(bins, np.int64), np.zeros(bins)
    for flat in map(np.ravel, arrays):
        for start, stop in cut(flat.size, _PIECE):
            piece = np.abs(flat[start:stop])
            keys = piece.view(np.int32) >> _SHIFT
            counts += np.bincount(keys, minlength=bins)
            squares += np.bincount(keys, np.square(piece, dtype=np.float64), minlength=bins)
    edge = int(np.searchsorted(np.cumsum(squares), frobenius**2 * (1 + 1e-12), side="right"))
    edge = min(edge, int(np.flatnonzero(counts)[-1]) + 1 if counts.any() else 0)
    above = np.cumsum(counts[::-1])[::-1]  # numbers in this bin and beyond
    edge = max(edge, int(np.searchsorted(-above, -most, side="left")))
    return float(np.int32(edge << _SHIFT).view(np.float32))


@dataclass(frozen=True)
class Coefficients:
    """The numbers of R between two bases of at least `threshold`: R~ = W_out^T core W_in.

    `first` is the Frobenius norm of what was dropped between the passes, `second` of what was at
    the end.
    """

    core: scipy.sparse.csr_array
    first: float
    second: float
    threshold: float

    @property
    def dropped(self) -> float:
        """||R~ - R||_F, or a bound on it: what both passes drop may add up."""
        return self.first + self.second

    def largest(self, drop: float) -> Coefficients:
        """The largest of them, so that all in all about the Frobenius norm `drop` is left out."""
        threshold = threshold_within(math.sqrt(max(drop**2 - self.dropped**2, 0.0)), self.core.data)
        if threshold <= self.threshold:
            return self
        core, lost = drop_below(self.core, threshold)
        return replace(
            self, core=core, second=math.sqrt(self.second**2 + lost), threshold=threshold
        )


def coefficients(
    R: Rows,
    out: Transform | None,
    into: Transform | None,
    threshold: float | None = None,
    *,
    drop: float = 0.0,
    most: float = math.inf,
    first: float | None = None,
    progress: Progress = lambda share: None,
) -> Coefficients:
    """C = W_out R W_in^T without what is below `threshold`, and below `first` between the two passes.

    W_out of (M, k) and W_in of (N, k) numbers are orthonormal, None of pixels. By default,
    `threshold` is the largest that drops no more than the Frobenius norm `drop`, or a larger one
    where that keeps more than `most` numbers, and `first` 0 where the host has room for all numbers
    twice, else what drops about a third of `drop`, or more. The core has the same bits for any
    `R.memory` and `R.client`.
    """
    (m, n), room = R.shape, checks.host_memory() // 2
    if first is None and 4 * m * n <= room:
        C = np.empty((m, n), np.float32)
        for at, rows in R.each(lambda at, rows, _: (at, _transformed(into, rows.T).T)):
            C[at] = rows
            progress(0.5 * at.stop / m)
        for start, stop in cut(n, _CACHED) if out is not None else ():
            C[:, start:stop] = _transformed(out, C[:, start:stop])
        threshold = threshold_within(drop, C, most=most) if threshold is None else threshold
        core, lost = drop_below(C, threshold)
        progress(1.0)
        return Coefficients(core, 0.0, math.sqrt(lost), threshold)
    most = min(most, room // 16)  # 8 bytes each, and up to twice as many for a while
    if out is None:
        core, lost, threshold = _collect(R, into, threshold, drop, most, progress)
        return Coefficients(core, 0.0, lost, threshold)
    between, left, _ = _collect(
        R, into, first, drop / 3.0, room // 16, lambda share: progress(0.5 * share)
    )
    columns = scipy.sparse.csr_array(between.T)
    lit = np.flatnonzero(np.diff(columns.indptr))  # few, where light is smooth
    columns, note = (
        source("C", columns[lit], R.memory, R.client),
        lambda share: progress(0.5 + 0.5 * share),
    )
    core, lost, threshold = _collect(columns, out, threshold, drop, most, note)
    core = scipy.sparse.csr_array(core.T)
    indices = lit.astype(core.indices.dtype)[core.indices]
    core = scipy.sparse.csr_array((core.data, indices, core.indptr), (m, n))
    return Coefficients(core, left, lost, threshold)


def _collect(
    R: Rows,
    W: Transform | None,
    threshold: float | None,
    drop: float,
    most: float,
    progress: Progress,
) -> tuple[scipy.sparse.csr_array, float, float]:
    """R W^T without what is below a threshold; what was lost; and the threshold.

    One that is not given rises whenever twice as many numbers as `most` have come together, never
    above what all of them call for.
    """
    pieces: list[Any] = [scipy.sparse.csr_array((0, R.shape[1]), dtype=np.float32)]
    lost, lowest = 0.0, threshold or 0.0

    def large(
        at: slice, rows: np.ndarray, least: float
    ) -> tuple[int, scipy.sparse.csr_array, float]:
        core, squares = drop_below(_transformed(W, rows.T), least)
        return at.stop, scipy.sparse.csr_array(core.T), squares

    def raise_threshold(frobenius: float) -> None:
        nonlocal pieces, lost, lowest
        lowest = max(
            lowest, threshold_within(frobenius, *(piece.data for piece in pieces), most=most)
        )
        cores, squares = zip(*(drop_below(piece, lowest) for piece in pieces), strict=True)
        pieces, lost = list(cores), lost + math.fsum(squares)

    for stop, piece, squares in R.each(large, lambda: lowest):
        pieces.append(piece)
        lost += squares
        if threshold is None and sum(piece.nnz for piece in pieces) > 2 * most:
            raise_threshold(0.0)
        progress(stop / R.shape[0])
    if threshold is None:
        raise_threshold(math.sqrt(max(drop**2 - lost, 0.0)))
    return (
        scipy.sparse.csr_array(scipy.sparse.vstack(pieces, format="csr")),
        math.sqrt(lost),
        lowest,
    )


def _transformed(transform: Transform | None, block: np.ndarray) -> np.ndarray:
    """`transform` of the columns of `block`, filled up with zeros to a multiple of `COLUMNS`."""
    if transform is None:
        return np.ascontiguousarray(block)
    count = block.shape[1]
    padded = np.zeros((len(block), -(-count // COLUMNS) * COLUMNS), np.float32)
    padded[:, :count] = block
    return transform(padded)[:, :count]
