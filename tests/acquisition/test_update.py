# SPDX-License-Identifier: BSD-3-Clause
"""A scan carried over by 12 photographs: after a nudge, an aged lamp, and what must be refused."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl import scenes
from ltcl.acquisition import Calibration, Report, VirtualRig, acquire
from ltcl.acquisition.calibration import stored_map
from ltcl.acquisition.estimation.windows import hat_matrix
from ltcl.acquisition.updating.movement import Movement, interpolation
from ltcl.acquisition.updating.photographs import all_patterns
from ltcl.acquisition.updating.warp import HostTransport
from ltcl.errors import AcquisitionError, FileError, InputError
from ltcl.store import BlockStore
from tests.acquisition.moved_corner import AMBIENT, CAMERA, GRID, camera_transport, rig

Scan = Callable[[str], Path]


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    """Finished scans of the corner by their strategies, each made once."""
    folder = tmp_path_factory.mktemp("scans")

    def make(strategy: str) -> Path:
        path = folder / f"{strategy}.zarr"
        if not path.exists():
            acquire(rig(), strategy=strategy, store=path)
        return path

    return make


def true_error(store: Path, transport: ltcl.Transport, truth: np.ndarray) -> float:
    """Relative error of T p for pictures like nature, on pixels that are not masked."""
    resampling = Calibration.of(store).resampling
    random = np.random.default_rng(3)
    camera = rig(truth)
    black = camera.radiance(np.zeros(GRID))
    squares = []
    for _ in range(4):
        pattern = (random.random((4, 4)) < 0.5).repeat(4, 0).repeat(4, 1).astype(np.float32)
        seen = resampling.apply(camera.radiance(pattern) - black)
        told = np.asarray(transport @ pattern, np.float64)
        known = ~transport.masked.reshape(GRID)
        scale = (told * seen)[known].sum() / (told**2)[known].sum()
        left = scale * told - seen
        squares.append((left[known] ** 2).sum() / (seen[known] ** 2).sum())
    return math.sqrt(np.mean(squares))


@pytest.mark.rare
@pytest.mark.parametrize("strategy", ["sketch", "pixel", "adaptive"])
def test_a_nudge_and_an_older_lamp(scan: Scan, tmp_path: Path, strategy: str) -> None:
    """Shift and gain are found, and T p is right for the scene as it is now."""
    old = scan(strategy)
    before = BlockStore.open(old).attributes
    truth = 0.95 * camera_transport(0.7, -1.4)
    store = tmp_path / "new.zarr"
    steps = []
    result = ltcl.update(
        rig(truth),
        old,
        store=store,
        photographs=12,
        progress=lambda *step: steps.append(step),
    )
    assert result.photographs == 12
    assert ("update", 12, 12) in steps
    assert result.shift == pytest.approx((0.7, -1.4), abs=0.05)
    assert result.gain == pytest.approx(0.95, abs=0.02)
    # The first column and the last row see places where nothing was lit.
    assert result.masked == 31
    assert result.transport.masked.sum() == 31
    assert f"{result.masked} pixels" in str(result)
    error = true_error(store, result.transport, truth)
    assert error < 0.03
    assert error < 0.1 * true_error(store, ltcl.load(old), truth)
    assert result.error < 0.03
    assert BlockStore.open(old).attributes == before
    report = Report.of(store)
    assert report.judged_error == result.error
    assert report.masked == pytest.approx(31 / 256)
    assert "updated from" in report.why


@pytest.mark.rare
def test_by_half_a_pixel(scan: Scan, tmp_path: Path) -> None:
    """The last row lies half on the old picture: what the camera does not tell apart is masked."""
    truth = camera_transport(0.5, -1.5)
    store = tmp_path / "new.zarr"
    result = ltcl.update(rig(truth), scan("sketch"), store=store, photographs=12)
    assert result.masked > 16
    assert result.transport.masked.sum() == result.masked
    assert true_error(store, result.transport, truth) < 0.02


@pytest.mark.rare
def test_an_update_is_updated(scan: Scan, tmp_path: Path) -> None:
    """The way back, by one update after the other, is no movement of the first scan."""
    there = ltcl.update(
        rig(camera_transport(0.0, 1.0)), scan("sketch"), store=tmp_path / "there.zarr"
    )
    back = ltcl.update(rig(), tmp_path / "there.zarr", store=tmp_path / "back.zarr")
    assert there.shift == pytest.approx((0.0, 1.0), abs=0.05)
    assert back.shift == pytest.approx((0.0, -1.0), abs=0.05)
    assert back.previous_error == there.error
    assert true_error(tmp_path / "back.zarr", back.transport, camera_transport()) < 0.03


@pytest.mark.rare
@pytest.mark.parametrize(("lamp", "ambient"), [(0.9, AMBIENT), (1.0, 5 * AMBIENT)])
def test_what_did_not_move_stays(scan: Scan, tmp_path: Path, lamp: float, ambient: float) -> None:
    camera = rig(lamp * camera_transport(), ambient=ambient)
    result = ltcl.update(camera, scan("sketch"), store=tmp_path / "new.zarr")
    assert result.movement.is_identity
    assert result.gain == pytest.approx(lamp, abs=0.01)
    assert result.masked == 0
    assert result.holds
    assert "nothing has moved" in str(result)


def test_black_at_the_lowest_code_hides_no_pixel(tmp_path: Path) -> None:
    """In a dark room black has a value at few pixels, or none; in the scan it had one at all."""
    T = scenes.dihedral(8, albedo=0.6).transport()
    options: dict[str, Any] = {"geometry": "aligned", "strategy": "sketch"}
    acquire(VirtualRig(T, T.grid, bits=12), store=tmp_path / "scan.zarr", **options)
    aged = VirtualRig([0.9 * T.matrices[0]], T.grid, bits=12)
    store = tmp_path / "new.zarr"
    result = ltcl.update(aged, tmp_path / "scan.zarr", store=store)
    assert result.holds
    assert Calibration.of(store).ambient.valid.all()
    # An error that is lost in noise is not stated as 0.
    random = np.random.default_rng(3)
    pattern = random.random(T.grid)
    truth = 0.9 * (T @ pattern)
    told = result.transport @ pattern
    told *= (truth * told).sum() / (told**2).sum()
    error = np.linalg.norm(told - truth) / np.linalg.norm(truth)
    assert error < result.bound < 0.1


@pytest.mark.rare
def test_pixels_at_the_lowest_code_are_black(tmp_path: Path) -> None:
    """A dark wall, and a camera without an offset: pixels that are not lit have no value."""
    options: dict[str, Any] = {"ambient": 0.0, "black": 0.0}
    old = tmp_path / "scan.zarr"
    acquire(rig(camera_transport(albedo=0.05), **options), strategy="sketch", store=old)
    truth = camera_transport(0.5, -0.6, albedo=0.05)
    store = tmp_path / "new.zarr"
    result = ltcl.update(rig(truth, **options), old, store=store)
    assert result.shift == pytest.approx((0.5, -0.6), abs=0.01)
    assert result.gain == pytest.approx(1.0, abs=0.01)
    assert true_error(store, result.transport, truth) < 0.03


@pytest.mark.rare
def test_a_wider_picture(scan: Scan, tmp_path: Path) -> None:
    """A movement that is no shift: 4 % wider, and higher, from the middle."""
    truth = camera_transport(spread=0.04)
    result = ltcl.update(rig(truth), scan("sketch"), store=tmp_path / "new.zarr")
    # From the middle to the corner, 7.5 pixels each way.
    assert result.movement.largest == pytest.approx(0.04 / 1.04 * 7.5 * 2**0.5, abs=0.1)
    assert result.shift == pytest.approx((0.0, 0.0), abs=0.05)
    assert true_error(tmp_path / "new.zarr", result.transport, truth) < 0.03


def textured(T: np.ndarray) -> np.ndarray:
    """A scene of other paint, which reflects less from place to place."""
    paint = np.random.default_rng(1).random((11, 11)).repeat(6, 0).repeat(6, 1)
    return (0.2 + 0.8 * paint).reshape(-1, 1) * T


@pytest.mark.rare
@pytest.mark.parametrize(
    ("truth", "reason"),
    [
        (camera_transport(2.6, 0.0), r"has moved by 2\.\d of its pixels; .* 2\.0 at most"),
        (textured(camera_transport()), "the camera or the scene has changed"),
    ],
)
def test_too_far_and_another_scene_are_refused(
    scan: Scan, tmp_path: Path, truth: np.ndarray, reason: str
) -> None:
    store = tmp_path / "new.zarr"
    with pytest.raises(AcquisitionError, match=f"{reason}.*a new scan is needed"):
        ltcl.update(rig(truth), scan("sketch"), store=store)
    assert not store.exists()


def without_right_third(T: np.ndarray) -> np.ndarray:
    """T of a scene that ends there: the camera sees none of the light."""
    seen = T.reshape(*CAMERA, -1).copy()
    seen[:, 44:] = 0.0
    return seen.reshape(T.shape)


@pytest.mark.rare
def test_a_picture_that_falls_beside_the_scene_in_part(tmp_path: Path) -> None:
    old = tmp_path / "scan.zarr"
    acquire(rig(without_right_third(camera_transport())), strategy="sketch", store=old)
    truth = without_right_third(camera_transport(0.5, -0.5))
    store = tmp_path / "new.zarr"
    result = ltcl.update(rig(truth), old, store=store)
    assert result.shift == pytest.approx((0.5, -0.5), abs=0.05)
    assert result.masked >= 64
    assert result.holds
    assert true_error(store, result.transport, truth) < 0.02


def test_a_picture_without_light_judges_no_update(tmp_path: Path) -> None:
    """The lit patch lies where the projector lights nothing."""
    truth = scenes.dihedral(8, albedo=0.6).transport().matrices[0].copy()
    truth[:, 64:] = 0.0
    truth[64:] = 0.0
    old = tmp_path / "scan.zarr"
    acquire(VirtualRig(truth, (8, 16), bits=12), geometry="aligned", strategy="sketch", store=old)
    camera = VirtualRig(0.95 * truth, (8, 16), bits=12)
    result = ltcl.update(camera, old, store=tmp_path / "new.zarr")
    assert np.isnan(result.errors).sum() == 1
    assert result.holds
    assert result.gain == pytest.approx(0.95, abs=0.01)


class MistakenRig:
    """A rig that photographs another pattern for one of the first twelve."""

    def __init__(self, rig: VirtualRig, number: int, other: int) -> None:
        self._rig = rig
        self._number = number
        self._other = other
        self._taken = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._rig, name)

    def photograph(self, codes: np.ndarray, seconds: float) -> np.ndarray:
        self._taken += 1
        if self._taken == self._number:
            codes = all_patterns(GRID)[self._other - 1]
        return self._rig.photograph(codes, seconds)


@pytest.mark.rare
@pytest.mark.parametrize(
    ("number", "other", "reason"),
    [
        (4, 8, "photograph 4 shows the pattern of photograph 8"),
        (5, 1, "photograph 5 shows the pattern of photograph 1;"),
        (11, 10, "photograph 11 shows the pattern of photograph 10"),
        (2, 1, "0% more light under white than under black"),
    ],
)
def test_a_photograph_of_another_pattern_is_named(
    scan: Scan, tmp_path: Path, number: int, other: int, reason: str
) -> None:
    camera = MistakenRig(rig(camera_transport(0.5, 0.4)), number, other)
    with pytest.raises(AcquisitionError, match=reason):
        ltcl.update(cast("Any", camera), scan("sketch"), store=tmp_path / "new.zarr")


@pytest.mark.rare
def test_a_new_lamp_that_saturates_the_camera_is_refused(scan: Scan, tmp_path: Path) -> None:
    with pytest.raises(AcquisitionError, match=r"saturated at \d+% of the pixels"):
        ltcl.update(rig(2.5 * camera_transport()), scan("sketch"), store=tmp_path / "new.zarr")


def mirrored() -> np.ndarray:
    """T after a mirror in the upper left corner sends light of pixels there elsewhere."""
    truth = camera_transport().copy()
    changed = truth.reshape(66, 66, 16, 16)
    # Camera pixels of the first four rows and columns of projector pixels.
    changed[8:20, 8:20, :8, :8] = changed[8:20, 8:20, :8, :8][:, :, ::-1]
    return truth


@pytest.mark.rare
def test_a_place_that_has_changed_is_named(
    scan: Scan, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    result = ltcl.update(
        rig(mirrored()), scan("sketch"), store=tmp_path / "new.zarr", photographs=27
    )
    assert result.photographs == 12
    assert not result.holds
    assert result.failing[:4, :4].mean() > 0.5
    assert result.failing[8:, 8:].mean() < 0.1
    assert "up to 60 photographs measure it again" in caplog.text


def turned(height: int) -> np.ndarray:
    """T after a turned mirror has come into the upper left corner: rows of it swap places."""
    T = camera_transport()
    swapped = np.arange(256).reshape(16, 16)
    swapped[:height, :height] = swapped[:height, height - 1 :: -1]
    return np.ascontiguousarray(T[:, swapped.ravel()])


@pytest.mark.rare
def test_what_fails_is_measured_again(
    scan: Scan, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Light of an eighth of the picture falls elsewhere: 16 photographs more are enough."""
    truth = 0.95 * turned(6)
    store = tmp_path / "new.zarr"
    steps = []
    result = ltcl.update(
        rig(truth), scan("sketch"), store=store, progress=lambda *step: steps.append(step)
    )
    assert result.photographs == 28
    assert ("update", 28, 28) in steps
    assert "16 more measure it again, at most 60 in all" in caplog.text
    assert result.holds
    assert 20 <= result.measured_again <= 60
    assert f"{result.measured_again} pixels" in str(result)
    assert true_error(store, result.transport, truth) < 0.03
    # With 12 photographs alone.
    before = ltcl.update(rig(truth), scan("sketch"), store=tmp_path / "first.zarr", photographs=12)
    assert not before.holds
    assert before.measured_again == 0
    assert true_error(tmp_path / "first.zarr", before.transport, truth) > 0.1


@pytest.mark.rare
def test_colours(tmp_path: Path) -> None:
    """Each channel has a lamp of its own."""
    lamps = (0.9, 0.95, 1.0)
    albedos = (0.6, 0.5, 0.4)
    mixing = np.array([[0.9, 0.1, 0.0], [0.05, 0.9, 0.05], [0.0, 0.1, 0.9]])

    def camera(rows: float, gains: tuple[float, ...]) -> VirtualRig:
        matrices = []
        for albedo, gain in zip(albedos, gains, strict=True):
            T = gain * camera_transport(rows, 0.0, albedo=albedo)
            matrices.append(T.astype(np.float32))
        return VirtualRig(
            matrices, GRID, mixing=mixing, bits=12, ambient=AMBIENT, camera_grid=(66, 66)
        )

    acquire(camera(0.0, (1.0, 1.0, 1.0)), strategy="sketch", store=tmp_path / "old.zarr")
    result = ltcl.update(camera(1.3, lamps), tmp_path / "old.zarr", store=tmp_path / "new.zarr")
    assert result.shift == pytest.approx((1.3, 0.0), abs=0.05)
    assert result.gain == pytest.approx(lamps, abs=0.02)
    assert result.error < 0.03
    assert result.transport.channels == 3


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan that cannot be carried over: its pixels are blocks."""
    path = tmp_path_factory.mktemp("small") / "block.zarr"
    acquire(small_rig(), geometry="aligned", strategy="block", store=path)
    return path


def small_rig(side: int = 4) -> VirtualRig:
    T = scenes.dihedral(side, albedo=0.6).transport()
    return VirtualRig(T, T.grid, bits=12)


def test_what_cannot_be_updated_is_refused_before_the_first_photograph(
    small: Path, tmp_path: Path
) -> None:
    camera: Any = small_rig()
    camera.photograph = None
    new = tmp_path / "new.zarr"
    with pytest.raises(InputError, match=r"'block'.* sketch, adaptive"):
        ltcl.update(camera, small, store=new)
    with pytest.raises(InputError, match=r"store is .*, which is the scan"):
        ltcl.update(camera, small, store=small)
    with pytest.raises(FileError, match="exists; store"):
        ltcl.update(camera, small, store=small.parent)
    with pytest.raises(FileError, match="no such folder"):
        ltcl.update(camera, tmp_path / "nowhere.zarr", store=new)
    with pytest.raises(InputError, match="photographs is 11"):
        ltcl.update(camera, small, store=new, photographs=11)
    with pytest.raises(ltcl.errors.InputTypeError, match="progress is 3"):
        ltcl.update(camera, small, store=new, progress=cast("Any", 3))


def test_a_scan_that_is_not_finished_or_of_another_rig_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "T.zarr"
    acquire(small_rig(), geometry="aligned", strategy="pixel", store=path)
    with pytest.raises(InputError, match=r"rig.projector_grid is .*3, 6.*4, 8"):
        ltcl.update(small_rig(3), path, store=tmp_path / "new.zarr")
    unfinished = BlockStore.create(tmp_path / "begun.zarr", shape=(4, 4), grid=(2, 2))
    with pytest.raises(FileError, match="holds no calibration"):
        ltcl.update(small_rig(), unfinished.path, store=tmp_path / "new.zarr")


@pytest.mark.slow
def test_a_scan_without_its_map_is_refused(scan: Scan, tmp_path: Path) -> None:
    """Scans kept no map once."""
    path = tmp_path / "old.zarr"
    shutil.copytree(scan("sketch"), path)
    store = BlockStore.open(path)
    names = [name for name in store._places if name.startswith("extra.calibration.map.")]
    assert len(names) == 2
    for name in names:
        del store._places[name]
    with pytest.raises(FileError, match="scan again"):
        stored_map(store)


def test_a_movement_and_its_inverse() -> None:
    random = np.random.default_rng(0)
    coefficients = random.normal(0.0, 1.0, (2, 6))
    movement = Movement(grid=(48, 64), coefficients=coefficients)
    row, column = np.indices(movement.grid).reshape(2, -1)
    there = movement.forward(row, column)
    back = movement.backward(*there)
    np.testing.assert_allclose(back, (row, column), atol=1e-6)
    assert movement.largest == pytest.approx(np.hypot(there[0] - row, there[1] - column).max())


def test_interpolation_keeps_pictures_that_are_linear_and_all_light() -> None:
    grid = (5, 7)
    row, column = np.indices(grid).reshape(2, -1).astype(float)
    picture = 2.0 + 0.5 * row - 0.25 * column
    random = np.random.default_rng(0)
    y = random.uniform(0.0, 4.0, 50)
    x = random.uniform(0.0, 6.0, 50)
    weights = interpolation(y, x, grid)
    np.testing.assert_allclose(weights @ picture, 2.0 + 0.5 * y - 0.25 * x)
    # Beyond the picture there is nothing, or its rim.
    outside = np.array([-3.0])
    assert interpolation(outside, outside, grid).nnz == 0
    assert (interpolation(outside, outside, grid, to_rim=True) @ picture).item() == picture[0]
    # A narrow aperture sees one square, but at its edge.
    narrow = interpolation(np.array([1.3, 1.5]), np.array([2.0, 2.0]), grid, aperture=0.2)
    assert narrow.toarray().max(axis=1) == pytest.approx([1.0, 0.5])


def test_focus_moves_with_the_pixels_and_light_across_a_crease_with_the_scene() -> None:
    """By half a pixel: the pixel that lies on the crease then lights itself across it."""
    height, width, crease = 12, 16, 8
    grid = height, width
    column = np.arange(width)
    own = 0.5 + 0.3 * np.sin(column)
    focus = np.eye(width) + 0.1 * np.eye(width, k=1) + 0.1 * np.eye(width, k=-1)
    crossing = np.zeros((width, width))
    crossing[crease - 1, crease] = crossing[crease, crease - 1] = 0.08
    rows = np.eye(height)
    T = np.kron(rows, own[:, None] * focus + crossing)
    hats: Any = hat_matrix(grid)
    core = scipy.sparse.csr_array(np.pad(T, ((0, 0), (0, hats.shape[0] - len(T)))))
    moved = HostTransport(grid=grid, cores=[core], W=hats).moved(Movement.shift(grid, 0.0, 0.5))
    new = (moved.cores[0] @ hats).toarray()
    new = new.reshape(height, width, height, width)[5, :, 5]
    # New pixel c looks at old places c - 1/2: on the crease lies the middle of pixel `crease`.
    halfway = np.append(own[0], 0.5 * (own[1:] + own[:-1]))
    expected = halfway[:, None] * focus
    across = crossing.copy()
    across[1:] = 0.5 * (crossing[1:] + crossing[:-1])
    across[:, 1:] = 0.5 * (across[:, 1:] + across[:, :-1])
    expected = expected + across
    np.testing.assert_allclose(new[2:-2, 2:-2], expected[2:-2, 2:-2], atol=1e-6)
    assert new[crease, crease] == pytest.approx(halfway[crease] + 0.04)
