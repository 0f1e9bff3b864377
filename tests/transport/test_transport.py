# SPDX-License-Identifier: BSD-3-Clause
"""`Transport` takes matrices of any form, splits them into F and S, and refuses others early."""

from __future__ import annotations

import copy
import pickle
import re
from collections.abc import Callable
from functools import partial
from operator import attrgetter
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from scipy.sparse.linalg import LinearOperator, aslinearoperator

import ltcl
from ltcl.device import Device
from ltcl.errors import DeviceError, InputError, InputTypeError, LtclError
from ltcl.operators import Dense, IdentityPlus, ScaledColumns
from ltcl.transport.noise import Noise
from tests.problems import lambertian

GRID = (5, 7)
SCENES = [lambertian(35, rho, seed=20 + channel) for channel, rho in enumerate((0.4, 0.9, 2.0))]
SCENE = SCENES[1]
SPARSE_FORMATS = ("csr", "csc", "coo", "bsr", "dia", "lil", "dok")
# Rounding of float32 sums of 35 products of like sign.
ROUNDING = 2.0**-22

FORMS: dict[str, Any] = {
    "array": lambda T: T,
    "float32": lambda T: T.astype(np.float32),
    "Fortran order": np.asfortranarray,
    "strided": lambda T: np.repeat(T, 2, axis=1)[:, ::2],
    "lists": lambda T: T.tolist(),
    "matrix": lambda T: scipy.sparse.csr_matrix(T).todense(),
    "operator": aslinearoperator,
    **{
        name: lambda T, name=name: scipy.sparse.csr_array(T).asformat(name)
        for name in SPARSE_FORMATS
    },
    "sparse matrix": scipy.sparse.csr_matrix,
    "64-bit indices": lambda T: _wide(scipy.sparse.csr_array(T)),
    "duplicates": lambda T: _duplicated(T),
}


def _duplicated(T):
    """Each entry as two halves."""
    rows, columns = np.indices(T.shape).reshape(2, -1)
    values = np.tile(T.ravel() / 2, 2)
    return scipy.sparse.coo_array((values, (np.tile(rows, 2), np.tile(columns, 2))))


def _wide(matrix):
    matrix.indices = matrix.indices.astype(np.int64)
    matrix.indptr = matrix.indptr.astype(np.int64)
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
    [("array", np.stack), ("array", tuple), ("csr", list), ("operator", tuple), ("lists", list)],
)
def test_three_make_colour_and_one_is_grey(device, form, collect):
    p = pattern(*GRID, 3)
    F = [scene.F for scene in SCENES]
    matrices = collect([FORMS[form](scene.T) for scene in SCENES])
    T = transport(matrices, first_bounce=F, device=device)
    pictures = [scene.T @ p[..., c].ravel() for c, scene in enumerate(SCENES)]
    expected = np.stack(pictures, axis=-1).reshape(*GRID, 3)
    np.testing.assert_allclose(T @ p, expected, rtol=ROUNDING)
    assert (T.channels, len(T.systems), T.first_bounce.shape) == (3, 3, (3, 35))
    assert T.interreflection is T.systems
    assert transport(collect([FORMS[form](SCENE.T)]), first_bounce=SCENE.F).channels == 1
    np.testing.assert_array_equal(
        transport(COLOUR, first_bounce=SCENE.F).first_bounce, [SCENE.F] * 3
    )


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("camera", [GRID, (2, 4)])
@pytest.mark.parametrize(
    "shape", [GRID, (*GRID, 3), (4, *GRID), (4, *GRID, 3), (35,), (1, *GRID), (3, *GRID)], ids=str
)
def test_pictures_keep_their_layout(device, shape, camera, channels):
    matrices = 1.0 + np.random.default_rng(22).random((channels, camera[0] * camera[1], 35))
    T = transport(list(matrices), camera_grid=camera, device=device)
    light = pattern(*shape)
    if channels == 3 and shape == (3, *GRID):
        with pytest.raises(InputError, match=r"moveaxis\(pattern, 0, -1\)"):
            ltcl.relight(T, light)
        return
    picture = ltcl.relight(T, light)
    assert picture.dtype == np.float32
    np.testing.assert_array_equal(picture, T @ light)
    is_colour = shape[-1] == 3
    frames = light.reshape(-1, 35, 3 if is_colour else 1)
    colours = max(channels, frames.shape[2])
    exact = [frames[..., c % frames.shape[2]] @ matrices[c % channels].T for c in range(colours)]
    pixels = (matrices.shape[1],) if shape == (35,) else camera
    leading = shape[: len(shape) - is_colour - 2]
    expected_shape = (*leading, *pixels, *(3,) * (colours == 3))
    expected = np.stack(exact, axis=-1).reshape(expected_shape)
    np.testing.assert_allclose(picture, expected, rtol=1e-6)


@pytest.mark.parametrize("channels", [1, 3])
def test_channels_first_are_refused_with_the_cure(channels, device):
    T = transport([np.eye(35)] * channels, device=device)
    light = pattern(2, 3, *GRID)
    with pytest.raises(InputError, match=r"moveaxis\(pattern, -3, -1\)"):
        ltcl.relight(T, light)
    assert ltcl.relight(T, np.moveaxis(light, -3, -1)).shape == (2, *GRID, 3)


def test_ambiguous_shapes_are_colour(device):
    """Three frames of 3 x 3 pixels have the shape of one colour picture, which is meant."""
    colour = pattern(3, 3, 3)
    T = transport(np.eye(9)[::-1] + np.eye(9), grid=(3, 3), first_bounce=np.ones(9), device=device)
    np.testing.assert_allclose(ltcl.relight(T, colour), colour + colour[::-1, ::-1], rtol=1e-6)


def test_no_device_is_opened_before_the_first_product(small_device):
    T = transport(SCENE.T, device="no such device")
    assert T.first_bounce.shape == (35,)
    assert "35 x 35, grey, grid 5 x 7" in repr(T)
    for task in (ltcl.compensate, ltcl.separate, ltcl.relight):
        with pytest.raises(InputError):
            task(T, pattern(5))
        with pytest.raises(DeviceError, match="no such device"):
            task(T, pattern(*GRID))
    T = transport(SCENE.T, device=small_device)
    assert T.device is T.systems[0].R.device is small_device
    assert T.interreflection is T.systems[0]
    np.testing.assert_allclose((T @ pattern(*GRID)).ravel(), SCENE.T @ pattern(35), rtol=ROUNDING)


@pytest.mark.parametrize("form", ["array", "csr", "operator"])
@pytest.mark.parametrize("camera", [(3, 4), (7, 5)])
def test_a_camera_of_another_grid_relights_and_has_no_S(device, form, camera):
    """A camera of 7 x 5 pixels has a square T, but its pixels are not those of the projector."""
    matrix = pattern(camera[0] * camera[1], 35)
    T = transport(FORMS[form](matrix), camera_grid=camera, device=device)
    np.testing.assert_allclose((T @ pattern(*GRID)).ravel(), matrix @ pattern(35), rtol=ROUNDING)
    separate = partial(ltcl.separate, image=pattern(*camera))
    for use in (attrgetter("first_bounce"), attrgetter("interreflection"), separate):
        with pytest.raises(InputError, match=rf"5, 7.*{camera[0]}, {camera[1]}"):
            use(T)


# Bad input: matrix, other arguments, error, and the argument and value that its message names.


# No diagonal.
KNOWN: dict[str, Any] = {
    "shape": (35, 35),
    "matvec": SCENE.T.dot,
    "dtype": np.float64,
}
T35 = SCENE.T
BARE = LinearOperator(**KNOWN)
DARK = np.isin(np.arange(35), [2, 9, 23])
COLOUR = [T35] * 3
THREE = r"3 of 35 pixels.*: \(0, 2\), \(1, 2\), \(3, 2\)"
AROUND_0 = np.random.default_rng(5).normal(size=(35, 35))  # eigenvalues
np.fill_diagonal(AROUND_0, 1.0)
SINGULAR = [1.0 + defect * np.eye(35) for defect in (0.0, 1e-17, 1e-16)]
NAN = np.where(np.arange(35 * 35).reshape(35, 35) == 3 * 35 + 4, np.nan, T35)
BAD: list[tuple[Any, dict[str, Any], type[LtclError], str]] = [
    *(
        (np.ones(shape), {}, InputError, rf"matrix .*{re.escape(str(shape))}")
        for shape in [(), (35,), (1, 1, 3, 3, 3), (5, 4, 4), (0, 0)]
    ),
    (np.ones((1, 3, 3, 3)), {}, InputError, r"matrix .*\[3\]"),
    ([T35] * 2, {}, InputError, "matrix .*2 channels"),
    (
        [np.ma.masked_array([1.0, 0], [False, True]), [0, 1.0]],
        {},
        InputTypeError,
        "matrix .*1 masked",
    ),
    ([T35, T35, T35[:4]], {}, InputError, r"matrix .*\(4, 35\), \(35, 35\)"),
    (scipy.sparse.csr_array((0, 5)), {}, InputError, r"matrix .*\(0, 5\)"),
    (T35 * 1j, {}, InputTypeError, "matrix .*complex"),
    ("T.npz", {}, InputTypeError, "matrix .*'T.npz'"),
    (None, {}, InputTypeError, "matrix is None"),
    ([[1.0, 2.0], [3.0]], {}, LtclError, "matrix"),
    (T35 * 1e39, {}, InputError, "matrix .*e\\+3[89].* float32"),
    ([T35, NAN, T35], {}, InputError, r"matrix\[1\] .*1 NaN .*\(3, 4\)"),
    (T35, {"grid": (5, 6)}, InputError, "grid .*30 .* 35"),
    (T35, {"grid": 35}, InputError, "grid .*35"),
    (T35[:12], {}, InputError, "camera_grid .*None.* 12"),
    (T35[:12], {"camera_grid": (3, 5)}, InputError, "camera_grid .*15.* 12"),
    (
        T35[:12],
        {"camera_grid": (3, 4), "first_bounce": "exact"},
        InputError,
        r"first_bounce .*\(12, 35\)",
    ),
    (T35, {"on_dark": "skip"}, InputError, "on_dark .*'skip'"),
    (T35, {"first_bounce": "guess"}, InputError, "first_bounce .*'guess'"),
    (T35, {"first_bounce": np.ones(3)}, InputError, r"first_bounce .*\(3,\).*\(35,\)"),
    (T35, {"first_bounce": np.full(35, np.nan)}, InputError, "first_bounce .*35 NaN"),
    (T35, {"first_bounce": ["a"] * 35}, InputTypeError, "first_bounce .*<U1"),
    (T35, {"probes": 1}, InputError, "probes .*1"),
    (T35, {"probes": 2.5}, InputError, "probes .*2.5"),
    (T35, {"seed": -1}, InputError, "seed .*-1"),
    (BARE, {}, InputError, "first_bounce .*'diagonal'.*LinearOperator"),
    (BARE, {"first_bounce": "exact"}, InputTypeError, "first_bounce.*'exact'.*LinearOperator"),
    (
        AROUND_0,
        {"first_bounce": "estimate", "device": None},
        InputError,
        "first_bounce is 'estimate'",
    ),
    *[
        (matrix, {"first_bounce": "exact"}, InputError, "first_bounce is 'exact'")
        for matrix in SINGULAR
    ],
    *[
        (T35 * lit, {"on_dark": "raise"}, InputError, THREE)
        for lit in (~DARK, ~DARK[:, None], ~DARK & ~DARK[:, None])
    ],
    ([T35, T35 - np.diag(2.0 * DARK), np.eye(35)], {"on_dark": "raise"}, InputError, THREE),
    *[
        (T35, {"dark_threshold": dark}, InputError, "dark_threshold .*at least 0 and below 1")
        for dark in (-0.1, 1.0, "a")
    ],
    (np.zeros((35, 35)), {"on_dark": "mask"}, InputError, "at every pixel"),
    (
        BARE,
        {"first_bounce": np.arange(35), "on_dark": "mask"},
        InputError,
        "first_bounce .*LinearOperator",
    ),
    (
        COLOUR,
        {"mixing": [[1, 2, 3], [2, 4, 6], [0, 0, 1]]},
        InputError,
        "mixing has the condition number",
    ),
    (COLOUR, {"mixing": np.eye(2)}, InputError, r"mixing .*\(2, 2\).*\(3, 3\)"),
    (COLOUR, {"mixing": np.full((3, 3), np.nan)}, InputError, "mixing has 9 NaN"),
    (T35, {"mixing": np.eye(3)}, InputError, "mixing .* one channel"),
    ([COLOUR] * 3, {"mixing": np.eye(3)}, InputError, "mixing .* 3 x 3 blocks"),
    ([COLOUR] * 3, {"first_bounce": np.ones(35)}, InputError, "first_bounce .* of 3 x 3 blocks"),
    ([COLOUR, COLOUR, COLOUR[:2]], {}, InputError, r"matrix .*\[3, 3, 2\]"),
    ([COLOUR, COLOUR, T35], {}, InputError, "matrix has rows of"),
    (
        [COLOUR, COLOUR, [T35, T35, np.ones((35, 5))]],
        {},
        InputError,
        r"matrix .*\(35, 5\), \(35, 35\)",
    ),
    ([COLOUR, COLOUR, [T35, T35, NAN]], {}, InputError, r"matrix\[2\]\[2\] has 1 NaN"),
]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("matrix", "arguments", "error", "says"), BAD)
def test_bad_input_is_refused_by_name_before_a_device_is_opened(matrix, arguments, error, says):
    with pytest.raises(error, match=says) as caught:
        transport(matrix, **{"device": "no such device", **arguments})
    assert "\n" not in str(caught.value)


SHAPES = [
    (),
    (34,),
    (35, 1),
    (7, 5),
    (5, 7, 4),
    (5, 7, 1),
    (0, 5, 7),
    (2, 2, 5, 7),
    (1, 2, 5, 7, 3),
]
NO_PICTURES: list[tuple[Any, type[LtclError], str]] = [
    *(
        (np.ones(shape), InputError, f"pattern has shape {re.escape(str(shape))}")
        for shape in SHAPES
    ),
    (np.full(GRID, np.nan), InputError, "pattern has 35 NaN"),
    (np.ones(GRID) * 1j, InputTypeError, "pattern holds complex"),
]


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize(("light", "error", "says"), NO_PICTURES)
def test_bad_patterns_are_refused_by_name(light, error, says, channels):
    with pytest.raises(error, match=says) as caught:
        ltcl.relight(transport([T35] * channels, device="no such device"), light)
    assert "\n" not in str(caught.value)


KINDS: dict[str, Callable[[Device], ltcl.Transport]] = {
    "array": lambda device: transport(T35),
    "csr": lambda device: transport(scipy.sparse.csr_array(T35)),
    "colour": lambda device: transport([scene.T for scene in SCENES]),
    "mixing": lambda device: transport(COLOUR, mixing=np.eye(3) + 0.1),
    "blocks": lambda device: transport([COLOUR] * 3),
    "open device": lambda device: transport(T35, device=device),
    "operator S F": lambda device: transport(
        ScaledColumns(IdentityPlus(Dense(device, SCENE.R), solution_error=1e-3), SCENE.F),
        first_bounce=SCENE.F,
    ),
}


def copy_by_pickle(T):
    return pickle.loads(pickle.dumps(T))  # noqa: S301 - our own


@pytest.mark.parametrize("again", [copy.copy, copy.deepcopy, copy_by_pickle])
@pytest.mark.parametrize("kind", KINDS)
def test_a_used_transport_is_copied_and_pickled(device, kind, again):
    T = KINDS[kind](device)
    p = pattern(*GRID) if T.channels == 1 else pattern(*GRID, 3)
    before = T @ p, ltcl.compensate(T, 0.1 * p).pattern
    other = again(T)
    assert repr(other) == repr(T)
    np.testing.assert_array_equal(other @ p, before[0])
    np.testing.assert_allclose(ltcl.compensate(other, 0.1 * p).pattern, before[1], atol=1e-6)


def test_a_bare_operator_cannot_leave_its_device(device):
    with pytest.raises(InputTypeError, match="T is made of Dense"):
        pickle.dumps(transport(Dense(device, SCENE.T)))
    with pytest.raises(InputTypeError, match="IdentityPlus"):
        pickle.dumps(transport(SCENE.T, device=device).interreflection)


@pytest.mark.slow
def test_a_compressed_transport_and_an_inverse_are_unpickled_without_a_device(device, monkeypatch):
    """Else a pool of processes would wait for ever for a worker that fails to unpickle its work."""
    T = ltcl.compress(ltcl.scenes.dihedral(4).transport(device=device), 0.05)
    inverse = ltcl.invert(T, 0.1)
    p = np.full(T.grid, 0.5)
    texts = pickle.dumps(T), pickle.dumps(inverse)
    with monkeypatch.context() as patch:
        patch.setattr("ltcl.device.discovery.open_device", None)
        patch.setattr("ltcl.transport.transport.open_device", None)
        patch.setattr("ltcl.solvers.inverse.open_device", None)
        T_again, inverse_again = (pickle.loads(text) for text in texts)  # noqa: S301
        assert (T_again.shape, T_again.channels, inverse_again.channels) == (T.shape, 1, 1)
        T_again = pickle.loads(pickle.dumps(T_again))  # noqa: S301
    np.testing.assert_array_equal(T_again @ p, T @ p)
    np.testing.assert_array_equal(inverse_again.pattern(p), inverse.pattern(p))


@pytest.mark.parametrize("form", ["array", "csr", "operator"])
@pytest.mark.parametrize("share", [1e-4, 1e-30])
def test_relighting_has_all_digits_whatever_the_first_bounce(device, form, share):
    """I + R has no digit of a diagonal of T that is far below F, and is not solved with."""
    F = np.diag(SCENE.T) / share
    T = transport(FORMS[form](SCENE.T), first_bounce=F, device=device)
    p = pattern(*GRID)
    np.testing.assert_allclose((T @ p).ravel(), SCENE.T @ p.ravel(), rtol=ROUNDING)
    if form != "operator":
        with pytest.raises(InputError, match=r"first_bounce is .* 16"):
            ltcl.separate(T, SCENE.T @ p.ravel())


@pytest.mark.filterwarnings("error")
def test_a_first_bounce_too_small_for_float32_is_refused():
    T = ltcl.Transport(
        [[1, 0.5], [0.3, 1e-39]], (1, 2), noise=Noise.uniform((2, 2), 0.0), dark_threshold=0.0
    )
    with pytest.raises(InputError, match=r"float32.* first bounce"):
        ltcl.relight(T, np.ones((1, 2)))


@pytest.mark.parametrize(
    ("task", "codes", "says"),
    [
        (lambda T, p: T @ p, np.uint8(200), "uint8, up to 200"),
        (ltcl.separate, np.uint8(200), "uint8, up to 200"),
        (lambda T, p: ltcl.compensate(T, FLAT, background=p), np.uint8(200), "uint8, up to 200"),
        (lambda T, p: ltcl.compensate(T, FLAT, weights=p), np.uint8(200), ""),
        *[(ltcl.compensate, code, "255") for code in (np.uint8(255), np.float32(255), 255.0)],
        (ltcl.compensate, 1, ""),
        (lambda T, p: ltcl.compensate(transport(1000 * T35), p), 1000.0, ""),  # in the units of T
    ],
)
def test_codes_of_a_picture_file_are_worth_a_warning(caplog, task, codes, says):
    task(transport(SCENE.T), np.full(GRID, codes))
    assert says in caplog.text
    assert len(caplog.records) == bool(says)


FLAT = np.full(GRID, 0.1)
