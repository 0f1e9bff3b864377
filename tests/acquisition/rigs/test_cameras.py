# SPDX-License-Identifier: BSD-3-Clause
"""`OpenCVCamera` on files, and on captures whose properties behave as those of OpenCV's backends do."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ltcl.acquisition import OpenCVCamera
from ltcl.errors import AcquisitionError, InputError, InputTypeError

PICTURE = np.random.default_rng(1).integers(0, 256, (4, 6, 3), dtype=np.uint8)  # RGB


class Capture:
    """In place of `cv2.VideoCapture`: properties that are kept, ignored, or not there."""

    def __init__(self, backend: str, kept: dict[int, float], stuck: dict[int, float] | None = None) -> None:
        self.backend, self.kept, self.stuck = backend, kept, stuck or {}
        self.range: dict[int, tuple[float, float]] = {}
        self.open = True
        self.image: np.ndarray | None = PICTURE[..., ::-1]

    def isOpened(self) -> bool:
        return self.open

    def getBackendName(self) -> str:
        return self.backend

    def get(self, name: int) -> float:
        return {**self.kept, **self.stuck}.get(name, -1.0)

    def set(self, name: int, value: float) -> bool:
        if name in self.kept and name not in self.stuck:
            least, most = self.range.get(name, (value, value))
            self.kept[name] = min(max(value, least), most)
        return name in self.kept

    def read(self) -> tuple[bool, np.ndarray | None]:
        return self.image is not None, self.image

    def release(self) -> None:
        self.open = False


def automatic(backend: str) -> dict[int, float]:
    on = {"V4L2": 3.0}.get(backend, 1.0)
    return {cv2.CAP_PROP_AUTO_EXPOSURE: on, cv2.CAP_PROP_AUTO_WB: 1.0, cv2.CAP_PROP_EXPOSURE: 100.0}


def with_capture(monkeypatch: pytest.MonkeyPatch, capture: Capture) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", lambda source: capture)


@pytest.mark.parametrize(("backend", "off"), [("V4L2", 1.0), ("MSMF", 0.0), ("DSHOW", 0.0)])
def test_automatics_are_switched_off(monkeypatch: pytest.MonkeyPatch, backend: str, off: float) -> None:
    capture = Capture(backend, automatic(backend))
    with_capture(monkeypatch, capture)
    with OpenCVCamera(0) as camera:
        assert capture.kept[cv2.CAP_PROP_AUTO_EXPOSURE] == off
        assert capture.kept[cv2.CAP_PROP_AUTO_WB] == 0
        told = json.loads(json.dumps(camera.describe()))
    assert told["locked"] == {"exposure": True, "white balance": True}
    assert not capture.open


@pytest.mark.parametrize(
    ("name", "what"), [(cv2.CAP_PROP_AUTO_EXPOSURE, "exposure"), (cv2.CAP_PROP_AUTO_WB, "white balance")]
)
def test_automatics_that_stay_on_are_refused(monkeypatch: pytest.MonkeyPatch, name: int, what: str) -> None:
    capture = Capture("V4L2", automatic("V4L2"), stuck={name: 3.0})
    with_capture(monkeypatch, capture)
    with pytest.raises(
        AcquisitionError, match=f"automatic {what} of 2 cannot be switched off: .*3 read back"
    ):
        OpenCVCamera(2)
    assert not capture.open


def test_automatics_that_a_camera_has_not_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    with_capture(monkeypatch, Capture("V4L2", {cv2.CAP_PROP_EXPOSURE: 100.0}))
    assert OpenCVCamera(0).describe()["locked"] == {"exposure": False, "white balance": False}


def test_v4l2_counts_in_tenths_of_milliseconds(monkeypatch: pytest.MonkeyPatch) -> None:
    capture = Capture("V4L2", automatic("V4L2"))
    with_capture(monkeypatch, capture)
    camera = OpenCVCamera(0)
    assert camera.exposures is None
    camera.expose(1 / 60)
    assert capture.kept[cv2.CAP_PROP_EXPOSURE] == 167
    with pytest.raises(AcquisitionError, match=r"does not expose for 0\.0001667 s: 2 was set, 2 read back"):
        camera.expose(1 / 6000)  # rounding changes it by a fifth


def test_limits_are_found_where_the_driver_cuts_to_them(monkeypatch: pytest.MonkeyPatch) -> None:
    capture = Capture("V4L2", automatic("V4L2"))
    capture.range[cv2.CAP_PROP_EXPOSURE] = (3, 2047)
    with_capture(monkeypatch, capture)
    assert OpenCVCamera(0).limits == (3e-4, 0.2047)
    with_capture(monkeypatch, Capture("V4L2", automatic("V4L2"), stuck={cv2.CAP_PROP_EXPOSURE: 100.0}))
    assert OpenCVCamera(0).limits == (1e-4, 30.0)


def test_windows_counts_in_powers_of_two(monkeypatch: pytest.MonkeyPatch) -> None:
    capture = Capture("MSMF", automatic("MSMF"))
    with_capture(monkeypatch, capture)
    camera = OpenCVCamera(0)
    assert camera.exposures is not None
    for seconds in camera.exposures:
        camera.expose(seconds)
        assert 2.0 ** capture.kept[cv2.CAP_PROP_EXPOSURE] == seconds


def test_an_exposure_that_the_camera_does_not_take_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    capture = Capture("V4L2", automatic("V4L2"), stuck={cv2.CAP_PROP_EXPOSURE: 100.0})
    with_capture(monkeypatch, capture)
    with pytest.raises(AcquisitionError, match=r"for 0\.5 s: 5000 was set, 100 read back"):
        OpenCVCamera(0).expose(0.5)


def test_a_stated_exposure_is_the_only_one(monkeypatch: pytest.MonkeyPatch) -> None:
    capture = Capture("V4L2", automatic("V4L2"))
    with_capture(monkeypatch, capture)
    camera = OpenCVCamera(0, seconds=0.02)
    assert camera.exposures == (0.02,)
    camera.expose(0.02)
    assert capture.kept[cv2.CAP_PROP_EXPOSURE] == 100
    with pytest.raises(InputError, match=r"seconds is 0\.04; it must be 0\.02"):
        camera.expose(0.04)


def test_an_unknown_backend_needs_its_exposure(monkeypatch: pytest.MonkeyPatch) -> None:
    with_capture(monkeypatch, Capture("AVFOUNDATION", {}))
    with pytest.raises(InputError, match="seconds is None; it must be the exposure of 0, which AVFOUNDATION"):
        OpenCVCamera(0)


def test_frames_are_rgb_or_green(monkeypatch: pytest.MonkeyPatch) -> None:
    with_capture(monkeypatch, Capture("V4L2", automatic("V4L2")))
    np.testing.assert_array_equal(OpenCVCamera(0).frame(), PICTURE)
    np.testing.assert_array_equal(OpenCVCamera(0, channels=1).frame(), PICTURE[..., 1])


@pytest.mark.parametrize("shape", [(4, 6), (4, 6, 1)])
def test_grey_frames_are_for_one_channel(monkeypatch: pytest.MonkeyPatch, shape: tuple[int, ...]) -> None:
    capture = Capture("V4L2", automatic("V4L2"))
    capture.image = PICTURE[..., 0].reshape(shape)
    with_capture(monkeypatch, capture)
    np.testing.assert_array_equal(OpenCVCamera(0, channels=1).frame(), PICTURE[..., 0])
    with pytest.raises(AcquisitionError, match="they must be RGB"):
        OpenCVCamera(0).frame()


def test_a_camera_that_was_unplugged_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    capture = Capture("V4L2", automatic("V4L2"))
    with_capture(monkeypatch, capture)
    camera = OpenCVCamera(0)
    capture.image = None
    with pytest.raises(AcquisitionError, match="no frame comes from 0: the camera was unplugged"):
        camera.frame()


def test_another_size_than_asked_for_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    sides = {cv2.CAP_PROP_FRAME_HEIGHT: 480.0, cv2.CAP_PROP_FRAME_WIDTH: 640.0}
    with_capture(monkeypatch, Capture("V4L2", {**automatic("V4L2"), **sides}))
    OpenCVCamera(0, size=(720, 1280))
    with_capture(monkeypatch, Capture("V4L2", {**automatic("V4L2"), **sides}, stuck=sides))
    with pytest.raises(AcquisitionError, match=r"frames of \(480, 640\); size asks for \(720, 1280\)"):
        OpenCVCamera(0, size=(720, 1280))


def test_a_video_file_is_read_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "steps.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, (32, 16))
    for level in (0, 80, 160):
        video.write(np.full((16, 32, 3), level, np.uint8))
    video.release()
    with OpenCVCamera(path, channels=1, seconds=1 / 30) as camera:
        assert not camera.stream
        assert [abs(camera.frame().mean() - level) < 4 for level in (0, 80, 160)] == [True] * 3
        with pytest.raises(AcquisitionError, match="or its stream has ended"):
            camera.frame()
        assert camera.describe()["source"] == "steps.avi"
    with pytest.raises(InputError, match="seconds is None"):
        OpenCVCamera(path)


def test_what_is_no_camera_is_named(tmp_path: Path) -> None:
    with pytest.raises(AcquisitionError, match=r"OpenCV cannot open .*none\.avi"):
        OpenCVCamera(tmp_path / "none.avi", seconds=1.0)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"source": -1}, InputError, "source is -1"),
        ({"source": 1.5}, InputTypeError, r"source is 1\.5; it must be the number of a camera"),
        ({"source": ""}, InputTypeError, "source is ''"),
        ({"source": 0, "channels": 2}, InputError, "channels is 2"),
        ({"source": 0, "seconds": 0.0}, InputError, r"seconds is 0\.0"),
        ({"source": 0, "size": (0, 4)}, InputError, "size is"),
    ],
)
def test_bad_arguments_are_named(
    monkeypatch: pytest.MonkeyPatch, arguments: dict[str, Any], error: type[Exception], message: str
) -> None:
    with_capture(monkeypatch, Capture("V4L2", automatic("V4L2")))
    with pytest.raises(error, match=message):
        OpenCVCamera(**arguments)
