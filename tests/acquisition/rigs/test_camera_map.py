# SPDX-License-Identifier: BSD-3-Clause
"""What camera pixels see by area, against areas that are known."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition import camera_map
from ltcl.errors import InputError


@pytest.mark.parametrize("points", [1, 7, 12])
def test_pixels_on_the_grid_see_one_each(points: int) -> None:
    C = camera_map(lambda u, v: (u, v), (3, 5), (3, 5), points=points)
    np.testing.assert_allclose(C.toarray(), np.eye(15), atol=1e-15)


def test_areas_of_a_shifted_and_scaled_camera_are_exact_where_rays_divide_them() -> None:
    """A camera pixel of 0.5 x 0.75 whose edges lie on quarters: overlaps of intervals, by 12 rays a side."""
    C = camera_map(lambda u, v: (0.5 * u + 0.125, 0.75 * v - 0.25), (4, 6), (3, 3)).toarray()

    def overlaps(start: float, size: float, count: int) -> np.ndarray:
        low = start + size * (np.arange(count)[:, None] - 0.5)
        n = np.arange(3)
        return np.clip(np.minimum(low + size, n + 0.5) - np.maximum(low, n - 0.5), 0, None) / size

    np.testing.assert_allclose(C, np.kron(overlaps(-0.25, 0.75, 4), overlaps(0.125, 0.5, 6)), atol=1e-12)


def test_a_turned_square_sees_areas_of_polygons() -> None:
    """A camera pixel turned by 45 degrees about a corner of four pixels sees a quarter of each."""
    s = np.sqrt(0.5)
    C = camera_map(lambda u, v: (0.5 + s * (u - v), 0.5 + s * (u + v)), (1, 1), (2, 2), points=64)
    np.testing.assert_allclose(C.toarray(), 0.25, atol=0.01)
    # Moved by half its diagonal, it has its corner on the border of the first column.
    C = camera_map(lambda u, v: (0.5 + s * (1 + u - v), 0.5 + s * (u + v)), (1, 1), (2, 3), points=64)
    assert C.toarray()[0, [0, 3]].sum() < 0.01


def test_rays_beside_the_grid_and_nowhere_see_nothing() -> None:
    def place(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.where(u > 1.0, np.nan, u), v

    C = camera_map(place, (2, 4), (1, 4))
    np.testing.assert_allclose(C.sum(axis=1), [1, 0.5, 0, 0, 0, 0, 0, 0], atol=1e-12)


def test_a_function_of_another_shape_is_refused() -> None:
    with pytest.raises(InputError, match=r"place gives \(\) and \(2, 3\)"):
        camera_map(lambda u, v: (0.0, v), (2, 3), (2, 3))
