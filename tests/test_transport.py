# SPDX-License-Identifier: BSD-3-Clause
"""`Transport` takes what users hold, splits it into F and S, and refuses the rest before opening a device."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from scipy.sparse.linalg import LinearOperator, aslinearoperator

import ltcl
from ltcl import first_bounce
from ltcl.errors import DeviceError, InputError, InputTypeError, LtclError
from ltcl.operators import Dense, IdentityPlus, ScaledColumns
from tests.problems import lambertian

GRID = (5, 7)
SCENES = [lambertian(35, rho, seed=20 + channel) for channel, rho in enumerate((0.4, 0.9, 2.0))]
SCENE = SCENES[1]
SPARSE_FORMATS = ("csr", "csc", "coo", "bsr", "dia", "lil", "dok")
ROUNDING = 2.0**-22  # of float32 sums of 35 products of like sign

FORMS: dict[str, Any] = {
    "array": lambda T: T,
    "float32": lambda T: T.astype(np.float32),
    "Fortran order": np.asfortranarray,
    "strided": lambda T: np.repeat(T, 2, axis=1)[:, ::2],
    "lists": lambda T: T.tolist(),
    "matrix": lambda T: scipy.sparse.csr_matrix(T).todense(),
    "operator": aslinearoperator,
    **{name: lambda T, name=name: scipy.sparse.csr_array(T).asformat(name) for name in SPARSE_FORMATS},
    "sparse matrix": scipy.sparse.csr_matrix,
    "64-bit indices": lambda T: _wide(scipy.sparse.csr_array(T)),
    "duplicates": lambda T: scipy.sparse.coo_array(
        (np.tile(T.ravel() / 2, 2), tuple(np.tile(i, 2) for i in np.indices(T.shape).reshape(2, -1)))
    ),
}


def _wide(matrix):
    matrix.indices, matrix.indptr = matrix.indices.astype(np.int64), matrix.indptr.astype(np.int64)
    return matrix


def transport(matrix: Any, **arguments: Any) -> ltcl.Transport:
    return ltcl.Transport(matrix, **{"grid": GRID, **arguments})


def pattern(*shape: int) -> np.ndarray:
    return np.random.default_rng(21).uniform(0.0, 1.0, shape)


@pytest.mark.parametrize("form", FORMS)
def test_every_form_relights_alike(device, form):
    T = transport(FORMS[form](SCENE.T), first_bounce=SCENE.F, device=device)
    p = pattern(*GRID)
    assert (T.shape, T.grid, T.camera_grid, T.channels) == ((35, 35), GRID, GRID, 1)
    np.testing.assert_allclose((T @ p).ravel(), SCENE.T @ p.ravel(), rtol=ROUNDING)
    np.testing.assert_array_equal(T.first_bounce, SCENE.F)
    S = T.systems[0].to_dense()
    np.testing.assert_allclose(S, SCENE.S, rtol=ROUNDING, atol=ROUNDING)
    image = (SCENE.T @ p.ravel()).reshape(GRID)
    np.testing.assert_allclose(ltcl.compensate(T, image, rtol=1e-5).pattern, p, atol=1e-3)


@pytest.mark.parametrize(
    ("form", "collect"),
    [
        *((form, kind) for form in ("array", "csr", "operator", "lists") for kind in (tuple, list)),
        ("array", np.stack),
    ],
)
def test_three_make_colour(device, form, collect):
    matrix = collect([FORMS[form](scene.T) for scene in SCENES])
    T = transport(matrix, first_bounce=[scene.F for scene in SCENES], device=device)
    p = pattern(*GRID, 3)
    wanted = np.stack([scene.T @ p[..., c].ravel() for c, scene in enumerate(SCENES)], axis=-1)
    np.testing.assert_allclose(T @ p, wanted.reshape(*GRID, 3), rtol=ROUNDING)
    assert T.channels == 3
    assert T.interreflection is T.systems
    assert len(T.systems) == 3
    assert T.first_bounce.shape == (3, 35)


def test_one_of_a_sequence_is_grey(device):
    assert transport([SCENE.T], device=device).channels == 1
    assert transport(SCENE.T[None], device=device).channels == 1


def test_no_device_is_opened_before_the_first_product():
    T = transport(SCENE.T, device="there is no such device")
    assert T.first_bounce.shape == (35,)
    assert "35 x 35, grey, grid 5 x 7" in repr(T)
    for early in (
        lambda: ltcl.compensate(T, pattern(5)),
        lambda: ltcl.separate(T, pattern(5)),
        lambda: T @ pattern(5),
    ):
        with pytest.raises(InputError):
            early()
    with pytest.raises(DeviceError, match="there is no such device"):
        ltcl.relight(T, pattern(*GRID))


def test_the_device_wanted_is_the_device_used(small_device):
    T = transport(SCENE.T, device=small_device)
    assert T.device is small_device
    assert T.interreflection is T.systems[0]
    assert T.systems[0].R.device is small_device
    np.testing.assert_allclose((T @ pattern(*GRID)).ravel(), SCENE.T @ pattern(35), rtol=ROUNDING)


@pytest.mark.parametrize("form", ["array", "csr", "operator"])
def test_a_rectangular_T_relights_and_has_no_S(device, form):
    matrix = pattern(12, 35)
    T = transport(FORMS[form](matrix), camera_grid=(3, 4), device=device)
    np.testing.assert_allclose((T @ pattern(*GRID)).ravel(), matrix @ pattern(35), rtol=ROUNDING)
    assert (T @ pattern(2, *GRID, 3)).shape == (2, 3, 4, 3)
    refuses = [
        lambda: T.first_bounce,
        lambda: T.interreflection,
        lambda: ltcl.separate(T, pattern(3, 4)),
        lambda: ltcl.analyze(T),
    ]
    for refuse in refuses:
        with pytest.raises(InputError, match=r"projector of 5 x 7 pixels to a camera of 3 x 4.*only relight"):
            refuse()


def test_grids_that_differ_cannot_share_pixels(device):
    """35 camera pixels, but not those of the projector: there is no S, whatever the shape of T says."""
    T = transport(SCENE.T, camera_grid=(7, 5), device=device)
    assert (T @ pattern(*GRID)).shape == (7, 5)
    with pytest.raises(InputError, match="only relight"):
        ltcl.separate(T, pattern(7, 5))


# Bad input: (matrix, other arguments, error, what the message says).


def broken(part: str, index: int, value: Any) -> scipy.sparse.csr_array:
    matrix = scipy.sparse.csr_array(SCENE.T)
    getattr(matrix, part)[index] = value
    return matrix


def holed(value: float) -> np.ndarray:
    matrix = SCENE.T.copy()
    matrix[3, 4] = value
    return matrix


class Bare(LinearOperator):
    """An operator that knows no diagonal."""

    def _matvec(self, x: np.ndarray) -> np.ndarray:
        return SCENE.T @ x


BARE = Bare(np.float64, (35, 35))
BAD: dict[str, tuple[Any, dict[str, Any], type[LtclError], str]] = {
    "a number": (3.0, {}, InputError, r"matrix has shape \(\); it must be \(M, N\)"),
    "a vector": (np.ones(35), {}, InputError, r"matrix has shape \(35,\); it must be \(M, N\)"),
    "four dimensions": (np.ones((1, 3, 3, 3)), {}, InputError, r"matrix has shape \(1, 3, 3, 3\)"),
    "two channels": ([SCENE.T] * 2, {}, InputError, "matrix has 2 channels; it must be one matrix, or three"),
    "unequal channels": ([SCENE.T, SCENE.T, SCENE.T[:4]], {}, InputError, "matrix has channels of shapes"),
    "empty": (np.ones((0, 0)), {}, InputError, r"matrix has shape \(0, 0\); it must have at least one row"),
    "empty sparse": (scipy.sparse.csr_array((0, 5)), {}, InputError, r"matrix has shape \(0, 5\)"),
    "sparse vector": (scipy.sparse.coo_array(np.ones(35)), {}, InputError, r"matrix has shape \(35,\)"),
    "CSR vector": (scipy.sparse.csr_array(np.ones(35)), {}, InputError, r"matrix has shape \(35,\)"),
    "complex": (SCENE.T * 1j, {}, InputTypeError, "matrix holds complex128; it must hold real numbers"),
    "complex CSR": (scipy.sparse.csr_array(SCENE.T * 1j), {}, InputTypeError, "matrix holds complex128"),
    "text": ("T.npz", {}, InputTypeError, "matrix holds <U5; it must hold real numbers"),
    "nothing": (None, {}, InputTypeError, "matrix holds object"),
    "ragged": ([[1.0, 2.0], [3.0]], {}, LtclError, "matrix"),
    "NaN": (holed(np.nan), {}, InputError, r"matrix has 1 NaN or infinite value\(s\), the first at \(3, 4\)"),
    "Inf": ([SCENE.T, holed(np.inf), SCENE.T], {}, InputError, r"matrix\[1\] has 1 NaN or infinite"),
    "NaN in CSR": (broken("data", 7, np.nan), {}, InputError, r"matrix.data has 1 NaN or infinite .* at 7"),
    "NaN in COO": (scipy.sparse.coo_array(holed(np.nan)), {}, InputError, "matrix.* has 1 NaN or infinite"),
    "column too large": (broken("indices", 9, 35), {}, InputError, r"matrix.indices holds 35; .* in 0\.\.34"),
    "column negative": (broken("indices", 9, -1), {}, InputError, r"matrix.indices holds -1; .* in 0\.\.34"),
    "pointers fall": (broken("indptr", 5, 999), {}, InputError, "matrix.indptr falls after entry 5"),
    "pointers end early": (
        broken("indptr", -1, 1220),
        {},
        InputError,
        "matrix.indptr ends at 1220 with 1225",
    ),
    "pointers start late": (broken("indptr", 0, 1), {}, InputError, "matrix.indptr has 36 entries from 1"),
    "grid too small": (SCENE.T, {"grid": (5, 6)}, InputError, r"grid is 5 x 6 = 30 pixels, .* must be 35"),
    "grid a number": (
        SCENE.T,
        {"grid": 35},
        InputError,
        r"grid is 35; it must be two positive integers \(h, w\)",
    ),
    "grid fractions": (SCENE.T, {"grid": (2.5, 14)}, InputError, r"grid is \(2.5, 14\); it must be"),
    "grid negative": (SCENE.T, {"grid": (-5, -7)}, InputError, r"grid is \(-5, -7\); it must be"),
    "no camera grid": (SCENE.T[:12], {}, InputError, r"camera_grid is None.*h \* w = 12"),
    "wrong camera grid": (
        SCENE.T[:12],
        {"camera_grid": (3, 5)},
        InputError,
        "camera_grid is 3 x 5 = 15 pixels",
    ),
    "on_dark": (SCENE.T, {"on_dark": "skip"}, InputError, "on_dark is 'skip'; it must be one of raise, mask"),
    "F unknown": (
        SCENE.T,
        {"first_bounce": "guess"},
        InputError,
        "first_bounce is 'guess'; it must be one of",
    ),
    "F short": (
        SCENE.T,
        {"first_bounce": np.ones(3)},
        InputError,
        r"first_bounce has shape \(3,\); .*\(35,\)",
    ),
    "F NaN": (SCENE.T, {"first_bounce": np.full(35, np.nan)}, InputError, "first_bounce has 35 NaN"),
    "F text": (SCENE.T, {"first_bounce": ["a"] * 35}, InputTypeError, "first_bounce holds <U1"),
    "no diagonal": (
        BARE,
        {},
        InputError,
        "first_bounce is 'diagonal', .* Bare",
    ),
    "no inverse": (BARE, {"first_bounce": "exact"}, InputTypeError, "first_bounce='exact' inverts.*Bare"),
    "singular": (
        np.ones((35, 35)),
        {"first_bounce": "exact"},
        InputError,
        "first_bounce is 'exact', which needs an inv",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_refused_by_name(case, monkeypatch):
    monkeypatch.setattr("ltcl.transport.open_device", lambda _: pytest.fail("a device was opened"))
    matrix, arguments, error, says = BAD[case]
    with pytest.raises(error, match=says) as caught:
        transport(matrix, **arguments)
    assert "\n" not in str(caught.value)


def test_what_would_not_fit_the_host_is_said_before(monkeypatch):
    monkeypatch.setattr("ltcl.checks.host_memory", lambda: 1024)
    with pytest.raises(MemoryError, match="first_bounce='exact' inverts T densely, which for N = 35 needs"):
        first_bounce.find([SCENE.T], "exact")  # a Transport would turn to an estimate


# Copies.


@pytest.mark.parametrize("again", [copy.copy, copy.deepcopy, lambda T: pickle.loads(pickle.dumps(T))])  # noqa: S301
@pytest.mark.parametrize(
    "kind", ["array", "csr", "colour", "mixing", "blocks", "operator S F", "open device"]
)
def test_a_used_transport_is_copied_and_pickled(device, kind, again):
    matrix: Any = SCENE.T
    arguments: dict[str, Any] = {"device": device if kind == "open device" else None}
    if kind == "csr":
        matrix = scipy.sparse.csr_array(matrix)
    elif kind in ("colour", "mixing"):
        matrix = [scene.T for scene in SCENES]
        arguments["mixing"] = np.eye(3) + 0.1 if kind == "mixing" else None
    elif kind == "blocks":
        matrix = [[scene.T for scene in SCENES]] * 3
    elif kind == "operator S F":
        S = IdentityPlus(Dense(device, SCENE.R), solution_error=1e-3)
        matrix, arguments["first_bounce"] = ScaledColumns(S, SCENE.F), SCENE.F
    T = transport(matrix, **arguments)
    p = pattern(*GRID) if T.channels == 1 else pattern(*GRID, 3)
    before = T @ p, ltcl.compensate(T, 0.1 * p).pattern
    other = again(T)
    assert repr(other) == repr(T)
    np.testing.assert_array_equal(other @ p, before[0])
    np.testing.assert_allclose(ltcl.compensate(other, 0.1 * p).pattern, before[1], atol=1e-6)


def test_a_bare_operator_cannot_leave_its_device(device):
    with pytest.raises(InputTypeError, match="T is made of Dense"):
        pickle.dumps(transport(Dense(device, SCENE.T)))


@pytest.mark.parametrize("form", ["array", "csr", "operator"])
@pytest.mark.parametrize("share", [1e-4, 1e-30])
def test_relighting_has_all_digits_whatever_the_first_bounce(device, form, share):
    """I + R holds no digit of a diagonal of T that is far below F."""
    F = np.diag(SCENE.T) / share
    T = transport(FORMS[form](SCENE.T), first_bounce=F, device=device)
    p = pattern(*GRID)
    np.testing.assert_allclose((T @ p).ravel(), SCENE.T @ p.ravel(), rtol=ROUNDING)
