# SPDX-License-Identifier: BSD-3-Clause
"""A scene with many pixels in each of its patches: direct light is fine, bounced light is smooth.

Radiosity calls it substructuring. Light bounces between the P patches, by the form factors K of
the scene, and pixels, N = P detail^2, only send it and receive it. W (P, N) are hats around the
middles of patches (`ltcl.operators.PatchHats`), which add up to 1 at each pixel: light that leaves
a pixel is shared by the patches around it, and light that arrives is interpolated between them.

    A = diag(r) W^T K W / detail^2,    T = (I - A)^-1 diag(r)

So the form factors of pixels are W^T K W / detail^2: reciprocal, as K is, and no row of them sums
to more than one of K does. By the formula of Sherman, Morrison and Woodbury

    S = (I - A)^-1 = I + diag(r) W^T C W,    C = (I - K Q)^-1 K / detail^2,
    Q = W diag(r) W^T / detail^2

of which no more than the P^2 numbers of C are stored. This is exact for the A above. That A itself
is smoother than the walls are where they meet, within about one patch of an edge. White light, and
a landscape, in the corner of two walls of albedo 0.7 come out 0.8 and 1.2 % from the exact light at
16 patches along a wall, and half as far at 32; pixels along the edge by up to a quarter.

Source: Cohen, Greenberg, Immel and Brock, "An efficient radiosity approach for realistic image
synthesis", IEEE Computer Graphics and Applications 6(3), 1986.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
import scipy.sparse
from scipy.sparse.linalg import LinearOperator, aslinearoperator

from ltcl import checks
from ltcl.device import Device, open_device
from ltcl.errors import InputError, InputTypeError
from ltcl.operators import (
    Compressed,
    Dense,
    IdentityPlus,
    PatchHats,
    ScaledBasis,
    ScaledColumns,
)
from ltcl.operators.patch_hats import hats_matrix
from ltcl.scenes.camera import SceneCamera
from ltcl.scenes.gloss.glossy import GlossyScene
from ltcl.scenes.scene import Scene
from ltcl.scenes.wall_pictures import WallPictures, single_or_all
from ltcl.scenes.walls import Block, Wall
from ltcl.transport.transport import Transport


def refine(scene: Scene, detail: int) -> RefinedScene:
    """The same scene with detail x detail pixels in each patch; light bounces between patches.

    Pictures then have detail times as many rows and columns, and T holds no more numbers than that
    of the patches. Direct light is exact in each pixel. Light that bounces is interpolated between
    the middles of patches, and so too smooth within about one patch of an edge.

    Parameters
    ----------
    scene : Scene
        A scene of `dihedral`, `trihedral`, `box`, or of form factors, without gloss.
    detail : int
        Pixels along a patch.

    Returns
    -------
    RefinedScene

    Raises
    ------
    InputError
        If detail is not a whole number of at least 1, or the scene is glossy.

    Examples
    --------
    >>> import ltcl
    >>> scene = ltcl.scenes.refine(ltcl.scenes.dihedral(8, albedo=0.5), 4)
    >>> T = scene.transport()
    >>> c = ltcl.compensate(T, np.full(scene.grid, 0.2))
    >>> scene.grid, c.error < 1e-2
    ((32, 64), True)
    """
    return RefinedScene(scene, detail)


@dataclass(frozen=True, eq=False, repr=False)
class RefinedScene(WallPictures):
    """A scene of many pixels, whose light bounces between larger patches; made by `refine`.

    Parameters
    ----------
    patches : Scene
        Form factors and albedo of P patches; n rows of them along a wall.
    detail : int
        Pixels along a patch.

    Attributes
    ----------
    grid : (h, w)
        Pixels, detail times those of the patches; N = h * w.
    albedo : (channels, N)
    area : (N,)

    Raises
    ------
    InputError
        If detail is not a whole number of at least 1, or patches are glossy.

    Examples
    --------
    >>> from ltcl.scenes import box, refine
    >>> scene = refine(box(4, sides=3), 8)
    >>> scene.grid, scene.channels
    ((32, 96), 1)
    """

    patches: Scene
    detail: int

    def __post_init__(self) -> None:
        if not isinstance(self.patches, Scene):
            kind = type(self.patches).__name__
            raise InputTypeError(f"patches is a {kind}; it must be a ltcl.scenes.Scene")
        if isinstance(self.patches, GlossyScene):
            raise InputError(
                f"patches is {self.patches.name}; it must be without gloss, as its matte is"
            )
        object.__setattr__(self, "detail", checks.count("detail", self.detail))

    def __repr__(self) -> str:
        h, w = self.grid
        return f"<ltcl RefinedScene {self.name}, grid {h} x {w}, {self.channels} channel(s)>"

    @property
    def name(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The name of the scene of patches."""
        return self.patches.name

    @property
    def grid(self) -> tuple[int, int]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Pixels (h, w), the walls side by side."""
        h, w = self.patches.grid
        return h * self.detail, w * self.detail

    @property
    def walls(self) -> tuple[Wall, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The parts of the picture in space, left to right."""
        return self.patches.walls

    @property
    def viewer(self) -> SceneCamera:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The eye of `view` and `sample`."""
        return self.patches.viewer

    @property
    def blocks(self) -> tuple[Block, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Boxes that hide walls from the viewer and from lights."""
        return self.patches.blocks

    @cached_property
    def albedo(self) -> np.ndarray:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Share of the light a pixel gives back, that of its patch, (channels, N)."""
        return self._spread(self.patches.albedo)

    @cached_property
    def area(self) -> np.ndarray:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Areas of the pixels, (N,)."""
        return self._spread(self.patches.area) / self.detail**2

    @property
    def A(self) -> LinearOperator | tuple[LinearOperator, ...]:
        """Physical bounce diag(albedo) W^T K W / detail^2, (N, N) in float64 on the host.

        In colour a tuple of three. `ltcl.scenes.FormFactor.of` has the exact one of all pixels.

        Examples
        --------
        >>> from ltcl.scenes import dihedral
        >>> A = refine(dihedral(4, albedo=0.5), 8).A
        >>> A.shape, bool((A @ np.ones(2048) < 0.25).all())
        ((2048, 2048), True)
        """
        return single_or_all(self.bounces)

    @property
    def bounces(self) -> tuple[LinearOperator, ...]:
        """A of each channel, always as a tuple."""
        W = hats_matrix(self.grid, len(self.walls), self.detail)
        received = aslinearoperator(W.T) @ aslinearoperator(self.patches.form_factors)
        bounce = received @ aslinearoperator(W / self.detail**2)
        bounces = []
        for albedo in self.albedo:
            reflection = aslinearoperator(scipy.sparse.diags_array(albedo))
            bounces.append(reflection @ bounce)
        return tuple(bounces)

    def transport(self, device: Device | str | None = None, *, on_dark: str = "mask") -> Transport:
        """The scene's `ltcl.Transport`, whose first bounce is the albedo.

        Parameters
        ----------
        device : Device or str, optional
            The device that holds it; the best one if omitted.
        on_dark : "mask" or "raise"
            Treatment of pixels of albedo 0: never light them, or refuse.

        Raises
        ------
        MemoryLimitError
            If the P^2 numbers of a channel do not fit in the memory of host or device.

        Examples
        --------
        >>> from ltcl.scenes import dihedral
        >>> T = refine(dihedral(4, albedo=0.5), 8).transport()
        >>> T.shape, T.nbytes < 100_000
        ((2048, 2048), True)
        """
        if not isinstance(device, Device):
            device = open_device(device)
        patches = len(self.patches.area)
        checks.fits_host(
            f"the transport between {patches} patches of {self.name}",
            4 * (3 + self.channels) * patches**2,
        )
        W = PatchHats(device, self.grid, len(self.walls), self.detail)
        channels = []
        for albedo in self.albedo:
            S = self._interreflection(W, albedo)
            channels.append(ScaledColumns(S, albedo))
        return Transport(
            single_or_all(channels),
            grid=self.grid,
            first_bounce=self.first_bounce,
            on_dark=on_dark,
        )

    def _interreflection(self, W: PatchHats, albedo: np.ndarray) -> IdentityPlus:
        """S of one channel on the device of W."""
        core = self._core(W, albedo)
        R = Compressed(
            Dense(W.device, core),
            ScaledBasis(W, albedo),
            W,
            error=0.0,
            diagonal=albedo * W.diagonal_of(core),
        )
        weights = None
        if albedo.all():
            weights = self.area / albedo / self.area.mean()
        return IdentityPlus(R, weights=weights)

    def _core(self, W: PatchHats, albedo: np.ndarray) -> np.ndarray:
        """C = (I - K Q)^-1 K / detail^2, (P, P) float32, to whose rounding it is good."""
        hats = W.matrix
        Q = (hats * albedo) @ hats.T / self.detail**2
        K = self.patches.form_factors
        # Q is sparse and symmetric: K Q = (Q K^T)^T.
        system = -np.asarray(Q @ K.T, np.float32).T
        system[np.diag_indices_from(system)] += 1.0
        right = (K / self.detail**2).astype(np.float32)
        # Rows of A sum to less than 1, so I - K Q is far from singular.
        return scipy.linalg.solve(
            system, right, overwrite_a=True, overwrite_b=True, check_finite=False
        )

    def _spread(self, patches: np.ndarray) -> np.ndarray:
        """Values per patch (..., P) at the pixels of each, (..., N)."""
        values = patches.reshape(*patches.shape[:-1], *self.patches.grid)
        values = values.repeat(self.detail, axis=-2).repeat(self.detail, axis=-1)
        return values.reshape(*patches.shape[:-1], -1)
