# SPDX-License-Identifier: BSD-3-Clause
"""`load` and `save` of whole transports."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl import store
from ltcl.errors import FileError, InputTypeError
from ltcl.store import formats
from ltcl.transport.transport import Transport
from tests.store.stores import dense

COLOUR = [dense(seed=seed) for seed in range(3)]
MIXING = np.array([[1.0, 0.2, 0.0], [0.1, 0.9, 0.0], [0.0, -0.1, 0.8]])


def test_npz_keeps_how_colours_mix(tmp_path):
    T = Transport(COLOUR, grid=(3, 4), mixing=MIXING)
    for suffix in (".npy", ".mtx"):
        with pytest.raises(FileError, match=f"T{suffix}: {suffix} .* colours mix"):
            store.save(tmp_path / f"T{suffix}", T)
    assert not list(tmp_path.iterdir())
    store.save(tmp_path / "T.npz", T)
    np.testing.assert_array_equal(store.load(tmp_path / "T.npz").mixing, MIXING)
    np.testing.assert_array_equal(store.load(tmp_path / "T.npz").to_numpy(), COLOUR)


def test_masked_pixels_stay_masked(tmp_path):
    matrix = dense()
    matrix[3, 3] = 0
    store.save(tmp_path / "T.npz", Transport(matrix, grid=(3, 4)))
    with pytest.raises(FileError, match=r"T\.npz: first_bounce .* 1 of 12"):
        store.load(tmp_path / "T.npz", on_dark="raise")
    assert np.flatnonzero(store.load(tmp_path / "T.npz").masked).tolist() == [3]


def test_the_callers_grid_is_preferred_if_it_fits(tmp_path):
    store.save(tmp_path / "T.npz", Transport(dense(), grid=(3, 4)))
    assert store.load(tmp_path / "T.npz", grid=(2, 6), camera_grid=(1, 12)).grid == (2, 6)
    with pytest.raises(FileError, match=r"T\.npz: grid is 5 x 5.* 12"):
        store.load(tmp_path / "T.npz", grid=(5, 5))


@pytest.mark.parametrize(
    ("shape", "grids", "text"),
    [
        ((12, 12), {}, r"12 projector pixels; give grid=\(h, w\)$"),
        ((16, 9), {}, r"give grid=\(h, w\), perhaps grid=\(3, 3\)"),
        ((16, 9), {"grid": (3, 3)}, r"16 camera pixels; give camera_grid"),
    ],
)
def test_a_missing_grid_is_asked_for(tmp_path, shape, grids, text):
    np.save(tmp_path / "T.npy", dense(*shape))
    with pytest.raises(FileError, match=text):
        store.load(tmp_path / "T.npy", **grids)
    T = store.load(tmp_path / "T.npy", grid=(3, shape[1] // 3), camera_grid=(2, shape[0] // 2))
    assert T.camera_grid == (2, shape[0] // 2)


def test_first_bounce_is_the_callers_then_the_files_then_the_diagonal(tmp_path):
    diagonal = dense().diagonal().tolist()
    twos = [2.0] * 12
    np.savez(tmp_path / "T.npz", T=dense(), grid=[3, 4], first_bounce=twos)
    np.savez(tmp_path / "plain.npz", T=dense(), grid=[3, 4])
    for name, F, expected in (
        ("T", None, twos),
        ("T", np.ones(12), [1.0] * 12),
        ("T", "diagonal", diagonal),
        ("plain", None, diagonal),
    ):
        assert (
            store.load(tmp_path / f"{name}.npz", first_bounce=F).first_bounce.tolist() == expected
        )


def test_what_cannot_be_saved(tmp_path):
    operator = scipy.sparse.linalg.aslinearoperator(dense())
    for T, text in (
        (
            Transport(operator, grid=(3, 4), first_bounce=np.ones(12)),
            "only arrays, sparse matrices",
        ),
        (
            Transport([[dense(seed=c + d) for d in range(3)] for c in range(3)], grid=(3, 4)),
            "3 x 3 blocks",
        ),
        (dense(), "T is a ndarray"),
    ):
        with pytest.raises(InputTypeError, match=text):
            store.save(tmp_path / "T.npz", T)  # pyright: ignore[reportArgumentType]
    assert list(tmp_path.iterdir()) == []


def test_paths_that_lead_nowhere(tmp_path):
    (tmp_path / "empty.npz").touch()
    (tmp_path / "folder.npz").mkdir()
    T = Transport(dense(), grid=(3, 4))
    for name in ("none.npz", "empty.npz", "folder.npz", r"T.xyz", "T"):
        with pytest.raises(
            FileError, match=f"{name}: .*(no such|empty|folder|xyz|has no extension)"
        ):
            store.load(tmp_path / name)
    for work in (store.load, store.BlockStore.open, lambda path: store.save(path, T)):
        for path, text in (("a\0b.zarr", r"a\\x00b\.zarr"), ("", "path is ''"), (3, "path is 3")):
            with pytest.raises((FileError, InputTypeError), match=text):
                work(path)  # pyright: ignore[reportArgumentType]
    with pytest.raises(FileError, match=r"\.xyz"):
        store.save(tmp_path / "T.xyz", T)


def test_a_store_whose_every_entry_is_known_is_dense_elsewhere(tmp_path):
    """A full store becomes an array: it can be written as .npy; its first bounce can be exact."""
    T = np.random.default_rng(0).uniform(0.1, 0.2, (3, 6, 6)) + np.eye(6)
    store.save(tmp_path / "T.zarr", Transport(T, (2, 3)))
    exact = store.load(tmp_path / "T.zarr", first_bounce="exact")
    np.testing.assert_allclose(
        exact.first_bounce, [1 / np.diag(np.linalg.inv(M)) for M in T], rtol=1e-6
    )
    formats.write(tmp_path / "T.npy", formats.read(tmp_path / "T.zarr"))
    np.testing.assert_array_equal(np.load(tmp_path / "T.npy"), T)
