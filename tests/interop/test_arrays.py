# SPDX-License-Identifier: BSD-3-Clause
"""Arrays of other libraries than PyTorch and JAX: their kind comes back, with NumPy's numbers."""

from __future__ import annotations

import sys
import types
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any, NamedTuple

import numpy as np
import pytest

import ltcl
from ltcl import checks
from ltcl.errors import InputError, InputTypeError
from ltcl.interop import arrays, host
from tests.interop.calls import CALLS, GRID, gives_back, picture, transport

pytestmark = [pytest.mark.usefixtures("device"), pytest.mark.filterwarnings("error")]


class Capsule:
    """An array of a package that knows nothing but DLPack."""

    def __init__(self, array: np.ndarray) -> None:
        self.array = array

    def __dlpack__(self, **options: Any) -> Any:
        return self.array.__dlpack__(**options)

    def __dlpack_device__(self) -> tuple[int, int]:
        return self.array.__dlpack_device__()

    def __mul__(self, factor: float) -> Capsule:
        return Capsule(factor * self.array)

    __rmul__ = __mul__


class FakeCuPyArray:
    """Stands for `cupy.ndarray`: NumPy reads it by `get()` alone."""

    __module__ = "cupy"

    def __init__(self, array: Any) -> None:
        self._array = np.asarray(array)
        self.device = nullcontext()
        self.dtype = self._array.dtype
        self.shape = self._array.shape
        self.ndim = self._array.ndim

    def get(self) -> np.ndarray:
        return self._array.copy()

    def __array__(self, *arguments: Any, **options: Any) -> np.ndarray:
        raise TypeError("Implicit conversion to a NumPy array is not allowed")

    def __rmul__(self, factor: float) -> FakeCuPyArray:
        return FakeCuPyArray(factor * self._array)


class Kind(NamedTuple):
    make: Callable[[np.ndarray], Any]
    type: type
    read: Callable[[Any], np.ndarray] = np.asarray


def _strict() -> Kind:
    import array_api_strict

    return Kind(array_api_strict.asarray, type(array_api_strict.asarray(0)))


def _dask() -> Kind:
    import dask.array

    chunks: Any = 1
    return Kind(lambda a: dask.array.from_array(a, chunks=chunks), dask.array.Array)


def _labelled() -> Kind:
    import xarray

    return Kind(xarray.DataArray, xarray.DataArray)


KINDS: dict[str, Callable[[], Kind]] = {
    "array API": _strict,
    "DLPack": lambda: Kind(Capsule, Capsule, np.from_dlpack),
    "Dask": _dask,
    "xarray": _labelled,
    "CuPy": lambda: Kind(FakeCuPyArray, FakeCuPyArray, FakeCuPyArray.get),
}


@pytest.fixture
def cupy(monkeypatch: pytest.MonkeyPatch) -> None:
    """What stands for CuPy, which needs a GPU."""
    package = types.ModuleType("cupy")
    vars(package).update(ndarray=FakeCuPyArray, asarray=FakeCuPyArray)
    monkeypatch.setitem(sys.modules, "cupy", package)


@pytest.fixture
def kind(request: pytest.FixtureRequest) -> Kind:
    if request.param == "CuPy":
        request.getfixturevalue("cupy")
    return KINDS[request.param]()


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("kind", KINDS, indirect=True)
def test_a_call_gives_back_the_kind_that_it_took(call, kind):
    gives_back(CALLS[call], kind.make, kind.type, kind.read)


@pytest.mark.parametrize("kind", [name for name in KINDS if name != "DLPack"], indirect=True)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_floats_come_back_in_their_type(kind, dtype):
    result = transport() @ kind.make(picture().astype(dtype))
    assert kind.read(result).dtype == dtype


@pytest.mark.parametrize("kind", KINDS, indirect=True)
def test_whole_numbers_come_back_as_floats(kind):
    result = transport() @ kind.make(np.ones(GRID, np.uint8))
    assert kind.read(result).dtype == np.float32


@pytest.mark.parametrize("kind", ["array API", "DLPack", "xarray"], indirect=True)
def test_memory_of_the_host_is_read_where_it_is(kind):
    array = kind.make(picture())
    first, second = checks.real("light", array), checks.real("light", array)
    assert np.shares_memory(first, second)


@pytest.mark.parametrize("kind", KINDS, indirect=True)
def test_a_transport_takes_them_as_its_matrix(kind):
    matrix = transport().to_numpy()
    T = ltcl.Transport(kind.make(matrix), GRID, first_bounce=kind.make(np.diag(matrix).copy()))
    np.testing.assert_array_equal(T @ picture(), transport() @ picture())


@pytest.mark.parametrize("kind", KINDS, indirect=True)
def test_what_is_wrong_with_them_is_said_by_name(kind):
    with pytest.raises(InputError, match="pattern has 1 NaN"):
        ltcl.relight(
            transport(), kind.make(np.where(np.arange(32).reshape(GRID) == 5, np.nan, 1.0))
        )
    with pytest.raises(InputError, match=r"pattern has shape \(3, 3\)"):
        ltcl.relight(transport(), kind.make(np.ones((3, 3))))
    with pytest.raises(InputTypeError, match="desired holds complex"):
        ltcl.compensate(transport(), kind.make(np.ones(GRID, complex)))


def test_kinds_may_be_mixed(device):
    """The first one decides."""
    import array_api_strict
    import xarray

    desired = xarray.DataArray(picture(), dims=("y", "x"))
    c = ltcl.compensate(transport(), desired, background=array_api_strict.asarray(picture(seed=1)))
    assert isinstance(c.pattern, xarray.DataArray)
    expected = ltcl.compensate(transport(), picture(), background=picture(seed=1))
    np.testing.assert_allclose(c.pattern, expected.pattern, atol=1e-6)


def test_names_and_coordinates_stay(device):
    import xarray

    coordinates = {"y": np.arange(4) * 0.5, "x": np.arange(8), "place": ("x", list("abcdefgh"))}
    light = xarray.DataArray(picture(), dims=("y", "x"), coords=coordinates)
    result = transport() @ light
    assert result.dims == ("y", "x")
    assert set(result.coords) == {"y", "x", "place"}
    assert result.sel(x=3, y=0.5).item() == pytest.approx((transport() @ picture())[1, 3])
    # New axes have names of their own, and coordinates of axes that changed are gone.
    assert (transport(3) @ light).dims == ("y", "x", "colour")
    b: Any = ltcl.separate(transport(), light, bounces=2)
    assert b.bounces.dims == ("bounce", "y", "x")
    matrix = np.vstack([transport().to_numpy()] * 2)
    wide: Any = ltcl.Transport(matrix, GRID, camera_grid=(8, 8)) @ light
    assert (wide.shape, set(wide.coords)) == ((8, 8), {"x", "place"})


def test_chunks_of_frames_stay(device):
    import dask.array

    chunks: Any = (2, 2, 2)
    frames = dask.array.from_array(picture(5, *GRID), chunks=chunks)
    assert (transport() @ frames).chunks == ((2, 2, 1), (4,), (8,))


@pytest.mark.usefixtures("cupy")
def test_values_of_a_device_go_through_the_host_which_is_said_once(caplog):
    host.say_once.cache_clear()
    for _ in range(3):
        ltcl.relight(transport(), FakeCuPyArray(picture()))
    assert [record.message.count("through the host") for record in caplog.records] == [1]


def test_codes_are_written_into_memory_that_numpy_sees(device):
    import array_api_strict
    import dask.array
    import xarray

    with ltcl.Compensator(transport()) as compensator:
        frame = np.full(GRID, 100, np.uint8)
        expected = compensator(frame)
        for make in (xarray.DataArray, array_api_strict.asarray, Capsule):
            codes = np.zeros(GRID, np.uint8)
            out: Any = make(codes)
            assert compensator(frame, out=out) is out
            np.testing.assert_array_equal(arrays.read(out), expected)
        with pytest.raises(InputError, match="memory that NumPy"):
            compensator(frame, out=dask.array.zeros(GRID, dtype=np.uint8))


def test_codes_of_other_kinds_come_back_in_their_type(device):
    import array_api_strict

    with ltcl.Compensator(transport()) as compensator:
        codes = compensator(array_api_strict.asarray(picture()))
    assert codes.dtype == array_api_strict.uint8
