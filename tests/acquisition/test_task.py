# SPDX-License-Identifier: BSD-3-Clause
"""The closed loop: photographs of a known transport in, and the transport out; stopped, resumed, refused."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.acquisition import Calibration, Report, VirtualRig, acquire, camera_map
from ltcl.acquisition.radiometry import Response
from ltcl.errors import AcquisitionError, FileError, InputError, InputTypeError
from ltcl.images import from_srgb
from ltcl.store import BlockStore

from .scanning.helpers import CLEAN, corner, dense, held, off, rig, unit

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


@pytest.mark.parametrize(("response", "bits"), [("srgb", 8), ("film", 12)])
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_patterns_that_no_scan_has_seen(strategy: str, response: str, bits: int) -> None:
    """Curve of the camera, black, ambient light and noise are found from photographs alone."""
    T = acquire(rig(response=response, bits=bits), geometry="aligned", strategy=strategy)
    assert T.grid == GRID
    assert off(dense(T), corner(), GRID) < 0.02


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_compensated_pictures(scanned: Callable[[str], Scanned], strategy: str) -> None:
    """The pattern found with the measured transport, under the true one: 30 dB at least."""
    T, truth = scanned(strategy).T, corner()
    y, x = np.mgrid[:8, :16] / 16
    desired = 0.25 + 0.1 * np.sin(7 * x + 4 * y)
    scale = unit(dense(T), truth)
    pattern = ltcl.compensate(T, (desired / scale).astype(np.float32), rtol=1e-3).pattern
    seen = truth @ np.asarray(pattern, np.float64).ravel()
    error = np.mean((seen - desired.ravel()) ** 2)
    assert 10 * np.log10(desired.max() ** 2 / error) > 30


def entries(path: Path, channel: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """T and the standard deviation of its entries, dense."""
    store = BlockStore.open(path)
    blocks = [store.block(channel, b, "rows") for b in range(store.layout.blocks())]
    T = np.concatenate([block.matrix.toarray() for block in blocks])
    V = [
        scipy.sparse.csr_array((b.variance, b.matrix.indices, b.matrix.indptr), shape=b.matrix.shape)
        for b in blocks
    ]
    return T.astype(np.float64), np.sqrt(np.concatenate([part.toarray() for part in V]).astype(np.float64))


@pytest.mark.parametrize("strategy", ["pixel", "hadamard"])
def test_the_variance_of_an_entry_is_what_it_is(tmp_path: Path, strategy: str) -> None:
    path = tmp_path / "T.zarr"
    made = rig(read=0.004, gain=2000.0, bits=12, response="linear", seed=6)
    line = Response(np.array([[-0.004 / 0.996, 1.0]]))
    acquire(made, geometry="aligned", strategy=strategy, store=path, response=line, sigmas=0.0)
    T, sigma = entries(path)
    ratio = ((T - corner()) / sigma)[sigma > 0]
    assert 0.85 < np.sqrt(np.mean(ratio**2)) < 1.2
    assert np.mean(np.abs(ratio) > 4) < 0.003


def test_blocks_of_pixels_make_a_coarser_transport() -> None:
    T = acquire(rig(**CLEAN), geometry="aligned", strategy="block", block=2, sigmas=0.0)
    cells = np.arange(128).reshape(4, 2, 8, 2).transpose(0, 2, 1, 3).reshape(32, 4)
    truth = np.stack([corner()[:, cell].sum(axis=1) for cell in cells], axis=1)
    truth = np.stack([truth[cell].mean(axis=0) for cell in cells])
    assert T.grid == (4, 8)
    found = dense(T)
    np.testing.assert_allclose(unit(found, truth) * found, truth, atol=2e-3 * truth.max())


def test_cells_cost_less_and_lose_no_light(tmp_path: Path) -> None:
    T = acquire(rig(**CLEAN), geometry="aligned", strategy="adaptive", store=tmp_path / "T.zarr")
    found = dense(T)
    sums, truth = unit(found, corner()) * found.sum(axis=1), corner().sum(axis=1)
    assert np.abs(sums / truth - 1).max() < 0.02
    told = Report.of(tmp_path / "T.zarr")
    assert told.patterns < 128
    assert sum(level["patterns"] for level in told.levels) == told.patterns
    assert [level["level"] for level in told.levels] == [4, 3, 2, 1]


class Dying(VirtualRig):
    """Fails at one of its photographs."""

    def __init__(self, at: int, **options: Any) -> None:
        super().__init__(corner(), GRID, bits=12, ambient=0.01, **options)
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
    """Each run gets a little further; the result is that of a run that was never stopped, to the bit."""
    options: dict[str, Any] = {"geometry": "aligned", "strategy": strategy}
    whole = scanned(strategy).T
    path, failures, T = tmp_path / "T.zarr", [], whole
    for at in (100, 280, 200, 10000):  # in the calibration, in the scan, further on, not at all
        try:
            T = acquire(Dying(at), store=path, **options)
            break
        except AcquisitionError as error:
            failures.append(str(error))
    assert len(failures) >= 2
    assert T is not whole
    assert all("unplugged" in text for text in failures)
    np.testing.assert_array_equal(dense(T), dense(whole))
    BlockStore.open(path).verify()


def test_a_store_that_is_done_needs_no_rig_any_more(scanned: Callable[[str], Scanned]) -> None:
    T, path = scanned("hadamard")
    again = acquire(Dying(1), geometry="aligned", strategy="hadamard", store=path)
    np.testing.assert_array_equal(dense(again), dense(T))
    np.testing.assert_array_equal(dense(ltcl.load(path)), dense(T))
    with pytest.raises(InputError, match="resume is False"):
        acquire(rig(), geometry="aligned", store=path, resume=False)


def test_other_settings_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "T.zarr"
    with pytest.raises(AcquisitionError, match="unplugged"):
        acquire(Dying(300), geometry="aligned", strategy="pixel", store=path)
    for options, part in (
        ({"strategy": "hadamard"}, "strategy is 'hadamard'"),
        ({"sigmas": 2.0}, "sigmas is"),
    ):
        with pytest.raises(InputError, match=part):
            acquire(rig(), geometry="aligned", store=path, **{"strategy": "pixel", **options})
    with pytest.raises(InputError, match=r"rig has \(4, 8\) pixels"):
        acquire(rig(4), geometry="aligned", strategy="pixel", store=path)
    others: list[tuple[dict[str, Any], str]] = [
        ({"response": "film"}, f"rig.response is 'film', but {path} was begun with 'srgb'"),
        ({"black": 0.01}, f"rig.black is 0.01, but {path} was begun with 0.004"),
        ({"read": 0.5}, "rig.read is 0.5, but"),
    ]
    for options, text in others:
        with pytest.raises(InputError, match=re.escape(text)):
            acquire(rig(**options), geometry="aligned", strategy="pixel", store=path)
    with pytest.raises(FileError, match="is still being scanned"):
        Report.of(path)
    assert acquire(rig(seed=5), geometry="aligned", strategy="pixel", store=path).grid == GRID
    with pytest.raises(InputError, match=r"rig\.response is 'film'"):  # finished, too
        acquire(rig(response="film"), geometry="aligned", strategy="pixel", store=path)
    other = tmp_path / "other.zarr"
    ltcl.save(other, ltcl.Transport(np.eye(128), GRID))
    with pytest.raises(InputError, match=r"which ltcl\.acquire did not make"):
        acquire(rig(), geometry="aligned", store=other)
    with pytest.raises(FileError, match="holds no calibration"):
        Calibration.of(other)
    with pytest.raises(FileError, match=r"was not made by ltcl\.acquire"):
        Report.of(other)


@pytest.mark.parametrize(
    ("options", "error", "part"),
    [
        ({"strategy": "spiral"}, InputError, "strategy is 'spiral'"),
        ({"geometry": "stripes"}, InputError, "geometry is 'stripes'"),
        ({"geometry": 3}, InputTypeError, "geometry is a int"),
        ({"order": 64}, InputError, "order is 64"),
        ({"block": 1}, InputError, "block is 1"),
        ({"threshold": 0.0}, InputError, "threshold is 0"),
        ({"frames": 0}, InputError, "frames is 0"),
        ({"resume": "no"}, InputTypeError, "resume is 'no'"),
    ],
)
def test_bad_arguments_are_refused(options: dict[str, Any], error: type[Exception], part: str) -> None:
    with pytest.raises(error, match=part):
        acquire(rig(), **{"geometry": "aligned", "strategy": "pixel", **options})


@pytest.mark.parametrize(
    ("offered", "asked", "part"),
    [
        (None, [0.5, 40.0], "exposures has 40 s; the rig takes 0.0001 to 30 s"),
        (None, [1e-5], "exposures has 1e-05 s"),
        ([0.1, 1.0], [0.1, 0.5], "exposures has 0.5 s; the rig takes 1 s at the nearest"),
    ],
)
def test_exposures_that_the_rig_does_not_have_are_refused(offered: Any, asked: Any, part: str) -> None:
    made = rig(exposures=offered)
    with pytest.raises(InputError, match=part):
        acquire(made, geometry="aligned", strategy="pixel", exposures=asked)


def test_one_exposure_tells_no_response() -> None:
    with pytest.raises(InputError, match="one exposure, which tells no response"):
        acquire(rig(exposures=[0.5]), geometry="aligned", strategy="pixel")
    line = Response(np.array([[-0.004 / 0.996, 1.0]]))
    made = rig(exposures=[0.5], response="linear")
    T = acquire(made, geometry="aligned", strategy="pixel", response=line)
    assert off(dense(T), corner(), GRID) < 0.02


@pytest.mark.parametrize("seed", [0, 1])
def test_colours_keep_their_balance(seed: int) -> None:
    """No scale of its own for any colour: one that the wall hardly reflects has the unit of the others."""
    corner_of_three = ltcl.scenes.dihedral(8, albedo=(0.8, 0.6, 0.4))
    truth, grid = corner_of_three.transport(), corner_of_three.grid
    made = VirtualRig(truth, grid, response="srgb", bits=12, ambient=0.01, seed=seed)
    T = acquire(made, geometry="aligned")
    for p in np.random.default_rng(5).random((3, *grid, 3)):
        ours, theirs = (np.asarray(part @ p).reshape(-1, 3) for part in (T, truth))
        off_by = np.linalg.norm(ours - theirs, axis=0) / np.linalg.norm(theirs, axis=0)
        assert off_by.max() < 0.02


@pytest.mark.parametrize("strategy", ["pixel", "adaptive"])
def test_colours_that_mix(strategy: str) -> None:
    M = np.array([[0.9, 0.15, 0.0], [0.05, 0.8, 0.1], [0.0, 0.2, 0.9]])
    colours = [corner(4, albedo) for albedo in (0.7, 0.5, 0.3)]
    made = VirtualRig(colours, (4, 8), mixing=M, bits=12, ambient=0.01)
    T = acquire(made, geometry="aligned", strategy=strategy)
    rng = np.random.default_rng(0)
    p = rng.random((4, 8, 3))
    seen, wanted = np.asarray(T @ p, np.float64), np.zeros((4, 8, 3))
    for c in range(3):
        wanted[..., c] = (colours[c] @ (p.reshape(-1, 3) @ M[c])).reshape(4, 8)
        scale = np.vdot(seen[..., c], wanted[..., c]) / np.vdot(seen[..., c], seen[..., c])
        difference = np.linalg.norm(scale * seen[..., c] - wanted[..., c])
        assert difference < 0.02 * np.linalg.norm(wanted[..., c])


def askance(u: Any, v: Any) -> tuple[Any, Any]:
    """Three camera pixels to each side of one of 8 x 16, of a picture seen in perspective."""
    a, b = u / 3 - 0.8, v / 3 - 0.6
    d = 1 + 0.008 * a - 0.01 * b
    return (a + 0.1 * b) / d - 0.4, (b - 0.05 * a) / d + 0.3


@pytest.mark.parametrize(
    ("response", "bits", "strategy"),
    [("srgb", 8, "pixel"), ("film", 12, "hadamard"), ("srgb", 8, "adaptive")],
)
def test_a_camera_of_its_own_pixels(tmp_path: Path, response: str, bits: int, strategy: str) -> None:
    """Found by Gray code. It does not see all pixels: these are masked, and the others are right."""
    C, path = camera_map(askance, (27, 50), GRID), tmp_path / "T.zarr"
    made = rig(camera_grid=(27, 50), camera_map=C, response=response, bits=bits)
    T = acquire(made, strategy=strategy, store=path)
    area = np.asarray(C.sum(axis=0))
    seen = ~T.masked
    assert seen[area > 3].all()
    assert not seen[area < 0.3].any()
    assert 0 < (~seen).sum() < 8
    told = Report.of(path)
    assert told.coverage == seen.mean()
    assert told.masked == pytest.approx(1 - seen.mean())
    found, truth = dense(T), corner()
    scale = unit(found[seen], truth[seen])
    P = held(GRID)
    ours, theirs = scale * (found @ P)[seen], (truth @ P)[seen]
    errors = np.linalg.norm(ours - theirs, axis=0) / np.linalg.norm(theirs, axis=0)
    assert errors.max() < 0.02, errors
    _works_downstream(T, truth, seen, scale)


def _works_downstream(T: ltcl.Transport, truth: np.ndarray, seen: np.ndarray, scale: float) -> None:
    """Compensation shows the picture, and bounces sum to it, where the camera sees."""
    y, x = np.mgrid[:8, :16] / 16
    desired = 0.25 + 0.1 * np.sin(7 * x + 4 * y)
    pattern = ltcl.compensate(T, (desired / scale).astype(np.float32), rtol=1e-3).pattern
    assert np.isfinite(pattern).all()
    shown = (truth @ np.asarray(pattern, np.float64).ravel())[seen]
    error = np.mean((shown - desired.ravel()[seen]) ** 2)
    assert 10 * np.log10(desired.max() ** 2 / error) > 30
    image = (truth.sum(axis=1) / scale).reshape(GRID).astype(np.float32)
    found = ltcl.separate(T, image, bounces=3, rtol=1e-4)
    np.testing.assert_allclose((found.direct + found.indirect).ravel()[seen], image.ravel()[seen], rtol=1e-4)
    direct = np.asarray(ltcl.separate(ltcl.Transport(truth, GRID), image, rtol=1e-4).direct)
    assert np.linalg.norm((found.direct - direct).ravel()[seen]) < 0.03 * np.linalg.norm(direct)


class Swapping(VirtualRig):
    """Gives the long exposures for the short ones, from some photograph on."""

    def photograph(self, codes: Any, seconds: float) -> np.ndarray:
        if codes.sum() in (1.0, 2.0) and codes.max() == 1.0:
            seconds = 1.0 / seconds
        return super().photograph(codes, seconds)


def test_exposures_in_the_wrong_order_are_named() -> None:
    made = Swapping(corner(4), (4, 8), bits=12, ambient=0.05)
    with pytest.raises(
        AcquisitionError, match=r"photographs \d+ to \d+: images\[\d\] has .* is not brighter"
    ):
        acquire(made, geometry="aligned", strategy="pixel")


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_progress_is_told(tmp_path: Path, strategy: str) -> None:
    """Of each pattern, to the end, though a scan by cells does not know beforehand how many it takes."""
    told: list[tuple[int, int]] = []
    path = tmp_path / "T.zarr"
    acquire(rig(4), geometry="aligned", strategy=strategy, store=path, progress=lambda *n: told.append(n))
    patterns = BlockStore.open(path).attributes["patterns"]
    done = [one for one, _ in told]
    assert sorted(set(done)) == list(range(patterns + 1))
    assert done == sorted(done)
    assert told[-1] == (patterns, patterns)


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_progress_of_an_earlier_run_counts_at_once(tmp_path: Path, strategy: str) -> None:
    options: dict[str, Any] = {"geometry": "aligned", "strategy": strategy, "store": tmp_path / "T.zarr"}
    whole = Dying(10000)
    acquire(whole, geometry="aligned", strategy=strategy)
    with pytest.raises(AcquisitionError, match="unplugged"):
        acquire(Dying(whole.taken - 3), **options)
    told: list[tuple[int, int]] = []  # patterns, and photographs of this run
    made = Dying(10000)
    acquire(made, **options, progress=lambda done, _: told.append((done, made.taken)))
    store = BlockStore.open(tmp_path / "T.zarr")
    patterns, each = store.attributes["patterns"], len(Calibration.of(store).exposures)
    kept = patterns - made.taken // each
    assert kept > 0
    assert max(done for done, photographs in told if not photographs) == kept
    later = [one for one in told if one[1]]
    wanted = [(done, (done - kept) * each) for done in range(kept + 1, patterns + 1)]
    assert later[: len(wanted)] == wanted
    assert set(later[len(wanted) :]) <= {wanted[-1]}


def test_auto_says_why(tmp_path: Path) -> None:
    path = tmp_path / "T.zarr"
    acquire(rig(), geometry="aligned", store=path)
    told = Report.of(path)
    assert told.strategy in ("pixel", "hadamard")
    assert "a picture T p is off by: pixel" in told.why
    assert told.coverage == 1.0
    light = np.linspace(0.0, 1.0, 9)
    np.testing.assert_allclose(from_srgb(Calibration.of(path).projector.codes(light)), light, atol=0.01)
    assert 0 < told.noise_sum < told.noise_direct < 0.1
    assert told.defect < 0.3
    for line in (told.to_json(), str(told)):
        assert told.strategy in line


def test_a_pixel_that_every_exposure_saturates(tmp_path: Path) -> None:
    """It is not told: masked, its entry of unknown variance; the others are as they are."""
    T = 0.02 * np.eye(32)
    T[5, 5] = 5.0
    made, path = VirtualRig(T, (4, 8), bits=12, response="linear"), tmp_path / "T.zarr"
    line = Response(np.array([[-0.004 / 0.996, 1.0]]))
    given = {"strategy": "pixel", "exposures": [4.0, 8.0], "response": line}
    found = acquire(made, geometry="aligned", store=path, **given)
    assert np.flatnonzero(found.masked).tolist() == [5]
    told = Report.of(path)
    assert told.masked == 1 / 32
    assert told.unknown > 0
    np.testing.assert_allclose(np.delete(found.first_bounce, 5), 0.02, rtol=0.1)


def test_what_a_report_does_not_know_is_null() -> None:
    part: dict[str, Any] = {"coverage": 1.0, "masked": 0.0, "saturated": 0.0, "entries": 9, "unknown": 0.0}
    part |= {"doubtful": 0.0, "sharpness": float("nan"), "blur": float("nan")}
    told = Report(
        "pixel", "as asked for", (4, 8), 1, 36, 72, [0.1, 2.0], **part, noise_direct=0.01, noise_sum=0.02,
        beside_white=float("nan"), defect=float("nan"),
        levels=[{"level": 1, "cells": 2, "entries": 8, "colours": 2, "patterns": 8}],
    )  # fmt: skip
    assert json.loads(told.to_json())["defect"] is None
    assert "reciprocity not told" in str(told)
    assert "in 2 group(s) without conflict" in str(told)
