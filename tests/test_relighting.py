# SPDX-License-Identifier: BSD-3-Clause
"""`relight` is the matrix product, in whatever layout pictures come."""

from __future__ import annotations

import numpy as np
import pytest

import ltcl
from ltcl.errors import InputError, InputTypeError

GRID = (3, 5)
N = 15
random = np.random.default_rng(70)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("camera", [None, (2, 4)])
@pytest.mark.parametrize(
    "shape", [GRID, (*GRID, 3), (4, *GRID), (4, *GRID, 3), (N,), (1, *GRID), (3, *GRID)], ids=str
)
def test_it_is_the_product_with_the_matrix(device, shape, camera, channels):
    rows = N if camera is None else 8
    matrices = [random.uniform(0.0, 1.0, (rows, N)) + np.eye(rows, N) for _ in range(channels)]
    T = ltcl.Transport(matrices, GRID, camera_grid=camera, device=device)
    pattern = random.uniform(0.0, 1.0, shape)
    picture = ltcl.relight(T, pattern)
    assert picture.dtype == np.float32
    np.testing.assert_array_equal(picture, T @ pattern)

    colour = shape[-1] == 3
    frames = pattern.reshape(-1, N, 3 if colour else 1)
    exact = [
        frames[..., c % frames.shape[2]] @ matrices[c % channels].T
        for c in range(max(channels, frames.shape[2]))
    ]
    pixels = (rows,) if shape == (N,) else camera or GRID
    front = shape[:1] if len(shape) - colour == 3 else ()
    layout = (*front, *pixels, *((3,) if len(exact) == 3 else ()))
    np.testing.assert_allclose(picture, np.stack(exact, axis=-1).reshape(layout), rtol=1e-6)


@pytest.mark.parametrize(
    ("pattern", "error", "says"),
    [
        (np.ones((5, 3)), InputError, r"pattern has shape \(5, 3\).*\(3, 5\)"),
        *[(np.ones(shape), InputError, "pattern has shape") for shape in ((2, 2, 3, 5, 3), 14, (0, 3, 5))],
        (np.full(GRID, np.nan), InputError, "pattern has 15 NaN"),
        (np.ones(GRID) * 1j, InputTypeError, "pattern holds complex"),
    ],
)
def test_bad_patterns_are_refused_by_name(pattern, error, says):
    T = ltcl.Transport(np.eye(N), GRID, device="there is no such device")
    with pytest.raises(error, match=says) as caught:
        ltcl.relight(T, pattern)
    assert "\n" not in str(caught.value)
