# SPDX-License-Identifier: BSD-3-Clause
"""`compensate` makes the wall look as desired, and tells what the projector cannot do."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.errors import ConvergenceError, InputError, InputTypeError, LtclError
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
    """T pattern in float64, frames and colours as they come; `colours`: through a transport of each."""
    flat = pattern.reshape(-1, N, 3 if pattern.shape[-1] == 3 else 1)
    matrices = [scene.T for scene in SCENES] if colours else [SCENE.T] * flat.shape[-1]
    return np.stack([flat[..., c] @ T.T for c, T in enumerate(matrices)], axis=-1).reshape(pattern.shape)


def close(found: np.ndarray, wanted: np.ndarray, tolerance: float = 1e-4) -> bool:
    return bool(np.linalg.norm(found - wanted) <= tolerance * np.linalg.norm(wanted))


def solutions(c: ltcl.Compensation) -> tuple[ltcl.Solution, ...]:
    return c.solution if isinstance(c.solution, tuple) else (c.solution,)


SHAPES = [GRID, (*GRID, 3), (2, *GRID), (2, *GRID, 3), (N,)]
BACKGROUNDS = [  # as many frames and colours as are desired, or one
    (shape, (*frames, *GRID, *colours))
    for shape in SHAPES[:4]
    for frames in [(), (2,)][: len(shape) - 1 - (shape[-1] == 3)]
    for colours in [(), (3,)][: 1 + (shape[-1] == 3)]
]


@pytest.mark.parametrize("method", ["auto", "chebyshev", "direct"])
@pytest.mark.parametrize("shape", SHAPES)
def test_pushed_back_through_T_the_pattern_gives_the_target(T, shape, method):
    desired = picture(random.uniform(0.3, 0.9, shape))
    c = ltcl.compensate(T, desired, method=method, rtol=1e-5)
    assert c.pattern.shape == c.appearance.shape == c.target.shape == shape
    assert c.pattern.dtype == c.appearance.dtype == np.float32
    assert close(picture(c.pattern.astype(float)), desired)
    assert close(c.appearance, desired)
    assert (c.clipped, c.gain) == (0.0, 1.0)
    assert c.error < 1e-4
    assert [s.converged for s in solutions(c)] == [True]


@pytest.mark.parametrize("shape", SHAPES[:4])
def test_every_colour_has_its_own_transport(RGB, shape):
    pattern = random.uniform(0.3, 0.9, shape)
    colour = shape[-1] == 3
    desired = picture(pattern, colours=True) if colour else 1.0 + pattern
    c = ltcl.compensate(RGB, desired, bounds=(-100, 100), rtol=1e-5)
    wanted = desired if colour else np.repeat(desired[..., None], 3, axis=-1)  # grey is wanted of all three
    assert c.pattern.shape == wanted.shape
    assert close(picture(c.pattern.astype(float), colours=True), wanted)
    assert [s.converged for s in solutions(c)] == [True] * 3


@pytest.mark.parametrize("gain", [0.5, 1.0, 2.0])
@pytest.mark.parametrize(("shape", "dark"), BACKGROUNDS, ids=str)
def test_gain_and_background(T, shape, dark, gain):
    """T pattern = gain desired - background."""
    desired, background = random.uniform(0.3, 0.9, shape), random.uniform(0.0, 0.1, dark)
    c = ltcl.compensate(T, desired, background=background, gain=gain, bounds=(-100, 100), rtol=1e-6)
    wide = background if (shape[-1] == 3) == (dark[-1] == 3) else background[..., None]
    assert close(picture(c.pattern.astype(float)), gain * desired - wide)
    assert close(c.appearance, gain * desired)
    np.testing.assert_allclose(c.target, gain * desired, rtol=1e-6)
    assert c.gain == gain


@pytest.mark.parametrize("bounds", [(0.0, 1.0), (0.2, 0.6), (-0.5, 0.5), (0.0, 255.0)])
@pytest.mark.parametrize("shape", SHAPES[:3])
def test_what_the_bounds_cost_is_reported_to_the_value(T, shape, bounds):
    low, high = bounds
    beyond = 0.3 * (high - low)
    target = picture(random.uniform(low - beyond, high + beyond, shape))
    c = ltcl.compensate(T, target, bounds=bounds, rtol=1e-4, method="direct")
    assert c.pattern.min() >= np.float32(low)
    assert c.pattern.max() <= np.float32(high)
    seen = picture(c.pattern.astype(float))
    assert close(c.appearance, seen, 1e-5)  # what will be seen, not what was wished
    size = np.linalg.norm(target)
    assert c.error == pytest.approx(np.linalg.norm(seen - target) / size, rel=1e-2, abs=1e-6)
    missing = np.where(np.abs(target - seen) > 1e-4 * np.abs(target).max(), target - seen, 0.0)
    np.testing.assert_allclose(c.out_of_reach, missing, rtol=0, atol=2e-4 * np.abs(target).max())
    near = 0.01 * (high - low)
    at_bound = (c.pattern <= low + near) | (c.pattern >= high - near)
    assert 0.0 < c.clipped <= np.mean(at_bound)


def test_a_pattern_at_its_bounds_is_not_called_clipped(T):
    c = ltcl.compensate(T, picture(np.ones(GRID)), rtol=1e-6, method="direct")
    assert c.clipped == 0.0
    assert c.pattern.max() <= 1.0


@pytest.mark.parametrize("first_bounce", ["diagonal", "exact", random.uniform(0.3, 0.9, N)], ids=str)
def test_it_does_not_depend_on_the_first_bounce(device, first_bounce):
    pattern = random.uniform(0.2, 0.8, GRID)
    T = ltcl.Transport(SCENE.T, GRID, first_bounce, device=device)
    c = ltcl.compensate(T, picture(pattern), rtol=1e-6)
    np.testing.assert_allclose(c.pattern, pattern, rtol=0, atol=1e-4)


def test_no_light_wanted_is_no_light(T):
    c = ltcl.compensate(T, np.zeros(GRID))
    assert not c.pattern.any()
    assert c.error == 0.0


def test_options_reach_the_solver(T):
    desired = picture(random.uniform(0.2, 0.8, GRID))
    with pytest.raises(ConvergenceError) as caught:
        ltcl.compensate(T, desired, method="jacobi")
    assert caught.value.solution.status is Status.DIVERGED
    c = ltcl.compensate(T, desired, method="chebyshev", maxiter=1, throw=False)
    assert [s.status for s in solutions(c)] == [Status.MAXITER]


FINE = np.full(GRID, 0.5)
BAD: dict[str, tuple[dict[str, Any], type[LtclError], str]] = {
    "desired of another size": (
        {"desired": np.ones((6, 5))},
        InputError,
        r"desired has shape \(6, 5\); .*\(5, 6\)",
    ),
    "desired of two colours": (
        {"desired": np.ones((*GRID, 2))},
        InputError,
        r"desired has shape \(5, 6, 2\)",
    ),
    "no frames": ({"desired": np.ones((0, *GRID))}, InputError, r"desired has shape \(0, 5, 6\)"),
    "desired has NaN": ({"desired": FINE * np.nan}, InputError, "desired has 30 NaN or infinite value"),
    "desired is text": ({"desired": "a.png"}, InputTypeError, "desired holds <U5"),
    "bounds in the wrong order": ({"bounds": (1, 0)}, InputError, r"bounds\[1\] is 0; .* above 1"),
    "bounds of no width": ({"bounds": (1, 1)}, InputError, r"bounds\[1\] is 1; .* above 1"),
    "bounds infinite": (
        {"bounds": (0, np.inf)},
        InputError,
        r"bounds\[1\] is inf; it must be a finite number",
    ),
    "bounds a number": ({"bounds": 1.0}, InputError, r"bounds is 1.0; it must be \(low, high\)"),
    "bounds of three": (
        {"bounds": (0, 1, 2)},
        InputError,
        r"bounds is \(0, 1, 2\); it must be \(low, high\)",
    ),
    "bounds missing": ({"bounds": None}, InputError, r"bounds is None; it must be \(low, high\)"),
    "gain zero": ({"gain": 0.0}, InputError, "gain is 0.0; it must be 'auto' or a finite number above 0"),
    "gain negative": ({"gain": -2}, InputError, "gain is -2; it must be"),
    "gain NaN": ({"gain": np.nan}, InputError, "gain is nan; it must be"),
    "gain text": ({"gain": "most"}, InputError, "gain is 'most'; it must be 'auto' or a finite number"),
    "loss of a gain": ({"gain": 2, "loss": 0.1}, InputError, "loss is 0.1, but gain is 2; .* gain='auto'"),
    "loss zero": ({"gain": "auto", "loss": 0}, InputError, "loss is 0; it must be .* above 0 and below 1"),
    "loss one": ({"gain": "auto", "loss": 1.0}, InputError, "loss is 1.0; it must be .* below 1"),
    "weights of another size": ({"weights": np.ones((6, 5))}, InputError, r"weights has shape \(6, 5\)"),
    "weights of more frames": ({"weights": np.ones((2, *GRID))}, InputError, "weights has 2 frame"),
    "weights have NaN": ({"weights": FINE * np.nan}, InputError, "weights has 30 NaN"),
    "weights negative": ({"weights": FINE - 1}, InputError, "weights range from -0.5 to -0.5; .* at least 0"),
    "weights zero": ({"weights": 0 * FINE}, InputError, "weights range from 0 to 0; .* not all 0"),
    "atol negative": ({"atol": -1}, InputError, "atol is -1; it must be"),
    "maxiter": ({"maxiter": 0}, InputError, "maxiter is 0; it must be"),
    "background of another size": (
        {"background": np.ones((6, 5))},
        InputError,
        r"background has shape \(6, 5\)",
    ),
    "background has NaN": (
        {"background": FINE * np.inf},
        InputError,
        "background has 30 NaN or infinite value",
    ),
    "background of more frames": ({"background": np.ones((2, *GRID))}, InputError, "background has 2 frame"),
    "background in colour": (
        {"background": np.ones((*GRID, 3))},
        InputError,
        r"background .* 3 colour\(s\), desired",
    ),
    "unknown method": ({"method": "magic"}, InputError, "method is 'magic'; it must be one of"),
    "unknown option": ({"method": "jacobi", "omega": 1}, InputTypeError, "unknown option 'omega'"),
    "rtol": ({"rtol": 0}, InputError, "rtol"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_refused_by_name(T, case):
    change, error, says = BAD[case]
    with pytest.raises(error, match=says) as caught:
        ltcl.compensate(T, **{"desired": FINE, **change})
    assert "\n" not in str(caught.value)


def test_pictures_are_refused_before_anything_is_uploaded():
    T = ltcl.Transport(SCENE.T, GRID, device="there is no such device")
    for change, error, says in BAD.values():
        if not {"method"} & set(change):  # those are the solver's
            with pytest.raises(error, match=says):
                ltcl.compensate(T, **{"desired": FINE, **change})


@pytest.mark.parametrize(("colours", "coloured"), [((), False), ((3,), False), ((3,), True)])
def test_each_frame_has_an_error_and_a_share_of_its_own(T, RGB, colours, coloured):
    T = RGB if coloured else T
    scale = np.array([0.5, 1.0, 3.0]).reshape(3, 1, 1, *[1] * len(colours))
    frames = scale * picture(random.uniform(0.3, 0.9, (3, *GRID, *colours)), coloured)
    weights = random.uniform(0.5, 2.0, GRID)
    together = ltcl.compensate(T, frames, weights=weights)
    apart = [ltcl.compensate(T, frame, weights=weights) for frame in frames]
    np.testing.assert_allclose(together.frame_errors, [c.error for c in apart], atol=0.02)
    np.testing.assert_allclose(together.frame_clipped, [c.clipped for c in apart], atol=0.1)
    assert together.frame_clipped[0] == 0.0 < together.frame_clipped[2]
    assert together.clipped == pytest.approx(together.frame_clipped.mean())
    counts = weights.reshape(*GRID, *[1] * len(colours))
    squares = (np.square(counts * part) for part in (together.appearance - frames, frames))
    off, size = (part.reshape(3, -1).sum(axis=1) for part in squares)
    np.testing.assert_allclose(together.frame_errors, np.sqrt(off / size), rtol=1e-3, atol=1e-6)
