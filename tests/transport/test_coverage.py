# SPDX-License-Identifier: BSD-3-Clause
"""Camera pixels that no projector pixel lights, and what they are to compensation."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import scipy.sparse.linalg

import ltcl

random = np.random.default_rng(7)
PROJECTOR = (8, 16)
CAMERA = (12, 20)
LIT = np.zeros(CAMERA, bool)
LIT[2:10, 2:18] = True
NARROW = ltcl.scenes.dihedral(8, albedo=0.7).transport().to_numpy().astype(np.float64)


def bordered() -> np.ndarray:
    """T of a camera that sees two rows and columns of unlit wall around the picture."""
    T = np.zeros((LIT.size, NARROW.shape[1]))
    T[LIT.ravel()] = NARROW
    return T


def noise(level: float) -> np.ndarray:
    return level * NARROW.diagonal().mean() * random.standard_normal((LIT.size, NARROW.shape[1]))


def dark_frame(level: float) -> np.ndarray:
    return level * NARROW.diagonal().mean() * random.standard_normal((LIT.size, 1))


KINDS: dict[str, Callable[[], Any]] = {
    "zeros": bordered,
    "sparse": lambda: scipy.sparse.csr_array(bordered()),
    "operator": lambda: scipy.sparse.linalg.aslinearoperator(bordered()),
    "noise of 1e-4": lambda: bordered() + noise(1e-4),
    "noise of 1e-3": lambda: bordered() + noise(1e-3),
    "dark frame": lambda: bordered() + noise(1e-4) + dark_frame(1e-4),
    "colour": lambda: [bordered(), 0.5 * bordered(), 0.2 * bordered()],
    "blocks": lambda: [[bordered() * (0.1 + (c == d)) for d in range(3)] for c in range(3)],
}


@pytest.mark.parametrize("kind", KINDS)
def test_unlit_camera_pixels_do_not_bend_the_gain(device, kind):
    T = ltcl.Transport(KINDS[kind](), PROJECTOR, camera_grid=CAMERA, device=device)
    np.testing.assert_array_equal(T.unlit.reshape(CAMERA), ~LIT)
    shape = CAMERA if T.channels == 1 else (*CAMERA, 3)
    desired = np.full(shape, 0.3)
    by_default = ltcl.compensate(T, desired, gain="auto")
    weights = np.broadcast_to(LIT if T.channels == 1 else LIT[..., None], shape)
    weighted = ltcl.compensate(T, desired, gain="auto", weights=weights.astype(float))
    assert by_default.gain == pytest.approx(weighted.gain, rel=1e-6)
    assert by_default.error == pytest.approx(weighted.error, rel=1e-3)


@pytest.mark.parametrize(
    "matrix",
    [
        random.standard_normal((60, 40)),
        np.zeros((60, 40)),
        random.uniform(0.0, 1.0, (60, 40)),
    ],
)
def test_pixels_of_other_matrices_count(device, matrix):
    """Entries below 0 are no light, and without any light nothing is unlit."""
    T = ltcl.Transport(matrix, (5, 8), camera_grid=(6, 10), device=device)
    assert not T.unlit.any()


def test_a_store_costs_no_more_than_a_file_at_each_frame(device, tmp_path: Path):
    """Norms of columns are found once, and are those of the same numbers in memory."""
    T = ltcl.Transport(
        [NARROW, NARROW, NARROW], PROJECTOR, mixing=0.9 * np.eye(3) + 0.05, device=device
    )
    ltcl.save(tmp_path / "T.zarr", T)
    stored = ltcl.load(tmp_path / "T.zarr", device=device)
    np.testing.assert_allclose(stored.column_norms, T.column_norms, rtol=1e-6)
    desired = np.full((*PROJECTOR, 3), 0.1)
    ltcl.compensate(stored, desired)
    launches = []
    for transport in (stored, T):
        ltcl.compensate(transport, desired)
        before = device.launches.total()
        ltcl.compensate(transport, desired)
        launches.append(device.launches.total() - before)
    assert launches[0] <= launches[1]
