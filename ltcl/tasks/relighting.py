# SPDX-License-Identifier: BSD-3-Clause
"""Relighting: the picture of the scene under any projector pattern, l_out = T l_in (eq. 3)."""

from __future__ import annotations

from typing import Any

import numpy as np

from ltcl.transport.transport import Transport, check_transport


def relight(T: Transport, pattern: Any) -> np.ndarray:
    """Compute the picture that the camera sees under `pattern`; the same as ``T @ pattern``.

    Parameters
    ----------
    T : Transport
    pattern : (h, w), (h, w, 3), frames of these, or (N,)
        Linear projector light.

    Returns
    -------
    array
        float32, on the camera's grid, in colour if T or the pattern is.

    Raises
    ------
    InputError
        A pattern of another size, or with NaN.

    Examples
    --------
    >>> import ltcl, numpy
    >>> T = ltcl.Transport([[0.5, 0.1], [0.1, 0.5]], grid=(1, 2))
    >>> print(ltcl.relight(T, numpy.array([[1.0, 1.0]])))
    [[0.6 0.6]]
    """
    check_transport(T, square=False)
    return T @ pattern
