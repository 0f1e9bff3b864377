# SPDX-License-Identifier: BSD-3-Clause
"""Which patches lie close together, touching ones too, and their form factors at any angle.

The form factors are the integrals over both outlines of `contours`, after what lies behind the plane of the
other patch is cut off. Accurate to 1e-6 of an entry. Known limit: no occlusion.
"""

from __future__ import annotations

import itertools

import numpy as np
import scipy.spatial

from ltcl.scenes.exchange import contours
from ltcl.scenes.patches import Patches

_TOUCHING = 2.2  # sizes of a pair within which two patches may touch, at any shape
_FLAT = 1e-12  # sizes of a pair: heights above a plane that are rounding errors


def squared_size(patches: Patches) -> np.ndarray:
    """(|right|^2 + |down|^2) / 4 of every patch, (N,); the size of a pair is the root of the sum of both."""
    return (np.square(patches.right).sum(axis=1) + np.square(patches.down).sum(axis=1)) / 4


def pairs(patches: Patches, sizes: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs i < j whose centres are within `sizes` of their size and that see each other, boxes aside."""
    squared = squared_size(patches)
    tree = scipy.spatial.KDTree(patches.centre)
    found = tree.query_pairs(sizes * np.sqrt(2 * squared.max()), output_type="ndarray")
    i, j = np.sort(found, axis=1).T if len(found) else np.zeros((2, 0), int)
    offset = patches.centre[j] - patches.centre[i]
    close = np.square(offset).sum(axis=1) < sizes**2 * (squared[i] + squared[j])
    i, j, offset = i[close], j[close], offset[close]
    facing = _above(patches, i, j, offset) & _above(patches, j, i, -offset)
    order = np.lexsort((j[facing], i[facing]))
    return i[facing][order], j[facing][order]


def form_factors(patches: Patches, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """F_ij of listed pairs, (P,) float64: shares of the light from patches i that meet patches j.

    Parameters
    ----------
    patches : Patches
    i, j : (P,) integers

    Examples
    --------
    >>> from ltcl.scenes.box import WALLS
    >>> from ltcl.scenes.patches import cut
    >>> round(float(form_factors(cut(WALLS[:2], 1), np.array([0]), np.array([1]))[0]), 5)
    0.20004
    """
    squared = squared_size(patches)
    unit, offset = np.sqrt(squared[i] + squared[j]), patches.centre[j] - patches.centre[i]
    touching = np.linalg.norm(offset, axis=1) < _TOUCHING * unit
    # Logarithms cancel best near 1, so lengths are counted in sizes of the pair.
    first, second = _outlines(patches, i, -offset / 2, unit), _outlines(patches, j, offset / 2, unit)
    over, under = _heights(first, second, patches.normal[j]), _heights(second, first, patches.normal[i])
    facing = (over.max(axis=1) > 0) & (under.max(axis=1) > 0)
    crossed = (over.min(axis=1) < 0) | (under.min(axis=1) < 0)
    result = np.zeros(len(i))
    for near, cut in itertools.product((True, False), repeat=2):
        some = np.flatnonzero(facing & (touching == near) & (crossed == cut))
        one, other = first[some], second[some]
        if cut:
            one, other = contours.clip(one, over[some]), contours.clip(other, under[some])
        result[some] = contours.exchange(one, other, contours.TOUCHING if near else contours.APART)
    return result * unit**2 / patches.area[i]


def _above(patches: Patches, i: np.ndarray, j: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Whether any point of patches j is above the planes of patches i."""
    normal = patches.normal[i]
    rise = sum(np.abs((edge[j] * normal).sum(axis=1)) for edge in (patches.right, patches.down))
    return (offset * normal).sum(axis=1) + rise / 2 > 1e-6 * np.sqrt(squared_size(patches)[j])


def _outlines(patches: Patches, which: np.ndarray, centre: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Outlines of listed patches moved to `centre`, in a unit of each pair, (P, 4, 2, 3)."""
    right, down = patches.right[which], patches.down[which]
    return contours.outline(centre - (right + down) / 2, right, down) / unit[:, None, None, None]


def _heights(outlines: np.ndarray, others: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Signed distances of corners from the planes of other patches, (P, 4)."""
    height = np.einsum("pkc,pc->pk", outlines[:, :, 0] - others[:, :1, 0], normal)
    return np.where(np.abs(height) < _FLAT, 0.0, height)
