# SPDX-License-Identifier: BSD-3-Clause
"""`NoiseStreams`: what the noise of a photograph depends on, and on what it does not."""

from __future__ import annotations

import numpy as np
import pytest

from ltcl.acquisition.rigs.noise import NoiseStreams
from ltcl.errors import InputError

A, B = np.zeros((2, 3), np.float32), np.eye(2, 3, dtype=np.float32)


def test_streams_do_not_depend_on_what_lies_between() -> None:
    plain, mixed = NoiseStreams(1), NoiseStreams(1)
    wanted = [plain.of(A, 1.0).random(5) for _ in range(3)]
    found = []
    for _ in range(3):
        mixed.of(B, 1.0)
        mixed.of(A, 2.0)
        found.append(mixed.of(A, 1.0).random(5))
    np.testing.assert_array_equal(found, wanted)


def test_each_photograph_has_its_own() -> None:
    streams, others = NoiseStreams(1), NoiseStreams(2)
    drawn = [
        streams.of(A, 1.0),
        streams.of(A, 1.0),
        streams.of(B, 1.0),
        streams.of(A, 2.0),
        streams.of(A.reshape(3, 2), 1.0),
        others.of(A, 1.0),
    ]
    numbers = np.array([stream.random(1000) for stream in drawn])
    correlation = np.corrcoef(numbers) - np.eye(len(drawn))
    assert np.abs(correlation).max() < 0.15  # 4.7 standard deviations of 1 / sqrt(1000)


def test_a_bad_seed_is_refused() -> None:
    with pytest.raises(InputError, match="seed is -1"):
        NoiseStreams(-1)
