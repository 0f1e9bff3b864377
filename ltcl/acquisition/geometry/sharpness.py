# SPDX-License-Identifier: BSD-3-Clause
"""How sharp a camera sees the projector's pixels, from the stripes that give their places.

With b = 1 and -1 where a pattern of stripes is on and off, and D the photograph of it less that of its
inverse, on the projector's grid, light from elsewhere is in both and cancels. What is left of pixel n is

    D_n = l_n ((1 - q) b_n + q (b_n-1 + b_n+1) / 2)

along an axis: l its direct light, and q the part of what comes out at it that is its neighbours', for camera
pixels are too large for the grid, or out of focus. Least squares over the patterns of the axis give q of each
pixel; the median of |q| counts, less what the residuals say of its noise. Blocks of k x k pixels share a k-th
of it. A picture of noise, even in [0, 1], has a root mean square of twice its deviation, so that its relative
error is

    blur = sqrt(a_y a_x - 2 (1 - q_y) (1 - q_x) + 1) / 2,    a = (1 - q)^2 + q^2 / 2

Errors of the map blur as a q of 0.07 times the square of a camera pixel's width does (measured: pictures
have errors of 0.5 % with a width of 0.27, 1.9 % with 0.54, 3.9 % with 0.72); of the two the larger counts.
Known limits: where q is below 0.02, light that is uneven between stripes passes for it; with 1000 electrons
at full scale noise makes it 0.03.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy.sparse

from ltcl.acquisition.geometry.correspondence import Correspondence
from ltcl.acquisition.geometry.resample import Resampling
from ltcl.acquisition.geometry.unmixing import inner, jacobian, shares
from ltcl.errors import AcquisitionError

logger = logging.getLogger(__name__)
WIDEST = 8  # pixels of a stripe, on average, whose light from elsewhere is as that of its inverse
BAD, HOPELESS = 0.035, 0.3  # blur from which there is a warning (a sharp camera has 1 to 2 %), and a refusal
OF_MAP = 0.07  # q of errors of the map, of camera pixels as wide as the projector's: measured, above
_DETERMINED = 0.5  # least determinant of the least squares of a pixel; independent integer patterns have 1
_MIDDLE = 0.6745  # of a deviation, below which half of normal values are

Pair = tuple[np.ndarray, np.ndarray]
"""Codes (h, w) and the photograph (H, W) of them, linear in light."""


@dataclass(frozen=True)
class Sharpness:
    """How well a camera separates pixels of the projector.

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
    def of(cls, mapping: Correspondence, R: Resampling, photographs: Sequence[Pair] = ()) -> Sharpness:
        """By photographs of stripes where there are enough, else by the map."""
        J, known = jacobian(mapping)
        width = float(np.median(np.linalg.norm(J[known], 2, axis=(1, 2))))
        return cls(leak(R, photographs) or _leak_of_map(R, mapping, J, known), width)

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
        """Relative error of pictures of noise."""
        y, x = self.errors
        a = ((1 - y) ** 2 + y**2 / 2) * ((1 - x) ** 2 + x**2 / 2)
        return float(np.sqrt(max(a - 2 * (1 - y) * (1 - x) + 1, 0.0)) / 2)

    @property
    def errors(self) -> tuple[float, float]:
        """q along y and x, or what is as bad as errors of the map, where that is more."""
        least = OF_MAP * min(self.width, 1.0) ** 2
        return max(self.leak[0], least), max(self.leak[1], least)

    def check(self, side: int = 1) -> None:
        """Warn of a camera that hardly separates blocks of `side` x `side` pixels; refuse one that does not.

        Raises
        ------
        AcquisitionError
            Pictures of noise have an error of 30 %: most light comes out at neighbours.

        Examples
        --------
        >>> Sharpness((0.4, 0.4), 0.9).check()  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ltcl.errors.AcquisitionError: the camera does not separate the projector's pixels: ...
        """
        here = self.of_blocks(side)
        if not here.blur > BAD:
            return
        measured = (
            f"camera pixels are {self.width:.2g} projector pixels wide, and {here.own:.0%} of what comes out "
            f"at a pixel is its own light: pictures of fine detail have an error of {here.blur:.1%}"
        )
        remedy = (
            "move the camera closer, focus it and the projector, use a longer lens or a projector_grid of "
            f"fewer pixels, or scan with strategy='block' and block={2 * side}"
        )
        if here.blur > HOPELESS:
            raise AcquisitionError(
                f"the camera does not separate the projector's pixels: {measured}; {remedy}"
            )
        logger.warning("%s; %s", measured, remedy)


def leak(R: Resampling, photographs: Sequence[Pair]) -> tuple[float, float] | None:
    """q along y and x, in [0, 1]; None where patterns are too few, or what is seen of them.

    A side of 1 has no neighbours, and 0.

    Examples
    --------
    A camera on the projector's grid, in focus:

    >>> from ltcl.acquisition.geometry import GrayCode
    >>> shown = [(codes, 0.5 * codes) for codes in GrayCode((8, 8)).patterns()]
    >>> leak(Resampling.aligned((8, 8)), shown)
    (0.0, 0.0)
    """
    # Patterns of 0 and 1, and the inverse that follows each; (codes, difference on the projector's grid).
    stripes = [
        (codes, R.apply(image - other).reshape(*R.grid, -1).mean(axis=-1))
        for (codes, image), (inverse, other) in pairwise(photographs)
        if ((codes == 0) | (codes == 1)).all() and np.ptp(codes) and np.array_equal(1 - codes, inverse)
    ]
    q = [_of_axis(R.seen, [pair for pair in stripes if _narrow(pair[0], axis)], axis) for axis in (0, 1)]
    return None if q[0] is None or q[1] is None else (q[0], q[1])


def _narrow(codes: np.ndarray, axis: int) -> bool:
    """Whether stripes end along this axis only, often enough."""
    ends = [int(np.count_nonzero(np.diff(codes, axis=k))) for k in (axis, 1 - axis)]
    return ends[1] == 0 and ends[0] * WIDEST >= codes.size - codes.shape[1 - axis] * WIDEST


def _of_axis(seen: np.ndarray, stripes: list[Pair], axis: int) -> float | None:
    """The median of |q| of pixels with two neighbours."""
    if seen.shape[axis] == 1:
        return 0.0
    if len(stripes) < 3:
        return None
    b = np.moveaxis(np.stack([2.0 * codes - 1.0 for codes, _ in stripes]), 1 + axis, -1)
    D = np.moveaxis(np.stack([difference for _, difference in stripes]), 1 + axis, -1)[..., 1:-1]
    A = np.stack([b[..., 1:-1], (b[..., :-2] + b[..., 2:]) / 2], axis=-1)  # (patterns, rows, columns, 2)
    G, y = np.einsum("krci,krcj->rcij", A, A), np.einsum("krci,krc->rci", A, D)
    determined = np.moveaxis(seen, axis, -1)[:, 1:-1] & (np.linalg.det(G) > _DETERMINED)
    if not determined.any():
        return None
    inverse = np.linalg.inv(G[determined])
    z = np.einsum("nij,nj->ni", inverse, y[determined])  # l (1 - q), l q
    rest = ((D[:, determined] - np.einsum("kni,ni->kn", A[:, determined], z)) ** 2).sum(axis=0)
    l = z.sum(axis=1)
    lit = l > 0
    if not lit.any():
        return None
    q = z[lit, 1] / l[lit]
    noise = (inverse[:, 1, 1] * rest / (len(D) - 2))[lit] / l[lit] ** 2
    square = np.median(np.abs(q)) ** 2 - _MIDDLE**2 * np.median(noise)
    return float(min(np.sqrt(max(square, 0.0)), 1.0))


def _leak_of_map(
    R: Resampling, mapping: Correspondence, J: np.ndarray, known: np.ndarray
) -> tuple[float, float]:
    """q along y and x by what camera pixels cover, without photographs: of a lens in focus."""
    h, w = mapping.grid
    C = shares(mapping, J, known)[:, inner(mapping.grid)]
    B = scipy.sparse.coo_array(R.weights.astype(np.float64) @ C)
    (n, m), seen = B.coords, R.seen.ravel()
    y, x = (
        float(np.clip(np.median(np.bincount(n, B.data * away, h * w)[seen]), 0.0, 1.0))
        for away in (n // w != m // w, n % w != m % w)
    )
    return y, x
