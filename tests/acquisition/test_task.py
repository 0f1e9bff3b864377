# SPDX-License-Identifier: BSD-3-Clause
"""The closed loop: photographs of a known transport in, and the transport out; stopped, resumed, refused."""

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
from .stopping import LINE, Unplugged

GRID = (8, 16)
STRATEGIES = ("pixel", "hadamard", "adaptive")


def askance(u: Any, v: Any) -> tuple[Any, Any]:
    """Three camera pixels to each side of one of 8 x 16, of a picture seen in perspective."""
    a, b = u / 3 - 0.8, v / 3 - 0.6
    d = 1 + 0.008 * a - 0.01 * b
    return (a + 0.1 * b) / d - 0.4, (b - 0.05 * a) / d + 0.3


@pytest.fixture(scope="module", params=STRATEGIES)
def scanned(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Strategy, transport and store of a scan that nobody stopped."""
    path = tmp_path_factory.mktemp("scanned") / "T.zarr"
    T = acquire(camera(), geometry="aligned", strategy=request.param, store=path)
    return request.param, T, path


def camera(left: int = 1 << 30) -> Unplugged:
    """Of 8 bits, with a curve; fails after so many photographs."""
    return Unplugged(corner(), GRID, left=left, response="film", bits=8)


def test_patterns_that_no_scan_has_seen(scanned: Any) -> None:
    """Curve of the camera, black, ambient light and noise are measured from photographs alone."""
    strategy, T, path = scanned
    assert relative_error(dense(T), corner(), GRID) < 0.02
    assert strategy != "adaptive" or Report.of(path).patterns < 128


def test_a_store_that_is_done_needs_no_rig_any_more(scanned: Any) -> None:
    strategy, T, path = scanned
    again = acquire(camera(0), geometry="aligned", strategy=strategy, store=path)
    np.testing.assert_array_equal(dense(again), dense(T))
    with pytest.raises(InputError, match="resume is False"):
        acquire(camera(), geometry="aligned", strategy=strategy, store=path, resume=False)


def test_what_is_photographed_is_all_it_takes(
    tmp_path: Path, scanned: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that ends between the last photograph and the transport, and one that was not stopped."""
    strategy, T, whole = scanned
    path, steps = tmp_path / "T.zarr", []
    monkeypatch.setattr(BlockStore, "finalize", lambda *_, **__: interrupt())
    with pytest.raises(KeyboardInterrupt):
        acquire(camera(), geometry="aligned", strategy=strategy, store=path)
    monkeypatch.undo()
    assert not BlockStore.open(path).final
    finalize(path, lambda *step: steps.append(step))
    np.testing.assert_array_equal(dense(ltcl.load(path, on_dark="mask")), dense(T))
    assert Report.of(path).to_json() == Report.of(whole).to_json()
    assert [done for _, done, _ in steps] == sorted(done for _, done, _ in steps) != []
    finalize(path)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_progress(tmp_path: Path, strategy: str) -> None:
    """Of the calibration and of each pattern to the end; what an earlier run photographed counts at once.

    Nothing is made up for photographs that are missing.
    """
    path, first, second = tmp_path / "T.zarr", [], []
    settings: dict[str, Any] = {"geometry": "aligned", "strategy": strategy, "store": path}
    with pytest.raises(AcquisitionError, match="unplugged"):
        acquire(camera(350), **settings, progress=lambda *step: first.append(step))
    done = [done for step, done, _ in first if step == "calibration"]
    assert done == [*range(1, done[-1] + 1), done[-1]]
    assert all(done <= total for _, done, total in first)
    earlier = BlockStore.open(path).written
    for read, error in ((finalize, AcquisitionError), (Report.of, FileError)):
        with pytest.raises(error, match=r"T\.zarr"):
            read(path)
    assert BlockStore.open(path).written == earlier
    rig = camera()
    acquire(rig, **settings, progress=lambda *step: second.append((*step, rig.count)))
    done = [done for _, done, _, _ in second]
    assert done == sorted(done)
    assert second[-1][:3] == ("scan", *(BlockStore.open(path).attributes["patterns"],) * 2)
    assert (max(done for _, done, _, count in second if count == 0) > 0) == bool(earlier)


def test_other_settings_and_rigs_are_refused(tmp_path: Path) -> None:
    settings: dict[str, Any] = {
        "geometry": "aligned",
        "strategy": "pixel",
        "store": tmp_path / "T.zarr",
    }
    with pytest.raises(AcquisitionError, match="unplugged"):
        acquire(Unplugged(corner(), GRID, left=300), **settings)
    for other, change, text in (
        (rig(), {"strategy": "hadamard"}, "strategy is 'hadamard'.*'pixel'"),
        (rig(), {"sigmas": 2.0}, "sigmas is 2.0.*3.0"),
        (rig(4), {}, r"\(4, 8\).*\(8, 16\)"),
        (rig(response="film"), {}, "rig.response is 'film'.*'srgb'"),
        (rig(black=0.01), {}, "rig.black is 0.01.*0.004"),
        (VirtualRig(1.001 * corner(), GRID, bits=12, ambient=0.01), {}, "rig.digests.transport is"),
    ):
        with pytest.raises(InputError, match=text):
            acquire(other, **{**settings, **change})
    acquire(rig(seed=5), **settings)
    with pytest.raises(InputError, match=r"rig\.response is 'film'"):  # finished, too
        acquire(rig(response="film"), **settings)


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


@pytest.mark.parametrize(
    ("by_hand", "response", "bits", "strategy", "most"),
    [
        (False, "film", 12, "hadamard", 0.02),
        (False, "srgb", 8, "adaptive", 0.02),
        (True, "srgb", 8, "auto", 0.011),
    ],
)
def test_a_camera_of_its_own_pixels(
    tmp_path: Path, by_hand: bool, response: str, bits: int, strategy: str, most: float
) -> None:
    """Decoded by Gray code. It does not see all pixels: these are masked, and the others are right.

    The pattern for the measured transport shows the picture under the true one to 30 dB. By hand,
    with all defaults, it takes at most 300 photographs.
    """
    C, path = camera_map(askance, (27, 50), GRID), tmp_path / "T.zarr"
    oblique = Unplugged(
        corner(), GRID, camera_grid=(27, 50), camera_map=C, response=response, bits=bits
    )
    oblique.keeps_photographs = by_hand
    T = acquire(oblique, strategy=strategy, store=path)
    assert oblique.count <= 300 or not by_hand
    area, seen, truth = np.asarray(C.sum(axis=0)), ~T.masked, corner()
    assert seen[area > 3].all()
    assert not seen[area < 0.3].any()
    assert 0 < (~seen).sum() < 8
    assert Report.of(path).coverage == seen.mean()
    scale, P = unit(dense(T)[seen], truth[seen]), unseen_patterns(GRID)
    ours, theirs = scale * (dense(T) @ P)[seen], (truth @ P)[seen]
    errors = np.linalg.norm(ours - theirs, axis=0) / np.linalg.norm(theirs, axis=0)
    assert errors.max() < most, errors
    y, x = np.mgrid[:8, :16] / 16
    desired = 0.25 + 0.1 * np.sin(7 * x + 4 * y)
    pattern = np.asarray(
        ltcl.compensate(T, (desired / scale).astype(np.float32), rtol=1e-3).pattern
    )
    error = (truth @ pattern.ravel().astype(np.float64) - desired.ravel())[seen]
    assert 10 * np.log10(desired.max() ** 2 / np.mean(error**2)) > 30


def test_pixels_that_every_exposure_saturates(tmp_path: Path) -> None:
    """They are masked, counted, and their entries of unknown variance; the others are right."""
    T, path, bright = 0.02 * np.eye(32), tmp_path / "T.zarr", [5, 17, 30]
    T[bright, bright] = 5.0
    camera = VirtualRig(T, (4, 8), exposures=[4.0, 8.0], bits=12, response="linear")
    measured = acquire(camera, geometry="aligned", strategy="pixel", response=LINE, store=path)
    assert np.flatnonzero(measured.masked).tolist() == bright
    np.testing.assert_allclose(np.delete(measured.first_bounce, bright), 0.02, rtol=0.1)
    with pytest.raises(FileError, match=r"first_bounce.* 3 of 32"):
        ltcl.load(path, on_dark="raise")
    report = Report.of(path)
    assert (report.saturated, report.masked, report.coverage) == (3 / 32, 3 / 32, 1.0)
    assert (
        3 / report.entries <= report.unknown < 0.5
    )  # their own, and those of the sums of their batches
    assert report.entries == ltcl.load(path, on_dark="mask").matrices[0].nnz
    assert report.photographs == report.patterns * len(Calibration.of(path).exposures)
