# SPDX-License-Identifier: BSD-3-Clause
"""`GPhoto2Camera` before a module that answers as python-gphoto2 does; its files are real JPEGs."""

from __future__ import annotations

import json
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import GPhoto2Camera
from ltcl.acquisition.rigs.tethered import seconds_of
from ltcl.errors import AcquisitionError, InputError
from tests.acquisition.rigs import camera_files

CHOICES = ["bulb", "30", "1", "1/4", "1/60", "1/125"]
GREY = np.full((16, 24, 3), (90, 120, 150), np.uint8)


class GPhoto2Error(Exception):
    pass


class Widget:
    def __init__(self, body: Body, name: str) -> None:
        self.body, self.name, self.value = body, name, body.settings[name]

    def get_value(self) -> str:
        return self.value

    def set_value(self, value: str) -> None:
        self.value = value

    def get_choices(self) -> Iterator[str]:
        return iter(CHOICES if self.name.startswith("shutterspeed") else [self.value])


class File:
    def __init__(self, content: bytes) -> None:
        self.content = content

    def save(self, path: str) -> None:
        Path(path).write_bytes(self.content)


class Body:
    """What `gphoto2.Camera()` gives."""

    def __init__(self) -> None:
        self.settings = {
            "shutterspeed": "1/60",
            "autoexposuremode": "Manual",
            "iso": "100",
            "whitebalance": "Daylight",
        }
        self.there = self.takes_settings = True
        self.files: dict[tuple[str, str], bytes] = {}
        self.shots = 0
        self.exif: float | None = None
        self.picture = GREY
        self.folder = Path()

    def _answer(self) -> None:
        if not self.there:
            raise GPhoto2Error("[-52] Could not find the requested device on the USB port")

    def init(self) -> None:
        self._answer()

    def exit(self) -> None:
        self._answer()

    def get_single_config(self, name: str) -> Widget:
        self._answer()
        if name not in self.settings:
            raise GPhoto2Error(f"[-2] Bad parameters: {name}")
        return Widget(self, name)

    def set_single_config(self, name: str, widget: Widget) -> None:
        self._answer()
        if self.takes_settings:
            self.settings[name] = widget.value

    def capture(self, kind: int) -> Any:
        assert kind == 0
        self._answer()
        self.shots += 1
        path = self.folder / "shot.jpg"
        name = next(name for name in ("shutterspeed2", "shutterspeed") if name in self.settings)
        camera_files.write(path, self.picture, self.exif or seconds_of(self.settings[name]))
        place = types.SimpleNamespace(folder="/store", name=f"IMG_{self.shots:04d}.JPG")
        self.files[place.folder, place.name] = path.read_bytes()
        return place

    def file_get(self, folder: str, name: str, kind: int) -> File:
        assert kind == 1
        return File(self.files[folder, name])

    def file_delete(self, folder: str, name: str) -> None:
        del self.files[folder, name]


@pytest.fixture
def body(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Body:
    module: Any = types.ModuleType("gphoto2")
    body = Body()
    body.folder = tmp_path
    module.Camera, module.GPhoto2Error = lambda: body, GPhoto2Error
    module.GP_CAPTURE_IMAGE, module.GP_FILE_TYPE_NORMAL = 0, 1
    monkeypatch.setitem(sys.modules, "gphoto2", module)
    return body


@pytest.mark.parametrize("name", ["shutterspeed", "shutterspeed2"])
def test_it_exposes_and_photographs(body: Body, name: str) -> None:
    body.settings[name] = "1/4"
    with GPhoto2Camera() as camera:
        assert camera.exposures == (1 / 125, 1 / 60, 1 / 4, 1.0, 30.0)
        camera.expose(1 / 125)
        assert body.settings[name] == "1/125"
        assert np.abs(camera.frame().astype(int) - GREY).max() <= 4
        assert body.files == {}  # nothing is left on the camera
        assert json.loads(json.dumps(camera.describe()))["iso"] == "100"
    grey = GPhoto2Camera(channels=1).frame()
    assert grey.shape == (16, 24)
    assert abs(grey.mean() - 120) < 2


@pytest.mark.parametrize(
    ("name", "value", "wanted"),
    [
        ("autoexposuremode", "AV", "'Manual'"),
        ("expprogram", "A", "'M'"),
        ("iso", "Auto", "a fixed value"),
        ("isoauto", "On", "a fixed value"),
        ("whitebalance", "Automatic", "a fixed value"),
    ],
)
def test_automatics_are_refused(body: Body, name: str, value: str, wanted: str) -> None:
    body.settings[name] = value
    with pytest.raises(AcquisitionError, match=f"^{name} of the camera is '{value}'; set it to {wanted}$"):
        GPhoto2Camera()


def test_no_camera_is_named(body: Body) -> None:
    body.there = False
    with pytest.raises(AcquisitionError, match=r"the camera cannot be opened: \[-52\] Could not find"):
        GPhoto2Camera()


def test_an_unplugged_camera_is_named_and_can_be_closed(body: Body) -> None:
    with GPhoto2Camera() as camera:
        body.there = False
        with pytest.raises(AcquisitionError, match=r"the camera cannot photograph: \[-52\]"):
            camera.frame()


def test_a_shutter_that_does_not_move_is_named(body: Body) -> None:
    camera = GPhoto2Camera()
    body.takes_settings = False
    with pytest.raises(AcquisitionError, match="keeps shutterspeed at '1/60'; '1' was asked for"):
        camera.expose(1.0)


def test_an_exposure_that_the_camera_has_not_is_refused(body: Body) -> None:
    with pytest.raises(InputError, match=r"seconds is 0\.5; the nearest the camera has is 0\.25"):
        GPhoto2Camera().expose(0.5)


def test_a_photograph_that_was_exposed_for_other_seconds_is_refused(body: Body) -> None:
    camera = GPhoto2Camera()
    camera.expose(1.0)
    body.exif = 0.5
    with pytest.raises(AcquisitionError, match=r"exposed for 0\.5 s by its EXIF; 1 s was set"):
        camera.frame()


def test_a_file_that_cannot_be_read_is_refused(body: Body, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(body, "file_get", lambda *_: File(b"no picture"))
    with pytest.raises(AcquisitionError, match=r"the camera's file cannot be used: .*IMG_0001"):
        GPhoto2Camera().frame()


def test_a_camera_without_a_shutter_is_refused(body: Body) -> None:
    del body.settings["shutterspeed"]
    with pytest.raises(AcquisitionError, match="no shutter that can be set; turn its dial to M"):
        GPhoto2Camera()


def test_the_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gphoto2", None)
    with pytest.raises(AcquisitionError, match=r'needs gphoto2.*pip install "ltcl\[camera\]"'):
        GPhoto2Camera()


@pytest.mark.parametrize(
    ("choice", "seconds"),
    [("1/8000", 1 / 8000), ("10/13", 10 / 13), ('1.3"', 1.3), ("0.0166s", 0.0166), ("30", 30.0)]
    + [(text, None) for text in ("bulb", "Bulb", "Time", "", "0", "1/0", "-1", "x200", "auto")],
)
def test_shutter_settings_are_read(choice: str, seconds: float | None) -> None:
    assert seconds_of(choice) == (seconds if seconds is None else pytest.approx(seconds))
