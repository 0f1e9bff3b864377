# SPDX-License-Identifier: BSD-3-Clause
"""Is a camera pixel lit by a stripe, or only by light from elsewhere: bits with a confidence.

Fine stripes light half of everything evenly, so that a pixel shows `l_d + l_g / 2` when its own stripe is on
and `l_g / 2` when it is off (Nayar et al. 2006). With the direct light l_d and the indirect l_g known, a bit
is certain (Xu and Aliaga 2007) where

- direct light outweighs indirect light: then the brighter of pattern and inverse tells;
- or one of the two shows more than l_g, so that it must be lit, and the other less than l_d, so that it
  cannot be.

Everything else is undecided, and so is what does not stand out of the noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

ENOUGH = 6  # pairs that tell a variance


@dataclass(frozen=True)
class Bits:
    """Decisions on B bits, (B, ...) each: `on`, `certain`, and by how much the two pictures differ.

    `part` (...) is what takes a difference to a part of l_d; 0 where that is too little to count.
    """

    on: np.ndarray
    certain: np.ndarray
    difference: np.ndarray
    part: np.ndarray

    def __getitem__(self, some: slice) -> Bits:
        """Some of the bits."""
        return Bits(self.on[some], self.certain[some], self.difference[some], self.part)

    @property
    def confidence(self) -> np.ndarray:
        """(...), in [0, 1]: by what part of l_d the two pictures of the weakest bit differ."""
        return np.minimum(self.difference.min(axis=0) * self.part, 1.0)


def direct_global(lit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Direct and indirect light of pictures (B, ...) under fine stripes, less what the black projector gives.

    `l_d = max - min`, `l_g = 2 min` (Nayar et al. 2006, with half of the projector's pixels lit).

    >>> l_d, l_g = direct_global(np.array([[1.0, 3.0], [2.0, 3.0]]))
    >>> l_d.tolist(), l_g.tolist()
    ([1.0, 0.0], [2.0, 6.0])
    """
    least = np.maximum(lit.min(axis=0), 0.0)
    return lit.max(axis=0) - least, 2.0 * least


def noise(pattern: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Variance of one photograph, from B pairs (B, ...): a pattern and its inverse always sum to white.

    What that sum varies by is noise of two photographs; drift and flicker count, too. Raw pictures keep that
    sum only where both are the lightest and the darkest they get, and so only those pairs count where there
    are enough of them. With one pair there is nothing to compare, and the answer is 0.
    """
    if len(pattern) < 2:
        return np.zeros(pattern.shape[1:], np.float32)
    total, difference = pattern + inverse, pattern - inverse
    np.abs(difference, out=difference)
    total -= total.mean(axis=0)  # small numbers, for the squares
    plain = _squares(total) / (len(total) - 1)
    far = np.greater(difference, 0.7 * difference.max(axis=0), out=difference)
    count = far.sum(axis=0).astype(np.float64)
    total *= far
    mean = total.sum(axis=0) / np.maximum(count, 1)
    chosen = np.maximum(_squares(total) - count * mean**2, 0.0) / np.maximum(count - 1, 1)
    return np.where(count >= ENOUGH, np.minimum(chosen, plain), plain) / 2.0


def _squares(stack: np.ndarray) -> np.ndarray:
    """Their sum over the pictures (B, ...)."""
    return np.einsum("b...,b...->...", stack, stack)


def classify(
    pattern: np.ndarray,
    inverse: np.ndarray,
    direct: np.ndarray,
    indirect: np.ndarray,
    least: np.ndarray,
    wide: np.ndarray,
    uneven: np.ndarray,
) -> Bits:
    """Decide B bits of every pixel.

    Parameters
    ----------
    pattern, inverse : (B, ...)
        Pictures under each pattern and its inverse, less what the black projector gives.
    direct, indirect : (...)
        Of the pixel, from `direct_global`.
    least : (...)
        The smallest difference that is no noise, and the smallest direct light that counts.
    wide : (B,) bool
        Bits of wide stripes. Under narrow ones light from elsewhere is the same in pattern and inverse, so
        that the brighter of the two tells, however much of it there is.
    uneven : (B,) float
        By what part of all light a pattern of narrow stripes and its inverse differ.

    Examples
    --------
    A pixel in much indirect light: it is lit in the first pattern; the second tells nothing.

    >>> one, lit, two = np.ones(1), np.array([[5.0], [3.0]]), np.ones(2)
    >>> bits = classify(lit, np.array([[1.0], [2.5]]), 2 * one, 4 * one, 0.1 * one, two > 0, 0 * two)
    >>> bits.on[:, 0].tolist(), bits.certain[:, 0].tolist()
    ([True, True], [True, False])
    """
    difference = pattern - inverse
    on = difference > 0
    np.abs(difference, out=difference)
    certain = difference > least
    for k in np.flatnonzero(uneven):
        certain[k] &= difference[k] > least + float(uneven[k]) * indirect
    certain &= direct > least
    bright = direct > indirect
    for k in np.flatnonzero(wide) if not bright.all() else ():
        lit, other = np.maximum(pattern[k], inverse[k]), np.minimum(pattern[k], inverse[k])
        certain[k] &= bright | ((lit > indirect) & (other < direct))
    part = np.where(direct > least, 1.0 / np.maximum(direct, least), 0.0)
    return Bits(on, certain, difference, part)
