# SPDX-License-Identifier: BSD-3-Clause
"""Glossy rooms, one camera, one projector: T = P S F Q on the full light field (eq. 28).

    S = (I - A)^-1,    A = K G (eq. 4),    T = P F Q + P A F Q + P A^2 F Q + ...    (eq. 29)

A light field gives each of N patches M + 1 values. Leaving a patch: radiance into M bins of
directions (`brdf`), and last the radiance towards the camera. Arriving: radiance from the M bins,
and last the irradiance from the projector. G (`beams`) carries light between bins; K (`brdf`)
reflects, block by block; F is K too, as it meets the projector's light. So P and Q only pick and
place the last values: camera and projector have the exact direction they see a patch from, not that
of the nearest bin, and what P picks is a final gather over the light that arrives. Only between
patches is light spread over bins.

A white matte patch under unit light shows 1, as in the diffuse `Scene`. Rows of A sum to at most
the albedo, so with m the largest albedo all bounces after A^k F Q are at most max(A^k F Q) m / (1 -
m); sums stop there.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import scipy.sparse
from scipy.sparse.linalg import aslinearoperator

from ltcl import checks
from ltcl.errors import InputError, InputTypeError
from ltcl.scenes.camera import SceneCamera
from ltcl.scenes.gloss import beams, brdf
from ltcl.scenes.patches import cut
from ltcl.scenes.rays import Sight, sight
from ltcl.scenes.scene import Scene, single_or_all
from ltcl.scenes.walls import (
    Block,
    Wall,
    box_corners,
    finite_floats,
    point,
    spread_albedo,
    vector,
)
from ltcl.transport import frames as picture_frames

# Columns of T that are computed together.
COLUMNS_AT_ONCE = 64
# Light that all bounces which are left out add together, as a part of a white patch.
MAX_TAIL = 1e-8


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class GlossyScene(Scene):
    """Glossy patches that reflect into each other, with camera and projector; made by `glossy`.

    Attributes
    ----------
    matte : Scene
        The same room without gloss: grid, walls, albedo, viewer, and form factors found by the same
        rays.
    G : csr_array, (N (M + 1), N (M + 1)), float64
        Light that arrives, for light that leaves; without colour.
    white : bsr_array, (N (M + 1), N (M + 1)), float64
        K at albedo 1: one block per patch, rows by leaving, columns by arriving direction.
    P : csr_array, (N, N (M + 1))
        Light that the camera sees; 0 for patches hidden from it.
    Q : csr_array, (N (M + 1), N)
        Light of the projector; the part of each patch that is not in shadow.

    Examples
    --------
    >>> from ltcl.scenes import dihedral, glossy
    >>> scene = glossy(
    ...     dihedral(2), 2, albedo=0.5, gloss=0.3, projector=(2, 1.5, 0.6), directions=16
    ... )
    >>> light = scene.K @ (scene.Q @ np.ones(8))  # F Q l_in
    >>> first_bounce = scene.P @ (scene.A @ light)
    >>> bool(np.allclose(first_bounce, scene.bounces(np.ones(scene.grid), 1)[1].ravel()))
    True
    """

    G: scipy.sparse.csr_array
    white: scipy.sparse.bsr_array
    P: scipy.sparse.csr_array
    Q: scipy.sparse.csr_array

    @property
    def matte(self) -> Scene:
        """The same room without gloss."""
        return Scene(**{field.name: getattr(self, field.name) for field in fields(Scene)})

    @property
    def directions(self) -> int:
        """M, the number of bins of directions over each patch."""
        return self.white.blocksize[0] - 1

    @property
    def K(self) -> Any:
        """Reflection from arriving to leaving light, and F: a bsr_array, or a tuple of three."""
        reflections = []
        for albedo in self.albedo:
            blocks = self.white.data * albedo[:, None, None]
            bsr = (blocks, self.white.indices, self.white.indptr)
            reflections.append(scipy.sparse.bsr_array(bsr))
        return single_or_all(tuple(reflections))

    @property
    def A(self) -> Any:
        """Bounce of the light field, K G (eq. 4), a LinearOperator; a tuple of three in colour."""
        G = aslinearoperator(self.G)
        if self.channels == 1:
            return aslinearoperator(self.K) @ G
        return tuple(aslinearoperator(K) @ G for K in self.K)

    @property
    def first_bounce(self) -> np.ndarray:
        """P F Q, which is diagonal: (N,), or (3, N) in colour.

        It is 0 where camera or projector see nothing.
        """
        reflected = self.P.sum(axis=1) * self.white.data[:, -1, -1]
        direct = reflected * self.Q.sum(axis=0)
        return single_or_all(self.albedo * direct)

    def matrices(self) -> tuple[np.ndarray, ...]:
        """T = P S F Q, one (N, N) float64 array per channel, bounces summed until 1e-8 is left.

        Raises
        ------
        MemoryLimitError
            If they do not fit in the memory of the host.
        """
        patches = len(self.area)
        columns_at_once = min(COLUMNS_AT_ONCE, patches)
        light_field = 8 * patches * (self.directions + 1) * columns_at_once
        checks.fits_host(
            f"the transport of {self.name}, {self.channels} of {patches} x {patches},",
            self.channels * 8 * patches**2 + 4 * light_field,
        )
        light = np.eye(patches)
        matrices = []
        for albedo in self.albedo:
            columns = []
            for start in range(0, patches, COLUMNS_AT_ONCE):
                patterns = light[:, start : start + COLUMNS_AT_ONCE]
                columns.append(sum(self._pictures(albedo, patterns)))
            matrices.append(np.concatenate(columns, axis=1))
        return tuple(matrices)

    def bounces(self, pattern: Any, count: int) -> np.ndarray:
        """True pictures of single bounces, P A^k F Q pattern for k = 0 (direct) to count (eq. 29).

        Parameters
        ----------
        pattern : (h, w), (h, w, 3), or frames of these
        count : int
            Number of indirect bounces.

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
        columns, layout = picture_frames.unpack("pattern", pattern, self.grid, self.channels)
        channels = []
        for albedo, light in zip(self.albedo, columns, strict=True):
            channels.append(list(self._pictures(albedo, light, count)))
        pictures = []
        for bounce in zip(*channels, strict=True):
            pictures.append(layout.pack(list(bounce), self.grid))
        return np.stack(pictures)

    def _pictures(
        self, albedo: np.ndarray, light: np.ndarray, count: int | None = None
    ) -> Iterator[np.ndarray]:
        """P A^k F Q light (N, k) in turn: `count` indirect ones, or until little is left."""
        largest_albedo = albedo.max()
        blocks = self.white.data
        arriving = self.Q @ light.astype(np.float64)
        for bounce in itertools.count():
            # K arriving, as products of dense blocks, which are much faster than those of
            # `bsr_array`.
            leaving = blocks @ arriving.reshape(len(blocks), blocks.shape[1], -1)
            leaving *= albedo[:, None, None]
            leaving = leaving.reshape(arriving.shape)
            yield self.P @ leaving
            largest = np.abs(leaving).max(initial=0.0)
            tail = largest * largest_albedo / (1 - largest_albedo)
            if bounce == count or (count is None and tail <= MAX_TAIL):
                return
            arriving = self.G @ leaving


def glossy(
    room: Scene | Sequence[Wall],
    n: int,
    albedo: Any = 0.7,
    gloss: Any = 0.5,
    exponent: Any = 20.0,
    *,
    projector: Any,
    camera: Any = None,
    directions: int = 64,
    rays: int = 64,
    blocks: Sequence[Block] = (),
    seed: int = 0,
) -> GlossyScene:
    """A room of glossy walls, n x n patches each, with the place of one projector and one camera.

    Parameters
    ----------
    room : Scene or sequence of Wall
        The walls and blocks of a scene, or any walls. The faces of a block reflect where they are
        among the walls, as in ``box(1, sides=3, occluder=Block(..., albedo=0.5))``.
    n : int
        Patches along each side of a wall.
    albedo : array_like in [0, 1)
        A scalar, one per wall, one colour, or one colour per wall, as `box` takes it.
    gloss : array_like in [0, 1]
        Share of the reflected light that the lobe takes; a scalar or one per wall. 0 is matte.
    exponent : array_like, above 0
        Exponent of the lobe, see `brdf`; a scalar or one per wall, at most 8 * directions.
    projector, camera : (3,)
        Their places. The camera of a scene stands at the eye of its viewer, unless given.
    directions : int
        Number of bins over each patch, M: a square number of at least 4.
    rays : int
        Number of rays followed from each bin of each patch.
    blocks : sequence of Block
        More boxes in the room. Faces that are not among the walls are black.
    seed : int
        Random seed of the rays.

    Returns
    -------
    GlossyScene
        Grid (n, n * walls), walls side by side.

    Raises
    ------
    InputError
        If a number is out of range, or projector or camera see no wall from its front.
    MemoryLimitError
        If the light field does not fit in the memory of the host; nothing is allocated then.

    Notes
    -----
    Errors of the rays fall with `rays`, those of the bins with `directions`. For gloss 0 bins do
    not matter: then this is the diffuse scene, with form factors found by rays (about 2 % off at 64
    x 64).

    Examples
    --------
    >>> from ltcl.scenes import box
    >>> scene = glossy(box(3, sides=3), 3, gloss=0.4, projector=(2, 1.4, 1.2), directions=16)
    >>> scene.grid, scene.directions, scene.P.shape
    ((3, 9), 16, (27, 459))
    """
    walls, name, viewer = _room(room, camera)
    if not isinstance(blocks, Sequence) or not all(isinstance(block, Block) for block in blocks):
        raise InputTypeError(f"blocks is {blocks!r}; it must be a sequence of ltcl.scenes.Block")
    if isinstance(room, Scene):
        blocks = (*room.blocks, *blocks)
    boxes = box_corners(blocks)
    n = checks.count("n", n)
    k = brdf.side(directions)
    size = n * n * len(walls)
    slots = k * k + 1
    reflectance_bytes = 8 * size * slots**2
    form_factor_bytes = 4 * 8 * size**2  # with room to work
    checks.fits_host(
        f"{name}, {size} patches of {slots} x {slots} reflectances,",
        reflectance_bytes + form_factor_bytes,
    )
    albedos = spread_albedo(albedo, len(walls), n)
    materials = _materials(gloss, exponent, len(walls), k)
    patches = cut(walls, n)
    eye = viewer.eye if camera is None else camera
    lit = sight("projector", projector, walls, patches, boxes)
    seen = sight("camera", eye, walls, patches, boxes)
    exchange = beams.exchange(walls, n, directions, rays, boxes, seed)
    return GlossyScene(
        name=name,
        grid=(n, n * len(walls)),
        form_factors=_form_factors(exchange, patches.area),
        albedo=albedos,
        area=patches.area,
        walls=walls,
        viewer=viewer,
        blocks=tuple(blocks),
        G=_with_last_slots(exchange, slots),
        white=_reflectance(n, materials, lit, seen),
        P=_last_slots((seen.share > 0).astype(np.float64), slots),
        Q=scipy.sparse.csr_array(_last_slots(lit.share, slots).T),
    )


def _with_last_slots(exchange: scipy.sparse.csr_array, slots: int) -> scipy.sparse.csr_array:
    """An exchange between bins with an empty last slot in each patch.

    No patch gets the light that others send to the camera.
    """
    bins = slots - 1
    entries = exchange.tocoo()
    rows = entries.row + entries.row // bins
    columns = entries.col + entries.col // bins
    patches = (len(exchange.indptr) - 1) // bins
    size = patches * slots
    return scipy.sparse.csr_array((entries.data, (rows, columns)), (size, size))


def _room(room: Any, camera: Any) -> tuple[tuple[Wall, ...], str, SceneCamera]:
    """Walls, name and viewer of a room.

    The viewer of bare walls looks from the camera at their middle.
    """
    if isinstance(room, Scene):
        return room.walls, f"glossy {room.name}", room.viewer
    walls = tuple(room) if isinstance(room, Sequence) else ()
    if not walls or not all(isinstance(wall, Wall) for wall in walls):
        raise InputTypeError(f"room is {room!r}; it must be a scene, or one or more walls")
    if camera is None:
        raise InputError("camera is None; it must be a place (x, y, z) where room is walls only")
    middle = cut(walls, 1).centre.mean(axis=0)
    viewer = SceneCamera(point("camera", camera), vector(middle))
    return walls, f"glossy room of {len(walls)} wall(s)", viewer


def _materials(gloss: Any, exponent: Any, walls: int, k: int) -> list[tuple[float, brdf.Lobe]]:
    """Share and lobe of the gloss of each wall."""
    shares = _of_walls("gloss", gloss, walls)
    exponents = _of_walls("exponent", exponent, walls)
    for share in shares:
        checks.number("gloss", share, least=0.0, most=1.0)
    lobes = {value: brdf.lobe(value, k) for value in exponents}
    return [(share, lobes[value]) for share, value in zip(shares, exponents, strict=True)]


def _of_walls(name: str, value: Any, walls: int) -> list[float]:
    """A number for each wall, of one for all or one for each."""
    array = checks.shape(name, finite_floats(name, value), (), (walls,))
    return np.broadcast_to(array, (walls,)).tolist()


def _form_factors(exchange: Any, area: np.ndarray) -> np.ndarray:
    """Form factors (N, N) of matte patches, means over the bins: reciprocal, no row above 1."""
    size = len(area)
    bins = exchange.shape[0] // size
    identity = scipy.sparse.eye_array(size)
    sums = scipy.sparse.kron(identity, np.ones((1, bins)), format="csr")
    both = area[:, None] * (sums @ exchange @ sums.T).toarray() / bins
    form_factors = (both + both.T) / (2 * area[:, None])
    return form_factors / max(1.0, form_factors.sum(axis=1).max())


def _last_slots(values: np.ndarray, slots: int) -> scipy.sparse.csr_array:
    """A matrix (N, N slots) that picks the last slot of each patch, times a value."""
    rows = np.flatnonzero(values)
    columns = (rows + 1) * slots - 1
    shape = (len(values), len(values) * slots)
    return scipy.sparse.csr_array((values[rows], (rows, columns)), shape)


def _reflectance(
    n: int, materials: list[tuple[float, brdf.Lobe]], lit: Sight, seen: Sight
) -> scipy.sparse.bsr_array:
    """K of a white room: a block (M + 1, M + 1) for each patch."""
    bins = len(materials[0][1].scale)
    wall = np.arange(n * n * len(materials)) // n % len(materials)
    blocks = np.zeros((len(wall), bins + 1, bins + 1))
    for number, (gloss, lobe) in enumerate(materials):
        matte = 1 - gloss
        is_here = wall == number
        is_seen = is_here & (seen.share > 0)
        is_lit = is_here & (lit.share > 0)
        is_both = is_seen & is_lit
        towards_camera = lobe.towards(seen.towards[is_seen])
        from_projector = lobe.towards(lit.towards[is_lit])
        direct = lobe.direct(lit.towards[is_both], seen.towards[is_both])
        blocks[is_here, :-1, :-1] = (matte + gloss * lobe.between) / bins
        blocks[is_seen, -1, :-1] = (matte + gloss * towards_camera) / bins
        blocks[is_lit, :-1, -1] = matte + gloss * from_projector
        blocks[is_both, -1, -1] = matte + gloss * direct
    places = np.arange(len(wall))
    return scipy.sparse.bsr_array((blocks, places, np.arange(len(wall) + 1)))
