# SPDX-License-Identifier: BSD-3-Clause
"""The box: what theory says about closed and open rooms of uniform albedo."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl import checks
from ltcl.errors import InputError, MemoryLimitError
from ltcl.scenes import Scene, box


def spectrum(scene: Scene) -> np.ndarray:
    """Eigenvalues of A, ascending; A is symmetric where areas and albedos are equal."""
    A = scene.A
    assert isinstance(A, np.ndarray)
    assert (A == A.T).all()
    return np.linalg.eigvalsh(A)


@pytest.mark.parametrize("albedo", [0.3, 0.5, 0.8])
def test_closed_box_of_uniform_albedo_reaches_the_bound_of_equation_14(albedo: float) -> None:
    scene = box(4, albedo=albedo)
    bounce = spectrum(scene)
    assert max(abs(bounce)) == pytest.approx(albedo, rel=1e-10)
    (T,) = scene.matrices()
    R = T / albedo - np.eye(len(T))
    assert max(abs(np.linalg.eigvalsh((R + R.T) / 2))) == pytest.approx(albedo / (1 - albedo), rel=1e-9)


def test_closed_box_under_uniform_light_glows_uniformly() -> None:
    (T,) = box(5, albedo=0.6).matrices()
    assert T.sum(axis=1) == pytest.approx(np.full(len(T), 0.6 / (1 - 0.6)), rel=1e-10)


def test_every_wall_taken_away_weakens_the_bounces() -> None:
    """Figure 5d: fewer sides converge faster."""
    strength = [max(abs(spectrum(box(4, sides=sides, albedo=0.62)))) for sides in range(1, 7)]
    assert strength[0] == 0
    assert (np.diff(strength) > 0).all()
    assert strength[-1] == pytest.approx(0.62, rel=1e-10)


def test_one_wall_alone_shows_direct_light_only() -> None:
    (T,) = box(3, sides=1, albedo=0.7).matrices()
    assert pytest.approx(0.7 * np.eye(9), abs=1e-15) == T


@pytest.mark.parametrize("sides", range(1, 7))
def test_grid_and_walls(sides: int) -> None:
    scene = box(3, sides=sides)
    assert scene.grid == (3, 3 * sides)
    names = ["left", "right", "floor", "ceiling", "near right", "near left"]
    assert [wall.name for wall in scene.walls] == names[:sides]
    assert scene.area.sum() == pytest.approx(sides)


def test_each_wall_has_its_colour() -> None:
    scene = box(2, sides=3, albedo=[(0.9, 0, 0), (0, 0.8, 0), (0, 0, 0.7)])
    picture = scene.picture(scene.first_bounce)
    assert picture[1, [0, 2, 4]].tolist() == [[0.9, 0, 0], [0, 0.8, 0], [0, 0, 0.7]]


def test_coarse_patches_average_fine_ones() -> None:
    """Two resolutions of one room agree: 2 x 2 fine patches make a coarse one."""
    fine, coarse = box(8, sides=5), box(4, sides=5)
    blocks = fine.form_factors.reshape(4, 2, 20, 2, 4, 2, 20, 2)
    assert blocks.sum(axis=(5, 7)).mean(axis=(1, 3)).reshape(80, 80) == pytest.approx(
        coarse.form_factors, rel=1e-9, abs=1e-15
    )


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        ({"n": 0}, "n is 0; it must be a whole number of at least 1"),
        ({"n": 2.0}, "n is 2.0"),
        ({"n": 2, "sides": 0}, "sides is 0"),
        ({"n": 2, "sides": 7}, "sides is 7; it must be at most 6"),
        ({"n": 2, "albedo": 1.0}, r"outside \[0, 1\)"),
        ({"n": 2, "albedo": -0.1}, r"outside \[0, 1\)"),
        ({"n": 2, "sides": 3, "albedo": [0.1, 0.2, 0.3]}, "one per wall, or one colour"),
        ({"n": 2, "sides": 4, "albedo": [0.1, 0.2]}, "albedo has shape"),
    ],
)
def test_bad_boxes_are_refused(arguments: dict[str, Any], part: str) -> None:
    with pytest.raises(InputError, match=part):
        box(**arguments)


def test_too_large_a_box_is_refused_before_anything_is_allocated() -> None:
    with pytest.raises(MemoryLimitError, match=r"box with 6 side\(s\), .* needs .* TiB"):
        box(10**5)


def test_limit_counts_form_factors_and_transport(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checks, "host_memory", lambda: 4 * 8 * 96**2 - 1)
    with pytest.raises(MemoryLimitError, match="96 x 96"):
        box(4)
    assert box(4, sides=5).grid == (4, 20)
