# SPDX-License-Identifier: BSD-3-Clause
"""Visibility V (N, N) of patches past opaque boxes: symmetric, 1 where nothing is between.

V_ij is the share of the rays between the fronts of patches i and j that meet no box. Rays that
leave or meet a back carry no light and do not count: where the plane of one patch cuts the other,
V is that of the part in front, as F is. Where no ray joins two fronts V is 1; there F is 0, or
almost.

Each patch has s x s points, one at random in each cell of a regular division, and ray k joins point
k of one patch with point partner(k) of the other, where partner is a fixed random exchange: both
directions have the same rays, so V = V^T to the bit.

Known limit: V counts rays, it is not weighted by the cosines along them; the standard error of an
entry in a penumbra is at most 1 / (2 s), less as the points are spread evenly.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ltcl import checks
from ltcl.device import Device, open_device
from ltcl.scenes.patches import Patches, check_blocks, check_patches, lanes, padded, scaled

# Tests of a ray and a box in one launch: a fraction of a second, also for slow devices.
TESTS_PER_LAUNCH = 1 << 30
MAX_SAMPLES = 64
# Bytes of a buffer that are kept free beside the rows of V.
BUFFER_RESERVE = 64


class Rays:
    """The samples^2 rays between any two of the patches, past boxes (B, 2, 3), on a device."""

    def __init__(self, patches: Patches, blocks: np.ndarray, device: Device, samples: int) -> None:
        self.device = device
        self.count = len(patches)
        self.rays = samples**2
        self.boxes = len(blocks)
        placed, self._blocks = scaled(device, patches, blocks)
        points = _points_on_patches(placed, samples)
        partner = _partners(self.rays)
        nbytes = (2 * points.size + 3 * self.count) * 4
        device.require(nbytes, f"{samples}^2 points on each of {self.count} patches")
        self._starts = padded(device, points.reshape(-1, self.count))
        self._ends = padded(device, points[partner].reshape(-1, self.count))
        self._normals = padded(device, placed.normal.T)

    def all(self) -> np.ndarray:
        """V of all patches, (N, N) float32."""
        # As many rows in a launch as one buffer holds.
        row_bytes = 4 * self._starts.shape[1]
        rows_of_buffer = (self.device.max_allocation - BUFFER_RESERVE) // row_bytes
        rows_of_launch = TESTS_PER_LAUNCH // (self.rays * self.boxes * self.count)
        rows = max(1, min(rows_of_launch, rows_of_buffer))
        seen = np.empty((self.count, self.count), np.float32)
        for i in np.split(np.arange(self.count), range(rows, self.count, rows)):
            seen[i] = self._launch(i, np.zeros_like(i), self.count)[: self.count].T
        return seen

    def pairs(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """V of listed pairs, (P,) float32."""
        width = lanes(self.device)
        pairs = max(1, TESTS_PER_LAUNCH // (self.rays * self.boxes * width))
        shares = [np.zeros(0, np.float32)]
        for start in range(0, len(i), pairs):
            first = i[start : start + pairs]
            second = j[start : start + pairs]
            stretches = self._launch(first, second // width * width, 1)
            shares.append(stretches[second % width, np.arange(len(first))])
        return np.concatenate(shares)

    def _launch(self, i: np.ndarray, start: np.ndarray, columns: int) -> np.ndarray:
        """V of patches i and `columns` from `start`, in whole lanes: (columns or more, len(i))."""
        width = lanes(self.device)
        kernel = self.device.kernel(
            "form_factor", "form_factor_visible", K=1, LANES=width, BLOCKS=self.boxes
        )
        stretches = -(-columns // width)
        out = self.device.empty((stretches * width, len(i)))
        kernel(
            (len(i), stretches),
            (64, 1),
            rows=len(i),
            pitch=self._starts.shape[1],
            rays=self.rays,
            from_patches=self.device.upload(i, np.int32),
            to_patches=self.device.upload(start, np.int32),
            starts=self._starts,
            ends=self._ends,
            normals=self._normals,
            blocks=self._blocks,
            out=out,
        )
        return out.get()


def _points_on_patches(patches: Patches, samples: int) -> np.ndarray:
    """A random point in each cell of every patch, (samples^2, 3, N)."""
    cells = np.arange(samples)
    rows, columns = np.meshgrid(cells, cells, indexing="ij")
    cell = np.stack([rows, columns], axis=-1).reshape(-1, 2)
    jitter = np.random.default_rng(1).random(cell.shape)
    place = (cell + jitter) / samples - 0.5  # (samples^2, 2), in edges
    edges = np.stack([patches.right, patches.down])  # (2, N, 3)
    points = patches.centre + np.tensordot(place, edges, 1)
    return points.transpose(0, 2, 1)


def _partners(rays: int) -> np.ndarray:
    """A random exchange of points, (rays,): partner[partner] is the identity."""
    partner = np.arange(rays)
    order = np.random.default_rng(2).permutation(rays)
    first, second = np.split(order[: rays // 2 * 2], 2)
    partner[first] = second
    partner[second] = first
    return partner


def visibility(
    patches: Patches, blocks: Any, device: Device | str | None = None, *, samples: int = 4
) -> np.ndarray:
    """Shares of rays between fronts of all patches that meet no box, (N, N) float32 on the host.

    Parameters
    ----------
    patches : Patches
        N parallelograms, as `ltcl.scenes.cut` makes them. Those on the faces of a box belong to it:
        light leaves them outwards and the box does not stop it.
    blocks : array_like, (B, 2, 3)
        Low and high corner of each opaque box, along the axes.
    device : Device or str, optional
        The best one if omitted.
    samples : int
        s, 1 to 64: s^2 rays for each pair.

    Returns
    -------
    ndarray, (N, N), float32
        Symmetric to the bit; 1 for patches that turn away from each other.

    Raises
    ------
    InputError
        If a box has no volume, a patch no area, or a value is not finite.
    MemoryLimitError
        If the matrix does not fit in the memory of the host; nothing is allocated then.

    Examples
    --------
    >>> from ltcl.scenes import box, cut
    >>> walls = box(1, sides=6).walls
    >>> screen = [[(0.4, -1, -1), (0.6, 2, 2)]]  # between the walls at x = 0 and x = 1
    >>> visibility(cut((walls[1], walls[5]), 1), screen).tolist()
    [[1.0, 0.0], [0.0, 1.0]]
    """
    patches = check_patches(patches)
    blocks = check_blocks(blocks)
    checks.count("samples", samples, most=MAX_SAMPLES)
    count = len(patches)
    checks.fits_host(f"the visibility of {count} x {count} patches", 4 * count**2)
    if not len(blocks):
        return np.ones((count, count), np.float32)
    if not isinstance(device, Device):
        device = open_device(device)
    return Rays(patches, blocks, device, samples).all()
