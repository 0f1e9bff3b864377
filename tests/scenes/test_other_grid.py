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
SCENES = {
    "corner": (scenes.box, {"n": 12, "sides": 3, "albedo": 0.7}),
    "closed": (scenes.box, {"n": 8}),
    "dihedral": (scenes.dihedral, {"n": 16}),
    "odd": (scenes.dihedral, {"n": 15}),
    "trihedral": (scenes.trihedral, {"n": 12}),
}


@pytest.mark.parametrize("form", [np.asarray, scipy.sparse.csr_array])
@pytest.mark.parametrize("name", SCENES)
def test_a_wrong_grid_is_found(name, form, caplog):
    """Half and double the width, rows as columns, all in a row; with texture or noise the right one fits."""
    build, options = SCENES[name]
    transport = build(**options).transport()
    (h, w), T = transport.grid, transport.to_numpy()
    for width in (w // 2, 2 * w, h, h * w):
        if h * w % width == 0:
            assert other_grid(form(T), (h * w // width, width)) == (h, w), width
    texture, noise = random.uniform(0.1, 1.0, (h * w, 1)), random.normal(size=T.shape)
    for right in (T, texture * T, T + 0.1 * T.mean() * noise):
        assert other_grid(form(right), (h, w)) is None
    ltcl.Transport(form(T), (h, w))
    assert caplog.messages == []
    ltcl.Transport(form(T), (w, h))
    assert str((h, w)) in caplog.messages[0]


def test_a_file_that_is_loaded_with_a_wrong_grid_is_warned_of(tmp_path, caplog):
    np.save(tmp_path / "T.npy", scenes.dihedral(16).transport().to_numpy())
    ltcl.load(tmp_path / "T.npy", grid=(16, 32))
    assert caplog.messages == []
    ltcl.load(tmp_path / "T.npy", grid=(8, 64))
    assert "(16, 32)" in caplog.messages[0]


@pytest.mark.parametrize("grid", [(1, 256), (256, 1), (16, 16), (4, 64), (1, 1)])
def test_without_smooth_rows_any_grid_fits(grid):
    n = grid[0] * grid[1]
    one, x = np.eye(n), np.arange(n) / n
    for T in (one, one + random.random((n, n)), one + 1e-3, np.diag(random.random(n)) + 1e-3, 0 * one):
        assert other_grid(T, grid) is None
    if 1 in grid:  # a projector of one row
        assert other_grid(one + np.exp(-(((x[:, None] - x) / 0.1) ** 2)), grid) is None


@pytest.mark.parametrize(
    "kind", ["array", "csr", "stored", "operator", "compressed", "colour", "blocks", "wide"]
)
def test_to_numpy_is_T(kind, tmp_path):
    T = scenes.dihedral(4).transport().to_numpy()
    three = [T, 0.5 * T, 0.2 * T]
    dense = {"colour": np.array(three), "blocks": np.array([three] * 3), "wide": T[:16]}.get(kind, T)
    given = {"csr": scipy.sparse.csr_array(T), "operator": aslinearoperator(T), "blocks": [three] * 3}
    F = np.diag(T) if kind == "operator" else "diagonal"
    built = ltcl.Transport(given.get(kind, dense), (4, 8), F, (4, 4) if kind == "wide" else None)
    if kind == "compressed":
        built = ltcl.compress(built, rtol=1e-5)
    if kind == "stored":
        ltcl.save(tmp_path / "T.zarr", built)
        built = ltcl.load(tmp_path / "T.zarr")
    np.testing.assert_allclose(built.to_numpy(), dense, rtol=1e-4, atol=1e-5)
