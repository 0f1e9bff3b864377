# SPDX-License-Identifier: BSD-3-Clause
"""Cameras of a `LiveRig`: `OpenCVCamera` for OpenCV's devices, `GPhoto2Camera` for a tethered one.

Of OpenCV's backends V4L2 (Linux) sets exposures, in units of 100 microseconds; with others a camera
has the exposure that its user states. A camera that adapts all the same is found by the tests of
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
from ltcl.acquisition.rig import LONGEST, SHORTEST, Closing, offered_exposure
from ltcl.acquisition.rigs.photographs import read_photograph
from ltcl.errors import AcquisitionError, InputError, InputTypeError

# V4L2's value of manual exposure.
V4L2_MANUAL_EXPOSURE = 1.0

# V4L2's units of exposure in a second.
V4L2_UNITS_PER_SECOND = 1e4

# OpenCV's value of a property that the camera does not have.
UNKNOWN_PROPERTY = -1.0

# Relative difference of an exposure that is read back: cameras round to their steps.
EXPOSURE_TOLERANCE = 0.05

# Settings of gphoto2 for the shutter; the first, if both are there, is not rounded.
SHUTTER_SETTINGS = ("shutterspeed2", "shutterspeed")

# Settings of gphoto2 for the exposure mode, and their manual values.
MANUAL_VALUES = {"autoexposuremode": ("Manual",), "expprogram": ("M", "Manual")}

# Settings of gphoto2 that may not be automatic.
FIXED_SETTINGS = ("iso", "isoauto", "autoiso", "whitebalance")
AUTOMATIC_VALUE = re.compile(r"\s*(auto|on\b|bulb)", re.IGNORECASE)

# Settings of gphoto2 that records keep.
DESCRIBED_SETTINGS = (
    "cameramodel",
    "lensname",
    "iso",
    "whitebalance",
    "aperture",
    "f-number",
    "imageformat",
)


class OpenCVCamera(Closing):
    """A camera or a stream that `cv2.VideoCapture` opens.

    Parameters
    ----------
    source : int, str or path
        Number of the camera, from 0, or a stream ("rtsp://...").
    channels : 1 or 3
        One channel is the green one.
    seconds : float, optional
        Exposure of a camera that cannot set it: streams, and cameras without V4L2.
    size : (int, int), optional
        Height and width of frames; None for the camera's default.
    white_level : int, optional
        Code from which on pixels are saturated; None for the largest code.

    Raises
    ------
    InputError, InputTypeError
        An argument cannot be used.
    AcquisitionError
        The camera cannot be opened, keeps automatic exposure or white balance, or gives frames of
        another size.
    """

    stream = True

    def __init__(
        self,
        source: int | str | os.PathLike[str],
        *,
        channels: int = 3,
        seconds: float | None = None,
        size: tuple[int, int] | None = None,
        white_level: int | None = None,
    ) -> None:
        self.channels = checks.one_of("channels", channels, (1, 3))
        if not isinstance(source, int | str | os.PathLike):
            raise InputTypeError(
                f"source is {source!r}; it must be the number of a camera or a URL"
            )
        self.source = source if isinstance(source, int) else os.fspath(source)
        self.exposures: tuple[float, ...] | None = None
        if seconds is not None:
            self.exposures = (checks.number("seconds", seconds, above=0.0),)
        self.limits = (SHORTEST, LONGEST)
        self.white_level = _check_white_level(white_level)
        if size is not None:
            size = checks.grid("size", size)
        self._capture = cv2.VideoCapture(self.source)
        with self._closed_on_error():
            self._set_up(size)

    def expose(self, seconds: float) -> None:
        """Set the exposure; AcquisitionError if the camera sets another."""
        seconds = offered_exposure("seconds", seconds, self.exposures)
        if self.exposures is not None:
            return
        actual = self._set_exposure(seconds)
        if abs(actual / seconds - 1.0) > EXPOSURE_TOLERANCE:
            raise AcquisitionError(
                f"exposure {seconds:.4g} s was set, but the camera has {actual:.4g} s"
            )

    def frame(self) -> np.ndarray:
        """The next frame: uint8 or uint16, (H, W) or (H, W, 3) in RGB.

        AcquisitionError if there is none.
        """
        is_read, image = self._capture.read()
        if not is_read or image is None:
            raise AcquisitionError(
                f"no frame comes from {self.source!r}: unplugged, or the stream has ended"
            )
        if image.ndim == 2:
            return image
        if image.shape[2] == 1:
            return image[..., 0]
        if image.shape[2] != 3:
            return image
        if self.channels == 1:
            return np.ascontiguousarray(image[..., 1])
        return np.ascontiguousarray(image[..., ::-1])  # OpenCV gives BGR

    def describe(self) -> dict[str, Any]:
        """The camera as plain JSON."""
        source = self.source
        if isinstance(source, str):
            source = os.path.basename(source)
        return {
            "kind": "opencv",
            "source": source,
            "backend": self._backend,
            "channels": self.channels,
            "exposures": self.exposures,
            "white_level": self.white_level,
        }

    def close(self) -> None:
        """Release the camera."""
        self._capture.release()

    def _set_up(self, size: tuple[int, int] | None) -> None:
        """Set the size of frames, switch automatics off, and find the range of exposures."""
        if not self._capture.isOpened():
            raise AcquisitionError(
                f"OpenCV cannot open {self.source!r}; it must be a camera or a stream"
            )
        self._backend = self._capture.getBackendName()
        is_v4l2 = self._backend == "V4L2"
        if not is_v4l2 and self.exposures is None:
            raise InputError(f"seconds is None; it must be the exposure: {self._backend} sets none")
        if size is not None:
            self._set_size(size)
        if is_v4l2:
            self._lock("exposure", cv2.CAP_PROP_AUTO_EXPOSURE, V4L2_MANUAL_EXPOSURE)
            self._lock("white balance", cv2.CAP_PROP_AUTO_WB, 0.0)
        if self.exposures is None:
            # The driver clips exposures to its range.
            least = self._set_exposure(SHORTEST)
            most = self._set_exposure(LONGEST)
            if SHORTEST <= least < most <= LONGEST:
                self.limits = (least, most)

    def _set_size(self, size: tuple[int, int]) -> None:
        height, width = size
        self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, height)
        self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, width)
        actual_height = int(self._capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        actual_width = int(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        actual = (actual_height, actual_width)
        if actual != size:
            raise AcquisitionError(
                f"{self.source!r} gives frames of {actual}; size asks for {size}"
            )

    def _set_exposure(self, seconds: float) -> float:
        """Set an exposure; returns the seconds that the camera then has."""
        self._capture.set(cv2.CAP_PROP_EXPOSURE, round(seconds * V4L2_UNITS_PER_SECOND))
        return self._capture.get(cv2.CAP_PROP_EXPOSURE) / V4L2_UNITS_PER_SECOND

    def _lock(self, name: str, setting: int, value: float) -> None:
        """Switch off an automatic, if the camera has such a setting."""
        before = self._capture.get(setting)
        self._capture.set(setting, value)
        actual = self._capture.get(setting)
        is_missing = before == actual == UNKNOWN_PROPERTY
        if actual != value and not is_missing:
            raise AcquisitionError(
                f"automatic {name} of {self.source!r} cannot be switched off: "
                f"{value:g} was set, {actual:g} read back; use the camera's own program"
            )


class GPhoto2Camera(Closing):
    """The camera that python-gphoto2 (extra `camera`) finds first, in manual exposure.

    Each frame is one release of the shutter; its file is fetched, and deleted on the camera.

    Parameters
    ----------
    channels : 1 or 3
        One channel is the green one.
    white_level : int, optional
        Code from which on pixels are saturated; None for the largest code.

    Raises
    ------
    AcquisitionError
        python-gphoto2 or the camera is missing, or exposure, sensitivity or white balance is
        automatic.
    """

    stream = False

    def __init__(self, channels: int = 3, *, white_level: int | None = None) -> None:
        self.channels = checks.one_of("channels", channels, (1, 3))
        self.white_level = _check_white_level(white_level)
        self._gphoto2 = checks.load_extra(
            "gphoto2", "camera", "a camera on a cable", AcquisitionError
        )
        self._camera = self._gphoto2.Camera()
        self._seconds: float | None = None
        with self._refusing("be opened"):
            self._camera.init()
        with self._closed_on_error():
            self._check_manual()
            self._shutter = self._find_shutter()
            self._choices = self._shutter_choices()
        self.exposures = tuple(sorted(self._choices))

    def expose(self, seconds: float) -> None:
        """Set the shutter, and read it back; InputError for another exposure than `exposures`."""
        offered = offered_exposure("seconds", seconds, self.exposures)
        choice = self._choices[offered]
        with self._refusing(f"set {self._shutter}"):
            widget = self._camera.get_single_config(self._shutter)
            widget.set_value(choice)
            self._camera.set_single_config(self._shutter, widget)
        actual = self._value(self._shutter)
        if actual != choice:
            raise AcquisitionError(
                f"the camera keeps {self._shutter} at {actual!r}; {choice!r} was set"
            )
        self._seconds = offered

    def frame(self) -> np.ndarray:
        """Release the shutter and fetch the photograph: uint8 or uint16, (H, W) or (H, W, 3).

        AcquisitionError for a file that cannot be read, or was exposed for other seconds.
        """
        gphoto2 = self._gphoto2
        with tempfile.TemporaryDirectory() as folder:
            with self._refusing("photograph"):
                place = self._camera.capture(gphoto2.GP_CAPTURE_IMAGE)
                path = Path(folder) / Path(place.name).name
                kind = gphoto2.GP_FILE_TYPE_NORMAL
                file = self._camera.file_get(place.folder, place.name, kind)
                file.save(str(path))
                self._camera.file_delete(place.folder, place.name)
            return read_photograph("the camera's file", path, self.channels, self._seconds)

    def describe(self) -> dict[str, Any]:
        """The camera as plain JSON."""
        facts: dict[str, Any] = {
            "kind": "gphoto2",
            "channels": self.channels,
            "white_level": self.white_level,
        }
        for name in DESCRIBED_SETTINGS:
            value = self._value(name)
            if value is not None:
                facts[name] = value
        return facts

    def close(self) -> None:
        """Release the camera."""
        with contextlib.suppress(self._gphoto2.GPhoto2Error):  # it was unplugged
            self._camera.exit()

    def _check_manual(self) -> None:
        """Refuse a camera with an automatic setting."""
        for name, manual_values in MANUAL_VALUES.items():
            value = self._value(name)
            if value is not None and value not in manual_values:
                raise AcquisitionError(
                    f"{name} of the camera is {value!r}; set it to {manual_values[0]!r}"
                )
        for name in FIXED_SETTINGS:
            value = self._value(name)
            if value is not None and AUTOMATIC_VALUE.match(value):
                raise AcquisitionError(
                    f"{name} of the camera is {value!r}; set it to a fixed value"
                )

    def _find_shutter(self) -> str:
        """Name of the shutter's setting; empty if there is none."""
        for name in SHUTTER_SETTINGS:
            if self._value(name) is not None:
                return name
        return ""

    def _shutter_choices(self) -> dict[float, str]:
        """Choices of the shutter that are an exposure, by their seconds."""
        choices = {}
        if self._shutter:
            widget = self._camera.get_single_config(self._shutter)
            for choice in widget.get_choices():
                seconds = _shutter_seconds(str(choice))
                if seconds > 0:
                    choices[seconds] = str(choice)
        if not choices:
            raise AcquisitionError("the camera has no shutter that can be set; turn its dial to M")
        return choices

    @contextlib.contextmanager
    def _refusing(self, action: str) -> Iterator[None]:
        """Raise errors of gphoto2 as AcquisitionError that says what the camera cannot do."""
        try:
            yield
        except self._gphoto2.GPhoto2Error as error:
            reason = " ".join(str(error).split())
            raise AcquisitionError(f"the camera cannot {action}: {reason}") from error

    def _value(self, name: str) -> str | None:
        """Value of a setting; None if the camera has none of that name."""
        try:
            return str(self._camera.get_single_config(name).get_value())
        except self._gphoto2.GPhoto2Error:
            return None


def _check_white_level(level: Any) -> int | None:
    if level is None:
        return None
    return checks.count("white_level", level, most=65535)


def _shutter_seconds(choice: str) -> float:
    """Seconds of a camera's shutter setting, 1/60 or 0.5s; 0 for bulb, automatic and the like."""
    try:
        return float(Fraction(choice.strip().rstrip('s"')))
    except (ValueError, ZeroDivisionError):
        return 0.0
