# SPDX-License-Identifier: BSD-3-Clause
"""Pictures on the walls of a scene: drawn for its viewer, read from an image, or lit by a lamp."""

from __future__ import annotations

from typing import Any

import numpy as np

from ltcl import checks
from ltcl.errors import InputError
from ltcl.scenes import camera
from ltcl.scenes.camera import MAX_IMAGE_SIDE, SceneCamera
from ltcl.scenes.rays import clear
from ltcl.scenes.walls import Block, Wall, box_corners, point

# Points along a pixel at which a light is tried.
LIGHT_POINTS = 8


class WallPictures:
    """Pictures on the walls of a scene; subclasses have these attributes.

    Attributes
    ----------
    name : str
    grid : (h, w)
        The walls side by side as a picture, row-major; N = h * w.
    albedo : ndarray, (channels, N)
    area : ndarray, (N,)
    walls : tuple of Wall
    viewer : SceneCamera
    blocks : tuple of Block
        Boxes that hide walls from the viewer and from lights.
    """

    name: str
    grid: tuple[int, int]
    albedo: np.ndarray
    area: np.ndarray
    walls: tuple[Wall, ...]
    viewer: SceneCamera
    blocks: tuple[Block, ...]

    @property
    def channels(self) -> int:
        """1 for a scene without colour, 3 for red, green and blue."""
        return len(self.albedo)

    @property
    def first_bounce(self) -> np.ndarray:
        """Direct light of a unit pattern, F = albedo: (N,), or (3, N) in colour."""
        return single_or_all(self.albedo)

    def picture(self, patches: Any) -> np.ndarray:
        """Values per patch, (N,) or (3, N), as a picture on the grid, (h, w) or (h, w, 3).

        Examples
        --------
        >>> from ltcl.scenes import dihedral
        >>> scene = dihedral(2, albedo=(0.9, 0.5, 0.2))
        >>> scene.picture(scene.first_bounce)[0, 0]
        array([0.9, 0.5, 0.2])
        """
        values = np.asarray(patches)
        pixels = len(self.area)
        checks.shape("patches", values, (pixels,), (3, pixels))
        if values.ndim == 1:
            return values.reshape(self.grid)
        return np.moveaxis(values.reshape(3, *self.grid), 0, -1)

    def view(self, picture: Any, size: int = 480, supersample: int = 3) -> np.ndarray:
        """Image of a picture on the walls as the viewer of the room sees it; backs are left out.

        Parameters
        ----------
        picture : array_like, (h, w) or (h, w, 3)
            Linear values on the patch grid, any real type, negative ones too.
        size : int
            Pixels along the longer side of the image, up to 32766.
        supersample : int
            Points averaged along each side of a pixel.

        Returns
        -------
        ndarray, (H, W) or (H, W, 3), float32
            The image; 0 beside the walls and on black blocks.

        Raises
        ------
        InputError
            If the picture is not on the grid or not finite, or size or supersample is not a whole
            number of at least 1.

        Examples
        --------
        >>> from ltcl.scenes import box
        >>> room = box(8, sides=3)
        >>> image = room.view(np.ones(room.grid), size=64)
        >>> max(image.shape), float(image.max())
        (64, 1.0)
        """
        picture = checks.finite("picture", checks.real("picture", picture))
        checks.shape("picture", picture, self.grid, (*self.grid, 3))
        size = checks.count("size", size, most=MAX_IMAGE_SIDE)
        supersample = checks.count("supersample", supersample)
        return camera.draw(self.viewer, self.walls, picture, size, supersample, self._screens)

    def sample(self, image: Any) -> np.ndarray:
        """The picture on the walls that looks like a flat image from where the viewer stands.

        Each patch takes the mean of the image over its footprint in `view`; the image is centred
        and just covers the walls, undistorted. The target of a compensation is made like this.

        Parameters
        ----------
        image : array_like, (H, W) or (H, W, 3)
            Linear values, any real type, up to 32766 pixels a side.

        Returns
        -------
        ndarray, (h, w) or (h, w, 3), float32
            On the patch grid; 0 on patches the viewer does not see.

        Raises
        ------
        InputError
            If the image has another shape, or is empty, too large or not finite.

        Examples
        --------
        >>> from ltcl.scenes import dihedral, landscape
        >>> dihedral(8).sample(landscape(60, 80)).shape
        (8, 16, 3)
        """
        image = checks.finite("image", checks.real("image", image))
        is_picture = image.ndim in (2, 3) and image.shape[2:] in ((), (3,))
        if not is_picture or image.size == 0:
            raise InputError(
                f"image has shape {image.shape}; it must be (H, W) or (H, W, 3), not empty"
            )
        checks.count("image", max(image.shape), most=MAX_IMAGE_SIDE)
        return camera.read(self.viewer, self.walls, image, self.grid, self._screens)

    def irradiance(self, light: Any) -> np.ndarray:
        """Light that falls on each patch straight from a point, shadows included, largest value 1.

        It serves as a pattern: ``T @ scene.irradiance(light)`` is the room under that light. The
        value of a patch is the mean of cos(t) / r^2 over 8 x 8 points, 0 where something stands in
        between: at the edge of a shadow it is good to about 1/64 of a patch's light.

        Parameters
        ----------
        light : (x, y, z)
            Place of the light, which shines alike in all directions.

        Returns
        -------
        ndarray, (h, w), float32

        Raises
        ------
        InputError
            If the light stands inside a block, or reaches no patch.

        Examples
        --------
        >>> from ltcl.scenes import box
        >>> picture = box(8, sides=3).irradiance(light=(0.9, 0.9, 0.9))
        >>> picture.shape, float(picture.max())
        ((8, 24), 1.0)
        """
        place = np.array(point("light", light))
        boxes = box_corners(self.blocks)
        for low, high in boxes:
            if np.all((place > low) & (place < high)):
                raise InputError(f"light is {light}, inside a block; move it out")
        light_on_walls = [self._wall_irradiance(wall, place, boxes) for wall in self.walls]
        picture = np.concatenate(light_on_walls, axis=1)
        if picture.max() <= 0:
            raise InputError(
                f"light is {light}, from where it reaches no patch; move it in front of a wall"
            )
        return (picture / picture.max()).astype(np.float32)

    def _wall_irradiance(self, wall: Wall, place: np.ndarray, boxes: Any) -> np.ndarray:
        """Light from a place on the patches of one wall, (h, w of the wall)."""
        h = self.grid[0]
        w = self.grid[1] // len(self.walls)
        u = (np.arange(w * LIGHT_POINTS) + 0.5) / (w * LIGHT_POINTS)
        v = (np.arange(h * LIGHT_POINTS) + 0.5) / (h * LIGHT_POINTS)
        points = wall.points(u, v[:, None])
        rays = place - points
        distance = np.linalg.norm(rays, axis=-1)
        light = np.maximum(rays @ wall.normal, 0) / distance**3
        is_clear = clear(self.walls, points.reshape(-1, 3), place, boxes)
        light *= is_clear.reshape(light.shape)
        return light.reshape(h, LIGHT_POINTS, w, LIGHT_POINTS).mean(axis=(1, 3))

    @property
    def _screens(self) -> tuple[Wall, ...]:
        """Faces of the blocks that carry no part of the picture: black."""
        screens = []
        for block in self.blocks:
            screens += [face for face in block.faces() if face not in self.walls]
        return tuple(screens)


def single_or_all(channels: Any) -> Any:
    """Values of the only channel, or of all channels of a colour."""
    if len(channels) == 1:
        return channels[0]
    return channels
