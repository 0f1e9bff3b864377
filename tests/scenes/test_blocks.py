# SPDX-License-Identifier: BSD-3-Clause
"""Blocks: faces that look outwards, ways that pass or do not, refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl.errors import InputError, InputTypeError
from ltcl.scenes.blocks import Block
from ltcl.scenes.rays import clear

BLOCK = Block(corner=(0.2, 0.3, 0.1), size=(0.4, 0.3, 0.5))


def blocked(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Whether the straight ways between points, (R, 3) both or one, pass through the block."""
    return ~clear((), start, end, [np.stack([BLOCK.low, BLOCK.high])])


def test_faces_look_outwards_and_close_the_block() -> None:
    middle = (BLOCK.low + BLOCK.high) / 2
    flux = 0.0
    for face in BLOCK.faces():
        outwards = np.asarray(face.corner) + 0.5 * np.add(face.right, face.down) - middle
        assert outwards @ face.normal > 0
        np.testing.assert_allclose(np.cross(outwards, face.normal), 0, atol=1e-15)
        corners = [
            np.asarray(face.corner) + a * np.array(face.right) + b * np.array(face.down)
            for a, b in ((0, 0), (0, 1), (1, 0), (1, 1))
        ]
        assert all(((c >= BLOCK.low - 1e-12) & (c <= BLOCK.high + 1e-12)).all() for c in corners)
        flux += face.area * (outwards + middle) @ face.normal / 3
    assert flux == pytest.approx(0.4 * 0.3 * 0.5)  # the volume, by Gauss' theorem
    assert sum(face.area for face in BLOCK.faces()) == pytest.approx(2 * (0.12 + 0.2 + 0.15))


def test_side_faces_stand_upright() -> None:
    for face in BLOCK.faces()[:4]:
        assert face.down == pytest.approx((0, 0, -0.5))
        assert face.right[2] == 0


def test_ways_through_a_block_agree_with_points_along_them() -> None:
    rng = np.random.default_rng(1)
    start, end = rng.random((3000, 3)), rng.random((3000, 3))
    along = np.linspace(0, 1, 2001)[:, None]
    found = [bool(hidden) for hidden in blocked(start, end)]
    expected = [bool(BLOCK.covers(a + along * (b - a)).any()) for a, b in zip(start, end, strict=True)]
    # Ways that only graze an edge slip between the points.
    differ = np.not_equal(found, expected)
    assert differ.mean() < 2e-3
    assert 0.05 < np.mean(expected) < 0.6
    assert not np.any(differ & np.array(expected))


def test_ways_along_a_face_or_from_it_pass() -> None:
    on_face = np.array([[0.6, 0.4, 0.3]])
    assert not blocked(on_face, np.array([1.0, 0.9, 0.9])).any()
    assert not blocked(on_face, np.array([0.6, 0.9, 0.3])).any()
    assert blocked(on_face, np.array([0.0, 0.4, 0.3])).all()
    assert not blocked(np.array([[0.0, 0.0, 0.6]]), np.array([1.0, 1.0, 0.6])).any()  # over the top


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"size": (0.1, 0, 0.1)}, r"block size is \(0.1, 0.0, 0.1\); all three lengths must be above 0"),
        ({"size": (0.1, -1, 0.1)}, "all three lengths must be above 0"),
        ({"size": (0.1, 0.1)}, "block size is .*three finite numbers"),
        ({"size": 0.1}, "block size is 0.1; it must be three finite numbers"),
        ({"corner": (0, float("nan"), 0)}, "block corner is .*three finite numbers"),
        ({"corner": "here"}, "block corner is 'here'; it must be three numbers"),
        ({"albedo": 1.0}, r"outside \[0, 1\)"),
        ({"albedo": (0.5, 0.5)}, r"block albedo has shape \(2,\)"),
        ({"albedo": float("inf")}, "block albedo has 1 NaN"),
    ],
)
def test_bad_blocks_are_refused(changes: dict[str, Any], part: str) -> None:
    with pytest.raises((InputError, InputTypeError), match=part):
        Block(**{"corner": (0, 0, 0), "size": (0.1, 0.1, 0.1), **changes})
