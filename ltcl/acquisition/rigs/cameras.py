# SPDX-License-Identifier: BSD-3-Clause
"""Cameras of a `LiveRig`: `OpenCVCamera`, whatever OpenCV opens; `GPhoto2Camera`, one on a cable (gphoto2).

Backends of OpenCV differ: V4L2 (Linux) counts exposure in units of 100 microseconds and calls manual exposure
1; Media Foundation and DirectShow (Windows) count in powers of two of a second and call it 0. A camera behind
another backend, a file or a stream has the one exposure that its user states. libgphoto2 names settings after
the camera's maker, so several names are tried. What adapts in spite of its settings is found by `survey`.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import tempfile
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ltcl import checks
from ltcl.acquisition.rig import LONGEST, SHORTEST, Closing, as_seconds, exact, load_extra
from ltcl.acquisition.rigs.folder import read_photograph
from ltcl.errors import AcquisitionError, InputError, InputTypeError

_MANUAL_EXPOSURE = {"V4L2": 1.0, "MSMF": 0.0, "DSHOW": 0.0}  # by the backend
_POWERS = tuple(2.0**k for k in range(-13, 1))
_SIDES = (cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_WIDTH)
_TOLERANCE = 0.05  # relative difference of an exposure read back that rounding to the camera's steps explains
_UNKNOWN = -1.0  # OpenCV's value of a property that the camera does not have
_SHUTTER = ("shutterspeed2", "shutterspeed")  # the first, where both are there, is not rounded
_MANUAL = {"autoexposuremode": ("Manual",), "expprogram": ("M", "Manual")}
_FIXED = ("iso", "isoauto", "autoiso", "whitebalance")  # none of these may be automatic
_AUTOMATIC = re.compile(r"\s*(auto|on\b|bulb)", re.IGNORECASE)


class OpenCVCamera(Closing):
    """A camera (its number, from 0), a video file or a stream ("rtsp://...") that `cv2.VideoCapture` opens.

    One channel is the green one. `seconds` is the exposure of a camera whose exposure cannot be set, needed
    for files, streams and unknown backends; `size`, (H, W), is that of frames to ask for. Automatic exposure
    and white balance are switched off where there are such settings: AcquisitionError for a camera that keeps
    them, cannot be opened, or gives frames of another size.

    Examples
    --------
    >>> OpenCVCamera("none.avi", seconds=1 / 30)
    Traceback (most recent call last):
    ltcl.errors.AcquisitionError: OpenCV cannot open 'none.avi'; it is no camera, video or stream
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
        if not isinstance(source, int | str | os.PathLike):
            raise InputTypeError(f"source is {source!r}; it must be the number of a camera, a file or a URL")
        self.source = source if isinstance(source, int) else os.fspath(source)
        self.stream = isinstance(source, int) or not os.path.isfile(source)
        self.exposures = None if seconds is None else (as_seconds(seconds),)
        self.limits = SHORTEST, LONGEST
        size = None if size is None else checks.grid("size", size)
        self._capture = cv2.VideoCapture(self.source)
        with self._closed_on_error():
            if not self._capture.isOpened():
                raise AcquisitionError(
                    f"OpenCV cannot open {self.source!r}; it is no camera, video or stream"
                )
            self._backend = self._capture.getBackendName()
            manual = _MANUAL_EXPOSURE.get(self._backend)
            self._is_fixed, self._counts_powers = seconds is not None, manual == 0.0
            if manual is None and not self._is_fixed:
                camera = f"the exposure of {self.source!r}: {self._backend} sets none"
                raise InputError(f"seconds is None; it must be {camera}")
            for side, pixels in zip(_SIDES, size or (), strict=False):
                self._capture.set(side, pixels)
            actual = tuple(int(self._capture.get(side)) for side in _SIDES)
            if size not in (None, actual):
                raise AcquisitionError(f"{self.source!r} gives frames of {actual}; size asks for {size}")
            if manual is not None:
                self._lock("exposure", cv2.CAP_PROP_AUTO_EXPOSURE, manual)
                self._lock("white balance", cv2.CAP_PROP_AUTO_WB, 0.0)
            if self._counts_powers and not self._is_fixed:
                self.exposures = _POWERS
            elif not self._is_fixed:  # where the driver clips
                least, most = (self._set_exposure(limit) for limit in self.limits)
                if SHORTEST <= least < most <= LONGEST:
                    self.limits = least, most

    def expose(self, seconds: float) -> None:
        """Set the exposure, and read it back; AcquisitionError where the camera sets another."""
        seconds = exact("seconds", seconds, self.exposures)
        if not self._is_fixed and abs((actual := self._set_exposure(seconds)) / seconds - 1.0) > _TOLERANCE:
            raise AcquisitionError(f"exposure {seconds:.4g} s was set, but the camera has {actual:.4g} s")

    def frame(self) -> np.ndarray:
        """The next frame: uint8 or uint16, (H, W) or (H, W, 3) in RGB; AcquisitionError where none comes."""
        good, image = self._capture.read()
        if not good or image is None:
            raise AcquisitionError(f"no frame comes from {self.source!r}: unplugged, or the stream has ended")
        if image.ndim == 3 and image.shape[2] == 3:
            return np.ascontiguousarray(image[..., 1 if self.channels == 1 else slice(None, None, -1)])
        return image[..., 0] if image.shape[2:] == (1,) else image

    def describe(self) -> dict[str, Any]:
        """Plain JSON for the records."""
        return {
            "kind": "opencv",
            "source": self.source if isinstance(self.source, int) else os.path.basename(self.source),
            "backend": self._backend,
            "channels": self.channels,
            "exposures": None if self.exposures is None else list(self.exposures),
        }

    def close(self) -> None:
        """Let the camera go."""
        self._capture.release()

    def _set_exposure(self, seconds: float) -> float:
        """Set an exposure; the seconds that the camera has then."""
        units = round(math.log2(seconds)) if self._counts_powers else round(seconds * 1e4)
        self._capture.set(cv2.CAP_PROP_EXPOSURE, units)
        actual = self._capture.get(cv2.CAP_PROP_EXPOSURE)
        return 2.0**actual if self._counts_powers else actual / 1e4

    def _lock(self, name: str, setting: int, value: float) -> None:
        """Switch off what adapts, where the camera has such a setting."""
        before = self._capture.get(setting)
        self._capture.set(setting, value)
        actual = self._capture.get(setting)
        if actual != value and not before == actual == _UNKNOWN:
            raise AcquisitionError(
                f"automatic {name} of {self.source!r} cannot be switched off: {value:g} was set, {actual:g} "
                "read back; switch it off in the camera's own program"
            )


class GPhoto2Camera(Closing):
    """The camera that libgphoto2 finds first, in manual exposure, by python-gphoto2 (extra `camera`).

    Each frame is one release of the shutter; its file is fetched, and deleted on the camera. One channel is
    the green one. AcquisitionError where python-gphoto2 or the camera is not there, a file cannot be read or
    was exposed for other seconds, or exposure, sensitivity or white balance is automatic.

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
        with self._naming("be opened"):
            self._camera.init()
        with self._closed_on_error():
            for name in (*_MANUAL, *_FIXED):
                value, manual = self._value(name), _MANUAL.get(name)
                if value is not None and (_AUTOMATIC.match(value) if manual is None else value not in manual):
                    setting = "a fixed value" if manual is None else repr(manual[0])
                    raise AcquisitionError(f"{name} of the camera is {value!r}; set it to {setting}")
            self._shutter = next((name for name in _SHUTTER if self._value(name) is not None), "")
            offered = self._camera.get_single_config(self._shutter).get_choices() if self._shutter else ()
            self._choices = {t: choice for choice in map(str, offered) if (t := _shutter_seconds(choice)) > 0}
            if not self._choices:
                raise AcquisitionError("the camera has no shutter that can be set; turn its dial to M")
        self.exposures = tuple(sorted(self._choices))

    def expose(self, seconds: float) -> None:
        """Set the shutter, and read it back; InputError for another than `exposures`."""
        offered = exact("seconds", seconds, self.exposures)
        choice = self._choices[offered]
        with self._naming(f"set {self._shutter}"):
            widget = self._camera.get_single_config(self._shutter)
            widget.set_value(choice)
            self._camera.set_single_config(self._shutter, widget)
        if (actual := self._value(self._shutter)) != choice:
            raise AcquisitionError(f"the camera keeps {self._shutter} at {actual!r}; {choice!r} was set")
        self._seconds = offered

    def frame(self) -> np.ndarray:
        """Release the shutter and fetch the photograph: uint8 or uint16, (H, W) or (H, W, 3)."""
        with tempfile.TemporaryDirectory() as folder:
            with self._naming("photograph"):
                place = self._camera.capture(self._gp.GP_CAPTURE_IMAGE)
                path = Path(folder) / Path(place.name).name
                file = self._camera.file_get(place.folder, place.name, self._gp.GP_FILE_TYPE_NORMAL)
                file.save(str(path))
                self._camera.file_delete(place.folder, place.name)
            return read_photograph("the camera's file", path, self.channels, self._seconds)

    def describe(self) -> dict[str, Any]:
        """Plain JSON for the records."""
        names = ("cameramodel", "lensname", "iso", "whitebalance", "aperture", "f-number", "imageformat")
        values = {name: value for name in names if (value := self._value(name)) is not None}
        return {"kind": "gphoto2", "channels": self.channels, **values}

    def close(self) -> None:
        """Let the camera go."""
        with contextlib.suppress(self._gp.GPhoto2Error):  # it was unplugged
            self._camera.exit()

    @contextlib.contextmanager
    def _naming(self, what: str) -> Iterator[None]:
        try:
            yield
        except self._gp.GPhoto2Error as error:
            raise AcquisitionError(f"the camera cannot {what}: {' '.join(str(error).split())}") from error

    def _value(self, name: str) -> str | None:
        """What a setting is; None where the camera has none of that name."""
        try:
            return str(self._camera.get_single_config(name).get_value())
        except self._gp.GPhoto2Error:
            return None


def _shutter_seconds(choice: str) -> float:
    """The seconds of a camera's shutter setting, 1/60 or 0.5s; 0 where that is none: bulb, automatic."""
    try:
        return float(Fraction(choice.strip().rstrip('s"')))
    except (ValueError, ZeroDivisionError):
        return 0.0
