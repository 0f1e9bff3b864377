# SPDX-License-Identifier: BSD-3-Clause
"""A wrong grid of the right size shows in the rows of T, a right one never does; T as an array."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse
from scipy.sparse.linalg import aslinearoperator

import ltcl
from ltcl import scenes
from ltcl.diagnostics import other_grid

random = np.random.default_rng(0)
SCENES = [scenes.box(12, sides=3, albedo=0.7), scenes.box(8), scenes.dihedral(15), scenes.trihedral(12)]


@pytest.mark.parametrize("scene", SCENES, ids=["corner", "closed", "dihedral", "trihedral"])
def test_a_wrong_grid_is_found(scene, caplog):
    """Half and double the width, rows as columns, all in a row; with texture or noise the right one fits."""
    transport = scene.transport()
    (h, w), T = transport.grid, transport.to_numpy()
    for width in {w // 2, 2 * w, h, h * w} - {w}:
        if h * w % width == 0:
            assert other_grid(T, (h * w // width, width)) == (h, w), width
    texture, noise = random.uniform(0.1, 1.0, (h * w, 1)), random.normal(size=T.shape)
    for right in (T, scipy.sparse.csr_array(T), texture * T, T + 0.1 * T.mean() * noise):
        assert other_grid(right, (h, w)) is None
    ltcl.Transport(T, (h, w))
    assert caplog.messages == []
    ltcl.Transport(scipy.sparse.csr_array(T), (w, h))
    assert str((h, w)) in caplog.messages[0]


def test_a_file_that_is_loaded_with_a_wrong_grid_is_warned_of(tmp_path, caplog):
    np.save(tmp_path / "T.npy", scenes.dihedral(16).transport().to_numpy())
    ltcl.load(tmp_path / "T.npy", grid=(16, 32))
    assert caplog.messages == []
    ltcl.load(tmp_path / "T.npy", grid=(8, 64))
    assert "(16, 32)" in caplog.messages[0]


@pytest.mark.parametrize(
    "kind", ["array", "csr", "stored", "operator", "compressed", "colour", "blocks", "wide"]
)
def test_to_numpy_is_T(kind, tmp_path):
    T = scenes.dihedral(4).transport().to_numpy()
    three = [T, 0.5 * T, 0.2 * T]
    dense = {"colour": np.array(three), "blocks": np.array([three] * 3), "wide": T[:16]}.get(kind, T)
    sources = {"csr": scipy.sparse.csr_array(T), "operator": aslinearoperator(T), "blocks": [three] * 3}
    F = np.diag(T) if kind == "operator" else "diagonal"
    built = ltcl.Transport(sources.get(kind, dense), (4, 8), F, (4, 4) if kind == "wide" else None)
    if kind == "compressed":
        built = ltcl.compress(built, rtol=1e-5)
    if kind == "stored":
        ltcl.save(tmp_path / "T.zarr", built)
        built = ltcl.load(tmp_path / "T.zarr")
    np.testing.assert_allclose(built.to_numpy(), dense, rtol=1e-4, atol=1e-5)
