# SPDX-License-Identifier: BSD-3-Clause
"""`load` and `save` of whole transports."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse

from ltcl import store
from ltcl.errors import FileError, InputTypeError
from ltcl.transport import Transport
from tests.store.helpers import dense, same_matrix, sparse

COLOUR = [dense(seed=seed) for seed in range(3)]


@pytest.mark.parametrize("bounce", ["diagonal", "exact", np.arange(1.0, 13)])
@pytest.mark.parametrize("matrix", [dense(), sparse(), COLOUR, [sparse(seed=seed) for seed in range(3)]])
def test_npz_keeps_everything(tmp_path, matrix, bounce):
    T = Transport(matrix, grid=(3, 4), first_bounce=bounce)
    store.save(tmp_path / "T.npz", T)
    result = store.load(tmp_path / "T.npz")
    assert (result.grid, result.camera_grid, result.channels) == ((3, 4), (3, 4), T.channels)
    np.testing.assert_array_equal(result.first_bounce, T.first_bounce)
    for a, b in zip(result.matrices, T.matrices, strict=True):
        same_matrix(a, b)


MIXING = np.array([[1.0, 0.2, 0.0], [0.1, 0.9, 0.0], [0.0, -0.1, 0.8]])


@pytest.mark.parametrize("matrix", [COLOUR, [sparse(seed=seed) for seed in range(3)]])
def test_npz_keeps_how_colours_mix(tmp_path, matrix, device):
    T = Transport(matrix, grid=(3, 4), mixing=MIXING, device=device)
    store.save(tmp_path / "T.npz", T)
    result = store.load(tmp_path / "T.npz", device=device)
    np.testing.assert_array_equal(result.mixing, MIXING)
    pattern = np.random.default_rng(1).random((3, 4, 3))
    np.testing.assert_array_equal(result @ pattern, T @ pattern)
    for suffix in (".npy", ".mtx"):
        with pytest.raises(FileError, match=f"T{suffix}: {suffix} does not keep how the projector's colours"):
            store.save(tmp_path / f"T{suffix}", T)
        assert not (tmp_path / f"T{suffix}").exists()


@pytest.mark.parametrize(
    ("mixing", "T", "says"),
    [
        (np.eye(2), COLOUR, r"mixing has shape \(2, 2\)"),
        (np.ones((3, 3)), COLOUR, "mixing has the condition number"),
        (np.full((3, 3), np.nan), COLOUR, "mixing has 9 NaN"),
        (MIXING, dense(), "mixing is given, but T has one channel"),
        (np.full((3, 3), "a"), COLOUR, "array 'mixing' holds <U1"),
    ],
)
def test_a_bad_mixing_in_a_file_is_refused(tmp_path, mixing, T, says):
    np.savez(tmp_path / "T.npz", T=np.array(T), grid=(3, 4), mixing=mixing)
    with pytest.raises(FileError, match=says) as caught:
        store.load(tmp_path / "T.npz")
    assert str(caught.value).startswith(f"{tmp_path / 'T.npz'}: ")


def test_blocks_between_colours_are_not_saved(tmp_path):
    T = Transport([[dense(seed=3 * c + d) for d in range(3)] for c in range(3)], grid=(3, 4))
    with pytest.raises(InputTypeError, match="T has 3 x 3 blocks between colours; only one matrix or three"):
        store.save(tmp_path / "T.npz", T)


def test_masked_pixels_stay_masked(tmp_path):
    matrix = dense()
    matrix[3, 3] = 0
    store.save(tmp_path / "T.npz", Transport(matrix, grid=(3, 4), on_dark="mask"))
    with pytest.raises(FileError, match=r"T\.npz: first_bounce is zero or negative at 1 of 12"):
        store.load(tmp_path / "T.npz")
    assert np.flatnonzero(store.load(tmp_path / "T.npz", on_dark="mask").masked).tolist() == [3]


def test_the_grid_given_is_preferred_if_it_fits(tmp_path):
    store.save(tmp_path / "T.npz", Transport(dense(), grid=(3, 4)))
    assert store.load(tmp_path / "T.npz", grid=(2, 6), camera_grid=(1, 12)).grid == (2, 6)
    with pytest.raises(FileError, match=r"T\.npz: grid is 5 x 5 = 25 pixels; .* must be 12"):
        store.load(tmp_path / "T.npz", grid=(5, 5))


def test_a_stored_grid_that_does_not_fit_is_refused(tmp_path):
    np.savez(tmp_path / "T.npz", T=dense(), grid=[2, 5])
    with pytest.raises(FileError, match=r"T\.npz: grid is 2 x 5"):
        store.load(tmp_path / "T.npz")
    assert store.load(tmp_path / "T.npz", grid=(3, 4)).grid == (3, 4)


def test_a_grid_that_nobody_tells_is_asked_for(tmp_path):
    np.save(tmp_path / "T.npy", dense())
    with pytest.raises(FileError, match=r"12 projector pixels lie; give grid=\(h, w\)$"):
        store.load(tmp_path / "T.npy")
    np.save(tmp_path / "T.npy", dense(16, 9))
    with pytest.raises(FileError, match=r"give grid=\(h, w\), perhaps grid=\(3, 3\)"):
        store.load(tmp_path / "T.npy")
    with pytest.raises(FileError, match=r"16 camera pixels lie; give camera_grid"):
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


def test_what_the_transport_refuses_names_the_file(tmp_path):
    matrix = dense()
    matrix[0, 1] = np.nan
    np.save(tmp_path / "T.npy", matrix)
    with pytest.raises(FileError, match=r"T\.npy: matrix has 1 NaN"):
        store.load(tmp_path / "T.npy", grid=(3, 4))


def test_operators_and_strangers_are_not_saved(tmp_path):
    operator = scipy.sparse.linalg.aslinearoperator(dense())
    T = Transport(operator, grid=(3, 4), first_bounce=np.ones(12))
    with pytest.raises(InputTypeError, match="only arrays, sparse matrices"):
        store.save(tmp_path / "T.npz", T)
    with pytest.raises(InputTypeError, match="T is a ndarray"):
        store.save(tmp_path / "T.npz", dense())  # pyright: ignore[reportArgumentType]
    assert list(tmp_path.iterdir()) == []


def test_paths_that_lead_nowhere(tmp_path):
    (tmp_path / "empty.npz").touch()
    (tmp_path / "folder.npz").mkdir()
    wanted = {
        "none.npz": "no such file",
        "empty.npz": "the file is empty",
        "folder.npz": "is a folder",
        "T.xyz": r"extension \.xyz is unknown; transports are \.npz, \.npy, \.mtx",
        "T": "has no extension",
    }
    with pytest.raises(FileError, match="path is ''"):
        store.load("")
    with pytest.raises(FileError, match="path is ''"):
        store.save("", Transport(dense(), grid=(3, 4)))
    for name, text in wanted.items():
        with pytest.raises(FileError, match=text) as error:
            store.load(tmp_path / name)
        assert str(error.value).startswith(str(tmp_path / name))
    with pytest.raises(FileError, match="unknown"):
        store.save(tmp_path / "T.xyz", Transport(dense(), grid=(3, 4)))
    with pytest.raises(InputTypeError, match="path is 3"):
        store.load(3)  # pyright: ignore[reportArgumentType]


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
