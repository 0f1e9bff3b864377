# SPDX-License-Identifier: BSD-3-Clause
"""`GPhoto2Camera`: a camera on a cable, worked by python-gphoto2 (extra `camera`).

Each frame is one release of the shutter; its file is fetched, deleted on the camera, and read as
`photographs` reads any other. libgphoto2 names settings after the camera's maker, so several names are tried.
"""

from __future__ import annotations

import math
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition.rig import as_seconds
from ltcl.acquisition.rigs import extras, photographs
from ltcl.errors import AcquisitionError, FileError, InputError

_SHUTTER = ("shutterspeed2", "shutterspeed")  # the first, where both are there, is not rounded
_MANUAL = {"autoexposuremode": ("Manual",), "expprogram": ("M", "Manual")}
_FIXED = ("iso", "isoauto", "autoiso", "whitebalance")  # none of these may be automatic
_AUTOMATIC = re.compile(r"\s*(auto|on\b|bulb)", re.IGNORECASE)
_NUMBER = re.compile(r"\s*(?:(\d+)\s*/\s*(\d+)|(\d+(?:\.\d+)?))\s*(?:s|\")?\s*", re.ASCII)
_OFF = 0.05  # of EXIF, which rounds to nominal values
_GREEN = 1


def seconds_of(choice: str) -> float | None:
    """The seconds of a camera's shutter setting, or None where that is none: bulb, automatic.

    >>> seconds_of("1/60"), seconds_of("0.5s"), seconds_of("30"), seconds_of("bulb"), seconds_of("1/0")
    (0.016666666666666666, 0.5, 30.0, None, None)
    """
    found = _NUMBER.fullmatch(choice)
    if found is None:
        return None
    above, below, whole = found.groups()
    if whole is None and int(below) == 0:
        return None
    value = float(whole) if whole is not None else int(above) / int(below)
    return value if value > 0 else None


class GPhoto2Camera:
    """The camera that libgphoto2 finds first, in manual exposure.

    Parameters
    ----------
    channels : 1 or 3
        One channel is the green one.

    Attributes
    ----------
    exposures : tuple of float
        The seconds of its shutter, ascending.

    Raises
    ------
    InputError
        A number of channels that is not 1 or 3.
    AcquisitionError
        python-gphoto2 is not installed, there is no camera, or exposure, sensitivity or white balance is
        automatic; the setting and what it is are named.

    Examples
    --------
    >>> GPhoto2Camera(channels=2)
    Traceback (most recent call last):
    ltcl.errors.InputError: channels is 2; it must be one of 1, 3
    """

    stream = False

    def __init__(self, channels: int = 3) -> None:
        self.channels = checks.one_of("channels", channels, (1, 3))
        self._gp = extras.load("gphoto2", "camera", "a camera on a cable")
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
        """Set the shutter, and read it back.

        Raises
        ------
        InputError
            The camera has no such exposure.
        AcquisitionError
            It does not take it.
        """
        seconds = as_seconds(seconds)
        nearest = min(self.exposures, key=lambda offered: abs(math.log(offered / seconds)))
        if not math.isclose(nearest, seconds, rel_tol=1e-3):
            raise InputError(f"seconds is {seconds:g}; the nearest the camera has is {nearest:g}")
        choice = self._choices[nearest]
        widget = self._do(f"tell its {self._shutter}", self._camera.get_single_config, self._shutter)
        widget.set_value(choice)
        self._do(f"set {self._shutter}", self._camera.set_single_config, self._shutter, widget)
        found = self._value(self._shutter)
        if found != choice:
            raise AcquisitionError(f"the camera keeps {self._shutter} at {found!r}; {choice!r} was asked for")
        self._seconds = nearest

    def frame(self) -> np.ndarray:
        """Release the shutter and fetch the photograph: uint8 or uint16, (H, W) or (H, W, 3).

        Raises
        ------
        AcquisitionError
            The camera was unplugged or is busy, its file cannot be read, or was exposed for other seconds.
        """
        place = self._do("photograph", self._camera.capture, self._gp.GP_CAPTURE_IMAGE)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / Path(place.name).name
            kind = self._gp.GP_FILE_TYPE_NORMAL
            file = self._do("send its photograph", self._camera.file_get, place.folder, place.name, kind)
            self._do("save its photograph", file.save, str(path))
            self._do("delete its photograph", self._camera.file_delete, place.folder, place.name)
            try:
                codes, taken = photographs.read(path)
            except FileError as error:
                raise AcquisitionError(f"the camera's file cannot be used: {error}") from error
        if taken.seconds and self._seconds and abs(taken.seconds / self._seconds - 1.0) > _OFF:
            raise AcquisitionError(
                f"the camera exposed for {taken.seconds:.4g} s by its EXIF; {self._seconds:.4g} s was set"
            )
        return np.ascontiguousarray(codes[..., _GREEN]) if self.channels == 1 and codes.ndim == 3 else codes

    def describe(self) -> dict[str, Any]:
        """Plain JSON for the records."""
        names = ("cameramodel", "lensname", "iso", "whitebalance", "aperture", "f-number", "imageformat")
        told = {name: self._value(name) for name in names}
        return {
            "kind": "gphoto2",
            "channels": self.channels,
            **{name: value for name, value in told.items() if value is not None},
        }

    def close(self) -> None:
        """Let the camera go."""
        try:
            self._camera.exit()
        except self._gp.GPhoto2Error:  # it was unplugged, and is gone anyway
            return

    def __enter__(self) -> GPhoto2Camera:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

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
        for name, allowed in _MANUAL.items():
            value = self._value(name)
            if value is not None and value not in allowed:
                raise AcquisitionError(f"{name} of the camera is {value!r}; set it to {allowed[0]!r}")
        for name in _FIXED:
            value = self._value(name)
            if value is not None and _AUTOMATIC.match(value):
                raise AcquisitionError(f"{name} of the camera is {value!r}; set it to a fixed value")

    def _shutter_settings(self) -> tuple[str, dict[float, str]]:
        """The name of the shutter's setting, and its choices by their seconds."""
        for name in _SHUTTER:
            try:
                offered = [str(choice) for choice in self._camera.get_single_config(name).get_choices()]
            except self._gp.GPhoto2Error:
                continue
            timed = {seconds_of(choice): choice for choice in offered}
            choices = {seconds: choice for seconds, choice in timed.items() if seconds is not None}
            if choices:
                return name, choices
        raise AcquisitionError("the camera has no shutter that can be set; turn its dial to M")
