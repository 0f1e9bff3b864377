# SPDX-License-Identifier: BSD-3-Clause
"""`OpenCVCamera` on captures like those of OpenCV, `GPhoto2Camera` on a model of python-gphoto2."""

from __future__ import annotations

import json
import sys
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ltcl.acquisition import GPhoto2Camera, OpenCVCamera
from ltcl.errors import AcquisitionError, InputError, InputTypeError
from tests.acquisition.rigs import camera_files

PICTURE = np.random.default_rng(1).integers(0, 256, (4, 6, 3), dtype=np.uint8)  # RGB
EXPOSURE, AUTO, WHITE = cv2.CAP_PROP_EXPOSURE, cv2.CAP_PROP_AUTO_EXPOSURE, cv2.CAP_PROP_AUTO_WB
SIDES = {cv2.CAP_PROP_FRAME_HEIGHT: 480.0, cv2.CAP_PROP_FRAME_WIDTH: 640.0}


class Capture:
    """In place of `cv2.VideoCapture`: properties that can be set, are stuck, or missing."""

    def __init__(
        self, backend: str, values: dict[int, float], stuck: dict[int, float], exposures: tuple[float, float]
    ) -> None:
        self.backend, self.values, self.stuck, self.exposures = backend, values, stuck, exposures
        self.open = True
        self.image: np.ndarray | None = PICTURE[..., ::-1]

    def isOpened(self) -> bool:
        return self.open

    def getBackendName(self) -> str:
        return self.backend

    def get(self, name: int) -> float:
        return {**self.values, **self.stuck}.get(name, -1.0)

    def set(self, name: int, value: float) -> bool:
        if name in self.values and name not in self.stuck:
            least, most = self.exposures if name == EXPOSURE else (value, value)
            self.values[name] = min(max(value, least), most)
        return name in self.values

    def read(self) -> tuple[bool, np.ndarray | None]:
        return self.image is not None, self.image

    def release(self) -> None:
        self.open = False


Open = Callable[..., Capture]


@pytest.fixture
def capture(monkeypatch: pytest.MonkeyPatch) -> Open:
    """The camera that OpenCV opens from now on."""

    def opened(
        backend: str = "V4L2",
        values: dict[int, float] | None = None,
        stuck: dict[int, float] | None = None,
        exposures: tuple[float, float] = (-1e9, 1e9),
    ) -> Capture:
        automatic = {AUTO: 3.0 if backend == "V4L2" else 1.0, WHITE: 1.0, EXPOSURE: 100.0}
        made = Capture(backend, automatic if values is None else values, stuck or {}, exposures)
        monkeypatch.setattr(cv2, "VideoCapture", lambda source: made)
        return made

    return opened


@pytest.mark.parametrize(("backend", "off"), [("V4L2", 1.0), ("MSMF", 0.0), ("DSHOW", 0.0)])
def test_automatics_are_switched_off(capture: Open, backend: str, off: float) -> None:
    made = capture(backend)
    with OpenCVCamera(0) as camera:
        assert (made.values[AUTO], made.values[WHITE]) == (off, 0)
        facts = json.loads(json.dumps(camera.describe()))
    assert facts["locked"] == {"exposure": True, "white balance": True}
    assert not made.open
    capture(values={EXPOSURE: 100.0})
    assert OpenCVCamera(0).describe()["locked"] == {"exposure": False, "white balance": False}


@pytest.mark.parametrize(("name", "what"), [(AUTO, "exposure"), (WHITE, "white balance")])
def test_automatics_that_stay_on_are_refused(capture: Open, name: int, what: str) -> None:
    made = capture(stuck={name: 3.0})
    with pytest.raises(AcquisitionError, match=f"automatic {what} of 2 .*3 read back"):
        OpenCVCamera(2)
    assert not made.open


@pytest.mark.parametrize(
    ("backend", "seconds", "units"), [("V4L2", 1 / 60, 167), ("MSMF", 1 / 64, -6), ("DSHOW", 1 / 4, -2)]
)
def test_exposures_are_set_in_the_units_of_the_backend(
    capture: Open, backend: str, seconds: float, units: float
) -> None:
    made = capture(backend)
    OpenCVCamera(0).expose(seconds)
    assert made.values[EXPOSURE] == units


@pytest.mark.parametrize(("stuck", "seconds"), [({}, 1 / 6000), ({EXPOSURE: 100.0}, 0.5)])
def test_an_exposure_that_the_camera_does_not_take_is_refused(
    capture: Open, stuck: dict[int, float], seconds: float
) -> None:
    capture(stuck=stuck)
    with pytest.raises(AcquisitionError, match=rf"{seconds:.4g} s: .* was set"):
        OpenCVCamera(0).expose(seconds)


def test_limits_are_where_the_driver_clips(capture: Open) -> None:
    capture(exposures=(3, 2047))
    assert OpenCVCamera(0).limits == (3e-4, 0.2047)
    capture(stuck={EXPOSURE: 100.0})
    assert OpenCVCamera(0).limits == (1e-4, 30.0)


def test_a_stated_exposure_is_the_only_one(capture: Open) -> None:
    made = capture()
    camera = OpenCVCamera(0, seconds=0.02)
    assert camera.exposures == (0.02,)
    camera.expose(0.02)
    assert made.values[EXPOSURE] == 100
    with pytest.raises(InputError, match=r"seconds is 0\.04; .* 0\.02"):
        camera.expose(0.04)
    capture("AVFOUNDATION", {})
    with pytest.raises(InputError, match=r"seconds is None; .* of 0: AVFOUNDATION"):
        OpenCVCamera(0)


def test_frames_are_rgb_or_green_or_grey(capture: Open) -> None:
    made = capture()
    np.testing.assert_array_equal(OpenCVCamera(0).frame(), PICTURE)
    green = OpenCVCamera(0, channels=1)
    np.testing.assert_array_equal(green.frame(), PICTURE[..., 1])
    for shape in ((4, 6), (4, 6, 1)):
        made.image = PICTURE[..., 0].reshape(shape)
        np.testing.assert_array_equal(green.frame(), PICTURE[..., 0])
        with pytest.raises(AcquisitionError, match="they must be RGB"):
            OpenCVCamera(0).frame()
    made.image = None
    with pytest.raises(AcquisitionError, match="no frame comes from 0"):
        green.frame()


def test_another_size_than_asked_for_is_refused(capture: Open) -> None:
    made = capture(values={EXPOSURE: 100.0, **SIDES})
    OpenCVCamera(0, size=(720, 1280))
    assert [made.values[side] for side in SIDES] == [720, 1280]
    capture(values={EXPOSURE: 100.0, **SIDES}, stuck=SIDES)
    with pytest.raises(AcquisitionError, match=r"\(480, 640\); size asks for \(720, 1280\)"):
        OpenCVCamera(0, size=(720, 1280))


def test_a_video_file_is_read_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "steps.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, (32, 16))
    for level in (0, 80, 160):
        video.write(np.full((16, 32, 3), level, np.uint8))
    video.release()
    with OpenCVCamera(path, channels=1, seconds=1 / 30) as camera:
        assert not camera.stream
        np.testing.assert_allclose([camera.frame().mean() for _ in range(3)], [0, 80, 160], atol=4)
        with pytest.raises(AcquisitionError, match="stream has ended"):
            camera.frame()
        assert camera.describe()["source"] == "steps.avi"
    with pytest.raises(AcquisitionError, match=r"OpenCV cannot open .*none\.avi"):
        OpenCVCamera(tmp_path / "none.avi", seconds=1.0)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"source": -1}, InputError, "source is -1"),
        ({"source": 1.5}, InputTypeError, r"source is 1\.5"),
        ({"source": ""}, InputTypeError, "source is ''"),
        ({"source": 0, "channels": 2}, InputError, "channels is 2"),
        ({"source": 0, "seconds": 0.0}, InputError, r"seconds is 0\.0"),
        ({"source": 0, "size": (0, 4)}, InputError, "size is"),
    ],
)
def test_bad_arguments_are_named(
    capture: Open, arguments: dict[str, Any], error: type[Exception], message: str
) -> None:
    capture()
    with pytest.raises(error, match=message):
        OpenCVCamera(**arguments)


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
        return iter(self.body.choices if self.name.startswith("shutterspeed") else [self.value])


class Body:
    """What `gphoto2.Camera()` gives; its files are real JPEGs."""

    def __init__(self, folder: Path) -> None:
        self.settings = {"shutterspeed": "1/60", "autoexposuremode": "Manual", "iso": "100"}
        self.choices = ["bulb", "30", "1", "1/4", "1/60", "1/125"]
        self.connected = self.obedient = True
        self.files: dict[tuple[str, str], Path] = {}
        self.exif = 1 / 60
        self.folder = folder

    def init(self) -> None:
        if not self.connected:
            raise GPhoto2Error("[-52] Could not find the requested device on the USB port")

    exit = init

    def get_single_config(self, name: str) -> Widget:
        self.init()
        if name not in self.settings:
            raise GPhoto2Error(f"[-2] Bad parameters: {name}")
        return Widget(self, name)

    def set_single_config(self, name: str, widget: Widget) -> None:
        if self.obedient:
            self.settings[name] = widget.value

    def capture(self, kind: int) -> Any:
        self.init()
        path = self.folder / "shot.jpg"
        camera_files.write(path, np.full((16, 24, 3), (90, 120, 150), np.uint8), self.exif)
        self.files["/store", "IMG_0001.JPG"] = path
        return types.SimpleNamespace(folder="/store", name="IMG_0001.JPG")

    def file_get(self, folder: str, name: str, kind: int) -> Any:
        content = self.files[folder, name].read_bytes()
        return types.SimpleNamespace(save=lambda path: Path(path).write_bytes(content))

    def file_delete(self, folder: str, name: str) -> None:
        del self.files[folder, name]


@pytest.fixture
def body(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Body:
    module: Any = types.ModuleType("gphoto2")
    body = Body(tmp_path)
    module.Camera, module.GPhoto2Error = lambda: body, GPhoto2Error
    module.GP_CAPTURE_IMAGE, module.GP_FILE_TYPE_NORMAL = 0, 1
    monkeypatch.setitem(sys.modules, "gphoto2", module)
    return body


@pytest.mark.parametrize("name", ["shutterspeed", "shutterspeed2"])
def test_a_tethered_camera_exposes_and_photographs(body: Body, name: str) -> None:
    body.settings[name], body.exif = "1/4", 1 / 125
    with GPhoto2Camera() as camera:
        assert camera.exposures == (1 / 125, 1 / 60, 1 / 4, 1.0, 30.0)
        camera.expose(1 / 125)
        assert body.settings[name] == "1/125"
        np.testing.assert_allclose(camera.frame().mean(axis=(0, 1)), (90, 120, 150), atol=4)
        assert body.files == {}  # nothing is left on the camera
        assert json.loads(json.dumps(camera.describe()))["iso"] == "100"
        with pytest.raises(InputError, match=r"seconds is 0\.5; .* 0\.25"):
            camera.expose(0.5)
    np.testing.assert_allclose(GPhoto2Camera(channels=1).frame(), np.full((16, 24), 120), atol=4)


@pytest.mark.parametrize(
    ("name", "value", "setting"),
    [
        ("autoexposuremode", "AV", "'Manual'"),
        ("expprogram", "A", "'M'"),
        ("iso", "Auto", "a fixed value"),
        ("isoauto", "On", "a fixed value"),
        ("whitebalance", "Automatic", "a fixed value"),
    ],
)
def test_automatics_of_a_tethered_camera_are_refused(body: Body, name: str, value: str, setting: str) -> None:
    body.settings[name] = value
    with pytest.raises(AcquisitionError, match=f"^{name} .*'{value}'.*{setting}$"):
        GPhoto2Camera()


def test_what_fails_on_the_cable_is_named(body: Body, monkeypatch: pytest.MonkeyPatch) -> None:
    with GPhoto2Camera() as camera:
        camera.expose(1.0)
        with pytest.raises(AcquisitionError, match=r"exposed for 0\.01667 s .* 1 s"):
            camera.frame()
        body.obedient = False
        with pytest.raises(AcquisitionError, match="shutterspeed at '1'; '1/4'"):
            camera.expose(0.25)
        broken = types.SimpleNamespace(save=lambda path: Path(path).write_bytes(b"no picture"))
        monkeypatch.setattr(body, "file_get", lambda *_: broken)
        with pytest.raises(AcquisitionError, match=r"file cannot be used: .*IMG_0001"):
            camera.frame()
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


def test_shutter_settings_of_all_makers_are_read(body: Body) -> None:
    body.choices = [
        "1/8000",
        "10/13",
        '1.3"',
        "0.0166s",
        "30",
        "bulb",
        "Time",
        "",
        "0",
        "1/0",
        "-1",
        "x2",
        "auto",
    ]
    assert GPhoto2Camera().exposures == (1 / 8000, 0.0166, 10 / 13, 1.3, 30.0)
