# SPDX-License-Identifier: BSD-3-Clause
"""Which photographs of a calibration explain that some contradict each other.

Comparisons are of photographs, or sums of them, that should show the same light:

    pattern   photographs of one pattern at any exposures
    sums      a pattern and its inverse, at one exposure
    white     white, these sums less black, and uniform codes, black and white stretched to white's

An explanation is one photograph, without which all comparisons agree; or a change from one
photograph on, if all before it agree, and all from it on; or two neighbours, without which all
agree. It names all that would do.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

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
# Most photographs that an explanation names.
MAX_NAMED = 4
# Different codes of a photograph, at least, that tell its bits, and the bits that all lack.
MIN_CODES = 8
MIN_TRAILING_ZEROS = 2


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Light that should be the same, and the numbers of the photographs behind each row of it."""

    light: LinearLight
    numbers: Sequence[tuple[int, ...]]


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """Numbers of photographs any of which explains all contradictions.

    `single` ones deviate alone; from one of `changes` on the others deviate; `pairs` are the first
    of two neighbours that deviate together.
    """

    single: tuple[int, ...]
    changes: tuple[int, ...]
    pairs: tuple[int, ...]

    def describe(self, name: PhotographName) -> str | None:
        """The explanation in words; None if there is none, or too many photographs explain it."""
        single = self.single
        changes = tuple(k for k in self.changes if k not in single)
        if self.pairs and len(self.pairs) < MAX_NAMED:
            names = [f"{name(k)} and {name(k + 1)}" for k in self.pairs]
            return f"{', or '.join(names)} deviate: they are exchanged, or of other patterns"
        if len(single) > MAX_NAMED:
            return None
        texts = []
        if single:
            names = [name(k) for k in single]
            texts.append(f"{' or '.join(names)} deviates")
        if changes:
            first, last = changes[0], changes[-1]
            is_range = last - first + 1 == len(changes) and first < last
            if first == last:
                where = f"{name(first)} and those after it deviate"
            elif is_range:
                where = f"from one of photographs {first} to {last} on, they deviate"
            elif len(changes) <= MAX_NAMED:
                where = f"from {' or '.join(map(name, changes))} on, they deviate"
            else:
                where = f"from one of {name(first)} to {name(last)} on, they deviate"
            texts.append(f"{where}: the camera or scene moved, or the light changed")
        if not texts:
            return None
        return "; or ".join(texts)


class Contradictions:
    """Comparisons of the photographs of a calibration."""

    def __init__(self, photographs: Sequence[RecordedPhotograph], camera: CameraModel) -> None:
        self.numbers = [photograph.number for photograph in photographs]
        self._agreement: dict[tuple[int, tuple[int, ...]], bool] = {}
        self.comparisons = _pattern_comparisons(photographs, camera)
        pairs = _inverse_pairs(photographs)
        self.comparisons += _sum_comparisons(pairs, camera)
        self.comparisons += _white_comparisons(photographs, pairs, camera)

    def explain(self) -> Explanation:
        """Find what explains all contradictions."""
        single = [k for k in self.numbers if self._agree_without({k})]
        changes = [k for k in self.numbers[1:] if self._agree_around(k)]
        pairs = []
        if not single and not changes:
            pairs = [k for k in self.numbers[:-1] if self._agree_without({k, k + 1})]
        return Explanation(single=tuple(single), changes=tuple(changes), pairs=tuple(pairs))

    def _agree_without(self, wrong: set[int]) -> bool:
        return self._agree_where(wrong.isdisjoint)

    def _agree_around(self, change: int) -> bool:
        return self._agree_where(lambda numbers: max(numbers) < change) and self._agree_where(
            lambda numbers: min(numbers) >= change
        )

    def _agree_where(self, is_chosen: Callable[[tuple[int, ...]], bool]) -> bool:
        """True if all comparisons of chosen rows agree."""
        for place, comparison in enumerate(self.comparisons):
            rows = [row for row, numbers in enumerate(comparison.numbers) if is_chosen(numbers)]
            key = place, tuple(rows)
            if key not in self._agreement:
                self._agreement[key] = len(rows) < 2 or comparison.light.select(rows).agrees()
            if not self._agreement[key]:
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
            light = _linear_light(group, camera)
            numbers = [(photograph.number,) for photograph in group]
            comparisons.append(Comparison(light=light, numbers=numbers))
    return comparisons


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
            light = _sums(group, camera)
            numbers = [(first.number, second.number) for first, second in group]
            comparisons.append(Comparison(light=light, numbers=numbers))
    return comparisons


def _sums(pairs: Sequence[Pair], camera: CameraModel) -> LinearLight:
    """Light of patterns and of their inverses together."""
    patterns = [first for first, _ in pairs]
    inverses = [second for _, second in pairs]
    both = _linear_light([*patterns, *inverses], camera)
    count = len(pairs)
    return both.select(range(count)).plus(both.select(range(count, 2 * count)))


def _white_comparisons(
    photographs: Sequence[RecordedPhotograph], pairs: Sequence[Pair], camera: CameraModel
) -> list[Comparison]:
    """White, sums of patterns and inverses less black, and uniform codes."""
    whites = [photograph for photograph in photographs if photograph.uniform == 1.0]
    blacks: dict[float, list[RecordedPhotograph]] = defaultdict(list)
    for photograph in photographs:
        if photograph.uniform == 0.0:
            blacks[photograph.seconds].append(photograph)
    if not whites:
        return []
    white = _median_radiance(whites, camera)
    parts = [_linear_light(whites, camera, white)]
    numbers: list[tuple[int, ...]] = [(photograph.number,) for photograph in whites]
    for seconds, dark in blacks.items():
        black = seconds * _median_radiance(dark, camera)
        group = [pair for pair in pairs if pair[0].seconds == seconds]
        group = [pair for pair in group if pair[0].uniform is None]
        if group:
            parts.append(_sums_less_black(group, camera, white, black))
            numbers += [(first.number, second.number) for first, second in group]
        for photograph in photographs:
            if photograph.seconds == seconds and 0.0 < (photograph.uniform or 0.0) < 1.0:
                light = _stretched(photograph, camera, white, black)
                if light is not None:
                    parts.append(light)
                    numbers.append((photograph.number,))
    return [Comparison(light=LinearLight.joined(parts), numbers=numbers)]


def _median_radiance(group: Sequence[RecordedPhotograph], camera: CameraModel) -> np.ndarray:
    """Median radiance (n, c) of photographs where they are not saturated; 0 without any."""
    light = _linear_light(group, camera)
    radiance = light.value / light.seconds
    count = np.isfinite(radiance).sum(axis=0)
    # Saturated values are inf, and last.
    ordered = np.sort(radiance, axis=0)
    middle = np.maximum(count - 1, 0) // 2
    median = np.take_along_axis(ordered, middle[None], axis=0)[0]
    return np.where(count > 0, median, 0.0)


def _sums_less_black(
    pairs: Sequence[Pair], camera: CameraModel, white: np.ndarray, black: np.ndarray
) -> LinearLight:
    """Light of patterns and inverses without that of black: as white is."""
    patterns = [first for first, _ in pairs]
    inverses = [second for _, second in pairs]
    first = _linear_light(patterns, camera, white)
    second = _linear_light(inverses, camera, white)
    total = first.plus(second)
    return replace(total, value=total.value - black)


def _stretched(
    photograph: RecordedPhotograph, camera: CameraModel, white: np.ndarray, black: np.ndarray
) -> LinearLight | None:
    """Light of a uniform code as if it were white's; None without enough."""
    light = _linear_light([photograph], camera, white)
    full = photograph.seconds * white - black
    part = light.value[0] - black
    shares = []
    for c in range(full.shape[1]):
        bright = full[:, c] >= BRIGHT_SHARE * np.quantile(full[:, c], 0.99)
        bright &= np.isfinite(part[:, c])
        if not bright.any():
            return None
        shares.append(np.median(part[bright, c] / np.maximum(full[bright, c], 1e-9)))
    share = np.array(shares)
    if share.min() < MIN_UNIFORM_SHARE:
        return None
    unevenness = (PROJECTOR_UNEVENNESS * full) ** 2
    return replace(
        light,
        value=(black + part / share)[None],
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
        """This in words."""
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
    first = len(is_coarse) - int(np.argmin(is_coarse[::-1])) if len(is_coarse) else 0
    if first == 0 or first == len(is_coarse) or is_coarse[:first].any():
        return None
    zeros = min(trailing_zeros[first:])
    bits = (levels - 1).bit_length() - zeros
    return FewerBits(first=numbers[first], bits=bits)
