# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of an update that show the pattern of another: repeated, exchanged, or late.

The old transport under a movement foretells the picture of each pattern. A photograph is of another
pattern if that explains it far better than its own.
"""

from __future__ import annotations

import numpy as np

from ltcl.errors import AcquisitionError

# Squares that the other pattern leaves of a photograph, relative to those that its own does.
MAX_SQUARES_RATIO = 0.25


def check_order(foretold: np.ndarray, seen: np.ndarray, known: np.ndarray) -> None:
    """Refuse a picture that another one's pattern explains.

    Pictures of all photographs are (k, N, channels), known at the pixels `known`, (N, channels).
    """
    expected = np.where(known, foretold, 0.0).reshape(len(foretold), -1)
    pictures = np.where(known, seen, 0.0).reshape(len(seen), -1)
    # |picture - expected|^2 of all pictures and patterns.
    squares = (
        (pictures**2).sum(axis=1)[:, None]
        - 2.0 * pictures @ expected.T
        + (expected**2).sum(axis=1)[None, :]
    )
    pattern = squares.argmin(axis=1)
    is_other = squares.min(axis=1) < MAX_SQUARES_RATIO * np.diagonal(squares)
    if is_other.any():
        number = int(is_other.argmax())
        raise AcquisitionError(
            f"photograph {number + 1} shows the pattern of photograph "
            f"{int(pattern[number]) + 1}; take it again"
        )
