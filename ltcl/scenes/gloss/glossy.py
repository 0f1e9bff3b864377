# SPDX-License-Identifier: BSD-3-Clause
"""Glossy rooms seen by one camera and lit by one projector: T = P S F Q on the full light field (eq. 28).

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

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from ltcl import checks
from ltcl.errors import InputError, InputTypeError
from ltcl.scenes.gloss import beams, brdf
from ltcl.scenes.patches import cut
from ltcl.scenes.rays import Sight, sight
from ltcl.scenes.scene import Scene
from ltcl.scenes.viewer import Viewer
from ltcl.scenes.walls import Block, Wall, point, spread_albedo, vector
from ltcl.transport import frames as layout

_COLUMNS = 64  # of T computed together
_TAIL = 1e-8  # of a white patch: all bounces left out together


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class GlossyScene(Scene):
    """Patches that reflect into each other as their material, camera and projector say; made by `glossy`.

    Attributes
    ----------
    matte : Scene
        The same room without gloss: grid, walls, albedo, viewer, and form factors found by the same
        rays.
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
        return Scene(*(getattr(self, own.name) for own in fields(Scene)))

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
            for r in self.albedo
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
        F = self.albedo * direct
        return F[0] if self.channels == 1 else F

    def matrices(self) -> tuple[np.ndarray, ...]:
        """T = P S F Q, one (N, N) float64 array per channel, bounces summed until 1e-8 is left.

        Raises
        ------
        MemoryLimitError
            If they do not fit in the memory of the host.
        """
        patches = len(self.area)
        block = 8 * patches * (self.directions + 1) * min(_COLUMNS, patches)
        checks.fits_host(
            f"the transport of {self.name}, {self.channels} of {patches} x {patches},",
            self.channels * 8 * patches**2 + 4 * block,
        )
        light = np.eye(patches)
        slices = [slice(start, start + _COLUMNS) for start in range(0, patches, _COLUMNS)]
        return tuple(
            np.concatenate(
                [sum(self._pictures(albedo, light[:, columns])) for columns in slices], axis=1
            )
            for albedo in self.albedo
        )

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
            for albedo, light in zip(self.albedo, columns, strict=True)
        ]
        return np.stack([shape.pack(list(parts), self.grid) for parts in zip(*series, strict=True)])

    def _pictures(
        self, albedo: np.ndarray, light: np.ndarray, count: int | None = None
    ) -> Iterator[np.ndarray]:
        """P A^k F Q light (N, k) one after another: `count` indirect ones, or until little is left."""
        most, blocks = albedo.max(), self.white.data
        arriving, bounce = self.Q @ light.astype(np.float64), 0
        while True:
            # K arriving, as products of dense blocks, which are much faster than those of
            # `bsr_array`.
            leaving = blocks @ arriving.reshape(len(blocks), blocks.shape[1], -1)
            leaving *= albedo[:, None, None]
            leaving = leaving.reshape(arriving.shape)
            yield self.P @ leaving
            left = np.abs(leaving).max(initial=0.0) * most / (1 - most)
            if bounce == count or (count is None and left <= _TAIL):
                return
            arriving, bounce = self.G @ leaving, bounce + 1


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
        As `box` takes it: a scalar, one per wall, one colour, or one colour per wall.
    gloss : array_like in [0, 1]
        Share of the reflected light that the lobe takes; a scalar or one per wall. 0 is matte.
    exponent : array_like, above 0
        Of the lobe, see `brdf`; a scalar or one per wall, at most 8 * directions.
    projector, camera : (3,)
        Where they stand. The camera of a scene stands where its viewer does, unless given.
    directions : int
        Bins over each patch, M: a square number of at least 4.
    rays : int
        Followed from each bin of each patch.
    blocks : sequence of Block
        What else stands in the room. Faces that are not among the walls are black.
    seed : int
        Of the rays.

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
    blocks = (*(room.blocks if isinstance(room, Scene) else ()), *blocks)
    boxes = np.array([(block.low, block.high) for block in blocks]).reshape(-1, 2, 3)
    n, k = checks.count("n", n), brdf.side(directions)
    size, slots = n * n * len(walls), k * k + 1
    needed = 8 * size * slots**2 + 4 * 8 * size**2  # reflectances; form factors and room to work
    checks.fits_host(f"{name}, {size} patches of {slots} x {slots} reflectances,", needed)
    albedos = spread_albedo(albedo, len(walls), n)
    materials = _materials(gloss, exponent, len(walls), k)
    patches = cut(walls, n)
    lights = sight("projector", projector, walls, patches, boxes)
    sees = sight("camera", viewer.eye if camera is None else camera, walls, patches, boxes)
    exchange = beams.exchange(walls, n, directions, rays, boxes, seed)
    entries = (
        exchange.tocoo()
    )  # with an empty last slot: no patch gets what others send to the camera
    places = tuple(index + index // (slots - 1) for index in (entries.row, entries.col))
    form_factors, grid = _form_factors(exchange, patches.area), (n, n * len(walls))
    matte = name, grid, form_factors, albedos, patches.area, walls, viewer, blocks
    return GlossyScene(
        *matte,
        G=scipy.sparse.csr_array((entries.data, places), (size * slots, size * slots)),
        white=_reflectance(n, materials, lights, sees),
        P=_last_slots((sees.share > 0).astype(np.float64), slots),
        Q=scipy.sparse.csr_array(_last_slots(lights.share, slots).T),
    )


def _room(room: Any, camera: Any) -> tuple[tuple[Wall, ...], str, Viewer]:
    """Walls, name, and who looks: the scene's viewer, or one at the camera who looks at the walls' middle."""
    if isinstance(room, Scene):
        return room.walls, f"glossy {room.name}", room.viewer
    walls = tuple(room) if isinstance(room, Sequence) else ()
    if not walls or not all(isinstance(wall, Wall) for wall in walls):
        raise InputTypeError(f"room is {room!r}; it must be a scene, or one or more walls")
    if camera is None:
        raise InputError("camera is None; it must be a place (x, y, z) where room is walls only")
    viewer = Viewer(point("camera", camera), vector(cut(walls, 1).centre.mean(axis=0)))
    return walls, f"glossy room of {len(walls)} wall(s)", viewer


def _materials(gloss: Any, exponent: Any, walls: int, k: int) -> list[tuple[float, brdf.Lobe]]:
    """Share and lobe of each wall, of one number for all or one for each."""
    numbers = []
    for name, value in (("gloss", gloss), ("exponent", exponent)):
        array = checks.finite(name, checks.real(name, value)).astype(np.float64)
        numbers.append(np.broadcast_to(checks.shape(name, array, (), (walls,)), (walls,)).tolist())
    for share in numbers[0]:
        checks.number("gloss", share, least=0.0, most=1.0)
    lobes = {value: brdf.lobe(value, k) for value in numbers[1]}
    return [(share, lobes[value]) for share, value in zip(*numbers, strict=True)]


def _form_factors(exchange: Any, area: np.ndarray) -> np.ndarray:
    """Of matte patches: means over the bins, (N, N); reciprocal, and no row above 1, to rounding."""
    size = len(area)
    bins = exchange.shape[0] // size
    sums = scipy.sparse.kron(scipy.sparse.eye_array(size), np.ones((1, bins)), format="csr")
    both = area[:, None] * (sums @ exchange @ sums.T).toarray() / bins
    form_factors = (both + both.T) / (2 * area[:, None])
    return form_factors / max(1.0, form_factors.sum(axis=1).max())


def _last_slots(values: np.ndarray, slots: int) -> scipy.sparse.csr_array:
    """(N, N slots) that picks the last slot of each patch, times a value."""
    rows = np.flatnonzero(values)
    shape = (len(values), len(values) * slots)
    return scipy.sparse.csr_array((values[rows], (rows, (rows + 1) * slots - 1)), shape)


def _reflectance(
    n: int, materials: list[tuple[float, brdf.Lobe]], lights: Sight, sees: Sight
) -> scipy.sparse.bsr_array:
    """K of a white room: a block (M + 1, M + 1) for each patch."""
    bins = len(materials[0][1].scale)
    wall = np.arange(n * n * len(materials)) // n % len(materials)
    blocks = np.zeros((len(wall), bins + 1, bins + 1))
    for number, (share, lobe) in enumerate(materials):
        here = wall == number
        seen, lit = here & (sees.share > 0), here & (lights.share > 0)
        both = seen & lit
        blocks[here, :-1, :-1] = (1 - share + share * lobe.between) / bins
        blocks[seen, -1, :-1] = (1 - share + share * lobe.towards(sees.towards[seen])) / bins
        blocks[lit, :-1, -1] = 1 - share + share * lobe.towards(lights.towards[lit])
        blocks[both, -1, -1] = (
            1 - share + share * lobe.direct(lights.towards[both], sees.towards[both])
        )
    places = np.arange(len(wall))
    return scipy.sparse.bsr_array((blocks, places, np.arange(len(wall) + 1)))
