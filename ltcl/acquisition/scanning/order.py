# SPDX-License-Identifier: BSD-3-Clause
"""Whether pictures show the patterns of their batch, in their order, before anything of them is kept.

With r_a = y_a / w the light of picture a relative to white, and k_i the pictures that light pixel i,

    s_a(i) = r_a(i) / max(sum_b r_b(i) / k_i, 1/4)

is about 1 where a lights i, and little elsewhere. The votes of picture a for pattern b are

    V(a, b) = sum_i W_a(i) (s_a(i) - 1/2) over the pixels i that b lights,    W = 1 / (1 + (sigma / 0.25)^2)

with sigma the noise of s: a picture taken under b instead of a has V(a, b) - V(a, a) = D / 2 of them more, D
the pixels that one of both lights alone. Refused are, beyond 6 standard deviations of noise,

    exchanged   cycles of the assignment with most votes that gain 0.15 of D / 2, and 8 votes; or fewer where
                all show 4 times as much where the other is lit as where they are, and as the other shows
    repeated    one that gains 0.35 of D / 2, and 3 votes, for the pattern of another
    strange     those that show less than 1/4 of the light where they are lit (8 pixels), and more than half
                of white at a quarter as many that are not, or at one where most of the batch is strange; or
                of which others show what is lit there
    missing     where the last pattern is the sum of the others: one that shows less than 1/4 where it is
                lit, which the last shows; or the last

Diffuse scenes never look so, however deep their corners: their S is the inverse of an M-matrix, so that
T_ij T_jk ... T_li <= T_ii T_jj ... T_ll, and y / w is largest where a pattern lights. Known limits: light
below its noise tells nothing; nor does one picture alone, or a few pixels that may be mirrors: that is
logged. A whole batch in the place of another is not told where less than half of white is light of its own.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize

from ltcl.errors import AcquisitionError

logger = logging.getLogger(__name__)
_SIGMAS, _SURE = 6.0, 4.0  # the latter where it is asked for something else as well
_SPREAD = 0.25  # standard deviation of s that counts half
_LEAST = 0.25  # of white: less than that of a batch at a pixel is not taken for all of its light
_PART = 0.15  # of D / 2 that an exchange gains
_SHOWN, _VOTES = 0.35, 3.0  # of D / 2, and at least, that one picture alone gains
_LITTLE, _CERTAIN, _MUCH = 0.25, 0.4, 0.5  # of the light at a pixel
_FEW = 8.0  # pixels, fewer of which may be mirrors
_CLEAR = 5.0  # standard deviations that white is above 0 where it tells what a pixel shows
_UNKNOWN = 1e6  # standard deviation of a share of which nothing is known


def check(
    patterns: np.ndarray,
    value: np.ndarray,
    variance: np.ndarray,
    ambient: np.ndarray,
    white: Any,
    name: Callable[[int], str],
) -> None:
    """Refuse pictures that do not show their patterns; log those of which that is likely.

    Parameters
    ----------
    patterns : (k, M)
        On where not 0.
    value, variance : (k, channels, M)
        Light on the pixels of the scan; what of it is not known has a large variance.
    ambient : (channels, M)
        Variance of the ambient light that was subtracted from all.
    white : Picture
        Under all of the projector.
    name : function
        What the photographs of picture a are called.

    Raises
    ------
    AcquisitionError
        It names the photographs.

    Examples
    --------
    >>> from ltcl.acquisition.scanning.pictures import Picture
    >>> P, y = np.eye(4), 0.9 * np.eye(4)[[1, 0, 2, 3], None]
    >>> white = Picture(np.ones((1, 4)), np.zeros((1, 4)))
    >>> check(P, y, np.full(y.shape, 1e-4), np.zeros((1, 4)), white, "{}".format)  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ltcl.errors.AcquisitionError: 0 shows the pattern of 1; 1 shows the pattern of 0; photographs must be ...
    """
    shares = Shares.of(np.asarray(patterns) > 0, value, variance, ambient, white)
    absent, beside, moves = shares.absent(), shares.beside(), shares.moves()
    exchanged, likely = _exchanged(moves)
    found = dict.fromkeys(_strange(shares, absent, beside) + _missing(shares, absent))
    found |= _others(moves) | exchanged
    if found:
        raise AcquisitionError(
            f"{_told(found, name)}; photographs must be in the order of their patterns, and the set-up as it "
            "was: put that right"
        )
    if not shares.summed:
        some = absent & ((beside > 0) | (shares.own()[0] >= _FEW))
        likely = dict.fromkeys(np.flatnonzero(some).tolist()) | likely
    if likely:
        logger.warning("%s: is it in its place, and the scene as it was?", _told(likely, name))


@dataclass(frozen=True)
class Shares:
    """What k pictures show of the light at each pixel.

    Attributes
    ----------
    lit : (k, M) bool
        Where patterns are on, and it is known what is seen there.
    share, sigma : (k, M)
        s_a(i) and its standard deviation.
    shown : (M,) bool
        Pixels of which the pictures that light them, 3 at least, show a share of white.
    rest : (M,)
        Sum of all shares but the last, less the last, and `uncertain`, its standard deviation.
    summed : bool
        Whether that must be 0.
    """

    lit: np.ndarray
    share: np.ndarray
    sigma: np.ndarray
    shown: np.ndarray
    rest: np.ndarray
    uncertain: np.ndarray
    summed: bool

    @classmethod
    def of(
        cls, on: np.ndarray, value: np.ndarray, variance: np.ndarray, ambient: np.ndarray, white: Any
    ) -> Shares:
        """Of what `check` is given."""
        clear = white.value > _CLEAR * np.sqrt(white.variance)
        w = np.where(clear, white.value, 0.0).astype(np.float64)
        precision = np.sum(w**2 / (variance + ambient), axis=1)
        known = precision > _UNKNOWN**-2
        noise = np.where(known, 1.0 / np.maximum(precision, _UNKNOWN**-2), 0.0)
        relative = noise * np.sum(value * w / (variance + ambient), axis=1)  # least squares of y = r w
        count = np.sum(on & known, axis=0)
        whole = relative.sum(axis=0) / np.maximum(count, 1)
        told = (count > 0) & (noise.sum(axis=0) < (0.1 * count) ** 2)
        scale = np.where(told, np.maximum(whole, _LEAST), 1.0)
        share, sigma = relative / scale, np.where(known, np.sqrt(noise) / scale, _UNKNOWN)
        common = np.where(clear, ambient / np.maximum(w, 1e-30) ** 2, 0.0).max(axis=0) / scale**2
        uncertain = np.sqrt((sigma**2).sum(axis=0) + len(on) ** 2 * common)
        rest = share[:-1].sum(axis=0) - share[-1]
        summed = len(on) > 2 and bool(np.array_equal(on[:-1].sum(axis=0), on[-1]))
        shown = told & (count > 2) & (whole >= _LEAST)
        return cls(on & known, np.clip(share, -1.0, 2.0), sigma, shown, rest, uncertain, summed)

    @property
    def weight(self) -> np.ndarray:
        """W_a(i)."""
        return 1.0 / (1.0 + (self.sigma / _SPREAD) ** 2)

    def own(self, where: Any = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of each picture, the pixels that it is lit at, the mean share there, its standard deviation."""
        weight = self.weight * (self.lit & where)
        pixels = weight.sum(axis=1)
        total = np.maximum(pixels, 1e-9)
        noise = np.sqrt(np.sum((weight * self.sigma) ** 2, axis=1))
        return pixels, np.sum(weight * self.share, axis=1) / total, noise / total

    def absent(self, where: Any = True) -> np.ndarray:
        """(k,) pictures that show little where they are lit."""
        pixels, mean, noise = self.own(where)
        return (pixels > 0.5) & (mean < _LITTLE) & (mean + _SIGMAS * noise < _MUCH)

    def beside(self) -> np.ndarray:
        """(k,) pixels of which a picture shows much that it is not lit at."""
        sure = (self.sigma < _SPREAD) & (self.share - 0.5 * _SIGMAS * self.sigma > _MUCH)
        return np.count_nonzero(sure & ~self.lit, axis=1)

    def moves(self) -> Moves:
        """What picture a shows of pattern b, against its own."""
        some = self.lit.any(axis=0)  # of most batches few pixels
        weight, share, sigma = self.weight[:, some], self.share[:, some], self.sigma[:, some]
        on = self.lit[:, some].astype(np.float64)
        other, own = _alone(weight, on)
        shown, kept = _alone(weight * share, on)
        noise = np.sqrt(np.maximum(sum(_alone((weight * sigma) ** 2, on)), 0.0))  # of rounding
        there, here = shown / np.maximum(other, 1e-9), kept / np.maximum(own, 1e-9)
        clear = (there >= _CERTAIN) & (_LITTLE * there >= np.maximum(here, here.T))
        return Moves(shown - kept - 0.5 * (other - own), noise, 0.5 * (other + own), clear)


class Moves(NamedTuple):
    """Of picture a and pattern b, (k, k): V(a, b) - V(a, a), its standard deviation, D / 2.

    `clear`: where b alone lights, picture a shows 0.4 of the light, and 4 times as much as where a alone
    does, and as picture b does where it alone is lit.
    """

    gain: np.ndarray
    noise: np.ndarray
    most: np.ndarray
    clear: np.ndarray


def _alone(values: np.ndarray, on: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sums of the values of picture a over the pixels that pattern b lights, not a; a, not b. (k, k)."""
    both, of = (values * on) @ on.T, values @ on.T
    return of - both, np.diag(of)[:, None] - both


def _others(moves: Moves) -> dict[int, int | None]:
    """Pictures that show the pattern of another, and that."""
    gain, noise, most, _ = moves
    found: dict[int, int | None] = {}
    much = (gain > _SIGMAS * noise) & (gain >= _SHOWN * most) & (gain >= _VOTES)
    for a in np.flatnonzero(much.any(axis=1)).tolist():
        found[a] = int(np.argmax(np.where(much[a], gain[a], -np.inf)))
    return found


def _exchanged(moves: Moves) -> tuple[dict[int, int | None], dict[int, int | None]]:
    """The same of pictures that are to be exchanged; and of such that may be."""
    gain, noise, most, clear = moves
    found: tuple[dict[int, int | None], ...] = ({}, {})
    _, best = scipy.optimize.linear_sum_assignment(gain, maximize=True)
    for cycle in _cycles(best):
        to = best[cycle]
        total, least = gain[cycle, to].sum(), _PART * most[cycle, to].sum()
        if total > _SIGMAS * noise[cycle, to].sum() and total >= least > 0:
            moved = gain[cycle, to] >= _PART * most[cycle, to]
            sure = total >= _FEW or clear[cycle, to][moved].all()
            found[not sure].update(zip(cycle[moved].tolist(), to[moved].tolist(), strict=True))
    return found[0], found[1]


def _cycles(best: np.ndarray) -> Iterator[np.ndarray]:
    """Those of a permutation that are longer than 1."""
    left = set(np.flatnonzero(best != np.arange(len(best))).tolist())
    while left:
        cycle = [min(left)]
        while best[cycle[-1]] != cycle[0]:
            cycle.append(int(best[cycle[-1]]))
        left -= set(cycle)
        yield np.array(cycle)


def _strange(shares: Shares, absent: np.ndarray, beside: np.ndarray) -> list[int]:
    """Pictures that show light elsewhere, or none where others show it."""
    pixels, *_ = shares.own()
    elsewhere = absent & (beside > 0)
    all_over = 2 * np.count_nonzero(elsewhere) > np.count_nonzero(pixels > 0.5)
    if not (all_over and pixels[elsewhere].sum() >= _FEW):
        elsewhere &= (beside >= _LITTLE * pixels) & (pixels >= _FEW)
    dark = shares.absent(shares.shown) & (shares.own(shares.shown)[0] >= _FEW)
    return np.flatnonzero(elsewhere | dark).tolist()


def _missing(shares: Shares, absent: np.ndarray) -> list[int]:
    """Pictures that lack what the last, the sum of all others, shows; or the last, that lacks theirs."""
    if not shares.summed:
        return []
    weight = shares.weight * shares.lit
    total = np.maximum(weight.sum(axis=1), 1e-9)
    rest = weight @ shares.rest / total
    noise = np.sqrt(weight**2 @ shares.uncertain**2) / total
    rest[-1] *= -1.0
    return np.flatnonzero(absent & (rest < -_MUCH) & (rest < -_SURE * noise)).tolist()


def _told(found: dict[int, int | None], name: Callable[[int], str], most: int = 3) -> str:
    """In one line what pictures show, of the first few."""
    parts = []
    for a, b in sorted(found.items())[:most]:
        own = name(a)
        show = "show" if own.startswith("photographs") else "shows"
        what = "little of the pattern asked for" if b is None else f"the pattern of {name(b)}"
        parts.append(f"{own} {show} {what}")
    more = len(found) - len(parts)
    return "; ".join(parts) + (f"; so do {more} more of this batch" if more else "")
