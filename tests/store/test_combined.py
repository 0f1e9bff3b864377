# SPDX-License-Identifier: BSD-3-Clause
"""Files of several projectors."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.errors import FileError
from tests.transport import projectors
from tests.transport.projectors import ALBEDO, CAMERA, LEFT, RIGHT

random = np.random.default_rng(9)


@pytest.fixture(scope="module")
def S():
    return projectors.corner()


def members(device, S, form, channels=1):
    made = []
    for projector in (LEFT, RIGHT):
        matrix = form((S @ projector.direct()).astype(np.float32))
        matrices = matrix if channels == 1 else [matrix] * 3
        made.append(ltcl.Transport(matrices, projector.grid, camera_grid=CAMERA, device=device))
    return made


def is_alike(T: ltcl.CombinedTransport, twin: ltcl.Transport) -> None:
    assert isinstance(twin, ltcl.CombinedTransport)
    assert twin.ceilings is not None
    assert T.ceilings is not None
    pattern = random.random(T.grid)
    np.testing.assert_allclose(twin @ pattern, T @ pattern, rtol=1e-6)
    np.testing.assert_allclose(twin.ceilings, T.ceilings)
    np.testing.assert_allclose(twin.black_level, T.black_level)
    assert (twin.balance, twin.black, twin.channels) == (T.balance, T.black, T.channels)


@pytest.mark.parametrize("form", [np.asarray, scipy.sparse.csr_array])
@pytest.mark.parametrize("channels", [1, 3])
def test_round_trip(tmp_path, device, S, form, channels):
    T = ltcl.combine(members(device, S, form, channels), balance=0.3)
    path = tmp_path / "two.npz"
    ltcl.save(path, T)
    is_alike(T, ltcl.load(path))


def test_weights_and_blacks(tmp_path, device, S):
    made = members(device, S, np.asarray)
    blend = [random.random(T.grid) for T in made]
    blacks = [0.01 * random.random(CAMERA), np.full(CAMERA, 0.02)]
    T = ltcl.combine(made, blend=blend, blacks=blacks, black="uniform")
    path = tmp_path / "two.npz"
    ltcl.save(path, T)
    is_alike(T, ltcl.load(path))


def test_scene(tmp_path, device, S):
    scene = ltcl.Transport((ALBEDO * S).astype(np.float32), CAMERA, device=device)
    direct = []
    for projector in (LEFT, RIGHT):
        matrix = scipy.sparse.csr_array(projector.direct())
        direct.append(ltcl.Transport(matrix, projector.grid, camera_grid=CAMERA, device=device))
    T = ltcl.combine(direct, scene=scene)
    path = tmp_path / "two.npz"
    ltcl.save(path, T)
    is_alike(T, ltcl.load(path))


def test_refusals(tmp_path, device, S):
    T = ltcl.combine(members(device, S, np.asarray))
    with pytest.raises(FileError, match="several projectors"):
        ltcl.save(tmp_path / "two.mat", T)
    path = tmp_path / "two.npz"
    ltcl.save(path, T)
    with pytest.raises(FileError, match="grid is"):
        ltcl.load(path, grid=(2, 2))
    with pytest.raises(FileError, match="first_bounce belongs"):
        ltcl.load(path, first_bounce="exact")
    with np.load(path) as archive:
        arrays = dict(archive)
    for name in ("balance", "projector_0.camera_grid", "projector_1.T"):
        damaged = {key: value for key, value in arrays.items() if key != name}
        np.savez(tmp_path / "damaged.npz", **damaged)
        with pytest.raises(FileError):
            ltcl.load(tmp_path / "damaged.npz")
