# SPDX-License-Identifier: BSD-3-Clause
"""Shares of the light for each projector: smooth weights that fall to zero at their borders.

With the distance of each projector pixel to the border beyond which other projectors light the
scene alone, in its own pixels, rho_k = distance^2 is as smooth where it ends as in between; where
projectors overlap by few pixels rho_k = distance is less steep. Camera pixel i sees

    a_k = (F_k rho_k) / (F_k 1),    sigma_k = a_k / max_j a_j

and direct light l_d is the sum of what all give with the drive q = l_d / sum_k sigma_k (F_k 1):

    p_k = s_k B_k q,    s_k = B_k sigma_k

where B_k, F_k^T with rows that sum up to 1, brings a camera picture to the projector's pixels.
Where a projector is alone, sigma_k = 1. Its light stays below

    u_k = min(1, s_k / balance)

so that it has no edge where another one takes over, also after the projector has moved a little:
the smaller `balance`, the more of the light of all projectors counts, and the steeper u_k.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy  # its subpackage ndimage is loaded at the first use
import scipy.sparse

from ltcl import checks
from ltcl.errors import InputError

# Powers of the distance to the border.
BLENDS = {"smooth": 2.0, "linear": 1.0}
# Width in projector pixels from which smooth weights make the weaker seam, after a small shift.
WIDE_OVERLAP = 16.0
# Times the mean direct light of a projector: dimmer camera pixels are not lit by it.
MIN_SEEN_SHARE = 0.02
# Share of a projector pixel's light that falls beside what others light alone, at a border.
BORDER_SHARE = 0.2
# Side of the window of camera pixels in which the light of a projector falls to nothing.
LIT_REACH = 5
# Camera pixels at the border of a projector in which its light falls off.
BORDER_REACH = 2
# Weights of B_k below this part of the largest in a row are left out.
MIN_BACK_SHARE = 0.1
# A pixel and its eight neighbours.
EIGHT = np.ones((3, 3), int)


@dataclass(frozen=True, kw_only=True, eq=False)
class ProjectorShare:
    """The share of one projector in the light.

    Attributes
    ----------
    ramp : (N_k,)
        Weight of each projector pixel, before that of others counts.
    direct : tuple of (M, N_k) csr_array
        F_k of each channel.
    back : (N_k, M) csr_array
        B_k.
    relative : (M,)
        sigma_k, the weight in each camera pixel over that of the strongest projector there.
    own : (N_k,)
        s_k, the same in projector pixels.
    ceiling : (N_k,)
        u_k, the largest light over the upper bound.
    """

    ramp: np.ndarray
    direct: tuple[scipy.sparse.csr_array, ...]
    back: scipy.sparse.csr_array
    relative: np.ndarray
    own: np.ndarray
    ceiling: np.ndarray

    def white(self, channel: int) -> np.ndarray:
        """Direct light (M,) of all pixels of this projector."""
        return np.asarray(self.direct[channel].sum(axis=1)).ravel()


def border_distances(borders: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Distance (N_k,) of each pixel to the outer side of the border pixels, (h, w) bool.

    A projector without a border never has to fade out: all of it is as far from a border as the
    pixel of another projector that is farthest from its own.
    """
    distances: list[np.ndarray | None] = []
    for is_border in borders:
        if is_border.any():
            distance = np.asarray(scipy.ndimage.distance_transform_edt(~is_border), np.float64)
            distances.append(distance.ravel() + 0.5)
        else:
            distances.append(None)
    known = [distance for distance in distances if distance is not None]
    farthest = max((float(distance.max()) for distance in known), default=1.0)
    filled = []
    for is_border, distance in zip(borders, distances, strict=True):
        if distance is None:
            distance = np.full(is_border.size, farthest)
        filled.append(distance)
    return filled


def find_borders(
    directs: Sequence[Sequence[scipy.sparse.csr_array]],
    grids: Sequence[tuple[int, int]],
    camera_grid: tuple[int, int],
) -> list[np.ndarray]:
    """Pixels (h, w) of each projector at which others take over, and it has to fade out.

    They light camera pixels beside those that other projectors light alone. Its border where no
    other one lights the scene, and the border of the camera's picture, are none.
    """
    totals = [_total(direct) for direct in directs]
    are_lit = lit_pictures(totals, camera_grid)
    borders = []
    for number, (total, grid) in enumerate(zip(totals, grids, strict=True)):
        is_taken_over = _lit_by_others(are_lit, number) & ~are_lit[number]
        neighbours = scipy.ndimage.convolve(is_taken_over.astype(int), EIGHT, mode="constant")
        # A single pixel is noise.
        is_taken_over &= neighbours > 1
        is_beside = scipy.ndimage.binary_dilation(is_taken_over, EIGHT, BORDER_REACH).ravel()
        light = _row_sums(scipy.sparse.csr_array(total.T))
        beside = np.asarray(total.T @ is_beside.astype(np.float64))
        is_border = (light > 0.0) & (beside > BORDER_SHARE * light)
        borders.append(is_border.reshape(grid))
    return borders


def lit_pictures(
    totals: Sequence[scipy.sparse.csr_array], camera_grid: tuple[int, int]
) -> list[np.ndarray]:
    """Camera pixels (H, W) that each projector lights."""
    are_lit = []
    for total in totals:
        white = _row_sums(total)
        mean = float(white.sum()) / max(np.count_nonzero(white), 1)
        picture = white.reshape(camera_grid)
        # At half of the light beside it, a projector ends.
        beside = scipy.ndimage.maximum_filter(picture, LIT_REACH, mode="nearest")
        is_lit = (picture > MIN_SEEN_SHARE * mean) & (picture > 0.5 * beside)
        are_lit.append(is_lit | np.asarray(scipy.ndimage.binary_closing(is_lit, EIGHT), bool))
    return are_lit


def _lit_by_others(are_lit: Sequence[np.ndarray], number: int) -> np.ndarray:
    """Camera pixels (H, W) that another projector than this one lights."""
    others = [is_lit for other, is_lit in enumerate(are_lit) if other != number]
    return np.logical_or.reduce(others)


def overlap_width(
    directs: Sequence[Sequence[scipy.sparse.csr_array]],
    distances: Sequence[np.ndarray],
    camera_grid: tuple[int, int],
) -> float:
    """The width of the narrowest overlap in projector pixels; 0 where no projectors overlap.

    `distances`, (N_k,), are those to the border at which others take over. Across an overlap their
    mean is half of its width.
    """
    totals = [_total(direct) for direct in directs]
    are_lit = lit_pictures(totals, camera_grid)
    widths = []
    for number, (total, distance) in enumerate(zip(totals, distances, strict=True)):
        light = _row_sums(scipy.sparse.csr_array(total.T))
        is_shared = _lit_by_others(are_lit, number).ravel().astype(np.float64)
        overlaps = (light > 0.0) & (np.asarray(total.T @ is_shared) > 0.5 * light)
        if overlaps.any():
            widths.append(2.0 * float(distance[overlaps].mean()))
    return min(widths, default=0.0)


def find_ramps(
    directs: Sequence[Sequence[scipy.sparse.csr_array]],
    grids: Sequence[tuple[int, int]],
    camera_grid: tuple[int, int],
    blend: object,
) -> list[np.ndarray]:
    """The weights of the pixels of each projector: by name, or the checked arrays of the caller."""
    ramps = []
    if isinstance(blend, str):
        name = checks.one_of("blend", blend, ("auto", *BLENDS))
        borders = find_borders(directs, grids, camera_grid)
        distances = border_distances(borders)
        if name == "auto":
            width = overlap_width(directs, distances, camera_grid)
            name = "smooth" if width >= WIDE_OVERLAP else "linear"
        return [distance ** BLENDS[name] for distance in distances]
    if not isinstance(blend, (list, tuple)) or len(blend) != len(grids):
        raise InputError(
            f"blend is {checks.shown(blend)}; it must be one of auto, {', '.join(BLENDS)}, "
            f"or one array for each of {len(grids)} projectors"
        )
    for number, (ramp, grid) in enumerate(zip(blend, grids, strict=True)):
        name = f"blend[{number}]"
        weights = checks.finite(name, checks.real(name, ramp))
        weights = checks.shape(name, weights, grid).astype(np.float64).ravel()
        if weights.min() < 0.0:
            raise InputError(f"{name} reaches {weights.min():.3g}; weights must be at least 0")
        ramps.append(weights)
    return ramps


def inner_pixels(
    shares: Sequence[ProjectorShare], camera_grid: tuple[int, int]
) -> list[np.ndarray]:
    """Camera pixels (M,) that each projector lights as the strongest, away from its rim.

    At its rim it lights pixels in part. One that is nowhere the strongest has all that it lights.
    """
    are_lit = lit_pictures([_total(share.direct) for share in shares], camera_grid)
    are_inside = []
    for share, is_lit in zip(shares, are_lit, strict=True):
        is_inside = np.asarray(scipy.ndimage.binary_erosion(is_lit, EIGHT, border_value=1)).ravel()
        is_inside &= share.relative == 1.0
        are_inside.append(is_inside if is_inside.any() else is_lit.ravel())
    return are_inside


def _total(direct: Sequence[scipy.sparse.csr_array]) -> scipy.sparse.csr_array:
    """The sum of all channels."""
    total = direct[0]
    for channel in direct[1:]:
        total = total + channel
    return scipy.sparse.csr_array(total)


def _row_sums(matrix: scipy.sparse.csr_array) -> np.ndarray:
    return np.asarray(matrix.sum(axis=1)).ravel()


def share_out(
    directs: Sequence[tuple[scipy.sparse.csr_array, ...]],
    ramps: Sequence[np.ndarray],
    balance: float,
) -> tuple[ProjectorShare, ...]:
    """The shares of all projectors."""
    weights = []
    backs = []
    for direct, ramp in zip(directs, ramps, strict=True):
        total = _total(direct)
        white = _row_sums(total)
        seen = total @ ramp
        weights.append(np.divide(seen, white, out=np.zeros_like(seen), where=white > 0.0))
        backs.append(_rows_of_one(scipy.sparse.csr_array(total.T)))
    strongest = np.max(weights, axis=0)
    shares = []
    for direct, ramp, weight, back in zip(directs, ramps, weights, backs, strict=True):
        relative = np.divide(weight, strongest, out=np.zeros_like(weight), where=strongest > 0.0)
        own = back @ relative
        ceiling = (own > 0.0).astype(np.float64)
        if balance > 0.0:
            ceiling = np.minimum(own / balance, 1.0)
        share = ProjectorShare(
            ramp=ramp,
            direct=direct,
            back=back,
            relative=relative,
            own=own,
            ceiling=ceiling,
        )
        shares.append(share)
    return tuple(shares)


def _rows_of_one(matrix: scipy.sparse.csr_array) -> scipy.sparse.csr_array:
    """The matrix without small weights, and with rows that sum up to 1, or 0."""
    largest = matrix.max(axis=1).toarray().ravel()
    counts = np.diff(matrix.indptr)
    is_small = matrix.data < MIN_BACK_SHARE * np.repeat(largest, counts)
    matrix = matrix.copy()
    matrix.data[is_small] = 0.0
    matrix.eliminate_zeros()
    sums = np.asarray(matrix.sum(axis=1)).ravel()
    inverses = np.divide(1.0, sums, out=np.zeros_like(sums), where=sums > 0.0)
    return scipy.sparse.csr_array(scipy.sparse.diags_array(inverses) @ matrix)


def drive_divisors(shares: Sequence[ProjectorShare]) -> np.ndarray:
    """sum_k sigma_k (F_k 1) of each channel, (channels, M): 0 where no projector lights."""
    channels = range(len(shares[0].direct))
    divisors = []
    for channel in channels:
        light = [share.relative * share.white(channel) for share in shares]
        divisors.append(np.sum(light, axis=0))
    return np.stack(divisors)
