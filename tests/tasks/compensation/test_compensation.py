# SPDX-License-Identifier: BSD-3-Clause
"""`compensate` makes the wall look as desired, and tells what the projector cannot do."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.errors import ConvergenceError, InputError, LtclError
from ltcl.operators import Dense, IdentityPlus, ScaledColumns
from ltcl.solvers import Status
from tests.problems import lambertian

GRID = (5, 6)
N = 30
SCENES = [lambertian(N, rho, seed=50 + channel) for channel, rho in enumerate((1.2, 0.7, 3.0))]
SCENE = SCENES[0]
random = np.random.default_rng(51)


@pytest.fixture(scope="module")
def T(device):
    return ltcl.Transport(SCENE.T, GRID, device=device)


@pytest.fixture(scope="module")
def RGB(device):
    return ltcl.Transport([scene.T for scene in SCENES], GRID, device=device)


def picture(pattern: np.ndarray, colours: bool = False) -> np.ndarray:
    """T pattern in float64; `colours`: through a transport of each, else the first for all."""
    channels = 3 if pattern.shape[-1] == 3 else 1
    flat = pattern.reshape(-1, N, channels)
    pictures = []
    for c in range(channels):
        scene = SCENES[c] if colours else SCENE
        pictures.append(flat[..., c] @ scene.T.T)
    return np.stack(pictures, axis=-1).reshape(pattern.shape)


def close(found: np.ndarray, wanted: np.ndarray, tolerance: float = 1e-4) -> bool:
    return bool(np.linalg.norm(found - wanted) <= tolerance * np.linalg.norm(wanted))


def solutions(c: ltcl.Compensation) -> tuple[ltcl.Solution, ...]:
    return c.solution if isinstance(c.solution, tuple) else (c.solution,)


# Shapes of the picture, and of backgrounds with as many frames and colours, or one.
BACKGROUNDS = [
    (GRID, GRID),
    (GRID, ()),
    ((N,), ()),
    ((*GRID, 3), GRID),
    ((*GRID, 3), (*GRID, 3)),
    ((2, *GRID), GRID),
    ((2, *GRID), (2, *GRID)),
    ((2, *GRID, 3), GRID),
    ((2, *GRID, 3), (*GRID, 3)),
    ((2, *GRID, 3), (2, *GRID)),
    ((2, *GRID, 3), (2, *GRID, 3)),
]


@pytest.mark.parametrize(("method", "gain"), [("auto", 0.5), ("chebyshev", 1.0), ("direct", 2.0)])
@pytest.mark.parametrize("colours", [False, True])
@pytest.mark.parametrize(("shape", "dark"), BACKGROUNDS, ids=str)
def test_pushed_back_through_T_the_pattern_gives_the_target(
    T, RGB, shape, dark, colours, method, gain
):
    """Grey is wanted of all three channels of a T in colour, each of which has its own pattern."""
    desired = random.uniform(0.3, 0.9, shape)
    background = random.uniform(0.0, 0.1, dark)
    c = ltcl.compensate(
        RGB if colours else T,
        desired,
        background=background,
        method=method,
        rtol=1e-6,
        bounds=(-100, 100),
        gain=gain,
    )
    if dark and shape[-1] == 3 and dark[-1] != 3:
        background = background[..., None]
    wanted = gain * desired
    light = gain * desired - background
    if colours and shape[-1] != 3:
        wanted = np.repeat(wanted[..., None], 3, axis=-1)
        light = np.repeat(light[..., None], 3, axis=-1)
    assert c.pattern.shape == c.appearance.shape == c.target.shape == wanted.shape
    assert c.pattern.dtype == c.appearance.dtype == np.float32
    assert close(picture(c.pattern.astype(float), colours), light)
    assert close(c.appearance, wanted)
    np.testing.assert_allclose(c.target, wanted, rtol=1e-6)
    assert c.clipped == 0.0
    assert c.gain == gain
    assert c.error < 1e-4
    assert len(solutions(c)) == (3 if colours else 1)
    assert all(s.converged for s in solutions(c))


def test_a_pattern_at_its_bounds_is_not_called_clipped(T):
    c = ltcl.compensate(T, picture(np.ones(GRID)), rtol=1e-6, method="direct")
    assert c.clipped == 0.0
    assert c.pattern.max() <= 1.0


@pytest.mark.parametrize(
    "first_bounce", ["diagonal", "exact", random.uniform(0.3, 0.9, N)], ids=str
)
def test_it_does_not_depend_on_the_first_bounce(device, first_bounce):
    pattern = random.uniform(0.2, 0.8, GRID)
    T = ltcl.Transport(SCENE.T, GRID, first_bounce, device=device)
    c = ltcl.compensate(T, picture(pattern), rtol=1e-6)
    np.testing.assert_allclose(c.pattern, pattern, rtol=0, atol=1e-4)


def test_options_reach_the_solver(T):
    desired = picture(random.uniform(0.2, 0.8, GRID))
    with pytest.raises(ConvergenceError) as caught:
        ltcl.compensate(T, desired, method="jacobi")
    assert caught.value.solution.status is Status.DIVERGED
    c = ltcl.compensate(T, desired, method="chebyshev", maxiter=1, throw=False)
    assert [s.status for s in solutions(c)] == [Status.MAXITER]


FINE = np.full(GRID, 0.5)
# Changed arguments, and the argument and value that a refusal names.
BAD: list[tuple[dict[str, Any], str]] = [
    ({"desired": np.ones((6, 5))}, r"desired .*\(6, 5\)"),
    ({"weights": np.ones((6, 5))}, r"weights .*\(6, 5\)"),
    ({"background": np.ones((6, 5))}, r"background .*\(6, 5\)"),
    ({"desired": FINE * np.nan}, "desired .*30 NaN"),
    ({"weights": FINE * np.nan}, "weights .*30 NaN"),
    ({"background": FINE * np.nan}, "background .*30 NaN"),
    ({"weights": np.ones((2, *GRID))}, "weights has 2 frame"),
    ({"background": np.ones((2, *GRID))}, "background has 2 frame"),
    ({"desired": np.ones((*GRID, 2))}, r"desired .*\(5, 6, 2\)"),
    ({"desired": "a.png"}, "desired .*'a.png'"),
    ({"desired": np.ma.masked_array(FINE, FINE > 0)}, "desired .*masked"),
    ({"background": np.ones((*GRID, 3))}, r"background .* 3 colour"),
    ({"background": np.nan}, "background is nan"),
    ({"weights": FINE - 1}, "weights .*-0.5"),
    ({"weights": 0 * FINE}, "weights .*0"),
    ({"bounds": 1.0}, "bounds is 1.0"),
    ({"bounds": (0, 1, 2)}, r"bounds is \(0, 1, 2\)"),
    ({"bounds": None}, "bounds is None"),
    ({"bounds": (1, 0)}, r"bounds is \(1, 0\)"),
    ({"bounds": (1, 1)}, r"bounds is \(1, 1\)"),
    ({"bounds": (1, 1 + 1e-12)}, "bounds is .*float32"),
    ({"bounds": (0, np.inf)}, r"bounds\[1\] is inf"),
    ({"bounds": (FINE, 2 * FINE)}, r"bounds\[0\] is .*\(5, 6\)"),
    ({"gain": 0.0}, "gain is 0.0"),
    ({"gain": -2}, "gain is -2"),
    ({"gain": np.nan}, "gain is nan"),
    ({"gain": "most"}, "gain is 'most'"),
    ({"gain": None}, "gain is None"),
    ({"gain": True}, "gain is True"),
    ({"gain": np.ones(3)}, r"gain is .*\(3,\)"),
    ({"gain": 2, "loss": 0.1}, "loss is 0.1, .*gain is 2"),
    ({"gain": "auto", "loss": 0}, "loss is 0"),
    ({"gain": "auto", "loss": 1.0}, "loss is 1.0"),
    ({"gain": "auto", "loss": 1e-12}, "loss is 1e-12"),
    ({"atol": -1}, "atol is -1"),
    ({"rtol": -1}, "rtol is -1"),
    ({"maxiter": -1}, "maxiter is -1"),
    ({"clamp": -1}, "clamp is -1"),
    ({"gian": "auto"}, "'gian'"),
    ({"method": "magic"}, "method is 'magic'"),
    ({"spectrum": (1, 2)}, "spectrum .*'chebyshev'.*'auto'"),
    ({"method": "jacobi", "omega": 1}, "omega.*'jacobi'"),
    ({"method": "jacobi", "samples": 1}, "samples.*'jacobi'"),
    ({"method": "jacobi", "seed": 1}, "seed.*'jacobi'"),
    ({"method": "monte_carlo", "pixels": [1, 2]}, "pixels"),
]


@pytest.mark.parametrize(("change", "says"), BAD)
@pytest.mark.parametrize("opened", [True, False])
def test_bad_input_is_refused_by_name_before_anything_is_uploaded(T, change, says, opened):
    if not opened:
        T = ltcl.Transport(SCENE.T, GRID, device="there is no such device")
    with pytest.raises(LtclError, match=says) as caught:
        ltcl.compensate(T, **{"desired": FINE, **change})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("desired", [0 * FINE, -FINE], ids=["black", "negative"])
def test_no_gain_is_the_largest_of_a_picture_without_light(T, desired):
    with pytest.raises(InputError, match=r"gain is 'auto', .*desired"):
        ltcl.compensate(T, desired, gain="auto")


@pytest.mark.parametrize(("colours", "coloured"), [((), False), ((3,), False), ((3,), True)])
def test_each_frame_has_an_error_and_a_share_of_its_own(T, RGB, colours, coloured):
    T = RGB if coloured else T
    colour_axes = [1] * len(colours)
    scale = np.array([0.5, 1.0, 3.0]).reshape(3, 1, 1, *colour_axes)
    frames = scale * picture(random.uniform(0.3, 0.9, (3, *GRID, *colours)), coloured)
    weights = random.uniform(0.5, 2.0, GRID)
    together = ltcl.compensate(T, frames, weights=weights)
    apart = [ltcl.compensate(T, frame, weights=weights).clipped for frame in frames]
    np.testing.assert_allclose(together.frame_clipped, apart, atol=0.1)
    assert together.frame_clipped[0] == 0.0 < together.frame_clipped[2]
    assert together.clipped == pytest.approx(together.frame_clipped.mean())
    w = weights.reshape(*GRID, *colour_axes)
    errors = np.linalg.norm((w * (together.appearance - frames)).reshape(3, -1), axis=1)
    sizes = np.linalg.norm((w * frames).reshape(3, -1), axis=1)
    np.testing.assert_allclose(together.frame_errors, errors / sizes, rtol=1e-3, atol=1e-6)


# Numbers at the edges of what floats hold.


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("scale", [1e-300, 1e-155, 1e155, 1e300])
def test_only_ratios_of_weights_count(T, scale):
    desired = picture(random.uniform(0.0, 1.6, GRID))
    weights = random.uniform(0.5, 2.0, GRID)
    one = ltcl.compensate(T, desired, weights=weights, rtol=1e-4)
    scaled = ltcl.compensate(T, desired, weights=scale * weights, rtol=1e-4)
    assert scaled.error == pytest.approx(one.error, abs=2e-4)
    assert scaled.gap == pytest.approx(one.gap, abs=2e-4)
    assert scaled.limited[0].errors == pytest.approx(scale * one.limited[0].errors, rel=1e-2)


@pytest.mark.parametrize("scale", [1e-45, 1e-29, 1e29, 1e45])
def test_light_is_right_in_any_unit_or_refused(device, scale):
    """Pattern, error and certificate of a picture beyond float32 would be meaningless."""
    desired = picture(random.uniform(0.0, 1.6, GRID))
    root = np.sqrt(scale)
    arguments = {"bounds": (0.0, root), "rtol": 1e-4}
    T = ltcl.Transport(root * SCENE.T, GRID, device=device)
    if not 1e-30 < scale < 1e30:
        for far in (scale * desired, desired):
            with pytest.raises(InputError, match=r"(T|desired|light of) .*1e-30 to 1e\+38"):
                ltcl.compensate(T, far, **arguments)
        return
    c = ltcl.compensate(T, scale * desired, **arguments)
    one = ltcl.compensate(ltcl.Transport(SCENE.T, GRID, device=device), desired, rtol=1e-4)
    assert c.error == pytest.approx(one.error, abs=1e-4)
    assert c.clipped == one.clipped
    np.testing.assert_allclose(c.pattern / root, one.pattern, atol=1e-2)


@pytest.mark.parametrize("bounds", [(0.1, 0.9), (0.3, 0.7), (-0.1, 1.1), (1 / 3, 2 / 3)])
@pytest.mark.parametrize("clamp", [False, True])
def test_no_rounding_leaves_the_bounds(T, bounds, clamp):
    low, high = bounds
    c = ltcl.compensate(
        T, picture(random.uniform(low - 1, high + 1, GRID)), bounds=bounds, clamp=clamp
    )
    pattern = c.pattern.astype(np.float64)
    assert c.clipped > 0.0
    assert low <= pattern.min() < pattern.max() <= high


@pytest.mark.slow
@pytest.mark.parametrize("error", [0.0, 1e-3, 0.05])
def test_the_tolerance_is_what_a_compressed_T_or_an_inverse_allows(device, error):
    S = IdentityPlus(Dense(device, SCENE.R), solution_error=error)
    T = ltcl.Transport(ScaledColumns(S, SCENE.F), GRID, SCENE.F)
    c = ltcl.compensate(T, FINE)
    assert c.rtol == max(1e-2, error)
    assert c.transport_error == error
    if error:
        with pytest.raises(InputError, match=r"rtol is 0\.0001"):
            ltcl.compensate(T, FINE, rtol=1e-4)
    exact = ltcl.Transport(SCENE.T, GRID, device=device)
    inverse = ltcl.invert(exact, 0.02)
    assert ltcl.compensate(exact, FINE, inverse=inverse).rtol == max(1e-2, inverse.error)
