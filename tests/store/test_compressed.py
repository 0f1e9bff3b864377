# SPDX-License-Identifier: BSD-3-Clause
"""Files of compressed transports and inverses: the same bits come back, damage is refused."""

from __future__ import annotations

from functools import partial
from pathlib import Path
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
from ltcl.store import CompressedRecord, formats
from tests.problems import enclosure, lambertian

random = np.random.default_rng()
GRID = (6, 7)
N = 42
F = np.linspace(0.3, 0.5, 3 * N).reshape(3, N)
CORES: dict[str, Any] = {
    "csr": CSR,
    "dense": lambda device, C: Dense(device, C.toarray()),
    "tiles": Tiles,
}


def system(device: Any, W: Any, core: str, channel: int = 0) -> IdentityPlus:
    C = W.to_dense() @ enclosure(N, 0.4, channel).R @ W.to_dense().T
    C = scipy.sparse.csr_array(np.where(np.abs(C) > 0.01, C, 0.0))
    R = Compressed(CORES[core](device, C), W, W, 0.01)
    return IdentityPlus(R, weights=1.0 / F[channel], solution_error=0.02 * (channel + 1))


def compressed(
    device: Any, channels: int = 1, core: str = "csr", f: Any = F, d: Any = F, **options: Any
) -> Any:
    """A transport whose channels share their basis."""
    W = Wavelet(device, GRID, "db2")
    matrices = [ScaledColumns(system(device, W, core, c), d[c]) for c in range(channels)]
    return ltcl.Transport(matrices, GRID, first_bounce=f[0] if channels == 1 else f, **options)


def ordered(device: Any, basis: str | None) -> Any:
    W = SubsetBasis(
        device, GRID, np.arange(N)[::-1], Wavelet(device, GRID, basis, 2) if basis else None
    )
    return ltcl.Transport(ScaledColumns(system(device, W, "tiles"), F[0]), GRID, first_bounce=F[0])


def unknown_error(device: Any) -> Any:
    S = IdentityPlus(Dense(device, np.zeros((N, N))), solution_error=np.inf)
    return ltcl.Transport(ScaledColumns(S, F[0]), GRID, first_bounce=F[0])


DARK = np.where(np.arange(N) % 5 == 0, 0.0, F)
TRANSPORTS: dict[str, Any] = {
    **{f"{core}, grey": partial(compressed, core=core) for core in CORES},
    **{f"{core}, colour": partial(compressed, channels=3, core=core) for core in CORES},
    "dark": partial(compressed, channels=3, f=DARK, d=DARK, on_dark="mask", mixing=np.eye(3) + 0.1),
    "first bounce of others": partial(compressed, d=1.1 * F),
    "order": partial(ordered, basis=None),
    "order of wavelets": partial(ordered, basis="haar"),
    "unknown error": unknown_error,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", TRANSPORTS)
@pytest.mark.parametrize("extension", [".npz", ".zarr"])
def test_the_same_transport_comes_back(
    device: Any, tmp_path: Path, extension: str, name: str
) -> None:
    C = TRANSPORTS[name](device)
    path = tmp_path / f"C{extension}"
    ltcl.save(path, C)
    if name == "dark":
        with pytest.raises(FileError, match="on_dark='mask'"):
            ltcl.load(path, on_dark="raise")
    again: Any = ltcl.load(path)
    assert (again.device, again.shape, again.grid) == (device, C.shape, C.grid)
    assert (again.channels, again.error) == (C.channels, C.error)
    for attribute in ("first_bounce", "masked", "mixing"):
        np.testing.assert_array_equal(getattr(again, attribute), getattr(C, attribute))
    p = random.uniform(0.0, 1.0, (*GRID, 3))
    np.testing.assert_array_equal(again @ p, C @ p)
    for T, S in zip(again.matrices, C.matrices, strict=True):
        np.testing.assert_array_equal(T.d, S.d)
    for S, R in zip(again.systems, C.systems, strict=True):
        np.testing.assert_array_equal(S.rmatmat(p.reshape(N, 3)), R.rmatmat(p.reshape(N, 3)))
        np.testing.assert_array_equal(S.weights, R.weights)
    if "colour" in name:
        assert len({basis for S in again.systems for basis in (S.R.into, S.R.out)}) == 1


def test_what_is_known_without_a_device(device: Any, tmp_path: Path) -> None:
    C = compressed(device, 3, "tiles")
    ltcl.save(tmp_path / "C.npz", C)
    parts = formats.read(tmp_path / "C.npz")
    assert isinstance(parts, CompressedRecord)
    assert (parts.shape, parts.grid, parts.error, parts.kinds) == (
        (N, N),
        GRID,
        0.06,
        ("tiles", "db2"),
    )
    packed = [S.R.core.packed for S in C.systems]
    assert parts.entries == sum(np.count_nonzero(core.codes) for core in packed)
    assert parts.nbytes > sum(core.codes.nbytes + core.columns.nbytes for core in packed)


def test_what_no_file_holds_is_refused(device: Any, tmp_path: Path) -> None:
    for name in ("C.npy", "C.mtx"):
        with pytest.raises(FileError, match=name):
            ltcl.save(tmp_path / name, compressed(device))
    with pytest.raises(InputTypeError, match=r"T .*Dense"):
        ltcl.save(tmp_path / "C.npz", ltcl.Transport(Dense(device, np.eye(N)), GRID))
    assert not list(tmp_path.iterdir())


# Either file of the fixture `saved`: the array that is replaced, or of None left out, and what is
# refused.
ALIEN: list[tuple[str, str, Any, str]] = [
    ("C", "grid", None, "'grid'"),
    ("C", "system_0.sign", None, "1 channels, but there are 0 operators"),
    ("C", "grid", np.array([5, 5]), "grid is 5 x 5 = 25 pixels"),
    ("C", "first_bounce", F[:2], r"first_bounce has shape \(2, 42\)"),
    ("C", "system_0.R.core.data", np.full(3, np.inf), "data' has 3 NaN or infinite"),
    ("C", "mixing", np.eye(3), "one channel"),
    ("C", "format", np.array("ltcl-compressed-2"), "'format' is"),
    ("C", "system_0.R.core.shape", np.array([1 << 62, 1 << 62]), "indptr has 43 entries"),
    ("inverse", "errors", None, "'errors'"),
    ("inverse", "confidence", np.array(2.0), "confidence is 2.0"),
    ("inverse", "system_1.sign", np.array(1.0), "I - A"),
    ("inverse", "system_2.R.kind", np.array("magic"), "'magic'"),
]


@pytest.fixture(scope="module")
def inverse() -> ltcl.Inverse:
    scenes = [lambertian(N, rho, seed=3) for rho in (0.2, 0.5, 0.8)]
    matrices = [scene.T for scene in scenes]
    first_bounce = np.stack([scene.F for scene in scenes])
    T = ltcl.Transport(matrices, GRID, first_bounce=first_bounce, mixing=np.eye(3) + 0.1)
    return ltcl.invert(T, 1e-2, basis="db2")


@pytest.fixture
def saved(device: Any, inverse: ltcl.Inverse, tmp_path: Path) -> Path:
    """A folder of a compressed transport and of an inverse."""
    ltcl.save(tmp_path / "C.npz", compressed(device))
    ltcl.save_inverse(tmp_path / "inverse.npz", inverse)
    return tmp_path


@pytest.mark.parametrize(("file", "name", "value", "text"), ALIEN)
def test_arrays_that_do_not_fit(saved: Path, file: str, name: str, value: Any, text: str) -> None:
    path = saved / f"{file}.npz"
    with np.load(path) as archive:
        arrays = {**archive, name: value}
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(FileError, match=text) as error:
        (ltcl.load if file == "C" else ltcl.load_inverse)(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


def test_one_is_not_the_other_and_each_has_its_grid(saved: Path, inverse: ltcl.Inverse) -> None:
    for load, name in ((ltcl.load, "inverse.npz"), (ltcl.load_inverse, "C.npz")):
        with pytest.raises(FileError, match=f"{name}: .*inverse"):
            load(saved / name)
    with pytest.raises(FileError, match=r"extension is '\.npy'"):
        ltcl.save_inverse(saved / "a.npy", inverse)
    with pytest.raises(InputTypeError, match="inverse is a Transport"):
        ltcl.save_inverse(saved / "a.npz", ltcl.load(saved / "C.npz"))  # pyright: ignore[reportArgumentType]
    assert len(list(saved.iterdir())) == 2
    assert ltcl.load(saved / "C.npz", grid=GRID).grid == GRID
    with pytest.raises(FileError, match=r"\(6, 7\)"):
        ltcl.load(saved / "C.npz", grid=(7, 6))
    columns = ltcl.load(saved / "C.npz", first_bounce=F[0])
    assert columns.systems[0] is columns.matrices[0].A


@pytest.mark.slow
def test_the_same_inverse_comes_back(saved: Path, inverse: ltcl.Inverse) -> None:
    again = ltcl.load_inverse(saved / "inverse.npz")
    for attribute in ("grid", "channels", "errors", "confidence"):
        assert getattr(again, attribute) == getattr(inverse, attribute)
    for attribute in ("first_bounce", "mixing"):
        np.testing.assert_array_equal(getattr(again, attribute), getattr(inverse, attribute))
    desired = random.random((2, *GRID, 3))
    np.testing.assert_array_equal(again.pattern(desired), inverse.pattern(desired))
    assert [S.R.error for S in again.systems] == [S.R.error for S in inverse.systems]


def mutants(array: np.ndarray) -> Any:
    """The array with another shape, another type, and with values that lie."""
    yield from (array.ravel()[:0], np.append(array.ravel(), array.ravel()[-1:]), array[None])
    if array.dtype.kind in "US":
        yield from (np.array("nothing"), np.array(3.0))
    elif array.size:
        yield np.full(array.shape, "a")
        integers = (-1, 0, 1, 35, 200, 1 << 31, 1 << 62)
        reals = (-1.0, 0.0, 1e30, np.nan)
        for value in integers if array.dtype.kind in "iu" else reals:
            wide = np.result_type(array.dtype, np.min_scalar_type(value))
            changed = array.astype(wide if array.dtype.kind in "iu" else array.dtype)
            with np.errstate(over="ignore"):  # 1e30 is infinite in float16
                changed.reshape(-1)[array.size // 2] = value
            yield changed


@pytest.mark.slow
@pytest.mark.parametrize("core", CORES)
def test_whatever_arrays_say_there_is_a_transport_or_one_line(
    device: Any, tmp_path: Path, core: str
) -> None:
    """No array is believed: kernels never see an index that is beyond."""
    path = tmp_path / "C.npz"
    refusals = []
    ltcl.save(path, compressed(device, core=core))
    with np.load(path) as archive:
        arrays = dict(archive)
    for name, array in arrays.items():
        for mutant in mutants(array):
            np.savez(path, **{**arrays, name: mutant})
            try:
                assert (ltcl.load(path, on_dark="mask") @ np.ones(GRID)).shape == GRID
            except LtclError as error:
                refusals.append(str(error))
    assert len(refusals) > 3 * len(arrays)
    assert not [text for text in refusals if "\n" in text]
