# SPDX-License-Identifier: BSD-3-Clause
"""Pairs of a pattern and its photograph, and what can be wrong with them.

order        the photographs of a film begin a few frames late, or two of them are swapped
saturation   pixels at the largest value say only that there was more light
drift        the lamp, or the exposure, changes from pair to pair
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from ltcl import checks
from ltcl.acquisition.agreement import standardised
from ltcl.acquisition.geometry import Resampling
from ltcl.acquisition.scratch import scratch_array
from ltcl.errors import AcquisitionError, InputError

# Pairs from which a transport can be judged.
LEAST_PAIRS = 10
# Shifts between patterns and photographs that are tried, and by how much the correlation of another
# shift must be larger.
MAX_SHIFT = 5
CLEAR_CORRELATION = 0.1
# Pixels at which pairs are compared.
COMPARED_PIXELS = 2000
# Values, and share of all, that may be the largest: of a saturated camera, more are.
MAX_LARGEST_VALUES = 10
MAX_SATURATED_SHARE = 1e-3
# Light of a photograph that can judge, relative to the brightest one.
MIN_LIGHT_SHARE = 0.02
# A photograph is of another pattern if that explains it with so much less error.
SWAPPED_ERROR_RATIO = 0.5


@dataclass(frozen=True, eq=False, kw_only=True)
class Pairs:
    """Patterns and photographs in linear light, (frames, N or M, channels).

    `grid` is that of the patterns, `camera_grid` that of the photographs. `variance` is that of the
    photographs by the noise of the camera, if it is known.
    """

    grid: tuple[int, int]
    camera_grid: tuple[int, int]
    patterns: np.ndarray
    photographs: np.ndarray
    variance: np.ndarray | None = None

    @classmethod
    def of(cls, patterns: Any, photographs: Any) -> Self:
        """Check arrays (frames, h, w) or (frames, h, w, 3); a grey pattern lights all channels."""
        shown = _frames("patterns", patterns)
        seen = _frames("photographs", photographs)
        if len(seen) != len(shown):
            raise InputError(
                f"photographs has {len(seen)} frames, patterns {len(shown)}; each pattern must "
                "have one photograph"
            )
        if shown.shape[3] == 3 and seen.shape[3] == 1:
            raise InputError(
                "patterns has colours, photographs has none; give grey patterns, or photographs "
                "(frames, h, w, 3)"
            )
        if shown.shape[3] < seen.shape[3]:
            shown = np.repeat(shown, 3, axis=3)
        frames, height, width, channels = seen.shape
        grid = (shown.shape[1], shown.shape[2])
        return cls(
            grid=grid,
            camera_grid=(height, width),
            patterns=shown.reshape(frames, -1, channels),
            photographs=seen.reshape(frames, -1, channels),
        )

    def __len__(self) -> int:
        return len(self.patterns)

    @property
    def channels(self) -> int:
        """1 or 3."""
        return self.photographs.shape[2]

    def select(self, chosen: np.ndarray | slice) -> Self:
        """The chosen pairs; a slice copies nothing."""
        variance = None
        if self.variance is not None:
            variance = _select_frames(self.variance, chosen)
        return replace(
            self,
            patterns=_select_frames(self.patterns, chosen),
            photographs=_select_frames(self.photographs, chosen),
            variance=variance,
        )

    def without(self, numbers: Sequence[int]) -> Self:
        """The pairs but for those of some numbers; nothing is copied if there are none."""
        if not numbers:
            return self
        return self.select(np.setdiff1d(np.arange(len(self)), numbers))

    def resampled(self, resampling: Resampling) -> Self:
        """The pairs with photographs on the pixels of the projector."""
        photographs = np.empty_like(self.patterns)
        for number, picture in enumerate(self.photographs):
            image = picture.reshape(*self.camera_grid, -1)
            photographs[number] = resampling.apply(image).reshape(-1, self.channels)
        return replace(self, camera_grid=self.grid, photographs=photographs)

    def joined(self, others: Self) -> Self:
        """These pairs and others of the same sizes."""
        is_alike = others.grid == self.grid and others.camera_grid == self.camera_grid
        if not is_alike or others.channels != self.channels:
            raise InputError(
                f"photographs is of {others.camera_grid} pixels and {others.channels} channel(s), "
                f"patterns of {others.grid}; those before are of {self.camera_grid}, "
                f"{self.channels} and {self.grid}"
            )
        variance = None
        if self.variance is not None and others.variance is not None:
            variance = np.concatenate([self.variance, others.variance])
        return replace(
            self,
            patterns=np.concatenate([self.patterns, others.patterns]),
            photographs=np.concatenate([self.photographs, others.photographs]),
            variance=variance,
        )

    def check_values(self) -> None:
        """Refuse pairs from which nothing can be learned: too few, dark, all alike, saturated."""
        if len(self) < LEAST_PAIRS:
            raise InputError(
                f"patterns has {len(self)} frames; it must have at least {LEAST_PAIRS}"
            )
        if not np.any(self.photographs):
            raise InputError("photographs is black; it must show light")
        if np.all(self.patterns == self.patterns[:1]):
            raise InputError("patterns are all the same; they must differ")
        if self.patterns.min() < 0.0:
            raise InputError(
                f"patterns has values down to {self.patterns.min():g}; light must be at least 0"
            )
        if self.photographs.mean() <= 0.0:
            raise InputError(
                "photographs are darker than black, on average; what is taken off them, such as "
                "ambient light, must be of the same exposure"
            )
        largest = self.photographs.max()
        count = np.count_nonzero(self.photographs == largest)
        share = count / self.photographs.size
        if count > MAX_LARGEST_VALUES and share > MAX_SATURATED_SHARE:
            raise InputError(
                f"photographs has {share:.1%} of its values at {largest:g}, the largest; the "
                "camera is saturated: expose less"
            )

    def lit_frames(self) -> np.ndarray:
        """Numbers of the pairs whose photograph has light; of a black frame T p has no error."""
        light = np.sqrt(np.square(self.photographs).sum(axis=(1, 2)))
        return np.flatnonzero(light > MIN_LIGHT_SHARE * light.max())

    def check_order(self) -> None:
        """Refuse photographs that follow other patterns than their own, a few frames later."""
        pixels = self._compared_pixels()
        shown = standardised(self.patterns[:, pixels].mean(axis=2))
        seen = standardised(self.photographs[:, pixels].mean(axis=2))
        most = min(MAX_SHIFT, len(self) // 4)
        correlations = {}
        for shift in range(-most, most + 1):
            late = seen[max(shift, 0) : len(seen) + min(shift, 0)]
            early = shown[max(-shift, 0) : len(shown) + min(-shift, 0)]
            correlations[shift] = float(np.mean(late * early))
        best = max(correlations, key=correlations.__getitem__)
        if best and correlations[best] > correlations[0] + CLEAR_CORRELATION:
            when = "late" if best > 0 else "early"
            raise AcquisitionError(
                f"photographs come {abs(best)} frame(s) {when}: photograph {max(best, 0) + 1} "
                f"shows pattern {max(-best, 0) + 1}; leave out the frames that have no partner"
            )

    def check_partners(self, explained: np.ndarray) -> None:
        """Refuse a photograph that another pattern explains far better than its own.

        `explained` is T p of all patterns, like `photographs`.
        """
        pixels = self._compared_pixels()
        expected = explained[:, pixels].reshape(len(self), -1)
        seen = self.photographs[:, pixels].reshape(len(self), -1)
        # |seen - expected|^2 of all photographs and patterns.
        error = (
            (seen**2).sum(axis=1)[:, None]
            - 2.0 * seen @ expected.T
            + (expected**2).sum(axis=1)[None, :]
        )
        own = np.diagonal(error)
        partner = error.argmin(axis=1)
        least = error.min(axis=1)
        swapped = np.flatnonzero(
            (partner != np.arange(len(self))) & (least < SWAPPED_ERROR_RATIO**2 * own)
        )
        if len(swapped):
            first = int(swapped[0])
            raise AcquisitionError(
                f"photograph {first + 1} shows pattern {int(partner[first]) + 1}, and so on at "
                f"{len(swapped)} of {len(self)}; each must show its own"
            )

    def _compared_pixels(self) -> np.ndarray:
        pixels = self.patterns.shape[1]
        return np.linspace(0, pixels - 1, min(pixels, COMPARED_PIXELS)).astype(int)


def _select_frames(frames: np.ndarray, chosen: np.ndarray | slice) -> np.ndarray:
    """The chosen frames of (frames, N, channels), in a temporary file if they are large."""
    if isinstance(chosen, slice):
        return frames[chosen]
    is_grey = frames.strides[2] == 0
    planes = frames[:, :, :1] if is_grey else frames
    numbers = np.arange(len(frames))[chosen]
    selected = scratch_array((len(numbers), *planes.shape[1:]), frames.dtype)
    for place, number in enumerate(numbers):
        selected[place] = planes[number]
    return np.broadcast_to(selected, (len(numbers), *frames.shape[1:]))


def gains(photographs: np.ndarray, explained: np.ndarray) -> np.ndarray:
    """Brightness of each photograph relative to what T explains, (frames,), 1 on average."""
    squares = np.maximum((explained**2).sum(axis=(1, 2)), np.finfo(float).tiny)
    ratio = (photographs * explained).sum(axis=(1, 2)) / squares
    return ratio / ratio.mean()


def _frames(name: str, value: Any) -> np.ndarray:
    """An array (frames, h, w, 1 or 3) of finite light."""
    array = checks.real(name, value)
    is_colour = array.ndim == 4 and array.shape[3] == 3
    if array.ndim != 3 and not is_colour:
        raise InputError(
            f"{name} has shape {array.shape}; it must be (frames, h, w) or (frames, h, w, 3)"
        )
    if not array.size:
        raise InputError(f"{name} has shape {array.shape}; it must hold frames")
    checks.finite(name, array)
    light = array.astype(np.float64)
    return light if is_colour else light[..., None]
