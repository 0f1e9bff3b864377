# SPDX-License-Identifier: BSD-3-Clause
"""Noise of simulated photographs that does not depend on what else was photographed.

The stream of a photograph is counter-based (Philox). Its key is a hash of the seed, the codes, the seconds
and how often the same were asked for before, so that a run which was stopped and resumed sees the same.
"""

from __future__ import annotations

import hashlib
import struct
from collections import Counter

import numpy as np

from ltcl import checks


class NoiseStreams:
    """One stream of random numbers for each photograph.

    Parameters
    ----------
    seed : int

    Raises
    ------
    InputError
        The seed is no whole number of at least 0.

    Examples
    --------
    >>> codes = np.ones((1, 2), np.float32)
    >>> first, second = NoiseStreams(7), NoiseStreams(7)
    >>> _ = second.of(codes / 2, 1.0)  # another photograph in between
    >>> bool(first.of(codes, 1.0).random() == second.of(codes, 1.0).random())
    True
    """

    def __init__(self, seed: int) -> None:
        self.seed = checks.count("seed", seed, least=0)
        self._asked: Counter[bytes] = Counter()

    def of(self, codes: np.ndarray, seconds: float) -> np.random.Generator:
        """The stream of the next photograph of `codes`, exposed for `seconds`."""
        asked = hashlib.blake2b(repr(codes.shape).encode() + codes.tobytes(), digest_size=16)
        asked.update(struct.pack("<d", seconds))
        place = asked.digest()
        key = hashlib.blake2b(place + f"{self.seed} {self._asked[place]}".encode(), digest_size=16)
        self._asked[place] += 1
        return np.random.Generator(np.random.Philox(key=int.from_bytes(key.digest(), "little")))
