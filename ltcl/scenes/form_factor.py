# SPDX-License-Identifier: BSD-3-Clause
"""Form factors as an operator without a matrix: A = diag(albedo) F of scenes of 100 000 patches.

Every product computes all N^2 form factors anew, by `kernels/form_factor.cl`: about 20 operations
each, no memory traffic to speak of, 52 bytes a patch stored. Distant pairs are taken at their
centres, nearer ones with the curvature between them, still nearer ones at eight pairs of points.
Within `NEAR_DISTANCE` sizes that is not good enough: there the exact form factors come from the
host, and their difference from the kernel's is added as a sparse matrix.

Measured on boxes of 6 to 131424 patches, and walls at 30, 70 and 130 degrees: for smooth x, F x is
within 1e-4 of its largest value (row sums of the largest box: 6e-5), and F within 1e-4 in the
2-norm; a single entry may be off by 2 %. With blocks, light is blocked or not at the same pairs of
points (36 between near patches, 1 or 8 between others), which adds the error of so few rays at the
borders of shadows: an entry with a border in it may be off by half of itself. Against the host's
matrices of rooms with a block, on the patch grid or off it, F was within 1.2 % in the Frobenius
norm, and row sums at most 1.02 and within 0.05 of theirs, the most where a block covers half of a
patch.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse
import scipy.spatial

from ltcl import checks
from ltcl.device import Array, Device, open_device
from ltcl.errors import InputError
from ltcl.operators import CSR, Operator
from ltcl.operators.epilogue import Epilogue, widths
from ltcl.scenes import exchange
from ltcl.scenes.patches import (
    Patches,
    check_blocks,
    check_patches,
    cut,
    lanes,
    padded,
    scaled,
    squared_size,
)
from ltcl.scenes.refined import RefinedScene
from ltcl.scenes.scene import Scene
from ltcl.scenes.visibility import Rays
from ltcl.scenes.walls import box_corners, check_albedo, finite_floats

# Pairs nearer than so many sizes of the pair (see `squared_size`) are corrected by the host.
NEAR_DISTANCE = 5.0
# Measured bound on the 2-norm of the error of F.
RELATIVE_ERROR = 1e-4
# Pairs in one launch: a fraction of a second, so that no display driver gives up.
PAIRS_PER_LAUNCH = 1 << 28
# Points along a patch: its square is the number of rays between near patches.
NEAR_SAMPLES = 6
# Heights of a patch above a plane, as a part of its size, that are rounding errors.
FLAT_TOLERANCE = 1e-6
BYTES_PER_PATCH = 60
GROUP_OF_CPU = 16
GROUP = 64


class FormFactor(Operator):
    """Bounce A = diag(albedo) F between patches, computed anew in every product, never stored.

    F_ij is the share of the light leaving patch i that meets patch j.

    Parameters
    ----------
    patches : Patches
        N parallelograms, as `ltcl.scenes.cut` makes them. They must not cut through each other.
    albedo : float or (N,) in [0, 1), optional
        Share of the light a patch gives back, in one colour. F itself when not given.
    blocks : (B, 2, 3), optional
        Low and high corner of opaque boxes along the axes; see `ltcl.scenes.visibility`.
    device : Device or str, optional
        The best one when not given.

    Attributes
    ----------
    error : float
        Bound on the 2-norm of A minus the exact one, blocks aside, where patches have equal areas.

    Raises
    ------
    InputError
        If a patch has no area or a box no volume, an albedo is outside [0, 1), or a value is not
        finite.

    Examples
    --------
    All bounces of light in a closed box, A never stored:

    >>> import ltcl, numpy
    >>> from ltcl.operators import IdentityPlus
    >>> room = ltcl.scenes.box(4, albedo=0.5)
    >>> A = FormFactor(ltcl.scenes.cut(room.walls, 4), albedo=room.first_bounce)
    >>> l_d = numpy.ones(len(room.area))  # direct light
    >>> l = ltcl.solve(IdentityPlus(A, sign=-1), l_d, rtol=1e-4).x
    >>> bool(numpy.allclose(l, 2, rtol=1e-3))  # 1 + 1/2 + 1/4 + ...
    True
    """

    def __init__(
        self,
        patches: Patches,
        albedo: Any = None,
        blocks: Any = None,
        device: Device | str | None = None,
    ) -> None:
        patches = check_patches(patches)
        blocks = check_blocks(blocks)
        count = len(patches)
        shares = np.ones(count)
        if albedo is not None:
            value = finite_floats("albedo", albedo)
            check_albedo(checks.shape("albedo", value, (), (count,)))
            shares = np.broadcast_to(value, (count,))
        if not isinstance(device, Device):
            device = open_device(device)
        super().__init__(device, (count, count))
        device.require(BYTES_PER_PATCH * count, f"the geometry of {count} patches")
        self.error = RELATIVE_ERROR * float(shares.max())
        placed, self._blocks = scaled(device, patches, blocks)
        rows = [
            placed.centre.T,
            placed.right.T,
            placed.down.T,
            placed.normal.T,
            squared_size(placed)[None],
        ]
        self._geometry = padded(device, np.concatenate(rows))  # (13, N)
        self._defines = {"LANES": lanes(device), "BLOCKS": len(blocks)}
        self._albedo = device.upload(shares)
        self._area = device.upload(placed.area)
        correction = self._correction(patches, blocks, shares, placed.area)
        self._near = CSR(device, correction)
        geometry = (self._geometry, self._blocks)
        self._components = (*geometry, self._albedo, self._area, self._near)

    @classmethod
    def of(
        cls, scene: Scene | RefinedScene, device: Device | str | None = None
    ) -> tuple[FormFactor, ...]:
        """Bounce in a scene of `box`, `dihedral` or `trihedral`, one operator per channel.

        They are computed from the scene's walls and blocks, not from its matrix of form factors:
        those of a `RefinedScene` are the exact ones of all its pixels.

        Raises
        ------
        InputError
            If the walls have not as many columns of patches as rows.

        Examples
        --------
        >>> from ltcl.scenes import Block, box
        >>> room = box(4, albedo=0.5, occluder=Block((0.3, 0.2, 0), (0.4, 0.3, 0.6), albedo=0.5))
        >>> (A,) = FormFactor.of(room)
        >>> A.shape
        (176, 176)
        """
        n = scene.grid[0]
        columns = scene.grid[1] // len(scene.walls)
        if n != columns:
            raise InputError(f"scene has walls of {n} x {columns} patches; they must be n x n")
        patches = cut(scene.walls, n)
        blocks = box_corners(scene.blocks)
        if not isinstance(device, Device):
            device = open_device(device)
        return tuple(cls(patches, albedo, blocks, device) for albedo in scene.albedo)

    def diagonal(self) -> np.ndarray:
        """Zeros, (N,): a flat patch does not light itself."""
        return np.zeros(self.shape[0])

    def _queue_product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        left, right = self._albedo, self._area
        if transpose:
            left, right = right, left
        scale, b, y, c = epilogue
        count = self.shape[0]
        pitch = self._geometry.shape[1]
        tests_per_row = pitch * (1 + self._defines["BLOCKS"])
        rows_per_launch = max(1, PAIRS_PER_LAUNCH // tests_per_row)
        group = GROUP_OF_CPU if self.device.is_cpu else GROUP
        for offset, width in widths(x.columns):
            defines = dict(self._defines, K=width)
            if width == x.columns:
                defines["PACKED"] = 1
            weigh = self.device.kernel("form_factor", "form_factor_weigh", **defines)
            matvec = self.device.kernel("form_factor", "form_factor_matvec", **defines)
            weighed = self.device.empty((width, pitch))
            weigh(
                pitch,
                GROUP,
                count=count,
                pitch=pitch,
                stride=x.columns,
                offset=offset,
                right=right,
                x=x,
                z=weighed,
            )
            for first in range(0, count, rows_per_launch):
                rows = min(rows_per_launch, count - first)
                added = y
                if y is None:
                    added = out
                matvec(
                    rows,
                    group,
                    rows=rows,
                    first=first,
                    stride=x.columns,
                    offset=offset,
                    a=scale,
                    b=b,
                    c=c,
                    x=x,
                    y=added,
                    out=out,
                    pitch=pitch,
                    geometry=self._geometry,
                    blocks=self._blocks,
                    left=left,
                    z=weighed,
                )
        self._near._queue_product(x, out, Epilogue(scale, 1.0, out), transpose)

    def _correction(
        self, patches: Patches, blocks: np.ndarray, albedo: np.ndarray, area: np.ndarray
    ) -> scipy.sparse.csr_array:
        """A of near pairs less the kernel's value of it, both ways, (N, N) sparse float64."""
        i, j = _near_pairs(patches)
        F = exchange.form_factors_of_pairs(patches, i, j)
        if len(blocks):
            rays = Rays(patches, blocks, self.device, NEAR_SAMPLES)
            F = F * rays.pairs(i, j)
        # Per area and so symmetric, as in the kernel.
        missing = F / area[j] - self._kernel_pairs(i, j)
        rows = np.concatenate([i, j])
        columns = np.concatenate([j, i])
        values = albedo[rows] * np.tile(missing, 2) * area[columns]
        entries = (values, (rows, columns))
        correction = scipy.sparse.coo_array(entries, shape=self.shape)
        return scipy.sparse.csr_array(correction)

    def _kernel_pairs(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """The kernel's own value per area of listed pairs, (P,) float64."""
        kernel = self.device.kernel(
            "form_factor", "form_factor_pairs", K=1, PACKED=1, **self._defines
        )
        tests_per_pair = 64 * (1 + self._defines["BLOCKS"])
        pairs_per_launch = max(1, PAIRS_PER_LAUNCH // tests_per_pair)
        values = [np.zeros(0)]
        for start in range(0, len(i), pairs_per_launch):
            pairs = slice(start, start + pairs_per_launch)
            from_patches = self.device.upload(i[pairs], np.int32)
            to_patches = self.device.upload(j[pairs], np.int32)
            out = self.device.empty(from_patches.shape)
            kernel(
                out.size,
                GROUP,
                count=out.size,
                pitch=self._geometry.shape[1],
                from_patches=from_patches,
                to_patches=to_patches,
                geometry=self._geometry,
                blocks=self._blocks,
                out=out,
            )
            values.append(out.get().astype(np.float64))
        return np.concatenate(values)


def _near_pairs(patches: Patches) -> tuple[np.ndarray, np.ndarray]:
    """Pairs i < j within `NEAR_DISTANCE` of their size that see each other, boxes aside."""
    squared = squared_size(patches)
    tree = scipy.spatial.KDTree(patches.centre)
    radius = NEAR_DISTANCE * np.sqrt(2 * squared.max())
    pairs = tree.query_pairs(radius, output_type="ndarray")
    if not len(pairs):
        return np.zeros(0, int), np.zeros(0, int)
    i, j = np.sort(pairs, axis=1).T
    offset = patches.centre[j] - patches.centre[i]
    distance = np.square(offset).sum(axis=1)
    is_near = distance < NEAR_DISTANCE**2 * (squared[i] + squared[j])
    is_near &= _rises_above(patches, i, j, offset)
    is_near &= _rises_above(patches, j, i, -offset)
    i = i[is_near]
    j = j[is_near]
    order = np.lexsort((j, i))
    return i[order], j[order]


def _rises_above(
    patches: Patches, plane: np.ndarray, patch: np.ndarray, offset: np.ndarray
) -> np.ndarray:
    """True if a point of a patch is above another's plane, whose centre is `offset` below it."""
    normal = patches.normal[plane]
    rise = np.abs((patches.right[patch] * normal).sum(axis=1))
    rise += np.abs((patches.down[patch] * normal).sum(axis=1))
    height = (offset * normal).sum(axis=1) + rise / 2
    return height > FLAT_TOLERANCE * np.sqrt(squared_size(patches)[patch])
