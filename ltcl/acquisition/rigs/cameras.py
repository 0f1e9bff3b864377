# SPDX-License-Identifier: BSD-3-Clause
"""`Camera`: what `LiveRig` needs of one. `OpenCVCamera`: whatever OpenCV opens, with its automatics locked.

Properties of OpenCV mean something else on each of its backends. Known here: V4L2 (Linux) counts exposure in
units of 100 microseconds and calls manual exposure 1; Media Foundation and DirectShow (Windows) count in
powers of two of a second and call it 0. A camera behind another backend, a file or a stream has the one
exposure that its user states. What a camera adapts against its settings shows in the tests of `LiveRig`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np

from ltcl import checks
from ltcl.acquisition.rig import LONGEST, SHORTEST, as_seconds
from ltcl.errors import AcquisitionError, InputError, InputTypeError

_GREEN = 1
_SAME = 0.05  # relative difference of an exposure read back that rounding to the camera's steps explains
_UNKNOWN = -1.0  # what OpenCV says of a property that the camera does not tell


class Camera(Protocol):
    """What `LiveRig` photographs with.

    Used where a camera has it: `exposures`, the seconds it offers, ascending (else any within `limits`, which
    are 1e-4 and 30 where it has none of these); `bits` in use in a uint16 frame (else 16); `describe()`, a
    dict of plain JSON; `close()`.
    """

    @property
    def channels(self) -> int:
        """1 for grey, 3 for RGB."""
        ...

    @property
    def stream(self) -> bool:
        """Whether frames come by themselves and may wait in a queue; else each is exposed when asked for."""
        ...

    def expose(self, seconds: float) -> None:
        """Set the time of exposure of the frames to come."""
        ...

    def frame(self) -> np.ndarray:
        """The next frame: uint8, uint16 or float, (H, W) or (H, W, 3), always the same."""
        ...


class _Backend(NamedTuple):
    """How a backend of OpenCV counts exposure."""

    manual: float  # automatic exposure, switched off
    units: Callable[[float], float]  # from seconds
    seconds: Callable[[float], float]  # from units
    exposures: tuple[float, ...] | None


_POWERS = _Backend(
    0.0, lambda s: float(round(math.log2(s))), lambda u: 2.0**u, tuple(2.0**k for k in range(-13, 1))
)
_BACKENDS = {
    "V4L2": _Backend(1.0, lambda s: float(round(s * 1e4)), lambda u: u / 1e4, None),
    "MSMF": _POWERS,
    "DSHOW": _POWERS,
}


class OpenCVCamera:
    """A camera, a video file or a stream that `cv2.VideoCapture` opens.

    Automatic exposure and automatic white balance are switched off, and read back; a camera that keeps them
    is refused.

    Parameters
    ----------
    source : int, path or URL
        The number of a camera, from 0; a file; or a stream, "rtsp://..." and so on.
    channels : 1 or 3
        One channel is the green one, as a sensor has the most pixels of it.
    seconds : float, optional
        The exposure of a camera that cannot be told; needed for files, streams and unknown backends. Nothing
        is set then but the automatics, where there are any.
    size : (H, W), optional
        Of frames to ask for; refused if others come.

    Attributes
    ----------
    exposures : tuple of float, or None
        The seconds that can be set, ascending; None: any within `limits`.
    limits : (float, float)
        The shortest and the longest of them.
    stream : bool
        Whether frames come by themselves; False of files.

    Raises
    ------
    InputError, InputTypeError
        No exposure is stated where it cannot be set, or `source` is neither number nor name.
    AcquisitionError
        It cannot be opened, gives frames of another size, or keeps its automatics on.

    Examples
    --------
    >>> import tempfile
    >>> path = f"{tempfile.mkdtemp()}/grey.avi"
    >>> video = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), 30, (32, 16))
    >>> _ = video.write(np.full((16, 32, 3), 128, np.uint8))
    >>> video.release()
    >>> with OpenCVCamera(path, channels=1, seconds=1 / 30) as camera:
    ...     camera.frame().shape
    (16, 32)
    """

    def __init__(
        self,
        source: int | str | os.PathLike[str],
        *,
        channels: int = 3,
        seconds: float | None = None,
        size: tuple[int, int] | None = None,
    ) -> None:
        self.channels = checks.one_of("channels", channels, (1, 3))
        self.source = _source(source)
        self.stream = not (isinstance(self.source, str) and os.path.isfile(self.source))
        self._seconds = None if seconds is None else as_seconds(seconds)
        size = None if size is None else checks.grid("size", size)
        self._capture = cv2.VideoCapture(self.source)
        try:
            self._set_up(size)
        except BaseException:
            self.close()
            raise

    def expose(self, seconds: float) -> None:
        """Set the exposure, and read it back.

        Raises
        ------
        InputError
            It is not the one exposure of a camera that cannot be told.
        AcquisitionError
            The camera takes another.
        """
        seconds = as_seconds(seconds)
        if self._backend is None or self._seconds is not None:
            if self._seconds is None or not math.isclose(seconds, self._seconds, rel_tol=1e-3):
                raise InputError(f"seconds is {seconds:g}; it must be {self._seconds:g}, as was stated")
            return
        asked = self._backend.units(seconds)
        taken = self._capture.set(cv2.CAP_PROP_EXPOSURE, asked)
        found = self._capture.get(cv2.CAP_PROP_EXPOSURE)
        if not taken or abs(self._backend.seconds(found) / seconds - 1.0) > _SAME:
            raise AcquisitionError(
                f"the camera does not expose for {seconds:.4g} s: {asked:g} was set, {found:g} read back"
            )

    def frame(self) -> np.ndarray:
        """The next frame: uint8 or uint16, (H, W) or (H, W, 3) in RGB.

        Raises
        ------
        AcquisitionError
            None comes: the camera was unplugged, or the file or stream has ended.
        """
        good, image = self._capture.read()
        if not good or image is None:
            raise AcquisitionError(
                f"no frame comes from {self.source!r}: the camera was unplugged, or its stream has ended"
            )
        if image.ndim == 3 and image.shape[2] == 3:
            return np.ascontiguousarray(image[..., _GREEN if self.channels == 1 else slice(None, None, -1)])
        grey = image.reshape(image.shape[:2]) if image.size == image.shape[0] * image.shape[1] else None
        if grey is None or self.channels == 3:
            raise AcquisitionError(f"frames from {self.source!r} have shape {image.shape}; they must be RGB")
        return grey

    def describe(self) -> dict[str, Any]:
        """Plain JSON for the records."""
        return {
            "kind": "opencv",
            "source": self.source if isinstance(self.source, int) else os.path.basename(self.source),
            "backend": self._capture.getBackendName() if self._capture.isOpened() else None,
            "channels": self.channels,
            "exposures": None if self.exposures is None else list(self.exposures),
            "locked": self._locked,
        }

    def close(self) -> None:
        """Let the camera go."""
        self._capture.release()

    def __enter__(self) -> OpenCVCamera:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _set_up(self, size: tuple[int, int] | None) -> None:
        if not self._capture.isOpened():
            raise AcquisitionError(f"OpenCV cannot open {self.source!r}; it is no camera, video or stream")
        name = self._capture.getBackendName()
        self._backend = _BACKENDS.get(name)
        if self._backend is None and self._seconds is None:
            raise InputError(
                f"seconds is None; it must be the exposure of {self.source!r}, which {name} cannot set"
            )
        self.exposures = self._backend.exposures if self._backend is not None else None
        if self._seconds is not None:
            self.exposures = (self._seconds,)
        if size is not None:
            self._resize(size)
        self._locked = self._lock()
        self.limits = self._limits()

    def _resize(self, size: tuple[int, int]) -> None:
        self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[0])
        self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[1])
        sides = (cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_WIDTH)
        found = tuple(int(self._capture.get(side)) for side in sides)
        if found != size:
            raise AcquisitionError(f"{self.source!r} gives frames of {found}; size asks for {size}")

    def _limits(self) -> tuple[float, float]:
        """The shortest and the longest exposure, as far as drivers cut to them what is out of range."""
        if self.exposures is not None or self._backend is None:
            return SHORTEST, LONGEST
        found = []
        for seconds in (SHORTEST, LONGEST):
            self._capture.set(cv2.CAP_PROP_EXPOSURE, self._backend.units(seconds))
            found.append(self._backend.seconds(self._capture.get(cv2.CAP_PROP_EXPOSURE)))
        least, most = max(found[0], SHORTEST), min(found[1], LONGEST)
        return (least, most) if least < most else (SHORTEST, LONGEST)

    def _lock(self) -> dict[str, bool]:
        """Switch off what adapts. True: off, as read back; False: the camera has no such setting."""
        if self._backend is None:
            return {"exposure": False, "white balance": False}
        wanted = {
            "exposure": (cv2.CAP_PROP_AUTO_EXPOSURE, self._backend.manual),
            "white balance": (cv2.CAP_PROP_AUTO_WB, 0.0),
        }
        return {name: self._switched(name, *setting) for name, setting in wanted.items()}

    def _switched(self, name: str, setting: int, value: float) -> bool:
        before = self._capture.get(setting)
        self._capture.set(setting, value)
        found = self._capture.get(setting)
        if found == value:
            return True
        if before == found == _UNKNOWN:
            return False
        raise AcquisitionError(
            f"automatic {name} of {self.source!r} cannot be switched off: {value:g} was asked for, "
            f"{found:g} read back; switch it off in the camera's own program"
        )


def _source(source: Any) -> int | str:
    if isinstance(source, (int, np.integer)) and not isinstance(source, bool):
        return checks.count("source", source, least=0)
    if isinstance(source, (str, os.PathLike)) and os.fspath(source):
        return str(os.fspath(source))
    raise InputTypeError(f"source is {source!r}; it must be the number of a camera, a file or a URL")
