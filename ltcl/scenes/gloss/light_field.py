# SPDX-License-Identifier: BSD-3-Clause
"""Glossy rooms seen by one camera and lit by one projector: T = P S F Q on the full light field (eq. 28).

    S = (I - A)^-1,    A = K G (eq. 4),    T = P F Q + P A F Q + P A^2 F Q + ...    (eq. 29)

A light field gives each of N patches M + 1 values. Leaving a patch: radiance into M bins of directions
(`directions`), and last the radiance towards the camera. Arriving: radiance from the M bins,
and last the irradiance from the projector. G (`beams`) carries light between bins; K
(`brdf`) reflects, block by block; F is K too, as it meets the projector's light. So P and Q only
pick and place the last values: camera and projector have the exact direction they see a patch from, not that
of the nearest bin, and what P picks is a final gather over the light that arrives. Only between patches is
light spread over bins.

A white matte patch under unit light shows 1, as in the diffuse `Scene`. Rows of A sum to at most the albedo,
so with m the largest albedo all bounces after A^k F Q are at most max(A^k F Q) m / (1 - m); sums stop there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from ltcl import checks, layout
from ltcl.scenes.scene import Scene
from ltcl.scenes.viewer import Viewer
from ltcl.scenes.walls import Wall
from ltcl.transport import Transport

if TYPE_CHECKING:
    from ltcl.device import Device

_COLUMNS = 64  # of T computed together
_TAIL = 1e-8  # of a white patch: all bounces left out together


@dataclass(frozen=True, eq=False)
class GlossyScene:
    """Patches that reflect into each other as their material, camera and projector say; made by `glossy`.

    Attributes
    ----------
    matte : Scene
        The same room without gloss: grid, walls, albedo, viewer, and form factors found by the same rays.
    G : csr_array, (N (M + 1), N (M + 1)), float64
        Light that arrives, for light that leaves. No colour.
    white : bsr_array, (N (M + 1), N (M + 1)), float64
        K at albedo 1: one block per patch, rows by leaving, columns by arriving direction.
    P : csr_array, (N, N (M + 1))
        What the camera sees; 0 for patches hidden from it.
    Q : csr_array, (N (M + 1), N)
        Light of the projector; the part of each patch that is not in shadow.

    Examples
    --------
    >>> from ltcl.scenes import dihedral, glossy
    >>> scene = glossy(dihedral(2), 2, albedo=0.5, gloss=0.3, projector=(2, 1.5, 0.6), directions=16)
    >>> light = scene.K @ (scene.Q @ np.ones(8))  # F Q l_in
    >>> first_bounce = scene.P @ (scene.A @ light)
    >>> bool(np.allclose(first_bounce, scene.bounces(np.ones(scene.grid), 1)[1].ravel()))
    True
    """

    matte: Scene
    G: scipy.sparse.csr_array = field(repr=False)
    white: scipy.sparse.bsr_array = field(repr=False)
    P: scipy.sparse.csr_array = field(repr=False)
    Q: scipy.sparse.csr_array = field(repr=False)

    @property
    def grid(self) -> tuple[int, int]:
        """The patches as a picture, (h, w); N = h * w."""
        return self.matte.grid

    @property
    def walls(self) -> tuple[Wall, ...]:
        """Where the parts of the picture stand."""
        return self.matte.walls

    @property
    def viewer(self) -> Viewer:
        """Who looks in `view` and `sample`."""
        return self.matte.viewer

    @property
    def channels(self) -> int:
        """1 for grey, 3 for colour."""
        return self.matte.channels

    @property
    def directions(self) -> int:
        """M, the bins of directions over each patch."""
        return self.white.blocksize[0] - 1

    @property
    def K(self) -> Any:
        """Reflection: what leaves for what arrives, bsr_array; a tuple of three in colour. F is the same."""
        structure = self.white.indices, self.white.indptr
        parts = tuple(
            scipy.sparse.bsr_array((self.white.data * r[:, None, None], *structure))
            for r in self.matte.albedo
        )
        return parts[0] if self.channels == 1 else parts

    @property
    def A(self) -> Any:
        """One bounce of the light field, K G (eq. 4), a LinearOperator; a tuple of three in colour."""
        G, K = scipy.sparse.linalg.aslinearoperator(self.G), self.K
        parts = tuple(
            scipy.sparse.linalg.aslinearoperator(k) @ G for k in (K if self.channels == 3 else (K,))
        )
        return parts[0] if self.channels == 1 else parts

    @property
    def first_bounce(self) -> np.ndarray:
        """P F Q, which is diagonal: (N,), or (3, N) in colour. 0 where camera or projector see nothing."""
        direct = self.P.sum(axis=1) * self.white.data[:, -1, -1] * self.Q.sum(axis=0)
        F = self.matte.albedo * direct
        return F[0] if self.channels == 1 else F

    def matrices(self) -> tuple[np.ndarray, ...]:
        """T = P S F Q, one (N, N) float64 array per channel, bounces summed until 1e-8 is left.

        Raises
        ------
        MemoryLimitError
            If they do not fit in the memory of the host.
        """
        patches = len(self.matte.area)
        block = 8 * patches * (self.directions + 1) * min(_COLUMNS, patches)
        checks.fits_host(
            f"the transport of {self.matte.name}, {self.channels} of {patches} x {patches},",
            self.channels * 8 * patches**2 + 4 * block,
        )
        light = np.eye(patches)
        parts = [slice(start, start + _COLUMNS) for start in range(0, patches, _COLUMNS)]
        return tuple(
            np.concatenate([sum(self._pictures(albedo, light[:, part])) for part in parts], axis=1)
            for albedo in self.matte.albedo
        )

    def transport(
        self,
        first_bounce: Any = "diagonal",
        device: Device | str | None = None,
        *,
        on_dark: str = "raise",
    ) -> Transport:
        """The scene's `ltcl.Transport`, as one camera and one projector measure it.

        Parameters
        ----------
        first_bounce, device, on_dark
            As `ltcl.Transport` takes them; `scene.first_bounce` is the truth. Patches hidden from camera or
            projector are dark.

        Examples
        --------
        >>> from ltcl.scenes import dihedral, glossy
        >>> scene = glossy(dihedral(2), 2, projector=(2, 1.5, 0.6), directions=16)
        >>> scene.transport(scene.first_bounce).grid
        (2, 4)
        """
        matrices = self.matrices()
        matrix = matrices[0] if self.channels == 1 else matrices
        return Transport(matrix, grid=self.grid, first_bounce=first_bounce, device=device, on_dark=on_dark)

    def bounces(self, pattern: Any, count: int) -> np.ndarray:
        """True pictures of single bounces, P A^k F Q pattern for k = 0 (direct) to count (eq. 29).

        Parameters
        ----------
        pattern : (h, w), (h, w, 3), or frames of these
        count : int
            Of indirect bounces.

        Returns
        -------
        ndarray, (count + 1, ...), float64
            One after another, as `ltcl.relight` shapes pictures.

        Raises
        ------
        InputError
            If the pattern is not on the grid, or count is below 0.

        Examples
        --------
        >>> from ltcl.scenes import dihedral, glossy
        >>> scene = glossy(dihedral(2), 2, projector=(2, 1.5, 0.6), directions=16)
        >>> scene.bounces(np.ones(scene.grid), 3).shape
        (4, 2, 4)
        """
        count = checks.count("count", count, least=0)
        columns, shape = layout.unpack("pattern", pattern, self.grid, self.channels)
        series = [
            self._pictures(albedo, light, count)
            for albedo, light in zip(self.matte.albedo, columns, strict=True)
        ]
        return np.stack([shape.pack(list(parts), self.grid) for parts in zip(*series, strict=True)])

    def picture(self, patches: Any) -> np.ndarray:
        """Values per patch as a picture on the grid; see `Scene.picture`."""
        return self.matte.picture(patches)

    def view(self, picture: Any, size: int = 480, supersample: int = 3) -> np.ndarray:
        """What the viewer sees of a picture on the walls; see `Scene.view`."""
        return self.matte.view(picture, size, supersample)

    def sample(self, image: Any) -> np.ndarray:
        """The picture on the walls that looks like a flat image to the viewer; see `Scene.sample`."""
        return self.matte.sample(image)

    def _pictures(
        self, albedo: np.ndarray, light: np.ndarray, count: int | None = None
    ) -> Iterator[np.ndarray]:
        """P A^k F Q light (N, k) one after another: `count` indirect ones, or until little is left."""
        most = albedo.max()
        arriving, bounce = self.Q @ light.astype(np.float64), 0
        while True:
            leaving = self._reflect(albedo, arriving)
            yield self.P @ leaving
            left = np.abs(leaving).max(initial=0.0) * most / (1 - most)
            if bounce == count or (count is None and left <= _TAIL):
                return
            arriving, bounce = self.G @ leaving, bounce + 1

    def _reflect(self, albedo: np.ndarray, arriving: np.ndarray) -> np.ndarray:
        """K arriving, as products of dense blocks, which are much faster than those of `bsr_array`."""
        blocks = self.white.data
        leaving = blocks @ arriving.reshape(len(blocks), blocks.shape[1], -1)
        leaving *= albedo[:, None, None]
        return leaving.reshape(arriving.shape)
