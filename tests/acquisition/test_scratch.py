# SPDX-License-Identifier: BSD-3-Clause
"""Arrays that grow in a temporary file, and a sketch in rounds whose pictures stand in them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ltcl import scenes
from ltcl.acquisition import VirtualRig, acquire, scratch
from ltcl.acquisition.scratch import ScratchFrames


@pytest.mark.parametrize("most", [0, 40, 1 << 20])
def test_frames_keep_what_they_hold(monkeypatch: pytest.MonkeyPatch, most: int) -> None:
    """In memory, in a file from the third frame on, and in a file from the start."""
    monkeypatch.setattr(scratch, "MAX_ARRAY_BYTES", most)
    frames = ScratchFrames((2, 2), "float32")
    expected = np.zeros((0, 2, 2), np.float32)
    for count in (1, 1, 3):
        array = frames.extend(count)
        assert not array[-count:].any()
        array[-count:] = count
        expected = np.concatenate([expected, np.full((count, 2, 2), count, np.float32)])
        np.testing.assert_array_equal(frames.array, expected)
    assert isinstance(frames.array, np.memmap) == (most < expected.nbytes)


@pytest.mark.slow
def test_rounds_of_a_sketch_stand_in_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where pictures stand changes nothing."""
    T = scenes.dihedral(4, albedo=0.6).transport()
    settings: dict[str, Any] = {
        "geometry": "aligned", "strategy": "sketch", "photographs": 120
    }  # fmt: skip
    in_memory = acquire(VirtualRig(T, T.grid, bits=12), **settings)
    monkeypatch.setattr(scratch, "MAX_ARRAY_BYTES", 0)
    in_files = acquire(VirtualRig(T, T.grid, bits=12), **settings)
    p = np.random.default_rng(0).random(T.grid)
    np.testing.assert_array_equal(in_memory @ p, in_files @ p)
