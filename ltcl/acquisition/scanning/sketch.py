# SPDX-License-Identifier: BSD-3-Clause
"""A sketch of T: pictures of some tens of patterns, from which all of T is estimated at once.

T is direct light, which is local, and light that bounces, which is smooth: each row is a sum of few
functions that widen with the distance from its pixel (`acquisition.estimation`). Their number
hardly grows with the pixels, so neither does that of the patterns that show them. These are on or
off, so that the curve of the projector does not matter. Of each scale s = 2^l there are

    stripes    Gray code: 0 1 1 0 of s rows or columns each, repeated; photographs of it that show
               the geometry are used again
    products   w(row / s) xor w'(column / s) of Walsh functions w and w' of four steps, repeated

Pictures of other kinds are photographed and never fitted (`judges`): the error of T p for them is
that of T. If it is too large, rounds of other patterns follow, each of which helps: squares at
random, of the scales that are unknown at each place (`refined_patterns`). Where nothing is known of
that, as after a nudge, they are patterns like nature, and blocks (`more_patterns`).

A picture that all others contradict is left out (`estimation.contradiction`); several are refused.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, overload

import cv2
import numpy as np
import scipy  # its subpackage stats is loaded at the first use

from ltcl.acquisition.estimation.contradiction import find_wrong_pictures
from ltcl.acquisition.estimation.estimator import Estimator
from ltcl.acquisition.estimation.pairs import Pairs
from ltcl.acquisition.estimation.refinement import RefinedEstimator, make_estimator
from ltcl.acquisition.scanning.picture_log import BATCH_SIZE, PictureLog
from ltcl.acquisition.scanning.pictures import KNOWN_VARIANCE, ScanGrid
from ltcl.acquisition.scanning.refined_patterns import refined_patterns
from ltcl.acquisition.scanning.sketch_pictures import SketchPictures
from ltcl.errors import ScanRefused
from ltcl.store import BlockStore, CompressedRecord

# Walsh functions of four steps, but the constant one.
WALSH = ((0, 0, 1, 1), (0, 1, 1, 0), (0, 1, 0, 1))
# Probability with which the error of other pictures is below the bound that is stated.
CONFIDENCE = 0.95
# Pictures that judge.
JUDGES = 8
# Fields of the checkerboard, and lit patches, along the shorter side.
CHECKERBOARD_FIELDS = 6
PATCH_SHARE = 8
# Squared light of a judge, relative to that of as many pixels of white, of which it must have more:
# a patch may lie where the projector lights nothing, and have no relative error.
MIN_JUDGE_LIGHT = 0.01
# Text is drawn so many times as large; letters of size 1 take so many rows, with their spacing.
TEXT_SCALE = 4
FONT_HEIGHT = 64
# Width of a stroke: thinner ones vanish where letters are drawn so many times as large.
MIN_STROKE = 2
SEED = 0
# Rounds at most, and by which share one must lower the error for another to follow.
MAX_ROUNDS = 24
LEAST_GAIN = 0.03
# Patterns of a round at least.
LEAST_PATTERNS = 4
# Pixels from which on there are patterns for rounds.
LEAST_PIXELS = 16
# Why a picture contradicts all others.
CAUSES = "another light was on, the exposure was another one, or something moved"

logger = logging.getLogger(__name__)


# Bits (h,) and (w,) of a pattern, which is their exclusive or.
Sides = tuple[np.ndarray, np.ndarray]


class PatternList(Sequence[np.ndarray]):
    """Patterns (h, w) of 0 and 1, float32, each of which is made of its sides when it is asked for.

    Those of 1920 x 1080 pixels would take a gigabyte. Pictures may follow them.
    """

    def __init__(self, sides: Sequence[Sides], pictures: Sequence[np.ndarray] = ()) -> None:
        self._items: list[Sides | np.ndarray] = [*sides, *pictures]

    def __len__(self) -> int:
        return len(self._items)

    @overload
    def __getitem__(self, number: int) -> np.ndarray: ...

    @overload
    def __getitem__(self, number: slice) -> list[np.ndarray]: ...

    def __getitem__(self, number: int | slice) -> np.ndarray | list[np.ndarray]:
        if isinstance(number, slice):
            return [self[place] for place in range(len(self))[number]]
        item = self._items[number]
        if isinstance(item, np.ndarray):
            return item
        down, across = item
        return np.bitwise_xor.outer(down, across).astype(np.float32)


def patterns(grid: tuple[int, int]) -> PatternList:
    """The patterns (h, w) of a sketch, of 0 and 1, coarse to fine.

    >>> len(patterns((4, 4))), len(patterns((64, 64)))
    (13, 53)
    """
    return PatternList(_sides(grid))


def stripes(grid: tuple[int, int]) -> PatternList:
    """Those of the patterns that are the bits of `geometry.GrayCode`, in its order.

    >>> len(stripes((64, 64)))
    12
    """
    return PatternList(_stripes(grid))


def patterns_to_take(grid: tuple[int, int], has_stripes: bool) -> PatternList:
    """The patterns that a sketch photographs, and those that judge it.

    Its calibration has photographed the stripes, or not.

    >>> len(patterns_to_take((64, 64), has_stripes=True))
    49
    """
    sides = _sides(grid)
    if has_stripes:
        known = {_key(bits) for bits in _stripes(grid)}
        sides = [bits for bits in sides if _key(bits) not in known]
    return PatternList(sides, judges(grid))


def _stripes(grid: tuple[int, int]) -> list[Sides]:
    """Bits of columns, coarse to fine, then those of rows."""
    row = np.arange(grid[0])
    column = np.arange(grid[1])
    sides = []
    for level in reversed(range((grid[1] - 1).bit_length())):
        sides.append((0 * row, _gray(column >> level)))
    for level in reversed(range((grid[0] - 1).bit_length())):
        sides.append((_gray(row >> level), 0 * column))
    return sides


def _key(bits: Sides) -> bytes:
    """Equal bits have equal keys."""
    return np.concatenate(bits).astype(np.uint8).tobytes()


def _sides(grid: tuple[int, int]) -> list[Sides]:
    """Bits of each pattern; the first of each is 0."""
    row = np.arange(grid[0])
    column = np.arange(grid[1])
    chosen: dict[bytes, Sides] = {}
    for level in reversed(range((max(grid) - 1).bit_length())):
        down = row >> level
        across = column >> level
        of_level = [(_gray(down), 0 * column), (0 * row, _gray(across))]
        for w in WALSH:
            for v in WALSH:
                of_level.append((np.take(w, down % 4), np.take(v, across % 4)))
        for of_rows, of_columns in of_level:
            # A complement shows the same, as white is known.
            bits = of_rows ^ of_rows[0], of_columns ^ of_columns[0]
            if bits[0].any() or bits[1].any():
                chosen.setdefault(_key(bits), bits)
    return list(chosen.values())


def _gray(number: np.ndarray) -> np.ndarray:
    """The lowest bit of the Gray code of numbers: 0 1 1 0, repeated."""
    return (number ^ (number >> 1)) & 1


def judges(grid: tuple[int, int]) -> list[np.ndarray]:
    """Pictures (h, w) of 0 and 1 that judge a sketch.

    They are two like nature (spectrum 1 / f), two areas with straight edges, text, a checkerboard
    and two lit patches.

    >>> len(judges((16, 16)))
    8
    """
    random = np.random.default_rng(SEED)
    pictures = [like_nature(grid, random) > 0 for _ in range(2)]
    pictures += [_half_plane(grid, angle) for angle in (0.4, 2.2)]
    pictures.append(text(grid))
    height, width = grid
    row, column = np.indices(grid)
    # No power of 2, which patterns have.
    field = max(3, min(grid) // CHECKERBOARD_FIELDS)
    pictures.append((row // field + column // field) % 2 == 1)
    side = max(1, min(grid) // PATCH_SHARE)
    for middle_row, middle_column in ((0.3, 0.35), (0.7, 0.6)):
        is_near_row = np.abs(row + 0.5 - middle_row * height) <= 0.5 * side
        is_near_column = np.abs(column + 0.5 - middle_column * width) <= 0.5 * side
        pictures.append(is_near_row & is_near_column)
    return [picture.astype(np.float32) for picture in pictures]


def like_nature(grid: tuple[int, int], random: np.random.Generator) -> np.ndarray:
    """Noise (h, w) whose amplitude falls as 1 / f, with mean 0."""
    frequency = np.hypot(
        *np.meshgrid(np.fft.fftfreq(grid[0]), np.fft.fftfreq(grid[1]), indexing="ij")
    )
    frequency[0, 0] = np.inf
    return np.fft.ifft2(np.fft.fft2(random.standard_normal(grid)) / frequency).real


def _half_plane(grid: tuple[int, int], angle: float) -> np.ndarray:
    height, width = grid
    row, column = np.indices(grid)
    across = (column + 0.5) / width - 0.5
    down = (row + 0.5) / height - 0.5
    return np.cos(angle) * across + np.sin(angle) * down > 0


def text(grid: tuple[int, int]) -> np.ndarray:
    """Letters over the whole picture.

    >>> bool(text((8, 24)).sum() > 20)
    True
    """
    height, width = grid
    rows = TEXT_SCALE * height
    columns = TEXT_SCALE * width
    picture = np.zeros((rows, columns), np.uint8)
    scale = rows / FONT_HEIGHT
    for line in range(2):
        place = (int(0.04 * columns), int((0.45 + 0.5 * line) * rows))
        cv2.putText(
            picture,
            "LIGHT"[line:],
            place,
            cv2.FONT_HERSHEY_SIMPLEX,
            scale,
            255,
            max(MIN_STROKE, int(3 * scale)),
        )
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA) > 127


def more_patterns(grid: tuple[int, int], number: int) -> list[np.ndarray]:
    """The patterns (h, w) of a round, of 0 and 1: half like nature, half of random blocks.

    Blocks are squares of 1, 2, 4 ... pixels, half of which are lit.

    >>> len(more_patterns((64, 64), 0))
    16
    """
    random = np.random.default_rng((SEED, 1 + number))
    shown = [like_nature(grid, random) > 0 for _ in range(BATCH_SIZE // 2)]
    sizes = max((min(grid) - 1).bit_length() - 1, 1)
    for place in range(BATCH_SIZE - len(shown)):
        shown.append(_random_blocks(grid, place % sizes, random))
    return [picture.astype(np.float32) for picture in shown]


def _random_blocks(grid: tuple[int, int], level: int, random: np.random.Generator) -> np.ndarray:
    """Squares of 2^level pixels, half of which are lit; the first ones are cut at random."""
    row, column = np.indices(grid)
    size = 1 << level
    down, across = random.integers(0, size, 2)
    rows = (grid[0] - 1 + down >> level) + 1
    columns = (grid[1] - 1 + across >> level) + 1
    is_lit = random.permutation(rows * columns) < rows * columns // 2
    block = (row + down >> level) * columns + (column + across >> level)
    return is_lit[block]


def count_patterns(grid: tuple[int, int]) -> int:
    """Patterns of a sketch, with those that judge it."""
    return len(_sides(grid)) + JUDGES


def count_stripes(grid: tuple[int, int]) -> int:
    """Patterns that are bits of Gray code."""
    return len(_stripes(grid))


def most_patterns(grid: tuple[int, int], rounds: int = 0, stripes: int = 0) -> int:
    """Number of patterns that no sketch of so many rounds exceeds, in whole batches.

    `stripes` are those that the calibration has photographed.
    """
    batches = rounds
    for patterns in (stripes, count_patterns(grid) - stripes):
        batches += -(-patterns // BATCH_SIZE)
    return BATCH_SIZE * batches


def photographs_of_round(exposures: int, patterns: int = BATCH_SIZE) -> int:
    """Photographs of a round; a batch ends with one that was taken before."""
    return exposures * patterns + 1


def round_sizes(
    photographs: int | None, rtol: float | None, first: int, exposures: int
) -> list[int]:
    """Patterns of each round within some photographs; set-up and first patterns take `first`.

    The last round has as many as there are photographs left.

    >>> round_sizes(150, None, 98, 1), round_sizes(145, None, 98, 1), round_sizes(None, None, 98, 1)
    ([16, 16, 16], [16, 16, 12], [])
    """
    if photographs is None:
        return [] if rtol is None else MAX_ROUNDS * [BATCH_SIZE]
    sizes: list[int] = []
    left = photographs - first
    while len(sizes) < MAX_ROUNDS:
        patterns = min((left - 1) // exposures, BATCH_SIZE)
        if patterns < LEAST_PATTERNS:
            break
        sizes.append(patterns)
        left -= photographs_of_round(exposures, patterns)
    return sizes


@dataclass(frozen=True, kw_only=True)
class Rounds:
    """The rounds by which a sketch goes on after its first patterns.

    Attributes
    ----------
    sizes : sequence of int
        Patterns of each round.
    rtol : float, optional
        Error of the judges that is small enough; None: all rounds are taken.
    """

    sizes: Sequence[int] = ()
    rtol: float | None = None

    def go_on(self, errors: list[float]) -> bool:
        """True if another round follows, given the errors after the first patterns and each round.

        >>> rounds = Rounds(sizes=[16, 16, 9], rtol=0.01)
        >>> rounds.go_on([0.03, 0.02]), rounds.go_on([0.009])
        (True, False)
        """
        if len(errors) > len(self.sizes):
            return False
        if self.rtol is None:
            return True
        if errors[-1] <= self.rtol:
            return False
        return len(errors) < 2 or errors[-1] < (1.0 - LEAST_GAIN) * errors[-2]


@dataclass(frozen=True, kw_only=True)
class Sketch:
    """T of a sketch, and what the judges say.

    Attributes
    ----------
    arrays : dict
        Those of the compressed transport (`ltcl.transport`).
    own_variance : (channels, N)
        Variance of the light of each pixel's own.
    errors : (judges,)
        Error of T p relative to the photograph of each judge, less the noise of the camera.
    error : float
        Their root mean square.
    bound : float
        What that of other pictures is below, with a probability of 95 %.
    wrong_patterns : list of int
        Numbers of patterns, from 1 on, whose pictures contradict all others.
    """

    arrays: dict[str, np.ndarray]
    own_variance: np.ndarray
    errors: np.ndarray
    error: float
    bound: float
    wrong_patterns: list[int]


def scan(
    grid: ScanGrid,
    log: PictureLog,
    progress: Callable[[str, int, int], object] | None = None,
    rounds: Rounds | None = None,
    stripes_by: Sequence[str] = (),
) -> Sketch:
    """Photograph the patterns and the judges, and estimate T.

    `log` takes the pictures, or has those of an earlier run; `progress` is called with "fit", rows
    that are done, and all; `rounds` of other patterns follow if it says so. `stripes_by` are names
    of the photographs of stripes, if the log begins with them.
    """
    if rounds is None or math.prod(grid.grid) < LEAST_PIXELS:
        rounds = Rounds()
    pictures = SketchPictures(grid, log)
    if stripes_by:
        pictures.take(stripes(grid.grid))
        log.name_photographs(stripes_by)
    shown = patterns_to_take(grid.grid, has_stripes=bool(stripes_by))
    log.announce(shown)
    pictures.take(shown, JUDGES)
    estimate = _estimate(grid, pictures, progress)
    errors = [estimate.error]
    while rounds.go_on(errors) and log.can_take:
        number = len(errors)
        size = rounds.sizes[number - 1]
        shown = _patterns_of_round(grid.grid, log, estimate.estimator, number, size)
        log.announce(shown)
        pictures.take(shown)
        estimate = _estimate(grid, pictures, progress)
        errors.append(estimate.error)
        logger.info("round %d: error of T p %.2f %%", number, 100 * estimate.error)
    # Once, not in each round.
    _warn_of_wrong(estimate.wrong_patterns, log.names)
    return estimate.sketch()


def _patterns_of_round(
    grid: tuple[int, int],
    log: PictureLog,
    estimator: Estimator | RefinedEstimator,
    number: int,
    size: int,
) -> list[np.ndarray]:
    """The patterns of a round: each place is divided at the scales that are unknown there.

    They are kept with the pictures, since an estimate that is rounded in another way, on another
    machine, would make others, and so would another number of photographs.
    """

    def make() -> np.ndarray:
        shown = refined_patterns(estimator.unknown_light(), size, (SEED, number))
        return np.packbits(np.array(shown, bool), axis=2)

    bits = np.unpackbits(log.keep(f"round_{number}", make), axis=2, count=grid[1])
    return list(bits.astype(np.float32))


def _estimate(
    grid: ScanGrid,
    pictures: SketchPictures,
    progress: Callable[[str, int, int], object] | None,
) -> _Estimate:
    """Estimate T from all pictures but those that judge it, and judge it."""
    known_mixing = _known_mixing(grid.calibration.mixing, grid.channels)
    pairs = pictures.pairs()
    judging = pictures.judging
    fitted = pairs.select(slice(0, judging[0]))

    def learn(wrong: list[int]) -> Estimator | RefinedEstimator:
        estimator = make_estimator(grid.grid, grid.channels, known_mixing, progress)
        wrong_fitted = [number for number in wrong if number < len(fitted)]
        estimator.learn(fitted.without(wrong_fitted))
        return estimator

    white = _squared_light(pairs.select(slice(0, 1)))

    def judge(wrong: list[int], estimator: Estimator | RefinedEstimator) -> _Estimate:
        judges_left = pairs.select(np.setdiff1d(judging, wrong))
        wrong_patterns = [pictures.numbers[number] for number in wrong]
        return _judged(estimator, judges_left, white, wrong_patterns)

    def error_without(wrong: list[int], estimator: Estimator | RefinedEstimator) -> float:
        return judge(wrong, estimator).error

    wrong, estimator = find_wrong_pictures(pairs, learn, error_without)
    _refuse_several(wrong, pictures.names)
    return judge(wrong, estimator)


def _refuse_several(wrong: Sequence[int], names: Sequence[str]) -> None:
    """Refuse several pictures that contradict all others."""
    if len(wrong) > 1:
        pictures = " and of ".join(names[number - 1] for number in wrong)
        raise ScanRefused(
            f"the pictures of {pictures}, of {len(names)} patterns, contradict all others: "
            f"{CAUSES}; the scan must be repeated"
        )


def _warn_of_wrong(wrong: Sequence[int], names: Sequence[str]) -> None:
    """Warn of a picture that contradicts all others, and is left out."""
    for number in wrong:
        logger.warning(
            "the picture of %s, of %d patterns, contradicts all others, and is left out: %s",
            names[number - 1],
            len(names),
            CAUSES,
        )


def _known_mixing(mixing: np.ndarray | None, channels: int) -> np.ndarray:
    if mixing is None:
        return np.eye(channels)
    return mixing


@dataclass(frozen=True, kw_only=True)
class _Estimate:
    """T as it is estimated, and how it was judged.

    `squares` are those of the relative errors of the judges, `deviations` theirs by noise, and
    `scales` the factors of the variances of T by which they explain these.
    """

    estimator: Estimator | RefinedEstimator
    squares: np.ndarray
    deviations: np.ndarray
    scales: np.ndarray
    wrong_patterns: list[int]

    @property
    def error(self) -> float:
        """The root mean square of the errors of the judges."""
        return math.sqrt(self.squares.mean())

    def sketch(self) -> Sketch:
        """The transport, with what the judges say."""
        return Sketch(
            arrays=self.estimator.arrays(self.scales),
            own_variance=self.estimator.own_variance() * self.scales[:, None],
            errors=np.sqrt(self.squares),
            error=self.error,
            bound=error_bound(self.error, self.deviations),
            wrong_patterns=self.wrong_patterns,
        )


def is_lit_judge(pattern: np.ndarray, light: float, white: float) -> bool:
    """True if a picture of a pattern has light; squared ones are those of it and of white.

    Letters vanish in a picture of few rows, and a patch where the projector lights nothing.
    """
    return light > MIN_JUDGE_LIGHT * white * float(np.mean(pattern))


def _squared_light(pair: Pairs) -> float:
    """The sum of squares of the known light of a picture."""
    variance: Any = pair.variance
    light = np.where(variance < KNOWN_VARIANCE, pair.photographs, 0.0).astype(np.float64)
    return float((light**2).sum())


def _judged(
    estimator: Estimator | RefinedEstimator,
    pairs: Pairs,
    white: float,
    wrong_patterns: list[int],
) -> _Estimate:
    """The error of an estimator for pairs that it has not seen; `white` is its squared light."""
    squares = np.zeros(len(pairs))
    deviations = np.zeros(len(pairs))
    is_lit = np.zeros(len(pairs), bool)
    residual_squares = np.zeros(estimator.channels)
    for number in range(len(pairs)):
        judge = pairs.select(slice(number, number + 1))
        variance: Any = judge.variance
        is_known = variance < KNOWN_VARIANCE
        explained = estimator.explain(judge.patterns)
        unexplained = np.where(is_known, judge.photographs - explained, 0.0)
        of_channels = (unexplained**2).sum(axis=(0, 1))
        noise = np.where(is_known, variance, 0.0).astype(np.float64)
        energy = max(_squared_light(judge), np.finfo(float).tiny)
        squares[number] = max(of_channels.sum() - noise.sum(), 0.0) / energy
        deviations[number] = deviation_of_squares(noise) / energy
        is_lit[number] = is_lit_judge(judge.patterns, energy, white)
        residual_squares += of_channels
    return _Estimate(
        estimator=estimator,
        squares=squares[is_lit],
        deviations=deviations[is_lit],
        scales=estimator.scale_of_variance(pairs.patterns, residual_squares),
        wrong_patterns=wrong_patterns,
    )


def deviation_of_squares(variance: np.ndarray) -> float:
    """Standard deviation of the sum of squares of noise of these variances."""
    return math.sqrt(2.0 * float((variance**2).sum()))


def error_bound(error: float, deviations: np.ndarray) -> float:
    """Bound of the error of other pictures, by the root mean square of that of some judges.

    `deviations` (judges,) are those of the squared relative errors by noise: an error that is lost
    in noise is not 0.
    """
    judges = len(deviations)
    by_judges = error**2 * judges / scipy.stats.chi2.ppf(1.0 - CONFIDENCE, judges)
    mean_deviation = float(np.linalg.norm(deviations)) / judges
    return math.sqrt(by_judges + scipy.stats.norm.ppf(CONFIDENCE) * mean_deviation)


def finish(store: BlockStore, sketch: Sketch) -> None:
    """Make the compressed transport of a sketch, which replaces its pictures in the store."""
    store.extra("own_variance", sketch.own_variance)
    store.update(
        sketch={
            "error": sketch.error,
            "bound": sketch.bound,
            "errors": sketch.errors.tolist(),
            "wrong_patterns": sketch.wrong_patterns,
        }
    )
    store.finalize(compressed=CompressedRecord(sketch.arrays))
