# SPDX-License-Identifier: BSD-3-Clause
"""Sketches: all of T from some tens of patterns."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import (
    Calibration,
    Report,
    VirtualRig,
    acquire,
    calibrate,
    camera_map,
    finalize,
)
from ltcl.acquisition.calibrate import expected_photographs
from ltcl.acquisition.estimation import refinement, windows
from ltcl.acquisition.estimation.contradiction import find_wrong_pictures
from ltcl.acquisition.geometry import GrayCode
from ltcl.acquisition.scanning import sketch
from ltcl.acquisition.scanning.plan import choose, plans
from ltcl.acquisition.settings import STRATEGIES
from ltcl.errors import AcquisitionError, InputError, MemoryLimitError, ScanRefused
from ltcl.store import BlockStore

from ..stopping import Unplugged
from .helpers import corner, dense, relative_error

GRIDS = [(1, 1), (1, 7), (5, 3), (8, 16), (64, 64), (256, 512)]


@pytest.mark.parametrize("grid", GRIDS)
def test_patterns_are_few_and_all_different(grid: tuple[int, int]) -> None:
    shown = sketch.patterns(grid)
    octaves = (max(grid) - 1).bit_length()
    assert len(shown) <= 10 * octaves
    kinds = set()
    for pattern in shown:
        assert pattern.shape == grid
        assert set(np.unique(pattern)) == {0.0, 1.0}
        first = pattern[0, 0]
        kinds.add((pattern == first).tobytes())
    # Not even the complement of another.
    assert len(kinds) == len(shown)


@pytest.mark.parametrize("grid", GRIDS[1:5])
def test_patterns_tell_all_pixels_apart(grid: tuple[int, int]) -> None:
    codes = np.stack(sketch.patterns(grid)).reshape(-1, math.prod(grid))
    assert len(np.unique(codes, axis=1).T) == math.prod(grid)


@pytest.mark.parametrize("grid", GRIDS[3:])
def test_judges_are_no_patterns(grid: tuple[int, int]) -> None:
    shown = {pattern.tobytes() for pattern in sketch.patterns(grid)}
    pictures = sketch.judges(grid)
    for picture in pictures:
        assert 0.0 < picture.mean() < 1.0
        assert picture.tobytes() not in shown
    assert len({picture.tobytes() for picture in pictures}) == len(pictures)


@pytest.fixture(scope="module")
def scanned(tmp_path_factory: pytest.TempPathFactory) -> tuple[Unplugged, ltcl.Transport, Report]:
    """A corner of 16 x 32 pixels, by a camera of 12 bits with a curve."""
    path = tmp_path_factory.mktemp("sketch") / "T.zarr"
    rig = Unplugged(corner(16), (16, 32), response="film")
    T = acquire(rig, geometry="aligned", strategy="sketch", store=path)
    return rig, T, Report.of(path)


def test_the_error_that_is_stated_holds(scanned: Any) -> None:
    _, T, report = scanned
    error = relative_error(dense(T), corner(16), (16, 32))
    assert error < report.judged_bound
    assert report.judged_error < report.judged_bound < 0.04
    assert error < 0.015


def test_photographs_are_as_planned_and_few(scanned: Any) -> None:
    rig, _, report = scanned
    assert report.patterns == report.photographs == sketch.count_patterns((16, 32))
    plan = plans((16, 32), (0.5, 8.0), aligned=True)["sketch"]
    assert plan.patterns == report.patterns
    assert plan.photographs == pytest.approx(rig.count, abs=3)
    # A camera of 512 pixels needs four ramps for its curve, where others need one.
    assert rig.count < 110


def test_it_is_compensated_with(scanned: Any) -> None:
    """The pattern of a sketch makes the true scene look as desired."""
    _, T, report = scanned
    assert T.is_compressed
    desired = np.full(T.grid, 0.25, np.float32)
    result = ltcl.compensate(T, desired)
    shown = corner(16) @ np.asarray(result.pattern, np.float64).ravel()
    # In the camera's unit of light.
    shown *= 0.25 / shown.mean()
    assert np.sqrt(np.mean((shown - 0.25) ** 2)) / 0.25 < 0.015
    assert "not fitted" in str(report)


@pytest.mark.parametrize("is_refined", [False, True])
def test_colours_are_told_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_refined: bool
) -> None:
    if is_refined:
        monkeypatch.setattr(windows, "MAX_WHOLE_PIXELS", 64)
        monkeypatch.setattr(refinement, "MAX_COARSE_NODES", 60)
    scene = [corner(8), corner(8, 0.5), corner(8, 0.4)]
    mixing = np.array([[0.9, 0.1, 0.0], [0.05, 0.9, 0.05], [0.0, 0.1, 0.9]])
    truth = ltcl.Transport(scene, (8, 16), mixing=mixing)
    rig = VirtualRig(truth, (8, 16), bits=12, ambient=0.01)
    T = acquire(rig, geometry="aligned", strategy="sketch", store=tmp_path / "T.zarr")
    picture = np.random.default_rng(2).random((8, 16, 3))
    measured = T @ picture
    expected = truth @ picture
    # Each channel has its own unit of light.
    scale = (measured * expected).sum(axis=(0, 1)) / (measured**2).sum(axis=(0, 1))
    error = np.linalg.norm(scale * measured - expected) / np.linalg.norm(expected)
    assert error < 0.03
    # In units of the photographs, whose ambient light is that of `Setup`.
    white = np.asarray(Calibration.of(tmp_path / "T.zarr").white.value)
    shown = np.asarray(T @ np.ones((8, 16, 3)))
    np.testing.assert_allclose(shown.mean(axis=(0, 1)), white.mean(axis=(0, 1)), rtol=0.01)


def test_a_person_takes_at_most_70_photographs() -> None:
    """An oblique camera of three pixels to a side, whose geometry Gray code shows."""
    view = camera_map(lambda u, v: (u / 3, v / 3), (24, 48), (8, 16))
    rig = Unplugged(corner(), (8, 16), camera_grid=(24, 48), camera_map=view)
    rig.keeps_photographs = True
    T = acquire(rig, strategy="sketch")
    assert rig.count <= 70
    planned = expected_photographs((8, 16), by_hand=True, sparing=True)
    plan = plans((8, 16), (0.5, 8.0), by_hand=True)["sketch"]
    assert plan.calibration == planned
    assert plan.photographs == pytest.approx(rig.count, abs=3)
    assert relative_error(dense(T), corner(), (8, 16)) < 0.025


def oblique_rig(left: int = 1 << 30, **options: Any) -> Unplugged:
    """A camera of three pixels to a side, which Gray code shows."""
    view = camera_map(lambda u, v: (u / 3, v / 3), (24, 48), (8, 16))
    return Unplugged(corner(), (8, 16), camera_grid=(24, 48), camera_map=view, left=left, **options)


def test_photographs_of_gray_code_are_pictures_of_the_sketch(tmp_path: Path) -> None:
    """Its stripes are the bits of both axes; each is photographed once."""
    rig = oblique_rig()
    shown: list[bytes] = []
    rig.fault = lambda codes, image: shown.append(np.asarray(codes).tobytes()) or image
    path = tmp_path / "T.zarr"
    T = acquire(rig, strategy="sketch", store=path)
    for stripe in sketch.stripes((8, 16)):
        assert shown.count(stripe.tobytes()) == 1
    report = Report.of(path)
    assert report.patterns == sketch.count_patterns((8, 16))
    assert report.photographs == report.patterns - 7
    planned = plans((8, 16), (0.5, 8.0))["sketch"]
    assert planned.photographs == pytest.approx(rig.count, abs=3)
    assert relative_error(dense(T), corner(), (8, 16)) < 0.025


def test_stripes_are_the_bits_of_gray_code() -> None:
    for grid in ((1, 7), (5, 3), (8, 16), (64, 64)):
        code = GrayCode(grid)
        bits = [code.patterns()[number] for number in code.layout.first]
        np.testing.assert_array_equal(list(sketch.stripes(grid)), bits)
        known = {pattern.tobytes() for pattern in sketch.patterns(grid)}
        assert all(bit.tobytes() in known for bit in bits)


@pytest.mark.slow
def test_a_sketch_with_stripes_is_resumed_to_the_bit(tmp_path: Path) -> None:
    whole = oblique_rig()
    T = acquire(whole, strategy="sketch")
    path = tmp_path / "T.zarr"
    with pytest.raises(AcquisitionError, match="unplugged"):
        acquire(oblique_rig(left=whole.count - 12), strategy="sketch", store=path)
    resumed = acquire(oblique_rig(), strategy="sketch", store=path)
    np.testing.assert_array_equal(dense(resumed), dense(T))


@pytest.mark.slow
def test_a_sketch_that_was_begun_without_stripes_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As earlier versions began it: all patterns are photographed in the scan."""
    path = tmp_path / "T.zarr"
    with monkeypatch.context() as earlier:
        earlier.setattr(calibrate, "_stripes_of_scan", lambda *_: [])
        whole = oblique_rig()
        acquire(whole, strategy="sketch")
        with pytest.raises(AcquisitionError, match="unplugged"):
            acquire(oblique_rig(left=whole.count - 30), strategy="sketch", store=path)
    attributes = BlockStore.open(path).attributes
    assert not attributes["stripes"]
    rest = oblique_rig()
    resumed = acquire(rest, strategy="sketch", store=path)
    assert rest.count <= 30 + ROUND
    # The noise is another one, of photographs of stripes that were taken twice.
    assert relative_error(dense(resumed), corner(), (8, 16)) < 0.025
    assert Report.of(path).photographs == sketch.count_patterns((8, 16))


@pytest.mark.slow
def test_a_coarse_stripe_that_shows_another_pattern_is_refused() -> None:
    """It has no inverse, by an automatic rig; the pattern of blocks contradicts its map."""
    grid = (8, 32)
    view = camera_map(lambda u, v: (u / 3, v / 3), (24, 96), grid)
    first, second = sketch.stripes(grid)[:2]
    rig = Unplugged(corner_of(grid), grid, camera_grid=(24, 96), camera_map=view)
    real = rig.photograph

    def late(codes: Any, seconds: float) -> np.ndarray:
        return real(first if np.array_equal(codes, second) else codes, seconds)

    rig.photograph = late
    with pytest.raises(AcquisitionError, match="of coarse stripes without their inverses"):
        acquire(rig, strategy="sketch")


def corner_of(grid: tuple[int, int]) -> np.ndarray:
    """Direct light, and a little of all pixels."""
    pixels = math.prod(grid)
    return 0.5 * np.eye(pixels) + 0.1 / pixels


def test_bounces_of_a_clean_sketch_carry_no_warning(
    scanned: tuple[Unplugged, ltcl.Transport, Report], caplog: pytest.LogCaptureFixture
) -> None:
    """Single entries are noisy, which their noise says; the scene is reciprocal."""
    _, T, _ = scanned
    separation = ltcl.separate(T, T @ np.ones(T.grid), bounces=2)
    assert separation.warning.startswith("bounces hold as far as")
    assert not caplog.records


@pytest.mark.slow
def test_a_patch_where_the_projector_lights_nothing_judges_nothing(tmp_path: Path) -> None:
    """A patch that judges lies on the left half, which is dark: it has no relative error."""
    truth = corner(8).reshape(8, 16, 8, 16).copy()
    truth[:, :8] = 0.0
    truth[:, :, :, :8] = 0.0
    path = tmp_path / "T.zarr"
    T = acquire(
        Unplugged(truth.reshape(128, 128), (8, 16)),
        geometry="aligned",
        strategy="sketch",
        store=path,
    )
    report = Report.of(path)
    assert T.masked.sum() == 64
    error = relative_error(dense(T), truth.reshape(128, 128), (8, 16))
    assert 0.5 * error < report.judged_error < 2.0 * error


@pytest.mark.slow
def test_where_light_is_not_smooth_the_error_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A mirror sends light of each pixel to the other side of the picture."""
    n = 16
    mirror = np.eye(n * n)[::-1]
    truth = 0.5 * np.eye(n * n) + 0.2 * mirror
    rig = Unplugged(truth, (n, n))
    path = tmp_path / "T.zarr"
    T = acquire(rig, geometry="aligned", strategy="sketch", store=path)
    report = Report.of(path)
    assert report.judged_error > 0.05
    advice = r"strategy 'adaptive' finds where, with up to \d+ photographs, [\d.e+-]+ minutes of"
    assert re.search(advice, caplog.text)
    assert relative_error(dense(T), truth, (n, n)) < 2.0 * report.judged_bound


def test_what_memory_does_not_hold_is_refused_before_the_first_photograph() -> None:
    rig = Unplugged(np.eye(4), (2, 2), left=0)
    rig.projector_grid = (1 << 14, 1 << 14)
    with pytest.raises(MemoryLimitError, match="16384 x 16384 pixels"):
        acquire(rig, strategy="sketch", geometry="aligned")


@pytest.mark.parametrize(
    ("grid", "strategy"), [((32, 64), "adaptive"), ((64, 64), "sketch"), ((1080, 1920), "adaptive")]
)
def test_auto_sketches_many_pixels(grid: tuple[int, int], strategy: str) -> None:
    chosen, reason = choose(plans(grid, (0.5, 8.0)))
    assert chosen == strategy
    assert strategy == "adaptive" or "more than 2048" in reason


def with_lamp(image: np.ndarray) -> np.ndarray:
    """A photograph of 12 bits in which another light of 5 % of full scale is on, to the right."""
    light = np.linspace(0.0, 2 * 0.05 * 4095, image.shape[1])
    return np.minimum(image + light, 4095.0).astype(image.dtype)


def dimmer(image: np.ndarray) -> np.ndarray:
    """A photograph of a lamp, or an exposure, that is a quarter too weak."""
    return (0.75 * image).astype(image.dtype)


SMALL = (8, 16)
# Numbers of patterns, from 1 on; the last ones judge.
FINE_PATTERN = sketch.count_patterns(SMALL) - sketch.JUDGES - 2
JUDGE = sketch.count_patterns(SMALL) - 3


def scan_with_fault(path: Path, fault: Any, wrong: list[int]) -> tuple[np.ndarray, Report]:
    """T and the report of a scan in which the photographs of these patterns have a fault."""
    shown = [*sketch.patterns(SMALL), *sketch.judges(SMALL)]
    faulty = {shown[number - 1].tobytes() for number in wrong}
    rig = Unplugged(corner(), SMALL)
    rig.fault = lambda codes, image: fault(image) if codes.tobytes() in faulty else image
    T = acquire(rig, geometry="aligned", strategy="sketch", store=path)
    return dense(T), Report.of(path)


@pytest.mark.slow
@pytest.mark.parametrize("fault", [with_lamp, dimmer])
@pytest.mark.parametrize("number", [FINE_PATTERN, JUDGE])
def test_one_picture_that_all_others_contradict_is_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, fault: Any, number: int
) -> None:
    """One exposure alone shows no deviation; all pictures together do."""
    T, report = scan_with_fault(tmp_path / "T.zarr", fault, [number])
    assert report.wrong_patterns == [number]
    assert f"pattern {number} (photograph" in caplog.text
    assert f"pattern {number} contradicts" in str(report)
    assert relative_error(T, corner(), SMALL) < min(report.judged_bound, 0.03)


def test_several_pictures_that_all_others_contradict_are_refused(tmp_path: Path) -> None:
    wrong = [FINE_PATTERN - 3, FINE_PATTERN]
    with pytest.raises(ScanRefused, match="contradict all others") as error:
        scan_with_fault(tmp_path / "T.zarr", with_lamp, wrong)
    for number in wrong:
        assert f"pattern {number} (photograph" in str(error.value)


def test_a_light_is_weighed_against_the_error_of_the_judges_that_are_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = []

    def find(pairs: Any, learn: Any, error_without: Any) -> Any:
        wrong, estimator = find_wrong_pictures(pairs, learn, error_without)
        last = len(pairs) - 1
        errors.extend([error_without([], estimator), error_without([last], estimator)])
        return wrong, estimator

    monkeypatch.setattr(sketch, "find_wrong_pictures", find)
    path = tmp_path / "T.zarr"
    acquire(Unplugged(corner(), SMALL), geometry="aligned", strategy="sketch", store=path)
    of_all, without_last = errors
    report = Report.of(path)
    assert of_all == pytest.approx(report.judged_error)
    assert 0.0 < without_last != of_all


ROUND = 17  # photographs: 16 patterns, and the one that all batches end with


@pytest.mark.parametrize("grid", [(4, 4), (5, 9), (16, 32)])
def test_patterns_of_rounds_are_new(grid: tuple[int, int]) -> None:
    seen = {pattern.tobytes() for pattern in (*sketch.patterns(grid), *sketch.judges(grid))}
    for number in range(2):
        shown = sketch.more_patterns(grid, number)
        assert len(shown) == 16
        for pattern in shown:
            assert set(np.unique(pattern)) == {0.0, 1.0}
            assert 0.2 < pattern.mean() < 0.8
        fresh = {pattern.tobytes() for pattern in shown} - seen
        assert len(fresh) > 12
        seen |= fresh
        for again, pattern in zip(sketch.more_patterns(grid, number), shown, strict=True):
            np.testing.assert_array_equal(again, pattern)


@pytest.fixture(scope="module")
def first_count() -> int:
    """Photographs of a sketch without rounds."""
    rig = Unplugged(corner(), SMALL)
    acquire(rig, geometry="aligned", strategy="sketch")
    return rig.count


@pytest.mark.rare
def test_rounds_make_the_error_smaller_within_the_photographs_allowed(
    tmp_path: Path, first_count: int
) -> None:
    errors = []
    for rounds in (0, 3):
        allowed = first_count + rounds * ROUND + sketch.LEAST_PATTERNS
        rig = Unplugged(corner(), SMALL)
        path = tmp_path / f"{rounds}.zarr"
        acquire(rig, geometry="aligned", strategy="sketch", store=path, photographs=allowed)
        assert rig.count == first_count + rounds * ROUND
        report = Report.of(path)
        assert report.patterns == sketch.count_patterns(SMALL) + 16 * rounds
        errors.append(report.judged_error)
    assert errors[1] < 0.9 * errors[0]


@pytest.mark.slow
def test_the_last_round_takes_the_photographs_that_are_left(
    tmp_path: Path, first_count: int
) -> None:
    path = tmp_path / "T.zarr"
    settings: dict[str, Any] = {"geometry": "aligned", "strategy": "sketch"}
    allowed = first_count + 10
    rig = Unplugged(corner(), SMALL)
    acquire(rig, store=path, photographs=allowed, **settings)
    assert rig.count == allowed
    assert Report.of(path).patterns == sketch.count_patterns(SMALL) + 9


@pytest.mark.rare
def test_rounds_end_where_the_error_is_small_enough(tmp_path: Path, first_count: int) -> None:
    counts = []
    for rtol in (0.5, 1e-4):
        rig = Unplugged(corner(), SMALL)
        path = tmp_path / f"{rtol}.zarr"
        acquire(rig, geometry="aligned", strategy="sketch", store=path, rtol=rtol)
        counts.append(rig.count)
        if rtol == 0.5:
            assert Report.of(path).judged_error < rtol
    assert counts[0] == first_count
    # Noise ends it: no round helps any more.
    assert first_count + ROUND <= counts[1] < first_count + sketch.MAX_ROUNDS * ROUND


@pytest.mark.rare
def test_rounds_are_resumed_to_the_bit(tmp_path: Path, first_count: int) -> None:
    settings: dict[str, Any] = {
        "geometry": "aligned", "strategy": "sketch", "photographs": first_count + 2 * ROUND
    }  # fmt: skip
    whole = acquire(Unplugged(corner(), SMALL), **settings)
    path = tmp_path / "T.zarr"
    stopped = Unplugged(corner(), SMALL, left=first_count + ROUND + 3)
    with pytest.raises(RuntimeError):
        acquire(stopped, store=path, **settings)
    resumed = acquire(Unplugged(corner(), SMALL), store=path, **settings)
    np.testing.assert_array_equal(dense(resumed), dense(whole))


@pytest.mark.slow
def test_a_sketch_is_finished_with_the_rounds_that_were_photographed(
    tmp_path: Path, first_count: int
) -> None:
    path = tmp_path / "T.zarr"
    rig = Unplugged(corner(), SMALL, left=first_count + ROUND + 3)
    allowed = first_count + 2 * ROUND
    with pytest.raises(RuntimeError):
        acquire(rig, geometry="aligned", strategy="sketch", store=path, photographs=allowed)
    finalize(path)
    assert Report.of(path).patterns == sketch.count_patterns(SMALL) + 16


@pytest.mark.slow
def test_patterns_of_a_round_are_kept_with_the_scan(
    tmp_path: Path, first_count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of a round that was begun are not made again: rounding may make others."""
    path = tmp_path / "T.zarr"
    settings: dict[str, Any] = {
        "geometry": "aligned", "strategy": "sketch", "photographs": first_count + ROUND
    }  # fmt: skip
    whole = acquire(Unplugged(corner(), SMALL), **settings)
    stopped = Unplugged(corner(), SMALL, left=first_count + 3)
    with pytest.raises(RuntimeError):
        acquire(stopped, store=path, **settings)

    def others(*_: Any) -> list[np.ndarray]:
        return sketch.more_patterns(SMALL, 0)

    monkeypatch.setattr(sketch, "refined_patterns", others)
    resumed = acquire(Unplugged(corner(), SMALL), store=path, **settings)
    np.testing.assert_array_equal(dense(resumed), dense(whole))


@pytest.mark.parametrize("goal", [{"rtol": 0.01}, {"photographs": 90}], ids=str)
@pytest.mark.parametrize("strategy", ["auto", *sorted({*STRATEGIES} - {"sketch"})])
def test_a_goal_that_no_other_strategy_keeps_is_refused(
    strategy: str, goal: dict[str, Any]
) -> None:
    """They would take as many photographs as ever; "auto" makes no sketch of so few pixels."""
    rig = Unplugged(corner(), SMALL)
    [(name, value)] = goal.items()
    with pytest.raises(InputError, match=f"{name} is {value}, but strategy is '{strategy}'"):
        acquire(rig, geometry="aligned", strategy=strategy, **goal)
    assert rig.count == 0


def test_too_few_photographs_are_refused_before_the_first(first_count: int) -> None:
    rig = Unplugged(corner(), SMALL)
    with pytest.raises(InputError, match="photographs is 20"):
        acquire(rig, geometry="aligned", strategy="sketch", photographs=20)
    assert rig.count == 0
