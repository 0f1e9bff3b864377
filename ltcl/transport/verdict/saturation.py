# SPDX-License-Identifier: BSD-3-Clause
"""The range of the camera in the entries of T: those at its upper end, and the steps of its codes.

Noise makes all entries of a T different. Where several are equal to the brightest one, the camera
was full; where most are equal to some other, T was stored in few codes.
"""

from __future__ import annotations

from typing import Any

import numpy as np

# Entries to read.
MAX_ENTRIES = 1 << 24
# Entries whose values are compared.
MAX_COMPARED = 1 << 16
# Share of different values, from which on T has noise: without, values repeat everywhere.
MEASURED_SHARE = 0.9
# Share of different values, up to which T has codes.
CODED_SHARE = 0.05
# Share of the entries of a row that are equal in a pixel that does not answer to patterns.
STUCK_SHARE = 0.5
# Codes of a T, at most those of 12 bits. Fewer than the least may also be those of a plain scene.
MIN_CODES = 4
MAX_CODES = 1 << 12


def saturated_entries(matrix: Any) -> tuple[int, np.ndarray]:
    """Number of entries as bright as the brightest one, and their camera pixels; 0 without noise.

    Pixels that see all patterns alike do not count.
    """
    pixels, rows = _sample_rows(matrix)
    brightest = rows.max(axis=1)
    is_stuck = (rows == brightest[:, None]).mean(axis=1) > STUCK_SHARE
    rows = rows[~is_stuck]
    pixels = pixels[~is_stuck]
    if rows.size == 0:
        return 0, pixels
    counts = (rows == rows.max()).sum(axis=1)
    compared = rows
    if np.mean(rows == 0) > STUCK_SHARE:
        # What is left of a sparse T may be different without noise: direct light alone tells.
        compared = rows.max(axis=1)
    if _different_share(compared) < MEASURED_SHARE:
        return 0, pixels[:0]
    return int(counts.sum()), pixels[counts > 0]


def quantization(matrix: Any) -> float:
    """Step of the codes of T to its mean indirect light; 0 if T has no codes.

    Light below half a step is lost.
    """
    _, rows = _sample_rows(matrix)
    if _different_share(rows) > CODED_SHARE:
        return 0.0
    codes = np.unique(rows)
    if not MIN_CODES <= len(codes) <= MAX_CODES:
        return 0.0
    steps = np.diff(codes)
    step = float(steps.min())
    # Values of a scene of equal patches repeat, too, but not at multiples of a step.
    multiples = codes / step
    if np.max(np.abs(multiples - np.rint(multiples))) > 1e-3 * np.sqrt(len(codes)):
        return 0.0
    without_brightest = rows.sum(axis=1, dtype=np.float64) - rows.max(axis=1)
    mean_light = float(np.mean(without_brightest)) / max(rows.shape[1] - 1, 1)
    if mean_light <= 0.0:
        return 0.0
    return step / mean_light


def _sample_rows(matrix: Any) -> tuple[np.ndarray, np.ndarray]:
    """Evenly spaced camera pixels, ascending, and their rows, dense."""
    M, N = matrix.shape
    count = max(min(M, MAX_ENTRIES // N), 1)
    pixels = np.unique(np.linspace(0, M - 1, count).astype(int))
    rows = matrix[pixels]
    if not isinstance(rows, np.ndarray):
        rows = rows.toarray()
    return pixels, rows


def _different_share(rows: np.ndarray) -> float:
    """Share of different values among entries that are neither 0 nor the brightest."""
    values = rows[(rows != 0) & (rows != rows.max())]
    if values.size == 0:
        return 0.0
    step = -(-values.size // MAX_COMPARED)
    values = values[::step]
    return len(np.unique(values)) / len(values)
