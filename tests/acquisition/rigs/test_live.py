# SPDX-License-Identifier: BSD-3-Clause
"""`LiveRig` on SDL's dummy display, with cameras that lag, tear, adapt, drift or freeze."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from ltcl.acquisition import Display, LiveRig, Shots, VirtualRig
from ltcl.acquisition.rigs import link
from ltcl.errors import AcquisitionError, InputError, InputTypeError

random = np.random.default_rng()
GRID = (6, 8)
SECONDS = 1 / 15
FRAME = 1 / 30  # seconds between two frames of the camera
WHITE = np.ones(GRID, np.float32)
CLEAN: dict[str, Any] = {"gain": None, "read": 0.0}
LINEAR: dict[str, Any] = {**CLEAN, "response": "linear", "projector_response": "linear"}


def scene(**options: Any) -> VirtualRig:
    """White gives about 0.6 of full scale, before the response, in SECONDS."""
    return VirtualRig(0.5 * np.eye(48) + 0.2 / 48, GRID, **{"sensitivity": 13.0, **options})


class Screen(Display):
    """A display that remembers the codes it showed, and a clock that only waiting moves."""

    now = 100.0
    history: list[tuple[float, np.ndarray]]

    def show(self, codes: Any) -> None:
        super().show(codes)
        self.history.append((self.now, np.rint(codes * 255).astype(np.float32) / np.float32(255)))

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds + 1e-9  # no sleep ends early, as rounding could let it


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> Iterator[Screen]:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    with Screen(GRID) as screen:
        screen.history = [(-math.inf, 0 * WHITE)]
        monkeypatch.setattr(link, "time", screen)
        yield screen


class Watcher:
    """A streaming camera with a rolling shutter and a queue of three frames.

    Row r of the frame that arrives at time t shows what was on the screen at
    t - latency(t) - readout (1 - r / H), but nothing older than the frame before: when the latency
    grows, frames hang.
    """

    channels = 1
    stream = True
    readout = 0.02
    queue = 3
    exposures: tuple[float, ...] | None = None

    def __init__(
        self, screen: Screen, rig: VirtualRig, latency: float = 0.08, **options: Any
    ) -> None:
        self.screen = screen
        self.rig = rig
        self.latency: Callable[[float], float] = lambda _: latency
        self.gain: Callable[[float, np.ndarray], float] = lambda moment, codes: 1.0
        self.frames = self._index = 0
        self._seen = -math.inf
        vars(self).update(options)

    def expose(self, seconds: float) -> None:
        self.seconds = seconds

    def frame(self) -> np.ndarray:
        self._index = max(self._index, math.floor(self.screen.now / FRAME) - self.queue) + 1
        self.screen.now = max(self.screen.now, self._index * FRAME)
        self.frames += 1
        return self.picture(self._index * FRAME)

    def picture(self, arrival: float) -> np.ndarray:
        self._seen = max(self._seen, arrival - self.latency(arrival))
        moments = self._seen - self.readout * (1 - np.arange(GRID[0]) / GRID[0])
        since, shown = zip(*self.screen.history, strict=True)
        places = np.searchsorted(since, moments, side="right") - 1
        light = {k: self.seconds * self.gain(arrival, shown[k]) for k in sorted({*places})}
        pictures = {k: self.rig.photograph(shown[k], seconds) for k, seconds in light.items()}
        return np.stack([pictures[k][row] for row, k in enumerate(places)])


class Still(Watcher):
    """A camera that begins to expose when it is asked; a frame takes half a second."""

    stream = False

    def frame(self) -> np.ndarray:
        image = self.picture(self.screen.now)
        self.screen.now += 0.5
        return image


@pytest.fixture
def camera(screen: Screen) -> Any:
    return Watcher(screen, scene(**CLEAN))


def patterns(count: int) -> np.ndarray:
    """Random patterns of codes that 8 bits hold."""
    return (random.integers(0, 256, (count, *GRID)) / 255).astype(np.float32)


def single(row: int, column: int, code: float = 1.0) -> np.ndarray:
    return np.float32(code) * (np.indices(GRID) == np.reshape((row, column), (2, 1, 1))).all(axis=0)


@pytest.mark.parametrize(("kind", "latency"), [(Watcher, 0.08), (Still, 0.3)])
def test_photographs_are_those_of_what_is_shown(
    screen: Screen, kind: type[Watcher], latency: float
) -> None:
    """Also of a single pixel of one code, a change below what the camera's noise is taken for."""
    rig = LiveRig(kind(screen, scene(**LINEAR), latency=latency), screen)
    truth = scene(**LINEAR)
    shots = list(itertools.product(patterns(6), (SECONDS, 1 / 60)))
    shots += [(single(k % 3, k, 4 / 255), SECONDS) for k in range(8)]
    shots += [(patterns(1)[0], seconds) for seconds in (256 / 60, 1 / 60, 256 / 60)]
    shots.append((0 * WHITE, 1 / 60))
    for codes, seconds in shots:
        np.testing.assert_array_equal(
            rig.photograph(codes, seconds), truth.photograph(codes, seconds)
        )


class Bursts:
    """A latency that jumps now and then, and falls by a frame each frame."""

    excess = 0.0

    def latency(self, _: float) -> float:
        self.excess = max(0.0, self.excess - FRAME)
        if random.random() < 0.1:
            self.excess = random.uniform(0, 0.4)
        return 0.05 + self.excess


@pytest.mark.parametrize("readout", [0.0, 0.03])
@pytest.mark.parametrize("later", [0.25, 0.4, 0.8, None])
def test_latency_that_grows_spoils_no_photograph(
    screen: Screen, readout: float, later: float | None
) -> None:
    """Latency grows to tenfold, falls again, or comes in bursts: older pictures may come late."""
    camera = Watcher(screen, scene(**LINEAR), latency=0.08, readout=readout)
    truth = scene(**LINEAR)
    rig = LiveRig(camera, screen)
    rig.photograph(WHITE, SECONDS)
    bursts = Bursts()
    points = [single(1, k, 2 / 255) for k in range(4)]
    for number, codes in enumerate([*patterns(3), 0 * WHITE, WHITE, *points, *patterns(3)]):
        if later is None:
            camera.latency = bursts.latency
        elif number == 5:
            camera.latency = lambda _: 0.05
        else:
            camera.latency = lambda _: later
        np.testing.assert_array_equal(
            rig.photograph(codes, SECONDS), truth.photograph(codes, SECONDS)
        )


def test_noise_is_no_change(screen: Screen) -> None:
    """48 pixels: means of identical frames differ by 0.2 % of full scale, 2 % of what is dim."""
    options = {"gain": 3000.0, "read": 0.01, "response": "linear", "black": 0.06}
    rig = LiveRig(Watcher(screen, scene(**options)), screen, drift=0.06)
    truth = scene(**(options | CLEAN))
    for codes in [*patterns(4), 0 * WHITE, single(1, 1)] * 4:
        image = rig.photograph(codes, SECONDS)
        expected = truth.photograph(codes, SECONDS)
        assert np.abs(image.astype(float) - expected).mean() < 5
    assert rig.survey is not None
    assert 1 / 255 < rig.survey.tolerance < rig.survey.contrast / 4


@pytest.mark.parametrize("latency", [0.0, 0.05, 0.31])
def test_latency_is_measured(screen: Screen, latency: float) -> None:
    """A flash waits for the end of the shutter's run, and then for the next frame."""
    rig = LiveRig(Watcher(screen, scene(**CLEAN), latency, queue=1), screen)
    rig.photograph(WHITE, SECONDS)
    assert rig.survey is not None
    assert latency <= rig.survey.latency <= latency + Watcher.readout + 2 * FRAME


def test_a_camera_that_freezes_is_named_stale(camera: Any) -> None:
    rig = LiveRig(camera, camera.screen)
    first, second = patterns(2)
    rig.photograph(first, SECONDS)
    camera.latency = lambda _: math.inf
    with pytest.raises(AcquisitionError, match=r"^photograph 2: the frame is stale"):
        rig.photograph(second, SECONDS)
    camera.latency = lambda _: 0.08
    camera.gain = lambda moment, _: 1.0 - 0.3 * (round(moment / FRAME) % 2)
    with pytest.raises(AcquisitionError, match=r"^photograph 2: .*\d.*%"):
        rig.photograph(first, SECONDS)
    camera.gain = lambda *_: 1.0
    np.testing.assert_array_equal(
        rig.photograph(second, SECONDS), scene(**CLEAN).photograph(second, SECONDS)
    )


def automatic(speed: float) -> Any:
    """The gain of a camera that adapts to the brightness."""
    current = 1.0

    def gain(_: float, codes: np.ndarray) -> float:
        nonlocal current
        current *= (0.5 / max(float(codes.mean()), 0.2) / current) ** speed
        return current

    return gain


@pytest.mark.parametrize(
    ("options", "gain", "message"),
    [
        (CLEAN, automatic(1.0), r"the camera adapts: .* \d+\.\d% of full scale"),
        (CLEAN, automatic(0.01), r"the camera drifts by \d\.\d%"),
        (CLEAN, lambda moment, _: 1.0 + 0.5 * (round(moment / FRAME) % 2), r"\d+\.\d% .* flickers"),
        ({"sensitivity": 0.01, "ambient": 20.0}, None, "display: white is .*%"),
        ({"sensitivity": 1e5}, None, "white is saturated at"),
    ],
)
def test_set_ups_that_cannot_be_measured_are_refused(
    screen: Screen, options: dict[str, Any], gain: Any, message: str
) -> None:
    camera = Watcher(screen, scene(**options))
    if gain is not None:
        camera.gain = gain
    with pytest.raises(AcquisitionError, match=f"photograph 1: .*{message}"):
        LiveRig(camera, screen, patience=0.5).photograph(WHITE, SECONDS)


@pytest.mark.parametrize("resumed", [False, True])
def test_a_lamp_that_fades_is_found_at_the_next_identical_shot(camera: Any, resumed: bool) -> None:
    rig = LiveRig(camera, camera.screen)
    (codes,) = patterns(1)
    earlier = rig.photograph(codes, SECONDS)
    if resumed:
        rig = LiveRig(camera, camera.screen)
        rig.recall(codes, SECONDS, earlier)
    np.testing.assert_array_equal(rig.photograph(codes, SECONDS), earlier)
    camera.gain = lambda *_: 0.9
    with pytest.raises(AcquisitionError, match=r"photograph 3: .*\d\.\d% .*drift=0\.02"):
        rig.photograph(codes, SECONDS)


def test_it_is_a_rig_and_names_what_goes_away_with_its_photograph(camera: Any) -> None:
    with Shots(LiveRig(camera, camera.screen)) as shots:
        shots.photograph(WHITE, SECONDS)
        facts = json.loads(json.dumps(shots.describe()))["rig"]
        assert (facts["camera"], facts["display"]["kind"]) == ({"kind": "Watcher"}, "display")
        assert facts["survey"]["latency"] > 0
        camera.screen.close()
        with pytest.raises(AcquisitionError, match=r"^photograph 2: the display is closed"):
            shots.photograph(0 * WHITE, SECONDS)


def colour_ripple(periods: float) -> float:
    """Relative range of the light of a colour, lit a third of each period, over the begin."""

    def light_until(t: np.ndarray) -> np.ndarray:
        return np.floor(t) / 3 + np.minimum(t % 1, 1 / 3)

    begin = np.linspace(0, 1, 3001)
    light = light_until(begin + periods) - light_until(begin)
    return np.ptp(light) / np.mean(light)


def test_exposures_are_multiples_of_the_period(screen: Screen, camera: Any) -> None:
    """A camera's own exposures are offered if the light of a colour varies by 6 % at most."""
    multiples = np.array(LiveRig(camera, screen, period=1 / 60).exposures) * 60
    np.testing.assert_allclose(multiples, np.rint(multiples), rtol=1e-12)
    assert np.max(multiples[1:] / multiples[:-1]) <= 2
    assert LiveRig(camera, screen, period=None).exposures is None
    camera.limits = (0.02, 0.1)
    rig = LiveRig(camera, screen, period=1 / 60)
    assert rig.exposures == pytest.approx((2 / 60, 3 / 60, 4 / 60, 6 / 60))
    with pytest.raises(InputError, match=r"seconds is 0\.02"):
        rig.photograph(WHITE, 1 / 50)
    assert camera.frames == 0  # refused before anything is shown
    camera.exposures = tuple(np.geomspace(1 / 4000, 8, 200))
    offered = LiveRig(camera, screen, period=1 / 60).exposures
    assert offered is not None
    for seconds in camera.exposures:
        ripple = colour_ripple(60 * seconds)
        assert ripple < 0.061 if seconds in offered else ripple > 0.039
    camera.exposures = (0.001, 0.02)
    with pytest.raises(InputError, match=r"period is 0\.01667 s"):
        LiveRig(camera, screen, period=1 / 60)


@pytest.mark.parametrize("name", ["drift", "patience", "period", "camera", "display"])
def test_bad_arguments_are_named(camera: Any, name: str) -> None:
    value: Any = object() if name in ("camera", "display") else 0.0
    with pytest.raises((InputError, InputTypeError), match=f"{name} is (0|a object without)"):
        LiveRig(**{"camera": camera, "display": camera.screen, name: value})
