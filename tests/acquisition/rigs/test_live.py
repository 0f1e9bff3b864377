# SPDX-License-Identifier: BSD-3-Clause
"""`LiveRig` on SDL's dummy display, before cameras that lag, tear, adapt, drift, freeze and go away."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pytest

from ltcl.acquisition import Display, LiveRig, OpenCVCamera, Shots
from ltcl.acquisition.rigs import stage
from ltcl.errors import AcquisitionError, InputError, InputTypeError
from tests.acquisition.rigs.watching import CLEAN, FRAME, GRID, SECONDS, Clock, Watcher, scene

WHITE = np.ones(GRID, np.float32)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(stage, "time", clock)
    return clock


@pytest.fixture
def display(monkeypatch: pytest.MonkeyPatch) -> Iterator[Display]:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    with Display(GRID) as display:
        yield display


def patterns(count: int, seed: int = 1) -> np.ndarray:
    """Of codes that 8 bits hold."""
    levels = np.random.default_rng(seed).integers(0, 256, (count, *GRID))
    return (levels / 255).astype(np.float32)


def single(place: tuple[int, int], code: float = 1.0) -> np.ndarray:
    codes = np.zeros(GRID, np.float32)
    codes[place] = code
    return codes


def test_photographs_are_those_of_what_is_shown(clock: Clock, display: Display) -> None:
    camera = Watcher(clock, scene(**CLEAN))
    rig, truth = LiveRig(camera, display), scene(**CLEAN)
    for codes in patterns(6):
        for seconds in (SECONDS, 1 / 60):
            np.testing.assert_array_equal(rig.photograph(codes, seconds), truth.photograph(codes, seconds))


def test_a_single_faint_pixel_that_moves_is_never_the_one_before(clock: Clock, display: Display) -> None:
    camera = Watcher(clock, scene(**CLEAN, response="linear"))
    rig, truth = LiveRig(camera, display), scene(**CLEAN, response="linear")
    for k in range(8):
        codes = single(
            (k % 3, k), 4 / 255
        )  # a change of one code, below what the camera's noise is taken for
        np.testing.assert_array_equal(rig.photograph(codes, SECONDS), truth.photograph(codes, SECONDS))


def test_noise_does_not_stop_it(clock: Clock, display: Display) -> None:
    camera = Watcher(clock, scene(gain=5000.0, read=0.0005))
    rig, truth = LiveRig(camera, display), scene(**CLEAN)
    for codes in patterns(4):
        taken, wanted = rig.photograph(codes, SECONDS), truth.photograph(codes, SECONDS)
        assert np.abs(taken.astype(float) - wanted).mean() < 3
    found = rig.survey
    assert found is not None
    assert 1 / 255 < found.tolerance < found.contrast / 4


@pytest.mark.parametrize("latency", [0.0, 0.05, 0.31])
def test_latency_is_measured(clock: Clock, display: Display, latency: float) -> None:
    camera = Watcher(clock, scene(**CLEAN), latency=latency, queue=1)
    rig = LiveRig(camera, display)
    found = rig.calibrate()
    # A flash waits for the end of the shutter's run, and then for the next frame.
    assert latency <= found.latency <= found.worst <= latency + camera.readout + 2 * FRAME
    assert rig.calibrate() is found


def test_latency_that_jumps_spoils_no_photograph(clock: Clock, display: Display) -> None:
    rng, truth = np.random.default_rng(5), scene(**CLEAN)
    camera = Watcher(clock, scene(**CLEAN), latency=0.05, readout=0.0)
    rig = LiveRig(camera, display)
    rig.calibrate()
    late = [0.0]

    def latency(_: float) -> float:
        late[0] = rng.uniform(0, 0.4) if rng.random() < 0.1 else max(0.0, late[0] - FRAME)
        return 0.05 + late[0]

    camera.latency = latency
    for codes in [*patterns(15), *(single((1, k)) for k in range(8))]:
        np.testing.assert_array_equal(rig.photograph(codes, SECONDS), truth.photograph(codes, SECONDS))


@pytest.mark.parametrize("readout", [0.0, 0.03])
def test_latency_that_grows_tenfold_spoils_no_photograph(
    clock: Clock, display: Display, readout: float
) -> None:
    linear = {**CLEAN, "response": "linear", "projector_response": "linear"}
    camera, truth = Watcher(clock, scene(**linear), latency=0.08, readout=readout), scene(**linear)
    rig = LiveRig(camera, display)
    codes = patterns(3)
    rig.photograph(codes[0], SECONDS)
    camera.latency = lambda _: 0.8
    faint = [single((1, k), 2 / 255) for k in range(4)]
    for shown in [codes[1], codes[2], *faint]:
        np.testing.assert_array_equal(rig.photograph(shown, SECONDS), truth.photograph(shown, SECONDS))


def test_a_camera_that_freezes_is_named_stale(clock: Clock, display: Display) -> None:
    camera = Watcher(clock, scene(**CLEAN))
    rig = LiveRig(camera, display)
    first, second, third = patterns(3)
    rig.photograph(first, SECONDS)
    camera.frozen = rig.photograph(second, SECONDS)
    with pytest.raises(AcquisitionError, match=r"^photograph 3: the frame is stale"):
        rig.photograph(third, SECONDS)
    camera.frozen = None
    np.testing.assert_array_equal(rig.photograph(third, SECONDS), scene(**CLEAN).photograph(third, SECONDS))


def test_frames_that_never_come_to_rest_are_named(clock: Clock, display: Display) -> None:
    camera = Watcher(clock, scene(**CLEAN))
    rig = LiveRig(camera, display)
    rig.photograph(WHITE, SECONDS)
    camera.gain = lambda moment, _: 1.0 - 0.3 * (round(moment / FRAME) % 2)
    with pytest.raises(AcquisitionError, match=r"^photograph 2: frames still change by \d.*% of full scale"):
        rig.photograph(patterns(1)[0], SECONDS)


def test_a_slow_automatic_exposure_is_refused_with_its_figure(clock: Clock, display: Display) -> None:
    camera = Watcher(clock, scene(**CLEAN))
    state = [1.0]

    def gain(_: float, codes: np.ndarray) -> float:
        wanted = 0.3 / max(float(codes.mean()), 0.1)
        state[0] *= (wanted / state[0]) ** 0.1
        return state[0]

    camera.gain = gain
    with pytest.raises(AcquisitionError, match=r"^photograph 1: the camera (drifts|adapts).*\d\.\d%"):
        LiveRig(camera, display, patience=0.5).photograph(WHITE, SECONDS)


def test_a_fast_automatic_exposure_is_refused_with_its_figure(clock: Clock, display: Display) -> None:
    camera = Watcher(clock, scene(**CLEAN))
    camera.gain = lambda _, codes: 0.5 / max(float(codes.mean()), 0.2)
    with pytest.raises(
        AcquisitionError, match=r"^photograph 1: the camera adapts: .* \d+\.\d% of full scale"
    ):
        LiveRig(camera, display).photograph(WHITE, SECONDS)


def test_a_lamp_that_fades_is_found_at_the_next_identical_shot(clock: Clock, display: Display) -> None:
    camera = Watcher(clock, scene(**CLEAN, response="linear", black=0.0))
    rig = LiveRig(camera, display)
    first, second = patterns(2)
    rig.photograph(first, SECONDS)
    rig.photograph(second, SECONDS)
    np.testing.assert_array_equal(rig.photograph(first, SECONDS), rig.photograph(first, SECONDS))
    camera.gain = lambda *_: 0.9
    with pytest.raises(AcquisitionError, match=r"^photograph 5: it is (9|10)\.\d% brighter or darker"):
        rig.photograph(first, SECONDS)
    with pytest.raises(AcquisitionError, match=r"drift=0\.02 accepts 2\.0%"):
        rig.photograph(first, SECONDS)


def test_a_lamp_that_fades_between_sessions_is_found(clock: Clock, display: Display) -> None:
    camera = Watcher(clock, scene(**CLEAN, response="linear", black=0.0))
    first, second = patterns(2)
    earlier = LiveRig(camera, display).photograph(first, SECONDS)
    rig = LiveRig(camera, display)
    rig.recall(first, SECONDS, earlier)
    rig.photograph(second, SECONDS)
    camera.gain = lambda *_: 0.9
    with pytest.raises(AcquisitionError, match=r"^photograph 3: it is (9|10)\.\d% brighter or darker"):
        rig.photograph(first, SECONDS)
    with pytest.raises(AcquisitionError, match="image has shape"):
        rig.recall(first, SECONDS, earlier[0])


NOISY: dict[str, Any] = {"gain": 3000.0, "read": 0.01, "response": "linear", "black": 0.06}


@pytest.mark.parametrize("seed", range(4))
def test_the_noise_of_few_pixels_is_no_drift(clock: Clock, display: Display, seed: int) -> None:
    """48 pixels: means of identical frames differ by 0.2 % of full scale, 2 % of what is dim."""
    rig = LiveRig(Watcher(clock, scene(**NOISY, seed=seed)), display)
    for codes in [*patterns(4), *patterns(4), 0 * WHITE, single((1, 1)), 0 * WHITE, single((1, 1))] * 4:
        rig.photograph(codes, SECONDS)


def test_a_lamp_that_fades_is_found_through_the_noise_of_few_pixels(clock: Clock, display: Display) -> None:
    camera = Watcher(clock, scene(**NOISY))
    rig = LiveRig(camera, display)
    first, second = patterns(2)
    for codes in (first, second, first):
        rig.photograph(codes, SECONDS)
    camera.gain = lambda *_: 0.85
    with pytest.raises(AcquisitionError, match=r"^photograph 4: it is \d+\.\d% brighter or darker"):
        rig.photograph(second, SECONDS)


def test_a_camera_that_looks_elsewhere_is_named(clock: Clock, display: Display) -> None:
    camera = Watcher(clock, scene(gain=2000.0, sensitivity=0.01, ambient=20.0))
    with pytest.raises(AcquisitionError, match=r"does not see the display: white is .*% of full scale above"):
        LiveRig(camera, display).photograph(WHITE, SECONDS)


def test_lamps_that_flicker_are_named(clock: Clock, display: Display) -> None:
    camera = Watcher(clock, scene(**CLEAN))
    camera.gain = lambda moment, _: 1.0 + 0.5 * (round(moment / FRAME) % 2)
    with pytest.raises(AcquisitionError, match=r"differ by \d+\.\d% of full scale: something flickers"):
        LiveRig(camera, display).photograph(WHITE, SECONDS)


def test_an_unplugged_camera_is_named_with_its_photograph(clock: Clock, display: Display) -> None:
    camera = Watcher(clock, scene(**CLEAN))
    rig = LiveRig(camera, display)
    shots = Shots(rig)
    for codes in patterns(3):
        shots.photograph(codes, SECONDS)
    camera.unplugged = True
    with pytest.raises(AcquisitionError, match=r"^photograph 4: no frame comes"):
        shots.photograph(WHITE, SECONDS)
    assert shots.count == 3


def test_a_closed_display_is_named_with_the_photograph(clock: Clock, display: Display) -> None:
    rig = LiveRig(Watcher(clock, scene(**CLEAN)), display)
    rig.photograph(WHITE, SECONDS)
    display.close()
    with pytest.raises(AcquisitionError, match=r"^photograph 2: the display is closed"):
        rig.photograph(0 * WHITE, SECONDS)


def test_a_bright_set_up_is_surveyed_in_a_shorter_exposure(clock: Clock, display: Display) -> None:
    rig = LiveRig(Watcher(clock, scene(**CLEAN, sensitivity=60.0)), display)
    assert rig.calibrate().seconds == pytest.approx(1 / 60)


def test_a_set_up_that_is_always_full_is_refused(clock: Clock, display: Display) -> None:
    with pytest.raises(AcquisitionError, match="white is full in the shortest exposure"):
        LiveRig(Watcher(clock, scene(**CLEAN, sensitivity=1e5)), display).calibrate()


def test_saturated_and_dark_exposures_can_be_taken(clock: Clock, display: Display) -> None:
    rig, truth = LiveRig(Watcher(clock, scene(**CLEAN)), display), scene(**CLEAN)
    codes, longest = patterns(1)[0], 256 / 60
    for seconds in (longest, 1 / 60, longest):
        np.testing.assert_array_equal(rig.photograph(codes, seconds), truth.photograph(codes, seconds))
    black = 0 * WHITE
    np.testing.assert_array_equal(rig.photograph(black, 1 / 60), truth.photograph(black, 1 / 60))


def test_exposures_are_multiples_of_the_display_s_period(clock: Clock, display: Display) -> None:
    assert display.period is not None
    offered = (1 / 125, 1 / 60, 1 / 50, 1 / 30, 1 / 8, 1 / 4)
    camera = Watcher(clock, scene(**CLEAN), exposures=offered)
    assert LiveRig(camera, display, period=1 / 60).exposures == (1 / 60, 1 / 30, 1 / 4)
    assert LiveRig(camera, display, period=None).exposures == offered
    with pytest.raises(InputError, match="hold no multiple of the projector's period, 1 s; period=None"):
        LiveRig(camera, display, period=1.0)
    rig = LiveRig(camera, display, period=1 / 60)
    with pytest.raises(InputError, match=r"seconds is 0\.02; .* the nearest is 0\.0166"):
        rig.photograph(WHITE, 1 / 50)


def test_it_is_a_rig_and_tells_plain_json(clock: Clock, display: Display) -> None:
    with Shots(LiveRig(Watcher(clock, scene(**CLEAN)), display)) as shots:
        image = shots.photograph(WHITE, SECONDS)
        assert (image.dtype, image.shape, shots.levels) == (np.float32, GRID, 256)
        told = json.loads(json.dumps(shots.describe()))
    assert told["rig"]["display"]["driver"] == "dummy"
    assert told["rig"]["camera"] == {"kind": "Watcher"}
    assert told["rig"]["survey"]["latency"] > 0


class Still(Watcher):
    """A camera that begins to expose when it is asked; a frame takes half a second."""

    stream = False

    def frame(self) -> np.ndarray:
        if self.unplugged:
            raise AcquisitionError("no frame comes")
        image = self._picture(self.clock.now)
        self.clock.pass_to(self.clock.now + 0.5)
        return image


def test_a_camera_with_a_shutter_waits_for_the_display(clock: Clock, display: Display) -> None:
    rig, truth = LiveRig(Still(clock, scene(**CLEAN), latency=0.3), display), scene(**CLEAN)
    for codes in [*patterns(3), single((2, 2)), single((2, 3))]:
        np.testing.assert_array_equal(rig.photograph(codes, SECONDS), truth.photograph(codes, SECONDS))
    found = rig.survey
    assert found is not None
    assert 0.3 <= found.worst <= 1.0


def test_frames_that_opencv_reads_give_the_same_photographs(
    clock: Clock, display: Display, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    camera = Watcher(clock, scene(gain=5000.0), exposures=(SECONDS,))
    moments: list[float] = []
    take = camera.frame

    def recorded() -> np.ndarray:
        image = take()
        cv2.imwrite(f"{tmp_path}/frame_{len(moments):05d}.png", image)
        moments.append(clock.now)
        return image

    monkeypatch.setattr(camera, "frame", recorded)
    start, shown = clock.now, patterns(3)
    first = LiveRig(camera, display).photograph(shown[0], SECONDS)
    rig = LiveRig(OpenCVCamera(f"{tmp_path}/frame_%05d.png", channels=1, seconds=SECONDS), display)
    read = rig._stage.camera.frame
    clock.watchers.clear()
    clock.now, replayed = start, iter(moments)

    def paced() -> np.ndarray:
        clock.now = next(replayed, clock.now + FRAME)
        return read()

    monkeypatch.setattr(rig._stage.camera, "frame", paced)
    np.testing.assert_array_equal(rig.photograph(shown[0], SECONDS), first)
    with pytest.raises(AcquisitionError, match=r"^photograph 2: no frame comes from .*ended"):
        rig.photograph(shown[1], SECONDS)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"margin": -1}, InputError, "margin is -1"),
        ({"drift": 0.0}, InputError, r"drift is 0\.0"),
        ({"retakes": -1}, InputError, "retakes is -1"),
        ({"flashes": 1}, InputError, "flashes is 1"),
        ({"patience": 0}, InputError, "patience is 0"),
        ({"period": 0.0}, InputError, r"period is 0\.0"),
        ({"camera": object()}, InputTypeError, "camera is a object without channels, stream, expose, frame"),
        ({"display": object()}, InputTypeError, "display is a object without grid, period, show"),
    ],
)
def test_bad_arguments_are_named(
    clock: Clock, display: Display, change: dict[str, Any], error: type[Exception], message: str
) -> None:
    arguments: dict[str, Any] = {"camera": Watcher(clock, scene()), "display": display, **change}
    with pytest.raises(error, match=message):
        LiveRig(**arguments)


def test_bad_codes_are_refused_before_anything_is_shown(clock: Clock, display: Display) -> None:
    camera = Watcher(clock, scene(**CLEAN))
    rig = LiveRig(camera, display)
    for codes, seconds in [(WHITE[:2], SECONDS), (2 * WHITE, SECONDS), (WHITE, 0.0)]:
        with pytest.raises(InputError):
            rig.photograph(codes, seconds)
    assert camera.frames == 0
