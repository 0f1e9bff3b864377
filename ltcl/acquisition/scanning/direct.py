# SPDX-License-Identifier: BSD-3-Clause
"""A scan of direct light alone: fine patterns, in some of which each projector pixel is lit.

They are one pattern at 15 shifts: pixel (row, column) is lit in pattern m if

    (column + 4 row + m) mod 15    is in    {0, 1, 2, 4, 5, 8, 10}

a difference set: each pixel is lit in 7 of 15, and each pair of pixels whose numbers differ is lit
together in 3. Pixels of one number are at least 4.1 pixels apart. So every small region is lit by
the same share in all patterns, and light that bounces is a constant (Nayar et al. 2006): the answer
to the changes is the direct light of a pixel and its neighbours (`estimation.neighbours`). T of
this scan is that sparse part alone.

Known limit: direct light that is blurred over more than two pixels counts as indirect, light that
bounces back from within two pixels as direct, and gloss that reflects fine patterns as either.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ltcl import checks
from ltcl.acquisition.estimation.neighbours import DirectLight, separate, sparse_rows
from ltcl.acquisition.scanning.picture_log import BATCH_SIZE, PictureLog
from ltcl.acquisition.scanning.pictures import Picture, ScanGrid
from ltcl.acquisition.scanning.sketch import (
    SEED,
    deviation_of_squares,
    error_bound,
    like_nature,
    text,
)
from ltcl.errors import ScanRefused
from ltcl.store import BlockStore
from ltcl.store.block_store import SparseMatrix
from ltcl.transport.noise import Noise
from ltcl.transport.noise.fit import noise_step

# Shifts of the pattern, the numbers that are lit, and the change of the number from row to row.
SHIFTS = 15
LIT_NUMBERS = (0, 1, 2, 4, 5, 8, 10)
NUMBERS_PER_ROW = 4
# Pictures that judge.
JUDGES = 4
# Pixels along the side of the fields of the checkerboard that judges.
FIELD = 2
# Surprise of a picture, relative to that of the median one, from which on it is refused: 1.1 to 1.3
# in clean scans, 15 to 25 if a picture is a quarter too dark.
MAX_SURPRISE_RATIO = 6.0
# Least factor of the variances of entries.
LEAST_SCALE = 1.0
# Columns from a pixel to entries without light whose noise counts, in steps of the fit of noise.
DISTANCES_WITHOUT_LIGHT = (-7, -5, -3, -2, 2, 3, 5, 7)
# Bytes of a pixel in each channel: pictures, and rows of D with their variances.
ROW_BYTES = 400


def patterns(grid: tuple[int, int]) -> list[np.ndarray]:
    """The patterns (h, w) of 0 and 1; fewer on a grid so small that shifts are alike.

    >>> len(patterns((64, 64))), patterns((2, 8))[0].astype(int).tolist()
    (15, [[1, 1, 1, 0, 1, 1, 0, 0], [1, 1, 0, 0, 1, 0, 1, 0]])
    """
    number = np.add.outer(NUMBERS_PER_ROW * np.arange(grid[0]), np.arange(grid[1]))
    shown = [np.isin((number + shift) % SHIFTS, LIT_NUMBERS) for shift in range(SHIFTS)]
    return _different(shown)


def judges(grid: tuple[int, int]) -> list[np.ndarray]:
    """Pictures (h, w) of 0 and 1 that are never fitted, with half of each small region lit.

    They are a checkerboard of fields of 2 x 2 pixels, this with text and with noise like nature in
    which its fields are exchanged, and single pixels at random.

    >>> len(judges((64, 64)))
    4
    """
    random = np.random.default_rng(SEED)
    row, column = np.indices(grid)
    board = (row // FIELD + column // FIELD) % 2 == 1
    nature = like_nature(grid, random) > 0
    pixels = random.random(grid) < 0.5
    return _different([board, board ^ text(grid), board ^ nature, pixels])


def _different(shown: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The patterns that are neither black nor white nor like an earlier one."""
    chosen: dict[bytes, np.ndarray] = {}
    for pattern in shown:
        if pattern.any() and not pattern.all():
            chosen.setdefault(pattern.tobytes(), pattern.astype(np.float32))
    return list(chosen.values())


def count_patterns(grid: tuple[int, int]) -> int:
    """Patterns of a scan, with those that judge it."""
    return len(patterns(grid)) + len(judges(grid))


def most_patterns(grid: tuple[int, int]) -> int:
    """Number of patterns that no scan exceeds, in whole batches."""
    return BATCH_SIZE * max(-(-count_patterns(grid) // BATCH_SIZE), 1)


def check_memory(grid: tuple[int, int], channels: int) -> None:
    """Refuse a grid whose pictures do not fit the memory of the host."""
    height, width = grid
    pixels = height * width * channels
    checks.fits_host(f"direct light of {height} x {width} pixels", pixels * ROW_BYTES)


@dataclass(frozen=True, kw_only=True)
class DirectScan:
    """Direct light of all channels, and what the judges say.

    Attributes
    ----------
    channels : sequence of DirectLight
    scales : (channels,)
        Factors of the variances, by which they explain the errors of the judges.
    errors : (judges,)
        Error of the direct light of each judge relative to it, less the noise of the camera.
    error : float
        Their root mean square; NaN without judges.
    bound : float
        What that of other pictures is below, with a probability of 95 %.
    left_out : float
        Indirect light, relative to all light under white, at the median pixel.
    """

    channels: Sequence[DirectLight]
    scales: np.ndarray
    errors: np.ndarray
    error: float
    bound: float
    left_out: float


def scan(
    grid: ScanGrid, log: PictureLog, progress: Callable[[str, int, int], object] | None = None
) -> DirectScan:
    """Photograph the patterns and the judges, and separate direct from indirect light.

    `log` takes the pictures, or has those of an earlier run; `progress` is called with "fit",
    pixels that are done, and all.
    """
    fitted = patterns(grid.grid)
    judging = judges(grid.grid)
    shown = [*fitted, *judging]
    log.announce(shown)
    pictures: list[Picture] = []
    for start in range(0, len(shown), BATCH_SIZE):
        pictures += log.take(shown[start : start + BATCH_SIZE])
    count = _FitCount(len(grid.seen) * grid.channels, progress)
    white = np.ones(grid.grid, np.float32)
    lit = [grid.light_of(pattern) for pattern in (white, *fitted)]
    judging = [grid.light_of(pattern) for pattern in judging]
    seen = [grid.white, *pictures[: len(fitted)]]
    channels = []
    for channel in range(grid.channels):
        value = np.stack([picture.value[channel] for picture in seen])
        variance = np.stack([picture.variance[channel] for picture in seen])
        # The ambient light was subtracted from the pictures.
        variance[1:] += grid.ambient[channel]
        channels.append(separate(grid.grid, lit, value, variance, count))
    surprise = np.mean([light.surprise for light in channels], axis=0)
    _check_surprise(surprise)
    return _judged(grid, channels, judging, pictures[len(fitted) :])


def _check_surprise(surprise: np.ndarray) -> None:
    """Refuse a picture that all others contradict, such as one of another lamp or exposure.

    `surprise` is that of each picture, (frames,), white first, which no pattern is like.
    """
    of_patterns = surprise[1:]
    if not len(of_patterns):
        return
    number = int(of_patterns.argmax())
    if of_patterns[number] > MAX_SURPRISE_RATIO * np.median(of_patterns):
        raise ScanRefused(
            f"the picture of pattern {number + 1} of {len(of_patterns)} contradicts those of all "
            "others: another exposure, another light, or something moved; the scan must be repeated"
        )


class _FitCount:
    """Tells the progress how many pixels are done."""

    def __init__(self, total: int, progress: Callable[[str, int, int], object] | None) -> None:
        self.total = total
        self.done = 0
        self.progress = progress

    def __call__(self, pixels: int) -> None:
        self.done += pixels
        if self.progress is not None:
            self.progress("fit", self.done, self.total)


def _judged(
    grid: ScanGrid,
    channels: Sequence[DirectLight],
    judging: Sequence[np.ndarray],
    pictures: Sequence[Picture],
) -> DirectScan:
    """Compare direct light, and the share of indirect light, with pictures never fitted."""
    shape = len(judging), len(channels)
    squares = np.zeros(shape)
    noise = np.zeros(shape)
    noise_squares = np.zeros(shape)
    energy = np.zeros(shape)
    expected = np.zeros(shape)
    for c, light in enumerate(channels):
        D = sparse_rows(grid.grid, light.direct, light.is_there)
        V = sparse_rows(grid.grid, light.variance, light.is_there)
        for k, (pattern, picture) in enumerate(zip(judging, pictures, strict=True)):
            is_known = picture.known[c]
            direct = D @ pattern.ravel()
            explained = direct + pattern.mean() * light.indirect
            residual = np.where(is_known, picture.value[c] - explained, 0.0)
            variance = np.where(is_known, picture.variance[c] + grid.ambient[c], 0.0)
            squares[k, c] = (residual**2).sum(dtype=np.float64)
            noise[k, c] = variance.sum(dtype=np.float64)
            noise_squares[k, c] = deviation_of_squares(variance.astype(np.float64)) ** 2
            energy[k, c] = (direct**2)[is_known].sum(dtype=np.float64)
            expected[k, c] = (V @ pattern.ravel())[is_known].sum(dtype=np.float64)
    tiny = np.finfo(float).tiny
    measured = np.maximum(squares - noise, 0.0)
    scales = measured.sum(axis=0) / np.maximum(expected.sum(axis=0), tiny)
    energy_of_judges = np.maximum(energy.sum(axis=1), tiny)
    of_judges = measured.sum(axis=1) / energy_of_judges
    error = math.nan
    bound = math.nan
    if len(judging):
        error = math.sqrt(of_judges.mean())
        bound = error_bound(error, np.sqrt(noise_squares.sum(axis=1)) / energy_of_judges)
    return DirectScan(
        channels=channels,
        scales=np.maximum(scales, LEAST_SCALE),
        errors=np.sqrt(of_judges),
        error=error,
        bound=bound,
        left_out=_left_out(grid, channels),
    )


def _left_out(grid: ScanGrid, channels: Sequence[DirectLight]) -> float:
    """Light under white less the row sums of D, relative to it, at the median pixel."""
    white = grid.white.value.sum(axis=0, dtype=np.float64)
    direct = np.sum([light.direct.sum(axis=1) for light in channels], axis=0)
    is_lit = grid.seen & grid.white.known.all(axis=0) & (white > 0)
    if grid.lit is not None:
        is_lit &= grid.lit.ravel()
    if not is_lit.any():
        return math.nan
    return float(np.median(1.0 - direct[is_lit] / white[is_lit]))


def finish(store: BlockStore, grid: ScanGrid, scanned: DirectScan, sigmas: float) -> None:
    """Make the sparse transport of a scan, which replaces its pictures in the store.

    Entries that are not `sigmas` standard deviations from 0 are left out.
    """
    matrices = []
    for light, scale in zip(scanned.channels, scanned.scales, strict=True):
        matrices.append(_significant(grid.grid, light, scale, sigmas))
    pixels = len(grid.seen)
    samples = [_entries(matrix, noise_step((pixels, pixels))) for matrix in matrices]
    noise = Noise.fit((pixels, pixels), samples, "acquired")
    for name, array in noise.to_arrays().items():
        store.extra(name, array)
    store.update(
        direct={
            "error": _number_or_none(scanned.error),
            "bound": _number_or_none(scanned.bound),
            "errors": scanned.errors.tolist(),
            "left_out": _number_or_none(scanned.left_out),
        }
    )
    store.finalize(sigmas=sigmas, matrices=matrices)


def _significant(
    grid: tuple[int, int], light: DirectLight, scale: float, sigmas: float
) -> SparseMatrix:
    """D of one channel without what is noise, and the variances of its entries."""
    variance = light.variance * scale
    keep = light.is_there & (light.direct**2 > sigmas**2 * variance)
    T = sparse_rows(grid, light.direct, keep)
    V = sparse_rows(grid, variance, keep)
    return SparseMatrix(T, V.data)


def _entries(matrix: SparseMatrix, step: int) -> list[tuple[np.ndarray, ...]]:
    """Rows, columns, light and variances of entries, as `Noise.fit` takes them.

    Of entries that were left out, which have no noise, some are with them: those that are a few
    times `step` columns away, between pixels with light. So sums over rows have the noise of the
    others alone.
    """
    T = matrix.matrix
    pixels = len(T.indptr) - 1
    row = np.repeat(np.arange(pixels), np.diff(T.indptr))
    parts = [(row, T.indices, T.data, matrix.variance)]
    stored = row * pixels + T.indices
    has_light = np.bincount(row, minlength=pixels) > 0
    is_seen = np.bincount(T.indices, minlength=pixels) > 0
    for distance in DISTANCES_WITHOUT_LIGHT:
        i = np.flatnonzero(has_light)
        j = i + distance * step
        is_inside = (j >= 0) & (j < pixels)
        i = i[is_inside]
        j = j[is_inside]
        is_empty = is_seen[j] & ~np.isin(i * pixels + j, stored)
        zeros = np.zeros(np.count_nonzero(is_empty))
        parts.append((i[is_empty], j[is_empty], zeros, zeros))
    return parts


def _number_or_none(value: float) -> float | None:
    """A number for JSON, which has no NaN."""
    return None if math.isnan(value) else value
