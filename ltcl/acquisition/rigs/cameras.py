# SPDX-License-Identifier: BSD-3-Clause
"""Cameras of a `LiveRig`: `OpenCVCamera`, whatever OpenCV opens; `GPhoto2Camera`, one on a cable (gphoto2).

Of OpenCV's backends V4L2 (Linux) sets exposures, in units of 100 microseconds; behind others a
camera has the one that its user states. What adapts all the same is found by the tests of
`LiveRig`.
"""

from __future__ import annotations

import contextlib
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
from ltcl.acquisition.rig import LONGEST, SHORTEST, Closing, load_extra, offered_exposure
from ltcl.acquisition.rigs.folder import read_photograph
from ltcl.errors import AcquisitionError, InputError, InputTypeError

_MANUAL_EXPOSURE = 1.0  # V4L2's value of it
_SIDES = (cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FRAME_WIDTH)
_TOLERANCE = (
    0.05  # relative difference of an exposure that is read back: cameras round to their steps
)
_UNKNOWN = -1.0  # OpenCV's value of a property that the camera does not have
_SHUTTER = ("shutterspeed2", "shutterspeed")  # the first, where both are there, is not rounded
_MANUAL = {"autoexposuremode": ("Manual",), "expprogram": ("M", "Manual")}
_FIXED = ("iso", "isoauto", "autoiso", "whitebalance")  # none of these may be automatic
_AUTOMATIC = re.compile(r"\s*(auto|on\b|bulb)", re.IGNORECASE)


class OpenCVCamera(Closing):
    """A camera (its number, from 0) or a stream ("rtsp://...") that `cv2.VideoCapture` opens.

    One channel is the green one. `seconds` is the exposure where it cannot be set, of streams and
    without V4L2; `size` is (H, W). AcquisitionError for a camera that cannot be opened, keeps
    automatic exposure or white balance, or gives frames of another size.
    """

    stream = True

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
            raise InputTypeError(
                f"source is {source!r}; it must be the number of a camera or a URL"
            )
        self.source = source if isinstance(source, int) else os.fspath(source)
        self.exposures = (
            None if seconds is None else (checks.number("seconds", seconds, above=0.0),)
        )
        self.limits = SHORTEST, LONGEST
        size = None if size is None else checks.grid("size", size)
        self._capture = cv2.VideoCapture(self.source)
        with self._closed_on_error():
            if not self._capture.isOpened():
                raise AcquisitionError(
                    f"OpenCV cannot open {self.source!r}; it must be a camera or a stream"
                )
            self._backend = self._capture.getBackendName()
            if self._backend != "V4L2" and seconds is None:
                raise InputError(
                    f"seconds is None; it must be the exposure: {self._backend} sets none"
                )
            for side, pixels in zip(_SIDES, size or (), strict=False):
                self._capture.set(side, pixels)
            actual = tuple(int(self._capture.get(side)) for side in _SIDES)
            if size not in (None, actual):
                raise AcquisitionError(
                    f"{self.source!r} gives frames of {actual}; size asks for {size}"
                )
            if self._backend == "V4L2":
                self._lock("exposure", cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE)
                self._lock("white balance", cv2.CAP_PROP_AUTO_WB, 0.0)
            if seconds is None:  # where the driver clips
                least, most = (self._set_exposure(limit) for limit in self.limits)
                if SHORTEST <= least < most <= LONGEST:
                    self.limits = least, most

    def expose(self, seconds: float) -> None:
        """Set the exposure; AcquisitionError where the camera sets another."""
        seconds = offered_exposure("seconds", seconds, self.exposures)
        actual = self._set_exposure(seconds) if self.exposures is None else seconds
        if abs(actual / seconds - 1.0) > _TOLERANCE:
            raise AcquisitionError(
                f"exposure {seconds:.4g} s was set, but the camera has {actual:.4g} s"
            )

    def frame(self) -> np.ndarray:
        """The next frame: uint8 or uint16, (H, W) or (H, W, 3) in RGB; AcquisitionError where none comes."""
        good, image = self._capture.read()
        if not good or image is None:
            raise AcquisitionError(
                f"no frame comes from {self.source!r}: unplugged, or the stream has ended"
            )
        if image.ndim == 3 and image.shape[2] == 3:
            return np.ascontiguousarray(
                image[..., 1 if self.channels == 1 else slice(None, None, -1)]
            )
        return image[..., 0] if image.shape[2:] == (1,) else image

    def describe(self) -> dict[str, Any]:
        """Plain JSON for the records."""
        source = self.source if isinstance(self.source, int) else os.path.basename(self.source)
        facts = {"kind": "opencv", "source": source, "backend": self._backend}
        return facts | {"channels": self.channels, "exposures": self.exposures}

    def close(self) -> None:
        """Let the camera go."""
        self._capture.release()

    def _set_exposure(self, seconds: float) -> float:
        """Set an exposure; the seconds that the camera has then."""
        self._capture.set(cv2.CAP_PROP_EXPOSURE, round(seconds * 1e4))
        return self._capture.get(cv2.CAP_PROP_EXPOSURE) / 1e4

    def _lock(self, name: str, setting: int, value: float) -> None:
        """Switch off what adapts, where the camera has such a setting."""
        before = self._capture.get(setting)
        self._capture.set(setting, value)
        actual = self._capture.get(setting)
        if actual != value and not before == actual == _UNKNOWN:
            text = f"{value:g} was set, {actual:g} read back; use the camera's own program"
            raise AcquisitionError(
                f"automatic {name} of {self.source!r} cannot be switched off: {text}"
            )


class GPhoto2Camera(Closing):
    """The camera that libgphoto2 finds first, in manual exposure, by python-gphoto2 (extra `camera`).

    Each frame is one release of the shutter; its file is fetched, and deleted on the camera. One
    channel is the green one. AcquisitionError where python-gphoto2 or the camera is missing, a file
    cannot be read or was exposed for other seconds, or exposure, sensitivity or white balance is
    automatic.
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
                if value is not None and (
                    _AUTOMATIC.match(value) if manual is None else value not in manual
                ):
                    setting = "a fixed value" if manual is None else repr(manual[0])
                    raise AcquisitionError(
                        f"{name} of the camera is {value!r}; set it to {setting}"
                    )
            self._shutter = next((name for name in _SHUTTER if self._value(name) is not None), "")
            offered = (
                self._camera.get_single_config(self._shutter).get_choices() if self._shutter else ()
            )
            self._choices = {
                t: choice for choice in map(str, offered) if (t := _shutter_seconds(choice)) > 0
            }
            if not self._choices:
                raise AcquisitionError(
                    "the camera has no shutter that can be set; turn its dial to M"
                )
        self.exposures = tuple(sorted(self._choices))

    def expose(self, seconds: float) -> None:
        """Set the shutter, and read it back; InputError for another than `exposures`."""
        offered = offered_exposure("seconds", seconds, self.exposures)
        choice = self._choices[offered]
        with self._naming(f"set {self._shutter}"):
            widget = self._camera.get_single_config(self._shutter)
            widget.set_value(choice)
            self._camera.set_single_config(self._shutter, widget)
        if (actual := self._value(self._shutter)) != choice:
            raise AcquisitionError(
                f"the camera keeps {self._shutter} at {actual!r}; {choice!r} was set"
            )
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
        names = (
            "cameramodel",
            "lensname",
            "iso",
            "whitebalance",
            "aperture",
            "f-number",
            "imageformat",
        )
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
            raise AcquisitionError(
                f"the camera cannot {what}: {' '.join(str(error).split())}"
            ) from error

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
