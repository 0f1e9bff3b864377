# SPDX-License-Identifier: BSD-3-Clause
"""Cameras of a `LiveRig`: `OpenCVCamera`, whatever OpenCV opens; `GPhoto2Camera`, one on a cable (gphoto2).

Properties of OpenCV mean something else on each of its backends. Known here: V4L2 (Linux) counts exposure in
units of 100 microseconds and calls manual exposure 1; Media Foundation and DirectShow (Windows) count in
powers of two of a second and call it 0. A camera behind another backend, a file or a stream has the one
exposure that its user states. A camera that adapts in spite of its settings is found by `survey`.

libgphoto2 names settings after the camera's maker, so several names are tried.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from ltcl import checks
from ltcl.acquisition.rig import LONGEST, SHORTEST, as_seconds, exact, load_extra
from ltcl.acquisition.rigs import photographs
from ltcl.errors import AcquisitionError, InputError, InputTypeError

_TOLERANCE = 0.05  # relative difference of an exposure read back that rounding to the camera's steps explains
_UNKNOWN = -1.0  # OpenCV's value of a property that the camera does not have
_SHUTTER = ("shutterspeed2", "shutterspeed")  # the first, where both are there, is not rounded
_MANUAL = {"autoexposuremode": ("Manual",), "expprogram": ("M", "Manual")}
_FIXED = ("iso", "isoauto", "autoiso", "whitebalance")  # none of these may be automatic
_AUTOMATIC = re.compile(r"\s*(auto|on\b|bulb)", re.IGNORECASE)
_SECONDS = re.compile(r"\s*(\d+(?:\.\d+)?)(?:\s*/\s*(\d+))?\s*(?:s|\")?\s*", re.ASCII)


class _Backend(NamedTuple):
    """How a backend of OpenCV counts exposure."""

    manual: float  # automatic exposure, switched off
    units: Callable[[float], float]  # from seconds
    seconds: Callable[[float], float]  # from units
    exposures: tuple[float, ...] | None


_POWERS = _Backend(0, lambda s: round(math.log2(s)), lambda u: 2.0**u, tuple(2.0**k for k in range(-13, 1)))
_TENTHS = _Backend(1, lambda s: round(s * 1e4), lambda u: u / 1e4, None)
_BACKENDS = {"V4L2": _TENTHS, "MSMF": _POWERS, "DSHOW": _POWERS}


class OpenCVCamera(contextlib.AbstractContextManager):
    """A camera, a video file or a stream that `cv2.VideoCapture` opens.

    Automatic exposure and white balance are switched off, and read back: AcquisitionError for a camera that
    keeps them, cannot be opened, or gives frames of another size.

    Parameters
    ----------
    source : int, path or URL
        The number of a camera, from 0; a file; or a stream, "rtsp://..." and so on.
    channels : 1 or 3
        One channel is the green one, as a sensor has the most pixels of it.
    seconds : float, optional
        The exposure of a camera whose exposure cannot be set; needed for files, streams and unknown backends.
    size : (H, W), optional
        Of frames to ask for; refused if others come.

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
        if isinstance(source, (str, os.PathLike)) and os.fspath(source):
            self.source: int | str = str(os.fspath(source))
        elif isinstance(source, int) and not isinstance(source, bool):
            self.source = checks.count("source", source, least=0)
        else:
            raise InputTypeError(f"source is {source!r}; it must be the number of a camera, a file or a URL")
        self.stream = not (isinstance(self.source, str) and os.path.isfile(self.source))
        self._stated = None if seconds is None else as_seconds(seconds)
        size = None if size is None else checks.grid("size", size)
        self._capture = cv2.VideoCapture(self.source)
        try:
            self._set_up(size)
        except BaseException:
            self.close()
            raise

    def expose(self, seconds: float) -> None:
        """Set the exposure, and read it back; AcquisitionError where the camera sets another."""
        seconds = as_seconds(seconds)
        if self._backend is None or self._stated is not None:
            exact("seconds", seconds, self.exposures or ())
            return
        units = self._backend.units(seconds)
        accepted = self._capture.set(cv2.CAP_PROP_EXPOSURE, units)
        actual = self._capture.get(cv2.CAP_PROP_EXPOSURE)
        if not accepted or abs(self._backend.seconds(actual) / seconds - 1.0) > _TOLERANCE:
            raise AcquisitionError(f"exposure {seconds:.4g} s: {units:g} was set, the camera has {actual:g}")

    def frame(self) -> np.ndarray:
        """The next frame: uint8 or uint16, (H, W) or (H, W, 3) in RGB; AcquisitionError where none comes."""
        good, image = self._capture.read()
        if not good or image is None:
            raise AcquisitionError(f"no frame comes from {self.source!r}: unplugged, or the stream has ended")
        if image.ndim == 3 and image.shape[2] == 3:
            return np.ascontiguousarray(image[..., 1 if self.channels == 1 else slice(None, None, -1)])
        if self.channels == 3 or image.shape[2:] not in ((), (1,)):
            raise AcquisitionError(f"frames from {self.source!r} have shape {image.shape}; they must be RGB")
        return image.reshape(image.shape[:2])

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

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let the camera go."""
        self._capture.release()

    def _set_up(self, size: tuple[int, int] | None) -> None:
        if not self._capture.isOpened():
            raise AcquisitionError(f"OpenCV cannot open {self.source!r}; it is no camera, video or stream")
        name = self._capture.getBackendName()
        self._backend = _BACKENDS.get(name)
        if self._backend is None and self._stated is None:
            raise InputError(f"seconds is None; it must be the exposure of {self.source!r}: {name} sets none")
        self.exposures = None if self._backend is None else self._backend.exposures
        if self._stated is not None:
            self.exposures = (self._stated,)
        if size is not None:
            sides = (cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_WIDTH)
            for side, pixels in zip(sides, size, strict=True):
                self._capture.set(side, pixels)
            actual = tuple(int(self._capture.get(side)) for side in sides)
            if actual != size:
                raise AcquisitionError(f"{self.source!r} gives frames of {actual}; size asks for {size}")
        self._locked = {"exposure": False, "white balance": False}
        if self._backend is not None:
            self._locked = {
                "exposure": self._lock("exposure", cv2.CAP_PROP_AUTO_EXPOSURE, self._backend.manual),
                "white balance": self._lock("white balance", cv2.CAP_PROP_AUTO_WB, 0.0),
            }
        self.limits = self._limits()

    def _limits(self) -> tuple[float, float]:
        """The shortest and the longest exposure, as far as drivers clip to them."""
        if self.exposures is not None or self._backend is None:
            return SHORTEST, LONGEST
        actual = []
        for seconds in (SHORTEST, LONGEST):
            self._capture.set(cv2.CAP_PROP_EXPOSURE, self._backend.units(seconds))
            actual.append(self._backend.seconds(self._capture.get(cv2.CAP_PROP_EXPOSURE)))
        least, most = max(actual[0], SHORTEST), min(actual[1], LONGEST)
        return (least, most) if least < most else (SHORTEST, LONGEST)

    def _lock(self, name: str, setting: int, value: float) -> bool:
        """Switch off what adapts. True: off, as read back; False: the camera has no such setting."""
        before = self._capture.get(setting)
        self._capture.set(setting, value)
        actual = self._capture.get(setting)
        if actual != value and not before == actual == _UNKNOWN:
            raise AcquisitionError(
                f"automatic {name} of {self.source!r} cannot be switched off: {value:g} was set, {actual:g} "
                "read back; switch it off in the camera's own program"
            )
        return actual == value


class GPhoto2Camera(contextlib.AbstractContextManager):
    """The camera that libgphoto2 finds first, in manual exposure, by python-gphoto2 (extra `camera`).

    Each frame is one release of the shutter; its file is fetched, and deleted on the camera. One channel is
    the green one. AcquisitionError where python-gphoto2 is not installed, there is no camera, or exposure,
    sensitivity or white balance is automatic; the setting and its value are named.

    Examples
    --------
    >>> GPhoto2Camera(channels=2)
    Traceback (most recent call last):
    ltcl.errors.InputError: channels is 2; it must be one of 1, 3
    """

    stream = False

    def __init__(self, channels: int = 3) -> None:
        self.channels = checks.one_of("channels", channels, (1, 3))
        self._gp = load_extra("gphoto2", "camera", "a camera on a cable")
        self._camera = self._gp.Camera()
        self._seconds: float | None = None
        self._do("be opened", self._camera.init)
        try:
            self._refuse_automatics()
            self._shutter, self._choices = self._shutter_settings()
        except BaseException:
            self.close()
            raise
        self.exposures = tuple(sorted(self._choices))

    def expose(self, seconds: float) -> None:
        """Set the shutter, and read it back; InputError for another than `exposures`."""
        offered = exact("seconds", as_seconds(seconds), self.exposures)
        choice = self._choices[offered]
        widget = self._do(f"read its {self._shutter}", self._camera.get_single_config, self._shutter)
        widget.set_value(choice)
        self._do(f"set {self._shutter}", self._camera.set_single_config, self._shutter, widget)
        actual = self._value(self._shutter)
        if actual != choice:
            raise AcquisitionError(f"the camera keeps {self._shutter} at {actual!r}; {choice!r} was set")
        self._seconds = offered

    def frame(self) -> np.ndarray:
        """Release the shutter and fetch the photograph: uint8 or uint16, (H, W) or (H, W, 3).

        AcquisitionError: unplugged or busy, a file that cannot be read or was exposed for other seconds.
        """
        place = self._do("photograph", self._camera.capture, self._gp.GP_CAPTURE_IMAGE)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / Path(place.name).name
            kind = self._gp.GP_FILE_TYPE_NORMAL
            file = self._do("send its photograph", self._camera.file_get, place.folder, place.name, kind)
            self._do("save its photograph", file.save, str(path))
            self._do("delete its photograph", self._camera.file_delete, place.folder, place.name)
            return photographs.photograph("the camera's file", path, self.channels, self._seconds)

    def describe(self) -> dict[str, Any]:
        """Plain JSON for the records."""
        names = ("cameramodel", "lensname", "iso", "whitebalance", "aperture", "f-number", "imageformat")
        values = {name: self._value(name) for name in names}
        known = {name: value for name, value in values.items() if value is not None}
        return {"kind": "gphoto2", "channels": self.channels, **known}

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let the camera go."""
        with contextlib.suppress(self._gp.GPhoto2Error):  # it was unplugged
            self._camera.exit()

    def _do(self, what: str, call: Any, *arguments: Any) -> Any:
        try:
            return call(*arguments)
        except self._gp.GPhoto2Error as error:
            raise AcquisitionError(f"the camera cannot {what}: {' '.join(str(error).split())}") from error

    def _value(self, name: str) -> str | None:
        """What a setting is; None where the camera has none of that name."""
        try:
            return str(self._camera.get_single_config(name).get_value())
        except self._gp.GPhoto2Error:
            return None

    def _refuse_automatics(self) -> None:
        for name in (*_MANUAL, *_FIXED):
            value, manual = self._value(name), _MANUAL.get(name)
            if value is not None and (_AUTOMATIC.match(value) if manual is None else value not in manual):
                setting = "a fixed value" if manual is None else repr(manual[0])
                raise AcquisitionError(f"{name} of the camera is {value!r}; set it to {setting}")

    def _shutter_settings(self) -> tuple[str, dict[float, str]]:
        """The name of the shutter's setting, and its choices by their seconds."""
        for name in _SHUTTER:
            try:
                offered = [str(choice) for choice in self._camera.get_single_config(name).get_choices()]
            except self._gp.GPhoto2Error:
                continue
            choices = {t: choice for choice in offered if (t := shutter_seconds(choice)) is not None}
            if choices:
                return name, choices
        raise AcquisitionError("the camera has no shutter that can be set; turn its dial to M")


def shutter_seconds(choice: str) -> float | None:
    """The seconds of a camera's shutter setting, or None where that is none: bulb, automatic.

    >>> shutter_seconds("1/60"), shutter_seconds("0.5s"), shutter_seconds("bulb"), shutter_seconds("1/0")
    (0.016666666666666666, 0.5, None, None)
    """
    match = _SECONDS.fullmatch(choice)
    if match is None or not (below := float(match[2] or 1)):
        return None
    return float(match[1]) / below or None
