# SPDX-License-Identifier: BSD-3-Clause
"""The closed loop: photographs of a known transport in, and the transport out; stopped, resumed, refused."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.acquisition import Calibration, Report, VirtualRig, acquire, camera_map
from ltcl.errors import AcquisitionError, FileError, InputError
from ltcl.images import from_srgb
from ltcl.store import BlockStore

from .scanning.helpers import CLEAN, corner, dense, held, off, rig, unit
from .stopping import LINE
from .test_calibrate import askance

GRID = (8, 16)
STRATEGIES = ("pixel", "hadamard", "adaptive")


class Scanned(NamedTuple):
    """Of `rig()`, which nobody stopped."""

    T: ltcl.Transport
    path: Path


@pytest.fixture(scope="module")
def scanned(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Scanned]:
    """The scan of each strategy, made once."""

    @cache
    def made(strategy: str) -> Scanned:
        path = tmp_path_factory.mktemp(strategy) / "T.zarr"
        return Scanned(acquire(rig(), geometry="aligned", strategy=strategy, store=path), path)

    return made


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_patterns_that_no_scan_has_seen(strategy: str) -> None:
    """Curve of the camera, black, ambient light and noise are measured from photographs alone."""
    T = acquire(rig(response="film", bits=8), geometry="aligned", strategy=strategy)
    assert T.grid == GRID
    assert off(dense(T), corner(), GRID) < 0.02


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_compensated_pictures(scanned: Callable[[str], Scanned], strategy: str) -> None:
    """The pattern for the measured transport, under the true one: 30 dB at least."""
    T, truth = scanned(strategy).T, corner()
    assert decibels(T, truth, unit(dense(T), truth), ~T.masked) > 30


def decibels(T: ltcl.Transport, truth: np.ndarray, scale: float, seen: np.ndarray) -> float:
    """Peak signal over noise of a compensated picture at the pixels that are seen."""
    y, x = np.mgrid[:8, :16] / 16
    desired = 0.25 + 0.1 * np.sin(7 * x + 4 * y)
    pattern = np.asarray(ltcl.compensate(T, (desired / scale).astype(np.float32), rtol=1e-3).pattern)
    error = (truth @ pattern.ravel().astype(np.float64) - desired.ravel())[seen]
    return float(10 * np.log10(desired.max() ** 2 / np.mean(error**2)))


@pytest.mark.parametrize("strategy", ["pixel", "hadamard"])
def test_the_variance_of_an_entry_is_that_of_its_error(tmp_path: Path, strategy: str) -> None:
    made = rig(read=0.004, gain=2000.0, bits=12, response="linear", seed=6)
    path = tmp_path / "T.zarr"
    acquire(made, geometry="aligned", strategy=strategy, store=path, response=LINE, sigmas=0.0)
    store = BlockStore.open(path)
    blocks = [store.block(0, number, "rows") for number in range(store.layout.blocks())]
    T = np.concatenate([block.matrix.toarray() for block in blocks]).astype(np.float64)
    V = [
        scipy.sparse.csr_array((b.variance, b.matrix.indices, b.matrix.indptr), b.matrix.shape)
        for b in blocks
    ]
    sigma = np.sqrt(np.concatenate([part.toarray() for part in V]).astype(np.float64))
    ratio = ((T - corner()) / sigma)[sigma > 0]
    assert 0.85 < np.sqrt(np.mean(ratio**2)) < 1.2
    assert np.mean(np.abs(ratio) > 4) < 0.003


def test_blocks_of_pixels_make_a_coarser_transport() -> None:
    T = acquire(rig(**CLEAN), geometry="aligned", strategy="block", block=2, sigmas=0.0)
    cells = np.arange(128).reshape(4, 2, 8, 2).transpose(0, 2, 1, 3).reshape(32, 4)
    truth = np.stack([corner()[:, cell].sum(axis=1) for cell in cells], axis=1)
    truth = np.stack([truth[cell].mean(axis=0) for cell in cells])
    assert T.grid == (4, 8)
    np.testing.assert_allclose(unit(dense(T), truth) * dense(T), truth, atol=2e-3 * truth.max())


def test_cells_cost_less_and_lose_no_light(tmp_path: Path) -> None:
    T = acquire(rig(**CLEAN), geometry="aligned", strategy="adaptive", store=tmp_path / "T.zarr")
    sums, truth = dense(T).sum(axis=1), corner().sum(axis=1)
    assert np.abs(unit(dense(T), corner()) * sums / truth - 1).max() < 0.02
    assert Report.of(tmp_path / "T.zarr").patterns < 128


class Dying(VirtualRig):
    """Fails at one of its photographs."""

    def __init__(self, at: int = 10**6, **options: Any) -> None:
        super().__init__(corner(), GRID, **{"bits": 12, "ambient": 0.01, **options})
        self._at, self.taken = at, 0

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        self.taken += 1
        if self.taken == self._at:
            raise OSError("unplugged")
        return super().photograph(codes, seconds)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_a_rig_that_fails_again_and_again(
    tmp_path: Path, scanned: Callable[[str], Scanned], strategy: str
) -> None:
    """Each run gets further; the result is that of a run that was never stopped, to the bit."""
    options: dict[str, Any] = {"geometry": "aligned", "strategy": strategy, "store": tmp_path / "T.zarr"}
    for at in (60, 230, 150):  # in the calibration, in the scan, further on
        with pytest.raises(AcquisitionError, match="unplugged"):
            acquire(Dying(at), **options)
    np.testing.assert_array_equal(dense(acquire(Dying(), **options)), dense(scanned(strategy).T))
    BlockStore.open(options["store"]).verify()


def test_a_store_that_is_done_needs_no_rig_any_more(scanned: Callable[[str], Scanned]) -> None:
    T, path = scanned("hadamard")
    again = acquire(Dying(1), geometry="aligned", strategy="hadamard", store=path)
    np.testing.assert_array_equal(dense(again), dense(T))
    np.testing.assert_array_equal(dense(ltcl.load(path)), dense(T))
    with pytest.raises(InputError, match="resume is False"):
        acquire(rig(), geometry="aligned", store=path, resume=False)


def test_other_settings_and_rigs_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "T.zarr"
    given: dict[str, Any] = {"geometry": "aligned", "strategy": "pixel", "store": path}
    with pytest.raises(AcquisitionError, match="unplugged"):
        acquire(Dying(300), **given)
    for made, change, part in (
        (rig(), {"strategy": "hadamard"}, "strategy is 'hadamard'.*'pixel'"),
        (rig(), {"sigmas": 2.0}, "sigmas is 2.0.*3.0"),
        (rig(4), {}, r"\(4, 8\).*\(8, 16\)"),
        (rig(response="film"), {}, "rig.response is 'film'.*'srgb'"),
        (rig(black=0.01), {}, "rig.black is 0.01.*0.004"),
    ):
        with pytest.raises(InputError, match=part):
            acquire(made, **{**given, **change})
    with pytest.raises(FileError, match="scan"):
        Report.of(path)
    acquire(rig(seed=5), **given)
    with pytest.raises(InputError, match=r"rig\.response is 'film'"):  # finished, too
        acquire(rig(response="film"), **given)
    other = tmp_path / "other.zarr"
    ltcl.save(other, ltcl.Transport(np.eye(128), GRID))
    with pytest.raises(InputError, match=r"ltcl\.acquire did not make"):
        acquire(rig(), **{**given, "store": other})
    for read in (Calibration.of, Report.of):
        with pytest.raises(FileError, match=r"ltcl\.acquire"):
            read(other)


def test_one_exposure_determines_no_response() -> None:
    with pytest.raises(InputError, match=r"one exposure.*response="):
        acquire(rig(exposures=[0.5]), geometry="aligned", strategy="pixel")
    made = rig(exposures=[0.5], response="linear")
    T = acquire(made, geometry="aligned", strategy="pixel", response=LINE)
    assert off(dense(T), corner(), GRID) < 0.03  # with one exposure, as much noise again


@pytest.mark.parametrize("strategy", ["pixel", "adaptive"])
def test_colours_that_mix(strategy: str) -> None:
    """Each colour within 2 %, in one unit."""
    M = np.array([[0.9, 0.15, 0.0], [0.05, 0.8, 0.1], [0.0, 0.2, 0.9]])
    colours = [corner(4, albedo) for albedo in (0.7, 0.5, 0.3)]
    made = VirtualRig(colours, (4, 8), mixing=M, bits=12, ambient=0.01)
    T = acquire(made, geometry="aligned", strategy=strategy)
    p = np.random.default_rng(0).random((4, 8, 3))
    seen = np.asarray(T @ p, np.float64).reshape(-1, 3)
    theirs = np.stack([T_c @ (p.reshape(-1, 3) @ M[c]) for c, T_c in enumerate(colours)], axis=-1)
    scales = np.sum(seen * theirs, axis=0) / np.sum(seen**2, axis=0)
    difference = np.linalg.norm(scales * seen - theirs, axis=0)
    assert (difference < 0.02 * np.linalg.norm(theirs, axis=0)).all()


@pytest.mark.parametrize(
    ("response", "bits", "strategy"), [("film", 12, "hadamard"), ("srgb", 8, "adaptive")]
)
def test_a_camera_of_its_own_pixels(tmp_path: Path, response: str, bits: int, strategy: str) -> None:
    """Decoded by Gray code. It does not see all pixels: these are masked, and the others are right."""
    C, path = camera_map(askance, (27, 50), GRID), tmp_path / "T.zarr"
    made = rig(camera_grid=(27, 50), camera_map=C, response=response, bits=bits)
    T = acquire(made, strategy=strategy, store=path)
    area, seen, truth = np.asarray(C.sum(axis=0)), ~T.masked, corner()
    assert seen[area > 3].all()
    assert not seen[area < 0.3].any()
    assert 0 < (~seen).sum() < 8
    assert Report.of(path).coverage == seen.mean()
    scale, P = unit(dense(T)[seen], truth[seen]), held(GRID)
    ours, theirs = scale * (dense(T) @ P)[seen], (truth @ P)[seen]
    errors = np.linalg.norm(ours - theirs, axis=0) / np.linalg.norm(theirs, axis=0)
    assert errors.max() < 0.02, errors
    assert decibels(T, truth, scale, seen) > 30
    image = (truth.sum(axis=1) / scale).reshape(GRID).astype(np.float32)
    bounces = ltcl.separate(T, image, bounces=3, rtol=1e-4)
    direct = np.asarray(ltcl.separate(ltcl.Transport(truth, GRID), image, rtol=1e-4).direct)
    assert np.linalg.norm((bounces.direct - direct).ravel()[seen]) < 0.03 * np.linalg.norm(direct)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_progress(tmp_path: Path, strategy: str) -> None:
    """Of the calibration and of each pattern to the end; what an earlier run photographed counts at once."""
    steps: list[tuple[str, int, int, int]] = []
    options: dict[str, Any] = {"geometry": "aligned", "strategy": strategy, "store": tmp_path / "T.zarr"}

    def watched(made: Dying) -> ltcl.Transport:
        steps.clear()
        return acquire(made, progress=lambda *step: steps.append((*step, made.taken)), **options)

    with pytest.raises(AcquisitionError, match="unplugged"):
        watched(Dying(200))
    calibrated = max(taken for step, _, _, taken in steps if step == "calibration")
    assert [done for step, done, *_ in steps if step == "calibration"] == [
        *range(1, calibrated + 1),
        calibrated,
    ]
    assert all(done <= total for _, done, total, _ in steps)
    earlier = len(BlockStore.open(options["store"]).written)
    watched(Dying())
    patterns = BlockStore.open(options["store"]).attributes["patterns"]
    assert {step for step, *_ in steps} == {"scan"}
    done = [done for _, done, *_ in steps]
    assert done == sorted(done)
    assert steps[-1][1:3] == (patterns, patterns)
    assert (max(done for _, done, _, taken in steps if taken == 0) > 0) == (earlier > 0)


def test_auto_says_why(tmp_path: Path) -> None:
    path = tmp_path / "T.zarr"
    acquire(rig(), geometry="aligned", store=path)
    report = Report.of(path)
    assert report.strategy in ("pixel", "hadamard")
    assert "T p" in report.why
    light = np.linspace(0.0, 1.0, 9)
    np.testing.assert_allclose(from_srgb(Calibration.of(path).projector.codes(light)), light, atol=0.01)


def test_a_pixel_that_every_exposure_saturates(tmp_path: Path) -> None:
    """It is masked, its entry of unknown variance; the others are right."""
    T = 0.02 * np.eye(32)
    T[5, 5] = 5.0
    made, path = VirtualRig(T, (4, 8), bits=12, response="linear"), tmp_path / "T.zarr"
    given: dict[str, Any] = {"strategy": "pixel", "exposures": [4.0, 8.0], "response": LINE}
    measured = acquire(made, geometry="aligned", store=path, **given)
    assert np.flatnonzero(measured.masked).tolist() == [5]
    assert Report.of(path).masked == 1 / 32
    np.testing.assert_allclose(np.delete(measured.first_bounce, 5), 0.02, rtol=0.1)
    with pytest.raises(FileError, match=r"first_bounce.* 1 of 32"):
        ltcl.load(path)
