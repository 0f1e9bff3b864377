# SPDX-License-Identifier: BSD-3-Clause
"""`OpenCVCamera` on captures like those of OpenCV, `GPhoto2Camera` on a model of python-gphoto2."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from ltcl.acquisition import GPhoto2Camera, OpenCVCamera
from ltcl.errors import AcquisitionError, InputError, InputTypeError
from tests.acquisition.rigs import camera_files

PICTURE = np.arange(72, dtype=np.uint8).reshape(4, 6, 3)  # RGB
EXPOSURE = cv2.CAP_PROP_EXPOSURE
AUTO = cv2.CAP_PROP_AUTO_EXPOSURE
WHITE = cv2.CAP_PROP_AUTO_WB
SIDES = {cv2.CAP_PROP_FRAME_HEIGHT: 480.0, cv2.CAP_PROP_FRAME_WIDTH: 640.0}


class Capture:
    """A model of `cv2.VideoCapture`: properties can be set, are stuck, or missing (-1)."""

    def __init__(self, backend: str = "V4L2", stuck: Any = None, limits: Any = (-20, 1e9)) -> None:
        self.values = {
            AUTO: 3.0 if backend == "V4L2" else 1.0,
            WHITE: 1.0,
            EXPOSURE: 100.0,
            **SIDES,
        }
        self.backend = backend
        self.stuck = {} if stuck is None else stuck
        self.limits = limits
        self.open = True
        self.image: np.ndarray | None = PICTURE[..., ::-1]

    def isOpened(self) -> bool:
        return self.open

    def getBackendName(self) -> str:
        return self.backend

    def read(self) -> tuple[bool, np.ndarray | None]:
        return self.image is not None, self.image

    def get(self, name: int) -> float:
        return {**self.values, **self.stuck}[name]

    def release(self) -> None:
        self.open = False

    def set(self, name: int, value: float) -> None:
        self.values[name] = np.clip(value, *self.limits) if name == EXPOSURE else value


Open = Callable[..., Capture]


@pytest.fixture
def capture(monkeypatch: pytest.MonkeyPatch) -> Open:
    """The camera that OpenCV opens from now on."""

    def connect(**options: Any) -> Capture:
        driver = Capture(**options)
        monkeypatch.setattr(cv2, "VideoCapture", lambda source: driver)
        return driver

    return connect


def test_automatics_are_off_and_exposures_in_the_units_of_v4l2(capture: Open) -> None:
    driver = capture()
    with OpenCVCamera(0) as camera:
        camera.expose(1 / 60)
        assert (driver.values[AUTO], driver.values[WHITE], driver.values[EXPOSURE]) == (1, 0, 167)
        assert camera.describe()["backend"] == "V4L2"
    assert not driver.open
    capture(stuck={AUTO: -1.0, WHITE: -1.0})  # nothing adapts
    OpenCVCamera(0).expose(1 / 60)


@pytest.mark.parametrize(
    ("driver", "arguments", "seconds", "error", "message"),
    [
        (
            {"stuck": {AUTO: 3.0}},
            {},
            0.01,
            AcquisitionError,
            "automatic exposure of 0 .*3 read back",
        ),
        (
            {"stuck": {WHITE: 3.0}},
            {},
            0.01,
            AcquisitionError,
            "automatic white balance of 0 .*3 read back",
        ),
        ({"stuck": {EXPOSURE: 100.0}}, {}, 0.5, AcquisitionError, r"exposure 0\.5 s .* 0\.01 s"),
        (
            {"stuck": SIDES},
            {"size": (720, 1280)},
            0.01,
            AcquisitionError,
            r"\(480, 640\); .*\(720, 1280\)",
        ),
        ({}, {}, 1 / 6000, AcquisitionError, r"exposure 0\.0001667 s .* 0\.0002 s"),
        ({}, {"seconds": 0.02}, 0.04, InputError, r"seconds is 0\.04; .* 0\.02"),
        ({"backend": "AVFOUNDATION"}, {}, 0.02, InputError, "seconds is None; .*AVFOUNDATION"),
        ({}, {"source": 1.5}, 0.01, InputTypeError, r"source is 1\.5"),
        ({}, {"channels": 0.0}, 0.01, InputError, "channels is 0.0"),
        ({}, {"seconds": 0.0}, 0.01, InputError, "seconds is 0.0"),
        ({}, {"size": 0.0}, 0.01, InputError, "size is 0.0"),
    ],
)
def test_what_a_camera_does_not_do_is_refused(
    capture: Open, driver: Any, arguments: Any, seconds: float, error: type[Exception], message: str
) -> None:
    capture(**driver)
    with pytest.raises(error, match=message):
        OpenCVCamera(**{"source": 0, **arguments}).expose(seconds)


def test_exposures_are_stated_or_where_the_driver_clips(capture: Open) -> None:
    driver = capture()
    camera = OpenCVCamera(0, seconds=0.02, size=(720, 1280))
    camera.expose(0.02)
    assert (camera.exposures, driver.values[EXPOSURE]) == ((0.02,), 100)
    assert [driver.values[side] for side in SIDES] == [720, 1280]
    capture(limits=(3, 2047))
    assert OpenCVCamera(0).limits == (3e-4, 0.2047)


def test_frames_are_rgb_or_green_or_grey_or_missing(capture: Open, tmp_path: Path) -> None:
    driver = capture()
    np.testing.assert_array_equal(OpenCVCamera(0).frame(), PICTURE)
    green = OpenCVCamera(tmp_path / "stream.avi", channels=1)
    assert green.describe()["source"] == "stream.avi"
    np.testing.assert_array_equal(green.frame(), PICTURE[..., 1])
    for grey in (PICTURE[..., 0], PICTURE[..., :1]):
        driver.image = grey
        np.testing.assert_array_equal(green.frame(), PICTURE[..., 0])
    driver.image = None
    driver.open = False
    with pytest.raises(AcquisitionError, match="stream has ended"):
        green.frame()
    with pytest.raises(AcquisitionError, match="OpenCV cannot open 7"):
        OpenCVCamera(7)


class GPhoto2Error(Exception):
    pass


class Widget:
    """A setting as gphoto2 gives it."""

    def __init__(self, value: str, choices: list[str]) -> None:
        self.value = value
        self.choices = choices

    def get_choices(self) -> Iterator[str]:
        return iter(self.choices)

    def get_value(self) -> str:
        return self.value

    def set_value(self, value: str) -> None:
        self.value = value


class Body:
    """A model of `gphoto2.Camera()`; its files are real JPEGs."""

    def __init__(self, folder: Path) -> None:
        self.settings = {"shutterspeed": "1/60", "autoexposuremode": "Manual", "iso": "100"}
        self.choices = [
            "bulb",
            "Time",
            "",
            "0",
            "1/0",
            "-1",
            "auto",
            '30"',
            "1s",
            "1/4",
            "1/60",
            "10/1250",
        ]
        self.connected = True
        self.obedient = True
        self.exif = 1 / 60
        self.path = folder / "IMG_0001.JPG"

    def file_get(self, *place: Any) -> Any:
        return SimpleNamespace(save=lambda path: shutil.copy(self.path, path))

    def file_delete(self, *place: Any) -> None:
        self.path.unlink()

    def init(self) -> None:
        if not self.connected:
            raise GPhoto2Error("[-52] Could not find the requested device on the USB port")

    exit = init

    def get_single_config(self, name: str) -> Any:
        if name not in self.settings:
            raise GPhoto2Error(f"[-2] Bad parameters: {name}")
        return Widget(self.settings[name], self.choices)

    def set_single_config(self, name: str, widget: Any) -> None:
        if self.obedient:
            self.settings[name] = widget.value

    def capture(self, kind: int) -> Any:
        self.init()
        camera_files.write(self.path, np.full((16, 24, 3), (90, 120, 150), np.uint8), self.exif)
        return SimpleNamespace(folder="/store", name=self.path.name)


@pytest.fixture
def body(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Body:
    body = Body(tmp_path)
    members = {"GPhoto2Error": GPhoto2Error, "GP_CAPTURE_IMAGE": 0, "GP_FILE_TYPE_NORMAL": 1}
    monkeypatch.setitem(sys.modules, "gphoto2", SimpleNamespace(Camera=lambda: body, **members))
    return body


@pytest.mark.parametrize("name", ["shutterspeed", "shutterspeed2"])
def test_a_tethered_camera_exposes_and_photographs(body: Body, name: str) -> None:
    body.settings[name] = "1/4"
    body.exif = 1 / 125
    with GPhoto2Camera() as camera:
        assert camera.exposures == (1 / 125, 1 / 60, 1 / 4, 1.0, 30.0)
        camera.expose(1 / 125)
        assert body.settings[name] == "10/1250"
        np.testing.assert_allclose(camera.frame().mean(axis=(0, 1)), (90, 120, 150), atol=4)
        assert not body.path.exists()  # nothing is left on the camera
        assert camera.describe()["iso"] == "100"
        with pytest.raises(InputError, match=r"seconds is 0\.5; .* 0\.25"):
            camera.expose(0.5)
    np.testing.assert_allclose(GPhoto2Camera(channels=1).frame(), np.full((16, 24), 120), atol=4)


@pytest.mark.parametrize(
    "setting", ["autoexposuremode=AV", "expprogram=A", "iso=Auto", "whitebalance=Automatic"]
)
def test_automatics_of_a_tethered_camera_are_refused(body: Body, setting: str) -> None:
    name, value = setting.split("=")
    body.settings[name] = value
    with pytest.raises(AcquisitionError, match=f"^{name} .*'{value}'"):
        GPhoto2Camera()


def test_what_fails_on_the_cable_is_named(body: Body, monkeypatch: pytest.MonkeyPatch) -> None:
    with GPhoto2Camera() as camera:
        camera.expose(1.0)
        with pytest.raises(AcquisitionError, match=r"exposed for 0\.01667 s .* 1 s"):
            camera.frame()
        body.obedient = False
        with pytest.raises(AcquisitionError, match="shutterspeed at '1s'; '1/4'"):
            camera.expose(0.25)
        body.connected = False
        with pytest.raises(AcquisitionError, match=r"photograph: \[-52\]"):
            camera.frame()
    with pytest.raises(AcquisitionError, match=r"opened: \[-52\]"):
        GPhoto2Camera()
    body.connected = True
    del body.settings["shutterspeed"]
    with pytest.raises(AcquisitionError, match="no shutter"):
        GPhoto2Camera()
    monkeypatch.setitem(sys.modules, "gphoto2", None)
    with pytest.raises(AcquisitionError, match=r"needs gphoto2.*ltcl\[camera\]"):
        GPhoto2Camera()
