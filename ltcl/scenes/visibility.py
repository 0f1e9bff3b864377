# SPDX-License-Identifier: BSD-3-Clause
"""Which part of a patch another one sees past opaque boxes: V (N, N), symmetric, 1 where nothing is between.

V_ij is the share of the rays between the fronts of patches i and j that meet no box. Rays that
leave or meet a back carry no light and do not count: where the plane of one patch cuts the other, V
is that of the part in front, as F is. Where no ray joins two fronts V is 1; there F is 0, or next
to it.

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

_LAUNCH = (
    1 << 30
)  # tests of a ray and a box in one launch: a fraction of a second, also for slow devices


class Rays:
    """The samples^2 rays between any two of the patches, past boxes (B, 2, 3), on a device."""

    def __init__(self, patches: Patches, blocks: np.ndarray, device: Device, samples: int) -> None:
        self.device, self.count, self.rays, self.boxes = (
            device,
            len(patches),
            samples**2,
            len(blocks),
        )
        placed, self._blocks = scaled(device, patches, blocks)
        cell = np.stack(np.meshgrid(*[np.arange(samples)] * 2, indexing="ij"), axis=-1).reshape(
            -1, 2
        )
        place = (
            cell + np.random.default_rng(1).random(cell.shape)
        ) / samples - 0.5  # (s^2, 2) in edges
        edges = np.stack([placed.right, placed.down])  # (2, N, 3)
        points = (placed.centre + np.tensordot(place, edges, 1)).transpose(0, 2, 1)  # (s^2, 3, N)
        partner, order = np.arange(self.rays), np.random.default_rng(2).permutation(self.rays)
        here, there = np.split(order[: self.rays // 2 * 2], 2)
        partner[here], partner[there] = there, here  # an exchange: partner[partner] is the identity
        nbytes = (2 * points.size + 3 * self.count) * 4
        device.require(nbytes, f"{samples}^2 points on each of {self.count} patches")
        self._starts = padded(device, points.reshape(-1, self.count))
        self._ends = padded(device, points[partner].reshape(-1, self.count))
        self._normals = padded(device, placed.normal.T)

    def all(self) -> np.ndarray:
        """V of all patches, (N, N) float32, some rows in a launch: as many as one buffer holds."""
        largest = (self.device.max_allocation - 64) // (4 * self._starts.shape[1])
        most = max(1, min(_LAUNCH // (self.rays * self.boxes * self.count), largest))
        seen = np.empty((self.count, self.count), np.float32)
        for i in np.split(np.arange(self.count), range(most, self.count, most)):
            seen[i] = self._launch(i, np.zeros_like(i), self.count)[: self.count].T
        return seen

    def pairs(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """V of listed pairs, (P,) float32."""
        width = lanes(self.device)
        most = max(1, _LAUNCH // (self.rays * self.boxes * width))
        parts = [np.zeros(0, np.float32)]
        for start in range(0, len(i), most):
            a, b = i[start : start + most], j[start : start + most]
            parts.append(self._launch(a, b // width * width, 1)[b % width, np.arange(len(a))])
        return np.concatenate(parts)

    def _launch(self, i: np.ndarray, start: np.ndarray, columns: int) -> np.ndarray:
        """V of patches i and the `columns` from `start` on, in whole lanes: (columns or more, len(i))."""
        width = lanes(self.device)
        kernel = self.device.kernel(
            "form_factor", "form_factor_visible", K=1, LANES=width, BLOCKS=self.boxes
        )
        stretches = -(-columns // width)
        out = self.device.empty((stretches * width, len(i)))
        lists = (self.device.upload(i, np.int32), self.device.upload(start, np.int32))
        points = (self._starts, self._ends, self._normals, self._blocks)
        pitch = self._starts.shape[1]
        kernel((len(i), stretches), (64, 1), len(i), pitch, self.rays, *lists, *points, out)
        return out.get()


def visibility(
    patches: Patches, blocks: Any, device: Device | str | None = None, *, samples: int = 4
) -> np.ndarray:
    """Shares of the rays between the fronts of all patches that meet no box, (N, N) float32 on the host.

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
    patches, blocks = check_patches(patches), check_blocks(blocks)
    checks.count("samples", samples, most=64)
    count = len(patches)
    checks.fits_host(f"the visibility of {count} x {count} patches", 4 * count**2)
    if not len(blocks):
        return np.ones((count, count), np.float32)
    return Rays(
        patches, blocks, device if isinstance(device, Device) else open_device(device), samples
    ).all()
