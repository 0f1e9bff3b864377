# SPDX-License-Identifier: BSD-3-Clause
"""A Lambertian scene of flat patches: form factors and albedo in, exact light transport out.

    l_out = (I - A)^-1 l_d,    A = diag(albedo) F    (eq. 4),    l_d = diag(albedo) l_in

Projector pixel i lights patch i with unit irradiance, and a white patch (albedo 1) under unit light
shows 1. So the transport is T = (I - A)^-1 diag(albedo), (N, N), one per colour.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg

from ltcl import checks
from ltcl.device import Device
from ltcl.errors import InputError
from ltcl.scenes import camera
from ltcl.scenes.camera import SceneCamera
from ltcl.scenes.wall_pictures import WallPictures, single_or_all
from ltcl.scenes.walls import Block, Wall, check_albedo, refuse_crossing
from ltcl.transport.transport import Transport

# Rows and columns touched at a time where a matrix meets its transpose.
BLOCK_SIZE = 512
# Form factors found by quadrature or sampling are a little off.
FORM_FACTOR_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class Scene(WallPictures):
    """Patches that light each other; made by `dihedral`, `trihedral`, `box`, or of form factors.

    Parameters
    ----------
    name : str
        Name for messages and plots.
    grid : (h, w)
        The patches as a picture, row-major; N = h * w. The walls lie side by side in it.
    form_factors : ndarray, (N, N), float64
        Entry [i, j] is the share of the light leaving patch i that meets patch j. All colours share
        them.
    albedo : ndarray, (channels, N), float64
        Share of the light a patch gives back, in [0, 1); one channel or three.
    area : ndarray, (N,), float64
        Areas of the patches, any unit; area_i F_ij = area_j F_ji.
    walls : tuple of Wall
        The parts of the picture in space, left to right.
    viewer : SceneCamera
        The eye of `view` and `sample`.
    blocks : tuple of Block
        Boxes that hide walls from the viewer and from lights; the form factors must know of them
        already.

    Raises
    ------
    InputError
        If shapes disagree, a value is NaN, infinite or negative, an albedo is not below 1, rows of
        the form factors sum to more than 1, they break reciprocity, walls cross, or the viewer sees
        no wall.

    Examples
    --------
    >>> from ltcl.scenes import box
    >>> scene = box(4, sides=5, albedo=0.6)
    >>> scene.grid, scene.channels
    ((4, 20), 1)
    """

    name: str
    grid: tuple[int, int]
    form_factors: np.ndarray
    albedo: np.ndarray
    area: np.ndarray
    walls: tuple[Wall, ...]
    viewer: SceneCamera
    blocks: tuple[Block, ...] = ()

    def __post_init__(self) -> None:
        h, w = checks.grid("grid", self.grid)
        object.__setattr__(self, "grid", (h, w))
        if not self.walls:
            raise InputError("walls are 0; a scene needs at least one")
        if w % len(self.walls):
            raise InputError(
                f"walls are {len(self.walls)}; they must divide the {w} columns of the grid"
            )
        n = h * w
        self._set_array("form_factors", (n, n))
        self._set_array("albedo", (1, n), (3, n))
        self._set_array("area", (n,))
        check_albedo(self.albedo)
        _check_exchange(self.form_factors, self.area)
        refuse_crossing((*self.walls, *self._screens))
        camera.frame(self.viewer, self.walls)

    def _set_array(self, name: str, *shapes: tuple[int, ...]) -> None:
        """Check an array and make it read-only."""
        value = checks.real(name, getattr(self, name)).astype(np.float64, copy=False)
        checks.shape(name, value, *shapes)
        # A view, so that the caller's own array stays writeable.
        view = checks.finite(name, value).view()
        view.flags.writeable = False
        object.__setattr__(self, name, view)

    def __repr__(self) -> str:
        h, w = self.grid
        return f"<ltcl Scene {self.name}, grid {h} x {w}, {self.channels} channel(s)>"

    @property
    def A(self) -> np.ndarray | tuple[np.ndarray, ...]:
        """Physical bounce diag(albedo) @ form_factors (eq. 4): (N, N), or a tuple of three.

        `ltcl.scenes.FormFactor.of` gives it as operators that store no matrix.
        """
        self._check_memory(self.channels)
        bounces = tuple(albedo[:, None] * self.form_factors for albedo in self.albedo)
        return single_or_all(bounces)

    def matrices(self) -> tuple[np.ndarray, ...]:
        """Exact light transport T = (I - A)^-1 diag(albedo) (eq. 4), (N, N) float64 per channel.

        T_ij is what patch i shows when unit light falls on patch j.

        Raises
        ------
        MemoryLimitError
            If the matrices do not fit in the memory of the host; nothing is allocated then.
        InputError
            If the scene makes light: form factors a little above 1 and albedos hardly below.

        Examples
        --------
        >>> from ltcl.scenes import dihedral
        >>> (T,) = dihedral(2, albedo=0.5).matrices()
        >>> T.shape, bool((T.diagonal() >= 0.5).all())
        ((8, 8), True)
        """
        self._check_memory(self.channels)
        matrices = []
        for albedo in self.albedo:
            matrices.append(transport_matrix(self.form_factors, albedo, self.area))
        return tuple(matrices)

    def transport(
        self,
        first_bounce: Any = "diagonal",
        device: Device | str | None = None,
        *,
        on_dark: str = "mask",
    ) -> Transport:
        """The scene's `ltcl.Transport`, ready to compensate, separate and relight.

        Parameters
        ----------
        first_bounce : "diagonal", "exact" or ndarray, (N,) or (3, N)
            F, as `Transport` takes it; `scene.first_bounce` is the truth.
        device : Device or str, optional
            The device that `Transport` computes on; the best one if omitted.
        on_dark : "mask" or "raise"
            Treatment of patches of albedo 0, or hidden from the camera or projector of a glossy
            scene: never light them, or refuse.

        Examples
        --------
        >>> from ltcl.scenes import dihedral
        >>> dihedral(4).transport().grid
        (4, 8)
        """
        return Transport(
            single_or_all(self.matrices()),
            grid=self.grid,
            first_bounce=first_bounce,
            device=device,
            on_dark=on_dark,
        )

    def _check_memory(self, matrices: int) -> None:
        pixels = len(self.area)
        shape = f"{pixels} x {pixels}"
        checks.fits_host(
            f"{matrices} matrix(es) of {shape} for the scene {self.name}",
            matrices * 8 * pixels**2,
        )


def transport_matrix(form_factors: np.ndarray, albedo: np.ndarray, area: np.ndarray) -> np.ndarray:
    """T = (I - A)^-1 diag(r), (N, N) float64, of form factors F, albedos r and areas a (N,).

    A is diag(r) F. Reciprocity says that diag(a) F is symmetric. With s = sqrt(r / a) this gives

        B = diag(s) diag(a) F diag(s) = B^T,    T = diag(s) (I - B)^-1 diag(s) diag(a)

    where I - B is positive definite for albedos below one. Cholesky inverts it with half the work
    of a general inverse and in the memory of the result alone; black patches (r = 0) need no
    special case.

    InputError if the gain of one bounce is 1 or more.

    >>> mirrors = np.array([[0.0, 1.0], [1.0, 0.0]])
    >>> transport_matrix(mirrors, albedo=np.array([0.5, 0.5]), area=np.ones(2)).round(4)
    array([[0.6667, 0.3333],
           [0.3333, 0.6667]])
    """
    s = np.sqrt(albedo / area)
    matrix = form_factors * -s  # I - B, step by step in place
    matrix *= (s * area)[:, None]
    matrix[np.diag_indices_from(matrix)] += 1
    potrf, potri = scipy.linalg.get_lapack_funcs(("potrf", "potri"), (matrix,))
    # LAPACK wants columns; the transposed view of a symmetric matrix will do, and saves a copy.
    columns, failed = potrf(matrix.T, lower=1, overwrite_a=1)
    if not failed:
        columns, failed = potri(columns, lower=1, overwrite_c=1)
    if failed:
        raise InputError(
            "albedo and form_factors give a bounce a gain of 1 or more; lower the albedo"
        )
    # The result stands in the upper triangle of the rows only.
    for rows, columns in _blocks(len(matrix)):
        block = matrix[rows, columns]
        if rows == columns:
            block = np.triu(block) + np.triu(block, 1).T
            matrix[rows, columns] = block
        matrix[columns, rows] = block.T
    matrix *= s[:, None]
    matrix *= s * area
    return matrix


def _check_exchange(form_factors: np.ndarray, area: np.ndarray) -> None:
    """Refuse form factors that are negative, make light or break reciprocity, and areas of zero."""
    if area.min() <= 0:
        raise InputError(f"area has the value {area.min():g}; all must be above 0")
    if form_factors.min() < 0:
        raise InputError(
            f"form_factors has the value {form_factors.min():g}; all must be at least 0"
        )
    most = form_factors.sum(axis=1).max()
    if most > 1 + FORM_FACTOR_TOLERANCE:
        raise InputError(
            f"form_factors has a row that sums to {most:g}; no patch can send out more than 1"
        )
    largest = (area * form_factors.max(axis=1)).max()
    worst = 0.0
    for rows, columns in _blocks(len(area)):
        forward = area[rows, None] * form_factors[rows, columns]
        backward = area[columns, None] * form_factors[columns, rows]
        worst = max(worst, np.abs(forward - backward.T).max())
    if worst > FORM_FACTOR_TOLERANCE * largest:
        raise InputError(
            f"form_factors breaks reciprocity by {worst / largest:.2g} of the largest exchange; "
            "area_i F_ij must equal area_j F_ji"
        )


def _blocks(size: int) -> list[tuple[slice, slice]]:
    """Blocks (rows, columns) that cover the upper triangle of a size x size matrix."""
    stretches = []
    for start in range(0, size, BLOCK_SIZE):
        stretches.append(slice(start, min(start + BLOCK_SIZE, size)))
    return list(itertools.combinations_with_replacement(stretches, 2))
