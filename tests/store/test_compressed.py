# SPDX-License-Identifier: BSD-3-Clause
"""Files of compressed transports: the same light comes back, and hostile ones are refused in one line."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.errors import FileError, InputTypeError, LtclError
from ltcl.operators import (
    CSR,
    Compressed,
    Dense,
    IdentityPlus,
    ScaledColumns,
    SubsetBasis,
    Tiles,
    Wavelet,
)
from ltcl.store import Parts, formats
from tests.problems import enclosure

GRID = (6, 7)
N = 42
F = np.random.default_rng(0).uniform(0.3, 0.5, (3, N))


def _core(device, kind, W, R):
    C = R if W is None else W.to_dense() @ R @ W.to_dense().T
    C = scipy.sparse.csr_array(np.where(np.abs(C) > 0.01, C, 0.0))
    return {"csr": CSR, "dense": lambda d, C: Dense(d, C.toarray()), "tiles": Tiles}[kind](device, C)


def compressed(device, channels=1, core="csr", f=F, d=None, **options):
    """A transport whose channels share their basis."""
    W = Wavelet(device, GRID, "db2")
    matrices = []
    for channel in range(channels):
        R = Compressed(_core(device, core, W, enclosure(N, 0.4, channel).R), W, W, 0.01)
        S = IdentityPlus(R, weights=1.0 / F[channel], solution_error=0.02 * (channel + 1))
        matrices.append(ScaledColumns(S, f[channel] if d is None else d[channel]))
    return ltcl.Transport(matrices, GRID, first_bounce=f[0] if channels == 1 else f, **options)


def same(a, b):
    assert (a.shape, a.grid, a.channels, a.error) == (b.shape, b.grid, b.channels, b.error)
    np.testing.assert_array_equal(a.first_bounce, b.first_bounce)
    np.testing.assert_array_equal(a.masked, b.masked)
    p = np.random.default_rng(1).uniform(0.0, 1.0, (*GRID, 3))
    np.testing.assert_array_equal(a @ p, b @ p)
    for S, R in zip(a.systems, b.systems, strict=True):
        np.testing.assert_array_equal(S.rmatmat(p.reshape(N, 3)), R.rmatmat(p.reshape(N, 3)))
        np.testing.assert_array_equal(S.weights, R.weights)


@pytest.mark.parametrize("core", ["csr", "dense", "tiles"])
@pytest.mark.parametrize("channels", [1, 3])
def test_the_same_transport_comes_back(device, tmp_path, channels, core):
    C = compressed(device, channels, core)
    path = tmp_path / "C.npz"
    ltcl.save(path, C)
    again = ltcl.load(path)
    same(C, again)
    assert again.device is device
    bases = {S.R.into for S in again.systems if isinstance(S.R, Compressed)}
    assert len(bases) == 1  # shared by all, and on both sides
    image = C @ np.full(GRID, 0.5)
    np.testing.assert_array_equal(
        ltcl.compensate(again, image, rtol=0.06).pattern, ltcl.compensate(C, image, rtol=0.06).pattern
    )


@pytest.mark.parametrize("of", [None, "haar"])
def test_orders_come_back(device, tmp_path, of):
    W = SubsetBasis(device, GRID, np.arange(N)[::-1], of and Wavelet(device, GRID, of, 2))
    S = IdentityPlus(Compressed(_core(device, "tiles", W, enclosure(N, 0.4).R), W, W), weights=F[0])
    C = ltcl.Transport(ScaledColumns(S, F[0]), GRID, first_bounce=F[0])
    ltcl.save(tmp_path / "C.npz", C)
    same(C, ltcl.load(tmp_path / "C.npz"))


def test_masked_pixels_and_mixed_colours_come_back(device, tmp_path):
    f = np.where(np.arange(N) % 5 == 0, 0.0, F)
    mixing = np.eye(3) + 0.1
    C = compressed(device, 3, f=f, on_dark="mask", mixing=mixing)
    ltcl.save(tmp_path / "C.npz", C)
    with pytest.raises(FileError, match="give on_dark='mask'"):
        ltcl.load(tmp_path / "C.npz")
    again = ltcl.load(tmp_path / "C.npz", on_dark="mask")
    same(C, again)
    np.testing.assert_array_equal(again.mixing, mixing)


def test_another_first_bounce_than_the_columns(device, tmp_path):
    C = compressed(device, d=1.1 * F)
    ltcl.save(tmp_path / "C.npz", C)
    again = ltcl.load(tmp_path / "C.npz")
    np.testing.assert_array_equal(again.matrices[0].d, C.matrices[0].d)
    np.testing.assert_array_equal(again.first_bounce, C.first_bounce)
    given = ltcl.load(tmp_path / "C.npz", first_bounce=1.1 * F[0])
    assert given.systems[0] is given.matrices[0].A


def test_unknown_errors_stay_unknown(device, tmp_path):
    S = IdentityPlus(Dense(device, np.zeros((N, N))), solution_error=np.inf)
    ltcl.save(tmp_path / "C.npz", ltcl.Transport(ScaledColumns(S, F[0]), GRID, first_bounce=F[0]))
    assert ltcl.load(tmp_path / "C.npz").error == np.inf


def test_what_is_known_without_a_device(device, tmp_path):
    C = compressed(device, 3, "tiles")
    ltcl.save(tmp_path / "C.npz", C)
    parts = formats.read(tmp_path / "C.npz")
    assert isinstance(parts, Parts)
    assert (parts.shape, parts.grid, parts.error) == ((N, N), GRID, 0.06)
    assert parts.kinds == ("tiles", "db2")
    inside = [S.R.core for S in C.systems if isinstance(S.R, Compressed)]
    packed = [core.packed for core in inside if isinstance(core, Tiles)]
    assert parts.entries == sum(np.count_nonzero(one.codes) for one in packed)
    assert parts.nbytes > sum(one.codes.nbytes + one.columns.nbytes for one in packed)


def test_other_formats_and_operators_are_refused(device, tmp_path):
    C = compressed(device)
    for name in ("C.npy", "C.mtx"):
        with pytest.raises(FileError, match=r"does not keep compressed transports; \.npz and \.zarr do"):
            ltcl.save(tmp_path / name, C)
    plain = ltcl.Transport(Dense(device, np.eye(N)), GRID)
    with pytest.raises(InputTypeError, match="T is made of Dense"):
        ltcl.save(tmp_path / "C.npz", plain)
    assert not list(tmp_path.iterdir())


def test_the_grid_is_part_of_it(device, tmp_path):
    path = tmp_path / "C.npz"
    ltcl.save(path, compressed(device))
    assert ltcl.load(path, grid=GRID).grid == GRID
    wrong: list[dict[str, Any]] = [{"grid": (7, 6)}, {"camera_grid": (1, N)}]
    for options in wrong:
        with pytest.raises(FileError, match=r"compressed on its own, \(6, 7\)"):
            ltcl.load(path, **options)


def _rewritten(device, tmp_path, **changes):
    """A file of a compressed transport with some arrays replaced, or, of None, left out."""
    path = tmp_path / "C.npz"
    ltcl.save(path, compressed(device))
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    arrays |= {name.replace("__", "."): value for name, value in changes.items()}
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    return path


ALIEN = {
    "no grid": ({"grid": None}, "'grid', which is missing"),
    "no first bounce": ({"first_bounce": None}, "'first_bounce', which is missing"),
    "no operators": ({"system_0__R__kind": None}, "'system_0.R.kind', which is missing"),
    "no sign": ({"system_0__sign": None}, "1 channels, but there are 0 operators"),
    "grid of others": ({"grid": np.array([5, 5])}, "grid is 5 x 5 = 25 pixels"),
    "grid of one": ({"grid": np.array([42])}, r"grid has shape \(1,\)"),
    "two channels": ({"first_bounce": F[:2]}, r"\(2, 42\); it must be \(1, N\) or \(3, N\)"),
    "three channels": ({"first_bounce": F}, "3 channels, but there are 1 operators"),
    "no numbers": ({"first_bounce": np.full((1, N), np.nan)}, "array 'first_bounce' has 42 NaN"),
    "infinite values": ({"system_0__R__core__data": np.full(3, np.inf)}, "data' has 3 NaN or infinite"),
    "mixing of grey": ({"mixing": np.eye(3)}, "T has one channel"),
    "columns of others": ({"columns_0": np.ones(3)}, r"d has shape \(3,\)"),
    "other layout": ({"format": np.array("ltcl-compressed-2")}, "the layout of the archive is"),
    "column beyond": (
        {"system_0__R__core__indices": np.array([99], np.int32), "system_0__R__core__data": np.ones(1)},
        "the three must agree",
    ),
    "huge shape": ({"system_0__R__core__shape": np.array([1 << 62, 1 << 62])}, "indptr has 43 entries"),
}


@pytest.mark.parametrize("name", ALIEN)
def test_files_that_do_not_fit_are_refused_in_one_line(device, tmp_path, name):
    changes, part = ALIEN[name]
    path = _rewritten(device, tmp_path, **changes)
    with pytest.raises(FileError, match=part) as caught:
        ltcl.load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def _mutants(array):
    """The array with another shape, another type, and with values that lie."""
    yield array.ravel()[:0]
    yield np.append(array.ravel(), array.ravel()[-1:])
    yield array[None]
    if array.dtype.kind in "US":
        yield np.array("nothing")
        yield np.array(3.0)
    elif array.size:
        yield np.full(array.shape, "a")
        lies = (
            (-1, 0, 1, 35, 200, 1 << 31, 1 << 62) if array.dtype.kind in "iu" else (-1.0, 0.0, 1e30, np.nan)
        )
        for value in lies:
            wide = np.result_type(array.dtype, np.min_scalar_type(value))
            changed = array.astype(wide if array.dtype.kind in "iu" else array.dtype)
            with np.errstate(over="ignore"):  # 1e30 is infinite in float16
                changed.reshape(-1)[array.size // 2] = value
            yield changed


def _lit(path):
    """Why a file is refused; nothing where it is not, and gives pictures."""
    try:
        T = ltcl.load(path, on_dark="mask")
    except LtclError as error:
        return str(error)
    assert (T @ np.ones(GRID)).shape == GRID
    return ""


@pytest.mark.parametrize("core", ["csr", "dense", "tiles"])
def test_whatever_arrays_say_there_is_a_transport_or_one_line(device, tmp_path, core):
    """No array is believed: kernels never see an index that is beyond."""
    ltcl.save(tmp_path / "C.npz", compressed(device, core=core))
    with np.load(tmp_path / "C.npz") as archive:
        arrays = {name: archive[name] for name in archive.files}
    refused = 0
    for name, array in arrays.items():
        for number, mutant in enumerate(_mutants(array)):
            path = tmp_path / f"{number}.npz"
            np.savez(path, **{**arrays, name: mutant})
            text = _lit(path)
            assert "\n" not in text, (name, number)
            refused += bool(text)
    assert refused > 3 * len(arrays)
