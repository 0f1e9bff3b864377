# SPDX-License-Identifier: BSD-3-Clause
"""How sharp a camera sees the projector's pixels, from the stripes that tell where it sees them.

With b = 1 and -1 where a pattern of stripes is on and off, and D the photograph of it less that of its
inverse, on the projector's grid, light from elsewhere is in both and cancels. What is left of pixel n is

    D_n = l_n ((1 - q) b_n + q (b_n-1 + b_n+1) / 2)

along an axis: l its direct light, and q the part of what comes out at it that is its neighbours', for camera
pixels are too large for the grid, or out of focus. Least squares over the patterns of the axis tell q of each
pixel; the median of |q| counts, less what the residuals say of its noise. Blocks of k x k pixels share a k-th
of it. A picture of noise, even in [0, 1], has a root mean square of twice its deviation, so that

    blur = sqrt(a_y a_x - 2 (1 - q_y) (1 - q_x) + 1) / 2,    a = (1 - q)^2 + q^2 / 2

is what it is off by, relative to it. Errors of the map blur as a q of about 0.07 of the square of a camera
pixel's width does (as measured: pictures are off by 0.5 % with a width of 0.27, 1.9 % with 0.54, 3.9 % with
0.72); of the two the larger counts. Known limits: where q is below 0.02, light that is uneven between stripes
passes for it; with 1000 electrons at full scale noise makes it 0.03.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy.sparse

from ltcl.acquisition.geometry.correspondence import Correspondence
from ltcl.acquisition.geometry.footprints import jacobian
from ltcl.acquisition.geometry.resample import Resampling
from ltcl.acquisition.geometry.unmixing import inner, shares
from ltcl.errors import AcquisitionError

logger = logging.getLogger(__name__)
WIDEST = 8  # pixels of a stripe, on average, whose light from elsewhere is as that of its inverse
BAD, HOPELESS = 0.035, 0.3  # parts that pictures of noise are off by
OF_MAP = 0.07  # q of errors of the map, of camera pixels as wide as the projector's
_TOLD = 0.5  # determinant of the least squares of a pixel, at least
_MIDDLE = 0.6745  # of a deviation, below which half of normal values are

Pair = tuple[np.ndarray, np.ndarray]
"""Codes (h, w) and the photograph (H, W) of them, linear in light."""


@dataclass(frozen=True)
class Sharpness:
    """How well a camera tells pixels of the projector apart.

    Attributes
    ----------
    leak : (float, float)
        q along y and x: the part of what comes out at a pixel that is its neighbours'.
    width : float
        Of a camera pixel, in projector pixels.

    Examples
    --------
    >>> one = Sharpness((0.2, 0.5), 0.25)
    >>> one.own, one.of_blocks(2).own
    (0.4, 0.675)
    >>> round(Sharpness((0.2, 0.0), 0.0).blur, 3)  # sqrt(3 / 8) of 0.2
    0.122
    """

    leak: tuple[float, float]
    width: float

    @classmethod
    def of(cls, found: Correspondence, R: Resampling, taken: Sequence[Pair] = ()) -> Sharpness:
        """By photographs where there are some that tell it, else by the map."""
        J, known = jacobian(found)
        width = float(np.median(np.linalg.norm(J[known], 2, axis=(1, 2))))
        return cls(leak(R, taken) or leak_of_map(R, found), width)

    def of_blocks(self, side: int) -> Sharpness:
        """Of blocks of `side` x `side` pixels: less of their light crosses a border."""
        y, x = self.leak
        return Sharpness((y / side, x / side), self.width / side)

    @property
    def own(self) -> float:
        """The part of what comes out at a pixel that is its own light."""
        y, x = self.leak
        return round((1 - y) * (1 - x), 12)

    @property
    def blur(self) -> float:
        """How far pictures of noise are off, relative to them."""
        y, x = self.errors
        a = ((1 - y) ** 2 + y**2 / 2) * ((1 - x) ** 2 + x**2 / 2)
        return float(np.sqrt(max(a - 2 * (1 - y) * (1 - x) + 1, 0.0)) / 2)

    @property
    def errors(self) -> tuple[float, float]:
        """q along y and x, or what is as bad as errors of the map, where that is more."""
        least = OF_MAP * min(self.width, 1.0) ** 2
        return max(self.leak[0], least), max(self.leak[1], least)

    def check(self, side: int = 1) -> None:
        """Warn of a camera that tells blocks of `side` x `side` pixels apart badly; refuse one that does not.

        Raises
        ------
        AcquisitionError
            Pictures of noise are off by 30 %: most light comes out at neighbours.

        Examples
        --------
        >>> Sharpness((0.4, 0.4), 0.9).check()  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ltcl.errors.AcquisitionError: the camera does not tell the projector's pixels apart: ...
        """
        here = self.of_blocks(side)
        if not here.blur > BAD:
            return
        told = (
            f"camera pixels are {self.width:.2g} projector pixels wide, and {here.own:.0%} of what comes out "
            f"at a pixel is its own light: pictures of fine detail are off by {here.blur:.1%}"
        )
        remedy = (
            "move the camera closer, focus it and the projector, use a longer lens or a projector_grid of "
            f"fewer pixels, or scan with strategy='block' and block={2 * side}"
        )
        if here.blur > HOPELESS:
            raise AcquisitionError(f"the camera does not tell the projector's pixels apart: {told}; {remedy}")
        logger.warning("%s; %s", told, remedy)


def leak(R: Resampling, taken: Sequence[Pair]) -> tuple[float, float] | None:
    """q along y and x, in [0, 1]; None where the patterns, or what is seen of them, do not tell it.

    A side of 1 has no neighbours, and 0.

    Examples
    --------
    A camera on the projector's grid, in focus:

    >>> from ltcl.acquisition.geometry import GrayCode
    >>> shown = [(codes, 0.5 * codes) for codes in GrayCode((8, 8)).patterns()]
    >>> leak(Resampling.aligned((8, 8)), shown)
    (0.0, 0.0)
    """
    pairs, found = list(_pairs(taken)), []
    for axis, n in enumerate(R.grid):
        if n == 1:
            found.append(0.0)
            continue
        stripes = [(on, off) for on, off in pairs if _narrow(on[0], axis)]
        q = _axis(R, stripes, axis) if len(stripes) > 2 else None
        if q is None:
            return None
        found.append(q)
    return found[0], found[1]


def leak_of_map(R: Resampling, found: Correspondence) -> tuple[float, float]:
    """q along y and x by what camera pixels cover, where no photograph tells it: of a lens in focus.

    >>> y, x = np.mgrid[:8, :8] * 1.0
    >>> half = Correspondence(x - 0.5, y, np.ones((8, 8)), np.ones((8, 8), bool), (8, 8))
    >>> [0.3 < q < 0.6 for q in leak_of_map(Resampling.of(half), half)]
    [True, True]
    """
    J, known = jacobian(found)
    h, w = found.grid
    C = shares(found, J, known)[:, inner(found.grid)]
    B = scipy.sparse.coo_array(R.weights.astype(np.float64) @ C)
    n, m = B.coords
    seen = R.seen.ravel()

    def crossing(of: Callable[[np.ndarray], np.ndarray]) -> float:
        away = np.bincount(n, B.data * (of(n) != of(m)), h * w)
        return float(np.clip(np.median(away[seen]), 0.0, 1.0))

    return crossing(lambda k: k // w), crossing(lambda k: k % w)


def _pairs(taken: Sequence[Pair]) -> Iterable[tuple[Pair, Pair]]:
    """Patterns of 0 and 1 with the inverse that follows each."""
    for one, other in pairwise(taken):
        b = one[0]
        if ((b == 0) | (b == 1)).all() and b.min() < b.max() and np.array_equal(1 - b, other[0]):
            yield one, other


def _narrow(codes: np.ndarray, axis: int) -> bool:
    """Whether stripes end along this axis only, often enough."""
    ends = [int(np.count_nonzero(np.diff(codes, axis=k))) for k in (axis, 1 - axis)]
    return ends[1] == 0 and ends[0] * WIDEST >= codes.size - codes.shape[1 - axis] * WIDEST


def _axis(R: Resampling, stripes: list[tuple[Pair, Pair]], axis: int) -> float | None:
    """The median of |q| of pixels with two neighbours."""
    b = np.moveaxis(np.stack([2.0 * on[0] - 1.0 for on, _ in stripes]), 1 + axis, -1)
    D = np.moveaxis(np.stack([_light(R, on, off) for on, off in stripes]), 1 + axis, -1)[..., 1:-1]
    seen = np.moveaxis(R.seen, axis, -1)[:, 1:-1]
    A = np.stack([b[..., 1:-1], (b[..., :-2] + b[..., 2:]) / 2], axis=-1)  # (patterns, rows, columns, 2)
    G, y = np.einsum("krci,krcj->rcij", A, A), np.einsum("krci,krc->rci", A, D)
    told = seen & (np.linalg.det(G) > _TOLD)
    if not told.any():
        return None
    back = np.linalg.inv(G[told])
    z = np.einsum("nij,nj->ni", back, y[told])
    l = z.sum(axis=1)
    rest = ((D - np.einsum("krci,krci->krc", A, _spread(z, told)))[:, told] ** 2).sum(axis=0)
    lit = l > 0
    if not lit.any():
        return None
    q = z[lit, 1] / l[lit]
    noise = (back[:, 1, 1] * rest / (len(D) - 2))[lit] / l[lit] ** 2
    square = np.median(np.abs(q)) ** 2 - _MIDDLE**2 * np.median(noise)
    return float(min(np.sqrt(max(square, 0.0)), 1.0))


def _light(R: Resampling, on: Pair, off: Pair) -> np.ndarray:
    """The difference of two photographs on the projector's grid, of all colours together."""
    return R.apply(on[1] - off[1]).reshape(*R.grid, -1).mean(axis=-1)


def _spread(z: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Values (n, 2) of the pixels that are told, as (1, rows, columns, 2)."""
    found = np.zeros((*where.shape, 2))
    found[where] = z
    return found[None]
