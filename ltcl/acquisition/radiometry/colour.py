# SPDX-License-Identifier: BSD-3-Clause
"""How the colours of a projector mix in the channels of a camera.

With channel d of the projector lit alone, channel c of the camera has the radiance L_cd(p) above black. The
mixing is relative to a channel's own light, as `ltcl.Transport(mixing=)` takes it: M_cc = 1,

    M_cd = sum_p w_p L_cd L_cc / sum_p w_p (L_cc^2 - V_cc),    w_p = 1 / (V_cd + V_cc)

(V_cc, the variance of L_cc, is the bias of its square), one for the set-up. Of each pixel
M_cd(p) = L_cd / L_cc where its own light is told to better than 10 %, and that of the set-up elsewhere: what
mixes depends on the spectrum of a surface, too.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ltcl import checks
from ltcl.acquisition.radiometry.merge import Radiance
from ltcl.errors import InputError, InputTypeError

_WORST = 1e6  # condition number of a mixing, as for a transport
_TOLD = 0.1  # relative error of a pixel's own light


def mixing(lit: Sequence[Radiance], black: Radiance | None = None, *, per_pixel: bool = False) -> np.ndarray:
    """The mixing of colours, from pictures under red, green and blue.

    Parameters
    ----------
    lit : 3 Radiance of (H, W, 3)
        The scene under the projector's red, green and blue alone.
    black : Radiance of (H, W, 3), optional
        Under a black projector; it is subtracted from each.
    per_pixel : bool
        A matrix for each pixel.

    Returns
    -------
    np.ndarray
        float64, (3, 3) or (H, W, 3, 3): rows are channels of the camera, columns those of the projector.

    Raises
    ------
    InputError, InputTypeError
        Not three pictures in colour of one shape; a channel of the camera without light of its own colour; a
        mixing that cannot be undone.

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
    # (H, W, camera, projector)
    L = np.stack([picture.value for picture in pictures], axis=-1).astype(np.float64)
    V = np.stack([picture.variance for picture in pictures], axis=-1).astype(np.float64)
    M = _of_all(L[valid], V[valid])
    return _of_each(L, V, valid, M) if per_pixel else M


def unmix(picture: ArrayLike, M: ArrayLike) -> np.ndarray:
    """X of M x = picture, pixel by pixel: what to send so that each channel gets its own light.

    Parameters
    ----------
    picture : (..., 3)
        Linear light.
    M : (3, 3) or (..., 3, 3)
        As from `mixing`.

    Returns
    -------
    np.ndarray
        float32, as `picture`; below 0 or above 1 where no projector can.

    Raises
    ------
    InputError
        Other shapes, NaN, a mixing that cannot be undone.

    Examples
    --------
    >>> unmix([0.6, 0.5, 0.0], [[1, 0.2, 0], [0, 1, 0], [0, 0, 1]])
    array([0.5, 0.5, 0. ], dtype=float32)
    """
    light = checks.finite("picture", checks.real("picture", picture).astype(np.float64))
    matrices = checks.finite("M", checks.real("M", M).astype(np.float64))
    if light.shape[-1:] != (3,):
        raise InputError(f"picture has shape {light.shape}; it must be (..., 3)")
    checks.shape("M", matrices, (3, 3), (*light.shape, 3))
    _check_regular("M", matrices)
    return np.linalg.solve(matrices, light[..., None])[..., 0].astype(np.float32)


def _of_all(L: np.ndarray, V: np.ndarray) -> np.ndarray:
    """(3, 3) of light (pixels, 3, 3)."""
    if len(L) == 0:
        raise InputError("lit have no pixel that is valid in all; other exposures are needed")
    M = np.eye(3)
    for c, d in np.argwhere(~np.eye(3, dtype=bool)):
        w = 1.0 / np.maximum(V[:, c, d] + V[:, c, c], 1e-300)
        own = np.sum(w * (L[:, c, c] ** 2 - V[:, c, c]))
        if own <= 0:
            raise InputError(f"lit[{c}] has no light in its own channel {c}; is the order red, green, blue?")
        M[c, d] = np.sum(w * L[:, c, d] * L[:, c, c]) / own
    _check_regular("the mixing of lit", M)
    return M


def _of_each(L: np.ndarray, V: np.ndarray, valid: np.ndarray, M: np.ndarray) -> np.ndarray:
    own, variance = (np.diagonal(part, axis1=-2, axis2=-1) for part in (L, V))
    with np.errstate(invalid="ignore"):
        told = valid[..., None] & (own > 0) & (variance < (_TOLD * own) ** 2)
    found = np.where(told[..., None], L / np.where(told, own, 1.0)[..., None], M)
    bad = ~(np.linalg.cond(found) < _WORST)
    found[bad] = M
    return found


def _check_regular(name: str, M: np.ndarray) -> None:
    worst = float(np.max(np.linalg.cond(M)))
    if not worst < _WORST:
        raise InputError(
            f"{name} has the condition number {worst:.3g}; it must be invertible, below {_WORST:g}"
        )
