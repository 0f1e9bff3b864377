# SPDX-License-Identifier: BSD-3-Clause
"""T of scenes as a projector sees them in perspective, from exact form factors, without noise.

Camera and projector are one pinhole on the z axis, as in `tracing`. Surfaces are cut along the
pixels' edges into pieces, so that light varies from pixel to pixel as the scene does. With F the
form factors of pieces (P, P), w the part of a pixel that a piece fills, E the irradiance by the own
pixel's light, and Q[m, n] the reflectance of piece m between the pinhole and piece n,

    direct     w Q(pinhole) E
    bounce 1   w (Q o F) (pi Q^T o .) E           both ends see the pinhole
    bounce k   w (Q o F) (a F)^(k-2) a (pi F o Q^T) E

where a is the albedo. Of matt surfaces Q is a / pi; gloss is a lobe around the half vector (Blinn)
at both ends of a path, and counts as albedo in between. Form factors are those of points on one
piece to the whole other one (Lambert's polygon formula), more points where pieces are near, made
reciprocal; blocks hide what rays between points tell. All is float64.

Known limit: a piece has one irradiance, and one reflectance to each other piece.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse

from scenes.exchange import Geometry, form_factors
from scenes.pieces import UNSEEN, Surface, View, cut, faces_of, seen_parts
from scenes.tracing import TRACED, Traced

# Direct light of the median pixel.
TYPICAL_LIGHT = 0.5


@dataclass(frozen=True, kw_only=True)
class Perspective:
    """A scene of `tracing`, and what its pinhole does not see.

    Attributes
    ----------
    traced : Traced
    unseen : sequence of walls
        Corner and both edges of each, (3, 3), of which none is in the frame.
    gloss, exponent : float
        Albedo of the lobe, and its exponent.
    """

    traced: Traced
    unseen: Sequence[np.ndarray] = ()
    gloss: float = 0.0
    exponent: float = 1.0


def _closed_box() -> Perspective:
    """A closed box, whose side walls are cut where they leave the frame."""
    closed = TRACED["closed"]
    leaves = closed.eye - 0.5 / closed.tangent
    seen = []
    unseen = []
    for wall in np.array(closed.walls, np.float64):
        depth = wall[1:, 2]
        if not depth.any():
            (seen if wall[0, 2] == 0 else unseen).append(wall)
            continue
        edge = 1 + int(np.argmax(np.abs(depth)))
        ends = np.sort([wall[0, 2], wall[0, 2] + wall[edge, 2]])
        for low, high, parts in ((ends[0], leaves, seen), (leaves, ends[1], unseen)):
            part = wall.copy()
            part[edge] *= (high - low) / (ends[1] - ends[0])
            part[0, 2] = low if wall[edge, 2] > 0 else high
            parts.append(part)
    return Perspective(traced=replace(closed, walls=seen), unseen=unseen)


SCENES = {
    "dihedral": Perspective(traced=TRACED["corner"]),
    "coloured trihedral": Perspective(traced=TRACED["coloured"]),
    "box with blocks": Perspective(traced=TRACED["blocks"]),
    "glossy corner": Perspective(traced=TRACED["glossy"], gloss=0.2, exponent=20.0),
    "closed box": _closed_box(),
}


class PerspectiveTransport:
    """T of a scene of `SCENES` on a grid, by channels and by bounces.

    Attributes
    ----------
    grid : (h, w)
    channels : 1 or 3
    F : (P, P)
        Form factors of the pieces.
    W, light : sparse (N, P), (P, N)
        Parts of pixels that pieces fill, and irradiance of pieces by the light of pixels.
    """

    def __init__(self, name: str, grid: tuple[int, int]) -> None:
        self.scene = SCENES[name]
        self.grid = grid
        self.pixels = grid[0] * grid[1]
        traced = self.scene.traced
        self.channels = traced.channels
        view = View(traced.eye, traced.tangent, grid)
        surfaces = self._surfaces()
        pieces = cut(view, surfaces, traced.blocks)
        self.shape = Geometry(pieces, surfaces)
        self.F = form_factors(self.shape, traced.blocks)
        if self.channels == 3:
            wall = [surfaces[k].wall for k in pieces.surface]
            self.albedo = np.array(traced.albedo)[wall].T
        else:
            self.albedo = np.full((1, len(pieces)), traced.albedo)
        self.to_eye = view.eye - self.shape.centre
        self.to_eye /= np.linalg.norm(self.to_eye, axis=1, keepdims=True)

        pixel = np.array(pieces.pixel)
        part = np.array(pieces.part)
        seen = part
        if traced.blocks:
            seen = seen_parts(view, surfaces, pieces, traced.blocks)
        # Light of a pixel, which is 1 a unit of area at depth 1.
        flux = (2.0 * view.tangent) ** 2 / self.pixels
        self.own_irradiance = part * flux / self.shape.area
        in_frame = np.flatnonzero(pixel >= 0)
        place = (pixel[in_frame], in_frame)
        shape = (self.pixels, len(pieces))
        lit = seen * flux / self.shape.area
        self.W = scipy.sparse.csr_array((seen[in_frame], place), shape=shape)
        self.light = scipy.sparse.csr_array((lit[in_frame], place), shape=shape).T
        self.unit = TYPICAL_LIGHT / float(np.median(self._direct(0)))

    def _surfaces(self) -> list[Surface]:
        """Walls, those that no pixel sees, and the faces of blocks."""
        traced = self.scene.traced
        surfaces = []
        for wall, (start, right, up) in enumerate(np.array(traced.walls, np.float64)):
            surfaces.append(Surface(start, right, up, wall))
        for start, right, up in self.scene.unseen:
            surfaces.append(Surface(start, right, up, UNSEEN))
        for block in traced.blocks:
            surfaces += faces_of(block)
        return surfaces

    def matrix(self, channel: int = 0) -> np.ndarray:
        """T (N, N) of a channel."""
        # Products with the light of all pixels, which is sparse.
        far = (self.light.T @ self._from_pinhole(channel).T).T
        albedo = self._total_albedo(channel)[:, None]
        system = np.eye(len(self.F)) - albedo * self.F
        radiosity = np.linalg.solve(system, albedo * far)
        T = (self.W @ self._to_pinhole(channel)) @ radiosity
        T += ((self.light.T @ self._both_ends(channel).T) @ self.W.T).T
        T[np.diag_indices(self.pixels)] += self._direct(channel)
        return self.unit * T

    def bounces(self, pattern: np.ndarray, count: int) -> np.ndarray:
        """Direct light and bounces under a grey pattern (h, w), (1 + count, N, channels)."""
        channels = []
        for channel in range(self.channels):
            channels.append(self.unit * self._bounces(channel, pattern.ravel(), count))
        return np.stack(channels, axis=2)

    def _bounces(self, channel: int, pattern: np.ndarray, count: int) -> np.ndarray:
        light = self.light @ pattern
        albedo = self._total_albedo(channel)
        parts = [self._direct(channel) * pattern]
        parts.append(self.W @ (self._both_ends(channel) @ light))
        radiosity = albedo * (self._from_pinhole(channel) @ light)
        to_pinhole = self._to_pinhole(channel)
        for _ in range(1, count):
            parts.append(self.W @ (to_pinhole @ radiosity))
            radiosity = albedo * (self.F @ radiosity)
        return np.array(parts[: 1 + count])

    def _total_albedo(self, channel: int) -> np.ndarray:
        return self.albedo[channel] + self.scene.gloss

    def _direct(self, channel: int) -> np.ndarray:
        """Light of each pixel's own, (N,)."""
        cosine = (self.to_eye * self.shape.normal).sum(axis=1)
        return self.W @ (self._reflectance(channel, cosine[:, None])[:, 0] * self.own_irradiance)

    def _reflectance(self, channel: int, cosine: np.ndarray) -> np.ndarray:
        """Q of pieces, by the cosines of their half vectors, (P, k), or (P, 1) if they are matt."""
        matt = self.albedo[channel][:, None] / math.pi
        if not self.scene.gloss:
            return matt
        exponent = self.scene.exponent
        lobe = (exponent + 8.0) / (8.0 * math.pi) * np.maximum(cosine, 0.0) ** exponent
        return matt + self.scene.gloss * lobe

    @cached_property
    def _cosines(self) -> np.ndarray:
        """Cosines of the half vectors between the pinhole and each other piece, (P, P)."""
        pieces = len(self.F)
        if not self.scene.gloss:
            return np.zeros((pieces, 1))
        cosines = np.zeros((pieces, pieces))
        for k in range(pieces):
            way = self.shape.centre - self.shape.centre[k]
            distance = np.linalg.norm(way, axis=1, keepdims=True)
            # A piece sends itself nothing.
            distance[k] = 1.0
            half = way / distance + self.to_eye[k]
            cosines[k] = half @ self.shape.normal[k] / np.linalg.norm(half, axis=1)
        return cosines

    def _to_pinhole(self, channel: int) -> np.ndarray:
        """Radiance towards the pinhole by the radiosity of pieces, (P, P)."""
        return self._reflectance(channel, self._cosines) * self.F

    def _from_pinhole(self, channel: int) -> np.ndarray:
        """Irradiance by that of pieces from the pinhole, (P, P)."""
        return math.pi * self.F * self._reflectance(channel, self._cosines).T

    def _both_ends(self, channel: int) -> np.ndarray:
        """Radiance towards the pinhole by the irradiance of pieces from it, one bounce, (P, P)."""
        return self._reflectance(channel, self._cosines) * self._from_pinhole(channel)
