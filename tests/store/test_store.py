# SPDX-License-Identifier: BSD-3-Clause
"""`load` and `save` of whole transports."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl import store
from ltcl.errors import FileError, InputTypeError
from ltcl.transport import Transport
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
    store.save(tmp_path / "T.npz", Transport(matrix, grid=(3, 4), on_dark="mask"))
    with pytest.raises(FileError, match=r"T\.npz: first_bounce is zero or negative at 1 of 12"):
        store.load(tmp_path / "T.npz")
    assert np.flatnonzero(store.load(tmp_path / "T.npz", on_dark="mask").masked).tolist() == [3]
    np.save(tmp_path / "T.npy", np.where(matrix == 0, np.nan, matrix))
    with pytest.raises(FileError, match=r"T\.npy: matrix has 1 NaN"):
        store.load(tmp_path / "T.npy", grid=(3, 4))


def test_the_grid_given_is_preferred_if_it_fits(tmp_path):
    store.save(tmp_path / "T.npz", Transport(dense(), grid=(3, 4)))
    assert store.load(tmp_path / "T.npz", grid=(2, 6), camera_grid=(1, 12)).grid == (2, 6)
    with pytest.raises(FileError, match=r"T\.npz: grid is 5 x 5 = 25 pixels; .* must be 12"):
        store.load(tmp_path / "T.npz", grid=(5, 5))


def test_a_missing_grid_is_asked_for(tmp_path):
    np.save(tmp_path / "T.npy", dense())
    with pytest.raises(FileError, match=r"12 projector pixels; give grid=\(h, w\)$"):
        store.load(tmp_path / "T.npy")
    np.save(tmp_path / "T.npy", dense(16, 9))
    with pytest.raises(FileError, match=r"give grid=\(h, w\), perhaps grid=\(3, 3\)"):
        store.load(tmp_path / "T.npy")
    with pytest.raises(FileError, match=r"16 camera pixels; give camera_grid"):
        store.load(tmp_path / "T.npy", grid=(3, 3))
    assert store.load(tmp_path / "T.npy", grid=(3, 3), camera_grid=(2, 8)).camera_grid == (2, 8)


def test_first_bounce_is_the_callers_then_the_files_then_the_diagonal(tmp_path):
    np.savez(tmp_path / "T.npz", T=dense(), grid=[3, 4], first_bounce=np.full(12, 2.0))
    assert store.load(tmp_path / "T.npz").first_bounce.tolist() == [2.0] * 12
    assert store.load(tmp_path / "T.npz", first_bounce=np.ones(12)).first_bounce.tolist() == [1.0] * 12
    diagonal = store.load(tmp_path / "T.npz", first_bounce="diagonal").first_bounce
    np.testing.assert_array_equal(diagonal, dense().diagonal())
    np.savez(tmp_path / "T.npz", T=dense(), grid=[3, 4])
    np.testing.assert_array_equal(store.load(tmp_path / "T.npz").first_bounce, dense().diagonal())


def test_what_cannot_be_saved(tmp_path):
    operator = scipy.sparse.linalg.aslinearoperator(dense())
    for T, text in (
        (Transport(operator, grid=(3, 4), first_bounce=np.ones(12)), "only arrays, sparse matrices"),
        (Transport([[dense(seed=c + d) for d in range(3)] for c in range(3)], grid=(3, 4)), "3 x 3 blocks"),
        (dense(), "T is a ndarray"),
    ):
        with pytest.raises(InputTypeError, match=text):
            store.save(tmp_path / "T.npz", T)  # pyright: ignore[reportArgumentType]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("none.npz", "no such file"),
        ("empty.npz", "is empty"),
        ("folder.npz", "is a folder"),
        ("T.xyz", r"extension \.xyz .* \.npz, \.npy, \.mtx"),
        ("T", "has no extension"),
    ],
)
def test_paths_that_lead_nowhere(tmp_path, name, text):
    (tmp_path / "empty.npz").touch()
    (tmp_path / "folder.npz").mkdir()
    with pytest.raises(FileError, match=f"{name}: .*{text}"):
        store.load(tmp_path / name)


def test_paths_that_are_none(tmp_path):
    T = Transport(dense(), grid=(3, 4))
    for work in (store.load, store.BlockStore.open, lambda path: store.save(path, T)):
        with pytest.raises(FileError, match=r"a\x00b\.zarr"):
            work("a\0b.zarr")
        with pytest.raises(FileError, match="path is ''"):
            work("")
        with pytest.raises(InputTypeError, match="path is 3"):
            work(3)  # pyright: ignore[reportArgumentType]
    with pytest.raises(FileError, match=r"\.xyz"):
        store.save(tmp_path / "T.xyz", T)


def test_a_failed_save_leaves_the_earlier_file(tmp_path, monkeypatch):
    path = tmp_path / "T.npz"
    store.save(path, Transport(dense(), grid=(3, 4)))
    before = path.read_bytes()

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("numpy.lib.format.write_array", full)
    with pytest.raises(FileError, match=r"T\.npz: .*No space left"):
        store.save(path, Transport(2 * dense(), grid=(3, 4)))
    assert [p.name for p in tmp_path.iterdir()] == ["T.npz"]
    assert path.read_bytes() == before
