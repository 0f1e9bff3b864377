# SPDX-License-Identifier: BSD-3-Clause
"""`Projection`: codes of a projector for pictures of any size, prepared once, for shows."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import Future
from typing import Any

import numpy as np

from ltcl import images
from ltcl.errors import InputError
from ltcl.images.encoding import to_linear
from ltcl.tasks.compensation import Compensator, FrameStatistics
from ltcl.viewer.answers import ViewerScene

# Share of the time from frame to frame that projected steps may take, where light cannot be undone.
STEPS_SHARE = 0.5


class Projection:
    """Codes of the projector for pictures, frame by frame.

    Parameters
    ----------
    scene : ViewerScene
        Its T, and its set-up where the projector was measured: codes are then those of the measured
        projector, on its own pixels.
    gain : float, "auto" or "follow"
    film : iterable of pictures
        Those that decide on gain="auto".
    fps : float
    resize : "crop", "letterbox" or "stretch"
        What becomes of pictures of another size, as `ltcl.images.resize` does.
    settings
        Those of `ltcl.Compensator`.
    """

    def __init__(
        self,
        scene: ViewerScene,
        gain: float | str,
        *,
        film: Iterable[np.ndarray] = (),
        fps: float,
        resize: str = "letterbox",
        **settings: Any,
    ) -> None:
        self._T = scene.T
        self._setup = scene.setup
        self._resize = resize
        self._decode = settings.get("decode", "auto")
        settings["gain"] = gain
        if self._setup is not None:
            settings["encode"] = self._setup.calibration.projector
        if gain == "auto":
            settings["film"] = [self._on_camera(picture) for picture in film]
        # For a camera of other pixels light is found only within the bounds.
        is_clamped = settings.pop("clamp", self._T.is_square)
        try:
            self._compensator = Compensator(self._T, clamp=is_clamped, fps=fps, **settings)
        except InputError:
            # Bad settings are refused once more; light that fixed steps do not undo is no reason.
            deadline = 1e3 * STEPS_SHARE / fps
            self._compensator = Compensator(self._T, deadline_ms=deadline, fps=fps, **settings)

    @property
    def grid(self) -> tuple[int, int]:
        """Height and width of the codes."""
        if self._setup is not None:
            return self._setup.blocks.pixels
        return self._T.grid

    @property
    def statistics(self) -> FrameStatistics:
        """Numbers of the frames so far."""
        return self._compensator.statistics

    def codes(self, picture: np.ndarray) -> np.ndarray:
        """Codes on the pixels of the projector for sRGB codes or light (h, w[, 3])."""
        return self.enlarged(self._compensator(self._on_camera(picture)))

    def submit(self, picture: np.ndarray) -> Future[np.ndarray | None]:
        """Take a picture; its codes, which `enlarged` brings to the projector, come later."""
        return self._compensator.submit(self._on_camera(picture))

    def enlarged(self, codes: np.ndarray) -> np.ndarray:
        """Bring codes from the pixels of T to those of the projector."""
        return codes if self._setup is None else self._setup.blocks.enlarged(codes)

    def close(self) -> None:
        """Wait for the frames on their way."""
        self._compensator.close()

    def _on_camera(self, picture: np.ndarray) -> np.ndarray:
        """Bring a picture to the camera's grid; one of another size becomes linear light."""
        grid = self._T.camera_grid
        if picture.shape[:2] == grid:
            return picture
        light = images.resize(to_linear(picture, self._decode), grid, self._resize)
        # The compensator would take floats for codes.
        return images.to_srgb(light) if self._decode == "srgb" else light
