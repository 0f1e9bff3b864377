# SPDX-License-Identifier: BSD-3-Clause
"""The closed loop, stopped and resumed: photographs of a known transport in, and T out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.acquisition import Calibration, Report, Setup, VirtualRig, acquire, camera_map, finalize
from ltcl.errors import AcquisitionError, FileError, InputError
from ltcl.store import BlockStore
from tests.store.stores import interrupt

from .scanning.helpers import corner, dense, relative_error, rig, unit, unseen_patterns
from .stopping import LINEAR_RESPONSE, Unplugged

GRID = (8, 16)
STRATEGIES = ("pixel", "hadamard", "adaptive", "sketch", "direct")


def oblique_view(u: Any, v: Any) -> tuple[Any, Any]:
    """Places seen by 27 x 50 camera pixels, three to a side of one of 8 x 16, in perspective."""
    x = u / 3 - 0.8
    y = v / 3 - 0.6
    depth = 1 + 0.008 * x - 0.01 * y
    return (x + 0.1 * y) / depth - 0.4, (y - 0.05 * x) / depth + 0.3


@pytest.fixture(scope="module", params=STRATEGIES)
def scanned(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Strategy, transport and store of a scan that nobody stopped."""
    path = tmp_path_factory.mktemp("scanned") / "T.zarr"
    T = acquire(camera(), geometry="aligned", strategy=request.param, store=path)
    return request.param, T, path


def camera(left: int = 1 << 30) -> Unplugged:
    """A camera of 8 bits, with a curve, which fails after so many photographs."""
    return Unplugged(corner(), GRID, left=left, response="film", bits=8)


def side_by_side(grid: tuple[int, int]) -> np.ndarray:
    """Mask (N, N) of pixels that touch each other."""
    row, column = np.indices(grid).reshape(2, -1)
    return (abs(row[:, None] - row) <= 1) & (abs(column[:, None] - column) <= 1)


@pytest.mark.slow
def test_patterns_that_no_scan_has_seen(scanned: Any) -> None:
    """Curve of the camera, black, ambient light and noise are measured from photographs alone."""
    strategy, T, path = scanned
    truth = corner()
    if strategy == "direct":
        truth = np.where(side_by_side(GRID), truth, 0.0)
    # Light from a few pixels away in the crease is neither constant nor near.
    assert relative_error(dense(T), truth, GRID) < (0.05 if strategy == "direct" else 0.02)
    if strategy == "adaptive":
        assert Report.of(path).patterns < 128


@pytest.mark.slow
def test_a_finished_store_needs_no_rig_any_more(scanned: Any) -> None:
    strategy, T, path = scanned
    again = acquire(camera(0), geometry="aligned", strategy=strategy, store=path)
    np.testing.assert_array_equal(dense(again), dense(T))
    with pytest.raises(InputError, match="resume is False"):
        acquire(camera(), geometry="aligned", strategy=strategy, store=path, resume=False)


class Steps:
    """Records the steps of a progress, with the photographs of a rig."""

    def __init__(self, rig: Unplugged) -> None:
        self.rig = rig
        self.steps: list[tuple[str, int, int]] = []
        self.counts: list[int] = []

    def __call__(self, step: str, done: int, total: int) -> None:
        self.steps.append((step, done, total))
        self.counts.append(self.rig.count)

    def done(self, kind: str) -> list[int]:
        """The numbers done of one kind of step."""
        return [done for step, done, _ in self.steps if step == kind]


@pytest.mark.rare
def test_photographs_are_enough_for_the_transport(
    tmp_path: Path, scanned: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that ends after the last photograph, and one that was not stopped, are the same."""
    strategy, T, whole = scanned
    path = tmp_path / "T.zarr"
    monkeypatch.setattr(BlockStore, "finalize", lambda *_, **__: interrupt())
    with pytest.raises(KeyboardInterrupt):
        acquire(camera(), geometry="aligned", strategy=strategy, store=path)
    monkeypatch.undo()
    assert not BlockStore.open(path).final
    progress = Steps(camera())
    finalize(path, progress)
    np.testing.assert_array_equal(dense(ltcl.load(path, on_dark="mask")), dense(T))
    assert Report.of(path).to_json() == Report.of(whole).to_json()
    done = progress.done("scan")
    assert done
    assert done == sorted(done)
    finalize(path)


@pytest.mark.slow
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_progress(tmp_path: Path, strategy: str) -> None:
    """The calibration and each pattern count, and at once those that an earlier run photographed.

    Nothing is made up for photographs that are missing.
    """
    path = tmp_path / "T.zarr"
    settings: dict[str, Any] = {"geometry": "aligned", "strategy": strategy, "store": path}
    # In the middle of the scan.
    stopped = camera({"sketch": 60, "direct": 60}.get(strategy, 350))
    first = Steps(stopped)
    with pytest.raises(AcquisitionError, match="unplugged"):
        acquire(stopped, **settings, progress=first)
    done = first.done("calibration")
    assert done == [*range(1, done[-1] + 1), done[-1]]
    assert all(done <= total for _, done, total in first.steps)

    earlier = BlockStore.open(path).written
    with pytest.raises(AcquisitionError, match=r"T\.zarr"):
        finalize(path)
    with pytest.raises(FileError, match=r"T\.zarr"):
        Report.of(path)
    assert BlockStore.open(path).written == earlier

    resumed = camera()
    second = Steps(resumed)
    acquire(resumed, **settings, progress=second)
    done = second.done("scan")
    assert done == sorted(done)
    patterns = BlockStore.open(path).attributes["patterns"]
    assert second.steps[-1] == ("scan", patterns, patterns)
    before_first_photograph = second.steps[: second.counts.count(0)]
    at_once = max(done for _, done, _ in before_first_photograph)
    assert (at_once > 0) == bool(earlier)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("other", "change", "text"),
    [
        (rig(), {"strategy": "hadamard"}, "strategy is 'hadamard'.*'pixel'"),
        (rig(), {"sigmas": 2.0}, "sigmas is 2.0.*3.0"),
        (rig(4), {}, r"\(4, 8\).*\(8, 16\)"),
        (rig(response="film"), {}, "rig.response is 'film'.*'srgb'"),
        (rig(black=0.01), {}, "rig.black is 0.01.*0.004"),
        (VirtualRig(1.001 * corner(), GRID, bits=12, ambient=0.01), {}, "rig.digests.transport"),
    ],
)
def test_other_settings_and_rigs_are_refused(
    begun: Path, other: VirtualRig, change: dict[str, Any], text: str
) -> None:
    settings = {"geometry": "aligned", "strategy": "pixel", "store": begun}
    with pytest.raises(InputError, match=text):
        acquire(other, **{**settings, **change})


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store whose scan was stopped."""
    path = tmp_path_factory.mktemp("begun") / "T.zarr"
    with pytest.raises(AcquisitionError, match="unplugged"):
        acquire(
            Unplugged(corner(), GRID, left=300), geometry="aligned", strategy="pixel", store=path
        )
    return path


@pytest.mark.slow
def test_another_rig_is_refused_after_the_end_too(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"geometry": "aligned", "strategy": "pixel"}
    path = tmp_path / "T.zarr"
    with pytest.raises(AcquisitionError, match="unplugged"):
        acquire(Unplugged(corner(4), (4, 8), left=200), **settings, store=path)
    acquire(rig(4, seed=5), **settings, store=path)
    with pytest.raises(InputError, match=r"rig\.response is 'film'"):
        acquire(rig(4, response="film"), **settings, store=path)


def test_stores_of_others_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "T.zarr"
    ltcl.save(path, ltcl.Transport(np.eye(128), GRID))
    with pytest.raises(InputError, match=r"ltcl\.acquire did not make"):
        acquire(rig(), geometry="aligned", store=path)
    for read in (Setup.of, Report.of, finalize):
        with pytest.raises(FileError, match=r"ltcl\.acquire"):
            read(path)
        with pytest.raises(FileError, match="no such folder"):
            read(tmp_path / "nowhere.zarr")


@pytest.mark.rare
@pytest.mark.parametrize(
    ("by_hand", "response", "bits", "strategy", "largest_error"),
    [
        (False, "film", 12, "hadamard", 0.02),
        (False, "srgb", 8, "adaptive", 0.02),
        (True, "srgb", 8, "auto", 0.011),
    ],
)
def test_a_camera_of_its_own_pixels(
    tmp_path: Path, by_hand: bool, response: str, bits: int, strategy: str, largest_error: float
) -> None:
    """It is decoded by Gray code. Pixels that it does not see are masked, the others are right.

    The pattern for the measured transport shows the picture under the true one to 30 dB. By hand,
    with all defaults, it takes at most 305 photographs.
    """
    path = tmp_path / "T.zarr"
    size = (27, 50)
    view = camera_map(oblique_view, size, GRID)
    oblique = Unplugged(
        corner(), GRID, camera_grid=size, camera_map=view, response=response, bits=bits
    )
    oblique.keeps_photographs = by_hand
    T = acquire(oblique, strategy=strategy, store=path)
    if by_hand:
        assert oblique.count <= 305

    area = np.asarray(view.sum(axis=0))
    seen = ~T.masked
    assert seen[area > 3].all()
    assert not seen[area < 0.3].any()
    assert 0 < (~seen).sum() < 8
    assert Report.of(path).coverage == seen.mean()

    truth = corner()
    scale = unit(dense(T)[seen], truth[seen])
    P = unseen_patterns(GRID)
    pictures = scale * (dense(T) @ P)[seen]
    expected = (truth @ P)[seen]
    errors = np.linalg.norm(pictures - expected, axis=0) / np.linalg.norm(expected, axis=0)
    assert errors.max() < largest_error, errors

    y, x = np.mgrid[:8, :16] / 16
    desired = 0.25 + 0.1 * np.sin(7 * x + 4 * y)
    compensation = ltcl.compensate(T, (desired / scale).astype(np.float32), rtol=1e-3)
    pattern = np.asarray(compensation.pattern, np.float64)
    error = (truth @ pattern.ravel() - desired.ravel())[seen]
    assert 10 * np.log10(desired.max() ** 2 / np.mean(error**2)) > 30


@pytest.mark.slow
def test_pixels_that_every_exposure_saturates(tmp_path: Path) -> None:
    """They are masked, counted, and their entries of unknown variance; the others are right."""
    path = tmp_path / "T.zarr"
    bright = [5, 17, 30]
    T = 0.02 * np.eye(32)
    T[bright, bright] = 5.0
    camera = VirtualRig(T, (4, 8), exposures=[4.0, 8.0], bits=12, response="linear")
    measured = acquire(
        camera, geometry="aligned", strategy="pixel", response=LINEAR_RESPONSE, store=path
    )
    assert np.flatnonzero(measured.masked).tolist() == bright
    np.testing.assert_allclose(np.delete(measured.first_bounce, bright), 0.02, rtol=0.1)
    with pytest.raises(FileError, match=r"first_bounce.* 3 of 32"):
        ltcl.load(path, on_dark="raise")
    report = Report.of(path)
    assert report.saturated == 3 / 32
    assert report.masked == 3 / 32
    assert report.coverage == 1.0
    # Their own entries are unknown, and those of the sums of their batches.
    assert 3 / report.entries <= report.unknown < 0.5
    assert report.entries == ltcl.load(path, on_dark="mask").matrices[0].nnz
    assert report.photographs == report.patterns * len(Calibration.of(path).exposures)
