# SPDX-License-Identifier: BSD-3-Clause
"""Colours of a T that look exchanged between camera and projector."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ltcl.transport.transport import Transport

NAMES = ("red", "green", "blue")
# Deviation of a first bounce from another diagonal, to that from its own, that tells an exchange.
EXCHANGE_RATIO = 0.5


def exchanged_colours(T: Transport) -> list[str]:
    """Colours that look exchanged, such as "blue for red"."""
    if T.blocks is not None:
        order = _brightest_blocks(T.blocks)
    elif T.mixing is not None:
        order = np.argmax(np.abs(T.mixing), axis=1)
    elif T.is_square and T.channels == 3 and hasattr(T.matrices[0], "diagonal"):
        order = _nearest_diagonals(T)
    else:
        return []
    exchanged = []
    for camera, projector in enumerate(order):
        if camera != projector:
            exchanged.append(f"{NAMES[projector]} for {NAMES[camera]}")
    return exchanged


def _brightest_blocks(blocks: Sequence[Sequence[Any]]) -> np.ndarray:
    """The projector channel that each camera channel sees best."""
    light = np.zeros((3, 3))
    for c, row in enumerate(blocks):
        for d, block in enumerate(row):
            white = np.ones(block.shape[1])
            light[c, d] = (block @ white).sum()
    return np.argmax(light, axis=1)


def _nearest_diagonals(T: Transport) -> np.ndarray:
    """The channel whose diagonal each first bounce is nearest to, by the median of |log ratio|."""
    diagonal = np.array([matrix.diagonal() for matrix in T.matrices], np.float64)
    is_lit = ~T.masked & (diagonal > 0).all(axis=0)
    ratios = T.first_bounce[:, None, is_lit] / diagonal[:, is_lit]
    deviation = np.median(np.abs(np.log(ratios)), axis=2)
    is_exchanged = deviation.min(axis=1) < EXCHANGE_RATIO * deviation.diagonal()
    return np.where(is_exchanged, deviation.argmin(axis=1), np.arange(3))
