# SPDX-License-Identifier: BSD-3-Clause
"""Form factors as an operator that stores no matrix: A = diag(albedo) F for scenes of 100 000 patches.

Every product computes all N^2 form factors anew, by `kernels/form_factor.cl`: about 20 operations
each, no memory traffic to speak of, 52 bytes a patch stored. Distant pairs are taken at their
centres, nearer ones with the curvature between them, still nearer ones at eight pairs of points.
Within `_NEAR` sizes that is not good enough: there the exact form factors come from the host, and
what they differ from the kernel's is added as a sparse matrix.

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
from ltcl.scenes.scene import Scene
from ltcl.scenes.visibility import Rays
from ltcl.scenes.walls import check_albedo

_NEAR = 5.0  # sizes of a pair, see `squared_size`
_ERROR = 1e-4
_LAUNCH = 1 << 28  # pairs in one launch: a fraction of a second, so that no display driver gives up
_NEAR_SAMPLES = 6  # squared, the rays between near patches


class FormFactor(Operator):
    """One bounce A = diag(albedo) F between patches, computed anew in every product, never stored.

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
        patches, blocks = check_patches(patches), check_blocks(blocks)
        count, shares = len(patches), np.ones(len(patches))
        if albedo is not None:
            value = checks.finite("albedo", checks.real("albedo", albedo)).astype(np.float64)
            check_albedo(checks.shape("albedo", value, (), (count,)))
            shares = np.broadcast_to(value, (count,))
        super().__init__(
            device if isinstance(device, Device) else open_device(device), (count, count)
        )
        self.device.require(60 * count, f"the geometry of {count} patches")
        self.error = _ERROR * float(shares.max())
        placed, self._blocks = scaled(self.device, patches, blocks)
        vectors = (placed.centre, placed.right, placed.down, placed.normal)
        rows = np.concatenate(
            [*(vector.T for vector in vectors), squared_size(placed)[None]]
        )  # (13, N)
        self._geometry = padded(self.device, rows)
        self._defines = {"LANES": lanes(self.device), "BLOCKS": len(blocks)}
        self._albedo, self._area = self.device.upload(shares), self.device.upload(placed.area)
        self._near = CSR(self.device, self._correction(patches, blocks, shares, placed.area))
        self._parts = (self._geometry, self._blocks, self._albedo, self._area, self._near)

    @classmethod
    def of(cls, scene: Scene, device: Device | str | None = None) -> tuple[FormFactor, ...]:
        """One bounce in a scene of `box`, `dihedral` or `trihedral`, one operator per channel.

        They are computed from the scene's walls and blocks, not from its matrix of form factors.

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
        n, columns = scene.grid[0], scene.grid[1] // len(scene.walls)
        if n != columns:
            raise InputError(f"scene has walls of {n} x {columns} patches; they must be n x n")
        patches, blocks = cut(scene.walls, n), [(block.low, block.high) for block in scene.blocks]
        chosen = device if isinstance(device, Device) else open_device(device)
        return tuple(cls(patches, albedo, blocks, chosen) for albedo in scene.albedo)

    def diagonal(self) -> np.ndarray:
        """Zeros, (N,): a flat patch does not light itself."""
        return np.zeros(self.shape[0])

    def _queue_product(self, x: Array, out: Array, epilogue: Epilogue, transpose: bool) -> None:
        right, left = (self._albedo, self._area) if transpose else (self._area, self._albedo)
        scale, b, y, c = epilogue
        count, pitch = self.shape[0], self._geometry.shape[1]
        rows = max(1, _LAUNCH // (pitch * (1 + self._defines["BLOCKS"])))
        for offset, width in widths(x.columns):
            packed = {"PACKED": 1} if width == x.columns else {}
            weigh, matvec = (
                self.device.kernel(
                    "form_factor", f"form_factor_{name}", K=width, **packed, **self._defines
                )
                for name in ("weigh", "matvec")
            )
            z = self.device.empty((width, pitch))
            weigh(pitch, 64, count, pitch, x.columns, offset, right, x, z)
            vectors = (
                x,
                out if y is None else y,
                out,
                pitch,
                self._geometry,
                self._blocks,
                left,
                z,
            )
            for first in range(0, count, rows):
                size = min(rows, count - first)
                place = (size, first, x.columns, offset, scale, b, c)
                matvec(size, 16 if self.device.is_cpu else 64, *place, *vectors)
        self._near._queue_product(x, out, Epilogue(scale, 1.0, out), transpose)

    def _correction(
        self, patches: Patches, blocks: np.ndarray, albedo: np.ndarray, area: np.ndarray
    ) -> scipy.sparse.csr_array:
        """A of near pairs less what the kernel takes it for, both ways, (N, N) sparse float64."""
        i, j = _near_pairs(patches)
        F = exchange.of_pairs(patches, i, j)
        if len(blocks):
            F = F * Rays(patches, blocks, self.device, _NEAR_SAMPLES).pairs(i, j)
        # Per area and so symmetric, as in the kernel.
        missing = F / area[j] - self._kernel_pairs(i, j)
        values = np.concatenate([albedo[i] * missing * area[j], albedo[j] * missing * area[i]])
        places = np.concatenate([i, j]), np.concatenate([j, i])
        return scipy.sparse.csr_array(scipy.sparse.coo_array((values, places), shape=self.shape))

    def _kernel_pairs(self, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        """The kernel's own value per area of listed pairs, (P,) float64."""
        kernel = self.device.kernel(
            "form_factor", "form_factor_pairs", K=1, PACKED=1, **self._defines
        )
        most = max(1, _LAUNCH // (64 * (1 + self._defines["BLOCKS"])))
        parts = [np.zeros(0)]
        for start in range(0, len(i), most):
            ends = [self.device.upload(end[start : start + most], np.int32) for end in (i, j)]
            out = self.device.empty(ends[0].shape)
            kernel(
                out.size,
                64,
                out.size,
                self._geometry.shape[1],
                *ends,
                self._geometry,
                self._blocks,
                out,
            )
            parts.append(out.get().astype(np.float64))
        return np.concatenate(parts)


def _near_pairs(patches: Patches) -> tuple[np.ndarray, np.ndarray]:
    """Pairs i < j whose centres are within `_NEAR` of their size and that see each other, boxes aside."""
    squared, normal = squared_size(patches), patches.normal
    tree = scipy.spatial.KDTree(patches.centre)
    pairs = tree.query_pairs(_NEAR * np.sqrt(2 * squared.max()), output_type="ndarray")
    i, j = np.sort(pairs, axis=1).T if len(pairs) else np.zeros((2, 0), int)
    offset = patches.centre[j] - patches.centre[i]
    close = np.square(offset).sum(axis=1) < _NEAR**2 * (squared[i] + squared[j])
    for plane, other, sign in (
        (i, j, 1),
        (j, i, -1),
    ):  # does any point of the other rise above the plane?
        rise = sum(
            np.abs((edge[other] * normal[plane]).sum(axis=1))
            for edge in (patches.right, patches.down)
        )
        height = sign * (offset * normal[plane]).sum(axis=1) + rise / 2
        close &= height > 1e-6 * np.sqrt(squared[other])
    order = np.lexsort((j[close], i[close]))
    return i[close][order], j[close][order]
