# SPDX-License-Identifier: BSD-3-Clause
"""`LiveRig` on SDL's dummy display, before cameras that lag, tear, adapt, drift, freeze and go away."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import Display, LiveRig, Shots
from ltcl.acquisition.rigs import survey
from ltcl.errors import AcquisitionError, InputError, InputTypeError
from tests.acquisition.rigs.watching import CLEAN, FRAME, GRID, SECONDS, Clock, Watcher, scene

WHITE = np.ones(GRID, np.float32)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(survey, "time", clock)
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


LINEAR: dict[str, Any] = {**CLEAN, "response": "linear", "projector_response": "linear"}


def test_photographs_are_those_of_what_is_shown(clock: Clock, display: Display) -> None:
    """Also of a single pixel of one code, a change below what the camera's noise is taken for."""
    rig, truth = LiveRig(Watcher(clock, scene(**LINEAR)), display), scene(**LINEAR)
    shots = [(codes, seconds) for codes in patterns(6) for seconds in (SECONDS, 1 / 60)]
    shots += [(single((k % 3, k), 4 / 255), SECONDS) for k in range(8)]
    shots += [(patterns(1)[0], seconds) for seconds in (256 / 60, 1 / 60, 256 / 60)] + [(0 * WHITE, 1 / 60)]
    for codes, seconds in shots:
        np.testing.assert_array_equal(rig.photograph(codes, seconds), truth.photograph(codes, seconds))


@pytest.mark.parametrize("readout", [0.0, 0.03])
@pytest.mark.parametrize("jumps", [False, True])
def test_latency_that_grows_spoils_no_photograph(
    clock: Clock, display: Display, readout: float, jumps: bool
) -> None:
    """To tenfold, or in bursts of a random length."""
    camera, truth = Watcher(clock, scene(**LINEAR), latency=0.08, readout=readout), scene(**LINEAR)
    rig, rng, late = LiveRig(camera, display), np.random.default_rng(5), [0.0]
    rig.photograph(WHITE, SECONDS)

    def latency(_: float) -> float:
        late[0] = rng.uniform(0, 0.4) if rng.random() < 0.1 else max(0.0, late[0] - FRAME)
        return 0.05 + late[0]

    camera.latency = latency if jumps else lambda _: 0.8
    faint = [single((1, k), 2 / 255) for k in range(4)]
    for codes in [*patterns(12 if jumps else 3), *faint]:
        np.testing.assert_array_equal(rig.photograph(codes, SECONDS), truth.photograph(codes, SECONDS))


@pytest.mark.parametrize("options", [{}, {"gain": 3000.0, "read": 0.01, "response": "linear", "black": 0.06}])
def test_noise_is_neither_change_nor_drift(clock: Clock, display: Display, options: dict[str, Any]) -> None:
    """48 pixels: means of identical frames differ by 0.2 % of full scale, 2 % of what is dim."""
    rig = LiveRig(Watcher(clock, scene(**options)), display)
    truth = scene(**{**options, **CLEAN})
    for codes in [*patterns(4), 0 * WHITE, single((1, 1))] * 4:
        taken, expected = rig.photograph(codes, SECONDS), truth.photograph(codes, SECONDS)
        assert np.abs(taken.astype(float) - expected).mean() < 5
    assert rig.survey is not None
    assert 1 / 255 < rig.survey.tolerance < rig.survey.contrast / 4


@pytest.mark.parametrize("latency", [0.0, 0.05, 0.31])
def test_latency_is_measured(clock: Clock, display: Display, latency: float) -> None:
    camera = Watcher(clock, scene(**CLEAN), latency=latency, queue=1)
    rig = LiveRig(camera, display)
    rig.photograph(WHITE, SECONDS)
    found = rig.survey
    assert found is not None
    # A flash waits for the end of the shutter's run, and then for the next frame.
    assert latency <= found.latency <= found.worst <= latency + camera.readout + 2 * FRAME


def test_a_camera_that_freezes_is_named_stale(clock: Clock, display: Display) -> None:
    camera = Watcher(clock, scene(**CLEAN))
    rig = LiveRig(camera, display)
    first, second, third = patterns(3)
    rig.photograph(first, SECONDS)
    camera.frozen = rig.photograph(second, SECONDS)
    with pytest.raises(AcquisitionError, match=r"^photograph 3: the frame is stale"):
        rig.photograph(third, SECONDS)
    camera.frozen = None
    camera.gain = lambda moment, _: 1.0 - 0.3 * (round(moment / FRAME) % 2)
    with pytest.raises(AcquisitionError, match=r"^photograph 3: frames still change by \d.*% of full scale"):
        rig.photograph(first, SECONDS)
    camera.gain = lambda *_: 1.0
    np.testing.assert_array_equal(rig.photograph(third, SECONDS), scene(**CLEAN).photograph(third, SECONDS))


def fast(_: float, codes: np.ndarray) -> float:
    return 0.5 / max(float(codes.mean()), 0.2)


def slow() -> Any:
    state = [1.0]

    def gain(_: float, codes: np.ndarray) -> float:
        state[0] *= (0.3 / max(float(codes.mean()), 0.1) / state[0]) ** 0.1
        return state[0]

    return gain


@pytest.mark.parametrize(
    ("options", "gain", "message"),
    [
        (CLEAN, fast, r"the camera adapts: .* \d+\.\d% of full scale"),
        (CLEAN, slow(), r"the camera (drifts|adapts).*\d\.\d%"),
        (CLEAN, lambda moment, _: 1.0 + 0.5 * (round(moment / FRAME) % 2), r"\d+\.\d% .* flickers"),
        ({"sensitivity": 0.01, "ambient": 20.0}, None, "does not see the display: white is .*%"),
        ({"sensitivity": 1e5}, None, "white is saturated at"),
    ],
)
def test_set_ups_that_cannot_be_measured_are_refused(
    clock: Clock, display: Display, options: dict[str, Any], gain: Any, message: str
) -> None:
    camera = Watcher(clock, scene(**options))
    camera.gain = gain or camera.gain
    with pytest.raises(AcquisitionError, match=f"photograph 1: .*{message}"):
        LiveRig(camera, display, patience=0.5).photograph(WHITE, SECONDS)


@pytest.mark.parametrize("resumed", [False, True])
def test_a_lamp_that_fades_is_found_at_the_next_identical_shot(
    clock: Clock, display: Display, resumed: bool
) -> None:
    camera = Watcher(clock, scene(**CLEAN, response="linear", black=0.0))
    rig = LiveRig(camera, display)
    first, second = patterns(2)
    earlier = rig.photograph(first, SECONDS)
    if resumed:
        rig = LiveRig(camera, display)
        rig.recall(first, SECONDS, earlier)
        with pytest.raises(AcquisitionError, match="image has shape"):
            rig.recall(first, SECONDS, earlier[0])
    rig.photograph(second, SECONDS)
    np.testing.assert_array_equal(rig.photograph(first, SECONDS), earlier)
    camera.gain = lambda *_: 0.9
    with pytest.raises(AcquisitionError, match=r"photograph 4: .*(9|10)\.\d% .*drift=0\.02"):
        rig.photograph(first, SECONDS)


def test_what_goes_away_is_named_with_its_photograph(clock: Clock, display: Display) -> None:
    camera = Watcher(clock, scene(**CLEAN))
    shots = Shots(LiveRig(camera, display))
    for codes in patterns(3):
        shots.photograph(codes, SECONDS)
    camera.unplugged = True
    with pytest.raises(AcquisitionError, match=r"^photograph 4: no frame comes"):
        shots.photograph(WHITE, SECONDS)
    assert shots.count == 3
    display.close()
    with pytest.raises(AcquisitionError, match=r"^photograph 4: the display is closed"):
        shots.photograph(0 * WHITE, SECONDS)


def ripple(seconds: float, period: float) -> float:
    """Relative spread of the light of a colour that is shown in the first third of each period."""
    begins = np.linspace(0, 1, 3001)

    def since_zero(moments: np.ndarray) -> np.ndarray:
        return np.floor(moments) / 3 + np.minimum(moments % 1, 1 / 3)

    light = since_zero(begins + seconds / period) - since_zero(begins)
    return np.ptp(light) / np.mean(light)


@pytest.mark.parametrize("period", [1 / 24, 1 / 60, 1 / 144])
def test_light_of_offered_exposures_hardly_depends_on_when_they_begin(
    clock: Clock, display: Display, period: float
) -> None:
    every = tuple(np.geomspace(1 / 4000, 8, 200))
    offered = LiveRig(Watcher(clock, scene(), exposures=every), display, period=period).exposures
    assert offered
    for seconds in every:
        if seconds in offered:
            assert ripple(seconds, period) < 3 * 0.02 + 0.001
        else:
            assert ripple(seconds, period) > 2 * 0.02 - 0.001


def test_exposures_are_multiples_of_the_period(clock: Clock, display: Display) -> None:
    camera: Any = Watcher(clock, scene(**CLEAN))
    multiples = np.array(LiveRig(camera, display, period=1 / 60).exposures) * 60
    np.testing.assert_allclose(multiples, np.rint(multiples), rtol=1e-12)
    assert (round(multiples[0]), multiples[-1] <= 1800) == (1, True)
    assert np.max(multiples[1:] / multiples[:-1]) <= 2
    assert LiveRig(camera, display, period=None).exposures is None
    camera.limits = (0.02, 0.1)
    rig = LiveRig(camera, display, period=1 / 60)
    assert rig.exposures == pytest.approx((2 / 60, 3 / 60, 4 / 60, 6 / 60))
    for codes, seconds, name in [(WHITE, 1 / 50, "seconds"), (WHITE[:2], 2 / 60, "codes")]:
        with pytest.raises(InputError, match=name):
            rig.photograph(codes, seconds)
    assert camera.frames == 0  # refused before anything is shown
    camera.exposures = (0.001, 0.02)
    with pytest.raises(InputError, match=r"period is 0\.01667 s; .* 0\.001 to 0\.02 s"):
        LiveRig(camera, display, period=1 / 60)


def test_it_is_a_rig_and_describes_itself_in_plain_json(clock: Clock, display: Display) -> None:
    with Shots(LiveRig(Watcher(clock, scene(**CLEAN)), display)) as shots:
        image = shots.photograph(WHITE, SECONDS)
        assert (image.dtype, image.shape, shots.levels) == (np.float32, GRID, 256)
        facts = json.loads(json.dumps(shots.describe()))
    assert facts["rig"]["display"]["driver"] == "dummy"
    assert facts["rig"]["camera"] == {"kind": "Watcher"}
    assert facts["rig"]["survey"]["latency"] > 0


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
