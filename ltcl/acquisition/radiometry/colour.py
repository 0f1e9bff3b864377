# SPDX-License-Identifier: BSD-3-Clause
"""How the colours of a projector mix in the channels of a camera.

With channel d of the projector lit alone, channel c of the camera has the radiance L_cd(p) above black. The
mixing is relative to a channel's own light, as `ltcl.Transport(mixing=)` takes it: M_cc = 1,

    M_cd = sum_p w_p L_cd L_cc / sum_p w_p (L_cc^2 - V_cc),    w_p = 1 / (V_cd + V_cc)

(V_cc, the variance of L_cc, is the bias of its square), one for the set-up. Known limit: it is the mean over
the surfaces of the scene; what mixes depends on their spectra, too.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ltcl import checks, layout
from ltcl.acquisition.radiometry.merge import Radiance
from ltcl.errors import InputError, InputTypeError


def mixing(lit: Sequence[Radiance], black: Radiance | None = None) -> np.ndarray:
    """The mixing of colours, from pictures under red, green and blue.

    Parameters
    ----------
    lit : 3 Radiance of (H, W, 3)
        The scene under the projector's red, green and blue alone.
    black : Radiance of (H, W, 3), optional
        Under a black projector; it is subtracted from each.

    Returns
    -------
    np.ndarray
        (3, 3) float64: rows are channels of the camera, columns those of the projector.

    Raises
    ------
    InputError, InputTypeError
        Not three pictures in colour of one shape; a channel of the camera without light of its own colour; a
        mixing that cannot be undone (condition number above 1e6).

    Examples
    --------
    >>> M = np.array([[1.0, 0.2, 0.0], [0.1, 1.0, 0.1], [0.0, 0.3, 1.0]])
    >>> pictures = [
    ...     Radiance(np.full((4, 5, 3), M[:, d]), np.full((4, 5, 3), 1e-8), np.full((4, 5, 3), True))
    ...     for d in range(3)
    ... ]
    >>> mixing(pictures).round(4)
    array([[1. , 0.2, 0. ],
           [0.1, 1. , 0.1],
           [0. , 0.3, 1. ]])
    """
    if len(lit) != 3:
        raise InputError(f"lit holds {len(lit)} picture(s); it must hold three: under red, green and blue")
    for d, picture in enumerate([*lit, *([] if black is None else [black])]):
        name = f"lit[{d}]" if d < 3 else "black"
        if not isinstance(picture, Radiance):
            raise InputTypeError(f"{name} is a {type(picture).__name__}; it must be a Radiance")
        if picture.value.ndim != 3 or picture.value.shape[2] != 3:
            raise InputError(f"{name} has shape {picture.value.shape}; it must be (H, W, 3)")
        checks.shape(name, picture.value, lit[0].value.shape)
    pictures = [picture if black is None else picture - black for picture in lit]
    valid = np.all([picture.valid for picture in pictures], axis=(0, 3))
    if not valid.any():
        raise InputError("lit have no pixel that is valid in all; other exposures are needed")
    # (pixels, camera, projector)
    L = np.stack([picture.value[valid] for picture in pictures], axis=-1).astype(np.float64)
    V = np.stack([picture.variance[valid] for picture in pictures], axis=-1).astype(np.float64)
    M = np.eye(3)
    for c, d in np.argwhere(~np.eye(3, dtype=bool)):
        w = 1.0 / np.maximum(V[:, c, d] + V[:, c, c], 1e-300)
        own = np.sum(w * (L[:, c, c] ** 2 - V[:, c, c]))
        if own <= 0:
            raise InputError(f"lit[{c}] has no light in its own channel {c}; is the order red, green, blue?")
        M[c, d] = np.sum(w * L[:, c, d] * L[:, c, c]) / own
    return layout.mixing(M, 3, None)
