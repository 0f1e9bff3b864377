# SPDX-License-Identifier: BSD-3-Clause
"""Which photographs of a calibration explain that some contradict each other.

Comparisons are of photographs, or sums of them, that should show the same light:

    pattern   photographs of one pattern at any exposures
    sums      a pattern and its inverse, at one exposure
    white     white, these sums less black, and uniform codes, black and white stretched to white's

An explanation is one photograph, without which all comparisons agree; or a change from one
photograph on, if all before it agree, and all from it on; or two neighbours, without which all
agree; or a missing one, if all agree where the next ones have moved up. It names all that would do.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np

from ltcl.acquisition.agreement import (
    BRIGHT_SHARE,
    CameraModel,
    LinearLight,
    PhotographName,
    RecordedPhotograph,
)

# Relative deviation of a projector's curve from pixel to pixel that is allowed.
PROJECTOR_UNEVENNESS = 0.1
# Least part of the light of white in a uniform code that is compared.
MIN_UNIFORM_SHARE = 0.02
# Most light of black, relative to white, that is subtracted from sums.
MAX_BLACK_SHARE = 0.5
# Score up to which light agrees: 1 for a single comparison, and more where one of many leaves a
# little to chance; and after a change, which may have come with less noise, as JPEG does, by which
# that of the camera was measured.
MAX_SCORE = 1.2
MAX_SCORE_AFTER = 2.0
# Most photographs that an explanation names.
MAX_NAMED = 4
# Different codes of a photograph, at least, that tell its bits, and the bits that all lack.
MIN_CODES = 8
MIN_TRAILING_ZEROS = 2


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Light that should be the same, and the numbers of the photographs behind each row of it.

    `select` gives some rows of it: the noise of each follows from the mean of these.
    """

    select: Callable[[Sequence[int]], LinearLight]
    numbers: Sequence[tuple[int, ...]]

    def score(self, rows: Sequence[int]) -> float:
        """Largest score of some rows, which agree up to 1."""
        if len(rows) < 2:
            return 0.0
        return float(self.select(rows).scores().max())


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """Numbers of photographs any of which explains all contradictions.

    `single` ones deviate alone; from one of `changes` on the others deviate; `pairs` are the first
    of two neighbours that deviate together; one of `missing` is missing, and the next ones have
    moved up.
    """

    single: tuple[int, ...]
    changes: tuple[int, ...]
    pairs: tuple[int, ...]
    missing: tuple[int, ...] = ()

    @property
    def suspects(self) -> set[int]:
        """Photographs that deviate alone, or from which on others do."""
        return {*self.single, *self.changes}

    def describe(self, name: PhotographName) -> str | None:
        """The explanation in words; None if there is none, or too many photographs explain it."""
        if len(self.single) > MAX_NAMED or len(self.pairs) > MAX_NAMED // 2:
            return None
        if self.pairs:
            names = [f"{name(k)} and {name(k + 1)}" for k in self.pairs]
            return f"{', or '.join(names)} deviate: they are exchanged, or show other patterns"
        if self.missing:
            first = self.missing[0]
            last = self.missing[-1]
            subject = name(first)
            if first != last:
                subject = f"one of photographs {first} to {last}"
            return f"{subject} is missing, and the next ones have moved up by one"
        texts = []
        if self.single:
            names = [name(k) for k in self.single]
            texts.append(
                f"{' or '.join(names)} deviates from others of the same light: another pattern, "
                "another light, or another exposure"
            )
        changes = [k for k in self.changes if k not in self.single]
        if changes:
            where = self._describe_changes(changes, name)
            texts.append(f"{where}: the camera or scene moved, or the light changed")
        if not texts:
            return None
        return "; or ".join(texts)

    def _describe_changes(self, changes: Sequence[int], name: PhotographName) -> str:
        """The photographs from one of which on the others deviate."""
        first = changes[0]
        last = changes[-1]
        if len(changes) == 1:
            return f"{name(first)} and those after it deviate"
        if len(changes) > MAX_NAMED:
            return (
                f"{name(last)} and those after it deviate, and perhaps some of photographs {first} "
                f"to {last - 1}"
            )
        if last - first + 1 == len(changes):
            return f"photographs deviate from one of photographs {first} to {last} on"
        return f"photographs deviate from {' or '.join(map(name, changes))} on"


class Contradictions:
    """Comparisons of the photographs of a calibration."""

    def __init__(self, photographs: Sequence[RecordedPhotograph], camera: CameraModel) -> None:
        self.photographs = photographs
        self.camera = camera
        self.numbers = [photograph.number for photograph in photographs]
        self._scores: dict[tuple[int, tuple[int, ...]], float] = {}
        self.comparisons = _pattern_comparisons(photographs, camera)
        pairs = _inverse_pairs(photographs)
        self.comparisons += _sum_comparisons(pairs, camera)
        self.comparisons += _white_comparisons(photographs, pairs, camera)

    def explain(self) -> Explanation:
        """Find what explains all contradictions: nothing if there are none beyond doubt."""
        if self._agree_without(set()):
            return Explanation(single=(), changes=(), pairs=())
        single = [k for k in self.numbers if self._agree_without({k})]
        changes = [k for k in self.numbers[1:] if self._agree_around(k)]
        pairs = []
        if not single and not changes:
            pairs = [k for k in self.numbers[:-1] if self._agree_without({k, k + 1})]
        missing: list[int] = []
        if not single and not changes and not pairs:
            missing = [k for k in self.numbers[:-1] if self._agree_if_missing(k)]
        return Explanation(
            single=tuple(single),
            changes=tuple(changes),
            pairs=tuple(pairs),
            missing=tuple(missing),
        )

    def _agree_if_missing(self, number: int) -> bool:
        """True if all agree where photographs from a number on are those after them in the list."""
        moved = []
        for photograph, following in pairwise(self.photographs):
            if photograph.number < number:
                moved.append(photograph)
            else:
                moved.append(replace(following, sample=photograph.sample, number=photograph.number))
        return Contradictions(moved, self.camera)._agree_without(set())

    def _agree_without(self, wrong: set[int]) -> bool:
        return self._agree_where(wrong.isdisjoint, MAX_SCORE)

    def _agree_around(self, change: int) -> bool:
        """True if photographs before a number agree, and those from it on do."""
        if not self._agree_where(lambda numbers: max(numbers) < change, MAX_SCORE):
            return False
        return self._agree_where(lambda numbers: min(numbers) >= change, MAX_SCORE_AFTER)

    def _agree_where(self, is_chosen: Callable[[tuple[int, ...]], bool], max_score: float) -> bool:
        """True if all comparisons of chosen rows agree."""
        for place, comparison in enumerate(self.comparisons):
            rows = [row for row, numbers in enumerate(comparison.numbers) if is_chosen(numbers)]
            key = place, tuple(rows)
            if key not in self._scores:
                self._scores[key] = comparison.score(rows)
            if self._scores[key] > max_score:
                return False
        return True


def _pattern_comparisons(
    photographs: Sequence[RecordedPhotograph], camera: CameraModel
) -> list[Comparison]:
    """Photographs of each pattern."""
    groups: dict[str, list[RecordedPhotograph]] = defaultdict(list)
    for photograph in photographs:
        groups[photograph.pattern].append(photograph)
    comparisons = []
    for group in groups.values():
        if len(group) > 1:
            numbers = [(photograph.number,) for photograph in group]
            comparison = Comparison(
                select=partial(_light_of_pattern, group, camera), numbers=numbers
            )
            comparisons.append(comparison)
    return comparisons


def _light_of_pattern(
    group: Sequence[RecordedPhotograph], camera: CameraModel, rows: Sequence[int]
) -> LinearLight:
    """Light of some photographs of a pattern."""
    return _linear_light([group[row] for row in rows], camera)


def _linear_light(
    group: Sequence[RecordedPhotograph], camera: CameraModel, radiance: np.ndarray | None = None
) -> LinearLight:
    samples = [photograph.sample for photograph in group]
    seconds = [photograph.seconds for photograph in group]
    return LinearLight.from_samples(samples, seconds, camera, radiance)


Pair = tuple[RecordedPhotograph, RecordedPhotograph]


def _inverse_pairs(photographs: Sequence[RecordedPhotograph]) -> list[Pair]:
    """Patterns with the next photographs of their inverses at the same exposure."""
    waiting: dict[tuple[str, float], RecordedPhotograph] = {}
    pairs = []
    for photograph in photographs:
        if photograph.inverse is None:
            continue
        partner = waiting.pop((photograph.inverse, photograph.seconds), None)
        if partner is None:
            waiting[photograph.pattern, photograph.seconds] = photograph
        else:
            pairs.append((partner, photograph))
    return pairs


def _sum_comparisons(pairs: Sequence[Pair], camera: CameraModel) -> list[Comparison]:
    """Sums of patterns and inverses, at each exposure."""
    groups: dict[float, list[Pair]] = defaultdict(list)
    for pair in pairs:
        groups[pair[0].seconds].append(pair)
    comparisons = []
    for group in groups.values():
        if len(group) > 1:
            numbers = [(first.number, second.number) for first, second in group]
            comparison = Comparison(select=partial(_sums, group, camera), numbers=numbers)
            comparisons.append(comparison)
    return comparisons


def _sums(pairs: Sequence[Pair], camera: CameraModel, rows: Sequence[int]) -> LinearLight:
    """Light of some patterns and of their inverses together."""
    patterns = [pairs[row][0] for row in rows]
    inverses = [pairs[row][1] for row in rows]
    both = _linear_light([*patterns, *inverses], camera)
    count = len(rows)
    return both.select(range(count)).plus(both.select(range(count, 2 * count)))


def _white_comparisons(
    photographs: Sequence[RecordedPhotograph], pairs: Sequence[Pair], camera: CameraModel
) -> list[Comparison]:
    """White, sums of patterns and inverses less black, and uniform codes."""
    blacks: dict[float, list[RecordedPhotograph]] = defaultdict(list)
    for photograph in photographs:
        if photograph.uniform == 0.0:
            blacks[photograph.seconds].append(photograph)
    # Long exposures are compared with others of white alone: errors of black show in them.
    shortest = min(blacks, default=0.0)
    whites = []
    for photograph in photographs:
        if photograph.uniform == 1.0 and photograph.seconds <= shortest:
            whites.append(photograph)
    if not whites:
        return []
    rough = _median_radiance(_linear_light(whites, camera))
    black = {}
    for seconds, dark in blacks.items():
        radiance = _median_radiance(_linear_light(dark, camera))
        # Otherwise black may be what is wrong, and sums less black tell nothing.
        if radiance.mean() < MAX_BLACK_SHARE * rough.mean():
            black[seconds] = seconds * radiance
    stripes = [pair for pair in pairs if pair[0].uniform is None and pair[0].seconds in black]
    numbers: list[tuple[int, ...]] = [(photograph.number,) for photograph in whites]
    numbers += [(first.number, second.number) for first, second in stripes]

    # Many sums outvote a photograph of white that is wrong.
    white = _median_radiance(_full_light(whites, stripes, camera, rough, black))
    parts = [_full_light(whites, stripes, camera, white, black)]
    for photograph in photographs:
        code = photograph.uniform
        if code is not None and 0.0 < code < 1.0 and photograph.seconds in black:
            light = _stretched(photograph, camera, white, black[photograph.seconds])
            if light is not None:
                parts.append(light)
                numbers.append((photograph.number,))
    return [Comparison(select=LinearLight.joined(parts).select, numbers=numbers)]


def _full_light(
    whites: Sequence[RecordedPhotograph],
    stripes: Sequence[Pair],
    camera: CameraModel,
    white: np.ndarray,
    black: Mapping[float, np.ndarray],
) -> LinearLight:
    """Light of white, then that of pairs of stripes less black, whose noise is that of white."""
    parts = [_linear_light(whites, camera, white)]
    for first, second in stripes:
        both = _linear_light([first, second], camera, white)
        total = both.select([0]).plus(both.select([1]))
        parts.append(replace(total, value=total.value - black[first.seconds]))
    return LinearLight.joined(parts)


def _median_radiance(light: LinearLight) -> np.ndarray:
    """Median radiance (n, c) of photographs where they are not saturated; 0 without any."""
    radiance = light.value / light.seconds
    count = np.isfinite(radiance).sum(axis=0)
    # Saturated values are inf, and last.
    ordered = np.sort(radiance, axis=0)
    middle = np.maximum(count - 1, 0) // 2
    median = np.take_along_axis(ordered, middle[None], axis=0)[0]
    return np.where(count > 0, median, 0.0)


def _stretched(
    photograph: RecordedPhotograph, camera: CameraModel, white: np.ndarray, black: np.ndarray
) -> LinearLight | None:
    """Light of a uniform code as if it were white's; None without enough."""
    light = _linear_light([photograph], camera, white)
    full = photograph.seconds * white - black
    lit = light.value[0] - black
    shares = []
    for c in range(full.shape[1]):
        bright = full[:, c] >= BRIGHT_SHARE * np.quantile(full[:, c], 0.99)
        bright &= np.isfinite(lit[:, c])
        if not bright.any():
            return None
        shares.append(np.median(lit[bright, c] / np.maximum(full[bright, c], 1e-9)))
    share = np.array(shares)
    if share.min() < MIN_UNIFORM_SHARE:
        return None
    unevenness = (PROJECTOR_UNEVENNESS * full) ** 2
    return replace(
        light,
        value=(black + lit / share)[None],
        variance=light.variance / share**2 + unevenness,
        limit=np.full(light.limit.shape, np.inf),
        bias=light.bias / share,
        dim_bias=light.dim_bias / share,
        clipping=light.clipping / share,
    )


@dataclass(frozen=True, kw_only=True)
class FewerBits:
    """Number of the first photograph from which on codes have fewer bits, and these bits."""

    first: int
    bits: int

    def describe(self, name: PhotographName) -> str:
        """Describe it in words."""
        return (
            f"{name(self.first)} and those after it have codes of {self.bits} bits alone, as JPEG "
            "has, and those before it more: all must be stored alike"
        )


def first_of_fewer_bits(
    photographs: Sequence[RecordedPhotograph], levels: int | None
) -> FewerBits | None:
    """Find from which photograph on all codes are multiples of at least 4, unlike those before."""
    if levels is None:
        return None
    trailing_zeros = []
    numbers = []
    for photograph in photographs:
        codes = np.unique(np.rint(photograph.sample * (levels - 1)).astype(np.int64))
        # Saturated pixels have the last code, and a single code tells nothing.
        codes = codes[(codes > 0) & (codes < levels - 1)]
        if len(codes) >= MIN_CODES:
            union = int(np.bitwise_or.reduce(codes))
            trailing_zeros.append((union & -union).bit_length() - 1)
            numbers.append(photograph.number)
    is_coarse = np.array(trailing_zeros) >= MIN_TRAILING_ZEROS
    if is_coarse.all() or not is_coarse.any():
        return None
    first = int(is_coarse.argmax())
    if not is_coarse[first:].all():
        return None
    zeros = min(trailing_zeros[first:])
    bits = (levels - 1).bit_length() - zeros
    return FewerBits(first=numbers[first], bits=bits)
