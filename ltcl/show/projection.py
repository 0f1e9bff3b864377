# SPDX-License-Identifier: BSD-3-Clause
"""`Projection`: codes of a projector for pictures of any size, prepared once, for shows."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import Future
from functools import partial
from typing import Any

import numpy as np

from ltcl import images
from ltcl.errors import InputError, LtclError
from ltcl.images.encoding import to_linear
from ltcl.show.control import ShowControl, ShowState
from ltcl.tasks.compensation import Compensator, FrameStatistics
from ltcl.transport.projectors import CombinedTransport
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
    control : ShowControl, optional
        Asked before each frame.
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
        control: ShowControl | None = None,
        **settings: Any,
    ) -> None:
        self._T = scene.T
        self._setup = scene.setup
        self._resize = resize
        self._decode = settings.get("decode", "auto")
        settings["gain"] = gain
        self._dtype = np.dtype(settings.get("dtype", "uint8"))
        if self._setup is not None:
            self._take_response(settings)
        if gain == "auto":
            settings["film"] = [self._on_camera(picture) for picture in film]
        self._fps = fps
        self._settings = settings
        self._compensator = self._prepare(settings)
        # Codes of the last frame.
        self._last: Future[np.ndarray | None] | None = None
        self._control = ShowControl() if control is None else control
        self._control.projectors = self.projectors
        self._control.read_statistics = lambda: self.statistics
        self._applied = ShowState()

    def _take_response(self, settings: dict[str, Any]) -> None:
        """Let codes be those of the measured projector; with several each has its own curve."""
        settings["encode"] = self._setup.response
        if self._setup.response is None:
            settings["encode"] = "linear"
            settings["dtype"] = "float32"

    def _prepare(self, settings: dict[str, Any]) -> Compensator:
        # For a camera of other pixels light is found only within the bounds.
        settings = {"clamp": self._T.is_square, "fps": self._fps, **settings}
        try:
            return Compensator(self._T, **settings)
        except InputError:
            # Bad settings are refused once more; light that fixed steps do not undo is no reason.
            del settings["clamp"]
            settings.setdefault("deadline_ms", 1e3 * STEPS_SHARE / self._fps)
            return Compensator(self._T, **settings)

    @property
    def grid(self) -> tuple[int, int]:
        """Height and width of the codes."""
        if self._setup is not None:
            return self._setup.pixels
        return self._T.grid

    @property
    def projectors(self) -> int:
        """Projectors whose codes stand side by side."""
        if isinstance(self._T, CombinedTransport):
            return len(self._T.transports)
        return 1

    @property
    def statistics(self) -> FrameStatistics:
        """Numbers of the frames so far, since the compensation was prepared."""
        return self._compensator.statistics

    def codes(self, picture: np.ndarray) -> np.ndarray:
        """Codes on the pixels of the projector for sRGB codes or light (h, w[, 3])."""
        codes = self.submit(picture).result()
        assert codes is not None  # noqa: S101 - late="wait" drops nothing
        return self.enlarged(codes)

    def submit(self, picture: np.ndarray) -> Future[np.ndarray | None]:
        """Take a picture; its codes, which `enlarged` brings to the projector, come later."""
        state = self._control.state
        if state is not self._applied:
            self._apply(state)
        if state.is_frozen and self._last is not None:
            return self._last
        if state.is_black or len(state.off) == self.projectors:
            future: Future[np.ndarray | None] = Future()
            future.set_result(self._black())
            self._last = future
            return future
        if state.picture is not None:
            picture = self._coded(state.picture)
        self._last = self._compensator.submit(self._on_camera(picture))
        if state.off:
            self._last = _then(self._last, partial(self._darkened, off=state.off))
        return self._last

    def _apply(self, state: ShowState) -> None:
        """Take over another gain and bounds; what cannot be is told, and nothing changes."""
        before = self._applied
        self._applied = state
        if (state.gain, state.bounds) == (before.gain, before.bounds):
            return
        try:
            if state.bounds is not None and state.bounds != before.bounds:
                self._take_bounds(state.bounds)
            if state.gain is not None and state.gain != before.gain:
                self._take_gain(state.gain)
        except LtclError as error:
            self._control.on_error(str(error))

    def _take_bounds(self, bounds: tuple[float, float]) -> None:
        try:
            self._compensator.bounds = bounds
            self._settings["bounds"] = bounds
        except InputError:
            # Perhaps these bounds need projected steps, which were left out.
            gain = self._compensator.gain
            if self._compensator.follows_gain:
                gain = "follow"
            self._prepare_anew({**self._settings, "bounds": bounds, "gain": gain})

    def _take_gain(self, gain: float | str) -> None:
        if isinstance(gain, str):
            self._prepare_anew({**self._settings, "gain": gain})
        else:
            self._compensator.follows_gain = False
            self._compensator.gain = gain

    def _prepare_anew(self, settings: dict[str, Any]) -> None:
        """Go on with other settings, for which the show pauses."""
        settings.pop("film", None)
        compensator = self._prepare(settings)
        self._compensator.close()
        self._compensator = compensator
        self._settings = settings

    def _black(self) -> np.ndarray:
        """The codes of a black projector."""
        return np.zeros((*self._T.grid, 3), self._settings.get("dtype", "uint8"))

    def _darkened(self, codes: np.ndarray, off: frozenset[int]) -> np.ndarray:
        """A copy of codes on the pixels of T with the patterns of projectors `off` black."""
        assert isinstance(self._T, CombinedTransport)  # noqa: S101 - else all are off
        montage = self._T.montage
        patterns = list(montage.split(codes))
        for number in off:
            patterns[number - 1][:] = 0
        return montage.join(patterns)

    def _coded(self, light: np.ndarray) -> np.ndarray:
        """Linear light in the encoding of frames."""
        return images.to_srgb(light) if self._decode == "srgb" else light

    def enlarged(self, codes: np.ndarray) -> np.ndarray:
        """Bring codes from the pixels of T to those of the projector."""
        if self._setup is None:
            return codes
        if self._setup.response is not None:
            return self._setup.blocks.enlarged(codes)
        # They are light, of which several projectors make codes.
        shown = self._setup.codes(codes)
        if self._dtype.kind == "f":
            return shown
        return np.rint(np.iinfo(self._dtype).max * shown).astype(self._dtype)

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
        return self._coded(light)


def _then(
    future: Future[np.ndarray | None], change: Callable[[np.ndarray], np.ndarray]
) -> Future[np.ndarray | None]:
    """A future of the changed codes of another one, dropped frames and errors as they are."""
    changed: Future[np.ndarray | None] = Future()

    def take(done: Future[np.ndarray | None]) -> None:
        try:
            codes = done.result()
            changed.set_result(None if codes is None else change(codes))
        except Exception as error:  # noqa: BLE001 - the one who asks for codes raises it
            changed.set_exception(error)

    future.add_done_callback(take)
    return changed
