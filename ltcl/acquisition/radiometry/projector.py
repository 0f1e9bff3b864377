# SPDX-License-Identifier: BSD-3-Clause
"""The response of a projector, from codes to light, and how its colours mix in a camera's channels.

Under a uniform code c camera pixel p has the radiance L_p(c) = a_p + g(c) s_p: its radiance at code
0, and its share of the projector's light, direct or not. With a_p = L_p(0), s_p = L_p(1) - L_p(0),

    g(c) = sum_p w_p (s_p (L_p(c) - a_p) - V_p(0)) / sum_p w_p (s_p^2 - V_p(0) - V_p(1))

where V are the variances of L, the bias of the products, and w_p = 1 / (V_p(0) + V_p(1)). Isotonic
regression makes g monotone; between the codes it is a monotone cubic.

With all three channels d at code c the light adds up, each with its own curve,

    L_p(c) = a_p + sum_d g_d(c) s_pd

so that a picture of each channel alone at code 1 and one of all of them at each code give all three
curves, by least squares over the camera's pixels and channels.

With channel d of the projector lit alone, channel c of the camera has the radiance L_cd(p) above
black. The mixing is relative to a channel's own light, as `ltcl.Transport(mixing=)` takes it:
M_cc = 1,

    M_cd = sum_p w_p L_cd L_cc / sum_p w_p (L_cc^2 - V_cc),    w_p = 1 / (V_cd + V_cc)

one for the set-up. Known limit: it is the mean over surfaces, but the mixing also depends on their
spectra.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy  # its subpackage optimize is loaded at the first use
from scipy.interpolate import PchipInterpolator

from ltcl import checks
from ltcl.acquisition.radiometry.exposures import NO_LIGHT
from ltcl.acquisition.radiometry.merge import Radiance
from ltcl.acquisition.radiometry.response import Response
from ltcl.errors import InputError
from ltcl.transport.matrices import check_mixing

# Codes of the result: four values for each code of 8 bits.
TABLE_SIZE = 1025

# Standard errors that white must be above black: one black projector in 700 passes.
MIN_WHITE_DEVIATIONS = 3.0

# Least part of the light of three colours in which they differ, relative to noise.
MIN_COLOUR_LIGHT = 3.0

# Instead of a division by zero.
TINY = 1e-300


def projector_response(codes: Any, channels: Sequence[Sequence[Radiance]]) -> Response:
    """Response of a projector, from merged pictures of the scene under uniform codes.

    Parameters
    ----------
    codes : (K,) array_like
        Uniform codes that rise from 0 to 1.
    channels : sequence of sequences of Radiance
        One sequence of K pictures, with all channels of the projector lit at once, or three, each
        with one channel lit.

    Returns
    -------
    Response
        1025 values a channel, from 0 to 1.

    Raises
    ------
    InputError
        The codes do not rise from 0 to 1, the number of pictures differs, or white is as dark as
        black.

    Examples
    --------
    >>> codes, ones = np.linspace(0, 1, 5), np.ones((2, 2))
    >>> pictures = [Radiance(0.1 + 0.5 * c**2 * ones, 1e-6 * ones, ones > 0) for c in codes]
    >>> projector_response(codes, [pictures]).linear(codes).round(4)
    array([0.    , 0.0625, 0.25  , 0.5625, 1.    ], dtype=float32)
    """
    levels = _rising_codes(codes)
    tables = []
    for c, pictures in enumerate(channels):
        tables.append(_channel_table(levels, pictures, f"channels[{c}]"))
    return Response(np.stack(tables))


def _rising_codes(codes: Any) -> np.ndarray:
    """Codes (K,) as float64; InputError if they do not rise from 0 to 1."""
    levels = checks.real("codes", codes).astype(np.float64)
    checks.finite("codes", levels)
    if not _rises_from_0_to_1(levels):
        raise InputError(f"codes is {codes!r}; it must rise from 0 to 1")
    return levels


def _rises_from_0_to_1(codes: np.ndarray) -> bool:
    if codes.ndim != 1 or len(codes) < 2:
        return False
    is_rising = np.all(np.diff(codes) > 0)
    return bool(is_rising and codes[0] == 0 and codes[-1] == 1)


def colour_response(
    codes: Any, pictures: Sequence[Radiance], colours: Sequence[Radiance], black: Radiance
) -> Response:
    """Response of the three channels of a projector, from pictures of all of them at one code.

    Parameters
    ----------
    codes : (K,) array_like
        Uniform codes that rise from 0 to 1.
    pictures : sequence of K - 2 Radiance
        Merged pictures (H, W, 3) of the scene with all channels at each of the codes between.
    colours : sequence of 3 Radiance
        Those with red, green or blue alone at code 1.
    black : Radiance
        That with all at code 0.

    Returns
    -------
    Response
        1025 values a channel, from 0 to 1.

    Raises
    ------
    InputError
        The codes do not rise from 0 to 1, the number of pictures differs, or a colour is as dark as
        black, or no other one than the rest.

    Examples
    --------
    >>> M, ones = np.array([[1.0, 0.2, 0.0], [0.1, 1.0, 0.1], [0.0, 0.3, 1.0]]), np.ones((4, 5, 3))
    >>> powers = np.array([1.8, 2.0, 2.2])
    >>> lit = [
    ...     Radiance(M @ light * ones, 1e-8 * ones, ones > 0)
    ...     for light in (*np.eye(3), 0.5**powers, np.zeros(3))
    ... ]
    >>> response = colour_response([0, 0.5, 1], lit[3:4], lit[:3], lit[4])
    >>> bool(np.allclose(response.linear(np.full(3, 0.5)), 0.5**powers, atol=1e-4))
    True
    """
    levels = _rising_codes(codes)
    if len(pictures) != len(levels) - 2 or len(colours) != 3:
        raise InputError(
            f"pictures holds {len(pictures)} and colours {len(colours)} picture(s); they must hold "
            f"{len(levels) - 2}, one for each code between 0 and 1, and three"
        )
    is_valid = np.all([picture.valid for picture in (black, *colours, *pictures)], axis=0)
    if not is_valid.any():
        raise InputError(
            "pictures have no value that is valid under all codes; other exposures are needed"
        )
    a = black.value[is_valid].astype(np.float64)
    a_variance = black.variance[is_valid].astype(np.float64)
    lit = np.stack([colour.value[is_valid] for colour in colours]).astype(np.float64)
    lit_variance = np.stack([colour.variance[is_valid] for colour in colours]).astype(np.float64)
    s = lit - a
    for d in range(3):
        error = np.sqrt(np.sum(a_variance + lit_variance[d]))
        if np.sum(s[d]) < MIN_WHITE_DEVIATIONS * error:
            raise InputError(f"colours[{d}] is no brighter than black; {NO_LIGHT}")
    w = 1.0 / np.maximum(a_variance + lit_variance.sum(axis=0), TINY)
    # The same noise of black is in all differences, and that of each colour in its own square.
    bias = w @ a_variance
    noise = bias + lit_variance @ w
    squares = (s * w) @ s.T - bias - np.diag(lit_variance @ w)
    if np.linalg.eigvalsh(squares)[0] < MIN_COLOUR_LIGHT * noise.max():
        raise InputError(
            "colours are alike in the camera's channels; the projector must have three"
        )
    tables = np.empty((len(pictures), 3))
    for k, picture in enumerate(pictures):
        products = (s * w) @ (picture.value[is_valid] - a) - bias
        tables[k] = np.linalg.solve(squares, products)
    return Response(np.stack([_monotone_table(levels, g) for g in tables.T]))


def _channel_table(codes: np.ndarray, pictures: Sequence[Radiance], name: str) -> np.ndarray:
    """Light at `TABLE_SIZE` codes, in [0, 1]."""
    if len(pictures) != len(codes):
        raise InputError(
            f"{name} holds {len(pictures)} picture(s); it must hold {len(codes)}, one for each code"
        )
    is_valid = np.all([picture.valid for picture in pictures], axis=0)
    if not is_valid.any():
        raise InputError(
            f"{name} have no pixel that is valid under all codes; other exposures are needed"
        )
    values = [picture.value[is_valid] for picture in pictures]
    L = np.stack(values).astype(np.float64)
    black_variance = pictures[0].variance[is_valid].astype(np.float64)
    white_variance = pictures[-1].variance[is_valid].astype(np.float64)
    s = L[-1] - L[0]

    # Not weighted: colours that a channel does not light have next to no variance, and would decide
    # alone.
    error = np.sqrt(np.sum(black_variance + white_variance))
    if np.sum(s) < MIN_WHITE_DEVIATIONS * error:
        raise InputError(f"{name} are no brighter under code 1 than under code 0; {NO_LIGHT}")

    w = 1.0 / np.maximum(black_variance + white_variance, TINY)
    products = (L[1:-1] - L[0]) * s - black_variance
    squares = s**2 - black_variance - white_variance
    g = (products @ w) / np.sum(w * squares)
    return _monotone_table(codes, g)


def _monotone_table(codes: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Table of the monotone cubic through the light `g` at the codes between 0 and 1."""
    light = np.concatenate([[0.0], np.clip(g, 0.0, 1.0), [1.0]])
    rising = scipy.optimize.isotonic_regression(light).x
    curve = PchipInterpolator(codes, rising)
    table = curve(np.linspace(0.0, 1.0, TABLE_SIZE))
    return np.maximum.accumulate(np.clip(table, 0.0, 1.0))


def mixing(lit: Sequence[Radiance], black: Radiance) -> np.ndarray:
    """Mixing of the projector's colours in the channels of the camera.

    Parameters
    ----------
    lit : sequence of 3 Radiance
        Pictures (H, W, 3) under red, green and blue.
    black : Radiance
        Picture (H, W, 3) under a black projector.

    Returns
    -------
    (3, 3) float64
        Rows are channels of the camera, columns those of the projector; the diagonal is 1.

    Raises
    ------
    InputError
        Numbers or shapes differ, a channel has no light of its own colour, or the mixing cannot be
        undone (condition number above 1e6).

    Examples
    --------
    >>> M = np.array([[1.0, 0.2, 0.0], [0.1, 1.0, 0.1], [0.0, 0.3, 1.0]])
    >>> ones = np.ones((4, 5, 3))
    >>> pictures = [Radiance(ones * M[:, d], 1e-8 * ones, ones > 0) for d in range(3)]
    >>> bool(np.allclose(mixing(pictures, Radiance(0 * ones, 1e-8 * ones, ones > 0)), M))
    True
    """
    if len(lit) != 3:
        raise InputError(
            f"lit holds {len(lit)} picture(s); it must hold three: under red, green and blue"
        )
    shape = (*black.value.shape[:2], 3)
    for d, picture in enumerate(lit):
        checks.shape(f"lit[{d}]", picture.value, shape)
    checks.shape("black", black.value, shape)

    pictures = [picture - black for picture in lit]
    is_valid = np.all([picture.valid for picture in pictures], axis=(0, 3))
    if not is_valid.any():
        raise InputError("lit have no pixel that is valid in all; other exposures are needed")

    # (pixels, channel of the camera, channel of the projector)
    values = [picture.value[is_valid] for picture in pictures]
    variances = [picture.variance[is_valid] for picture in pictures]
    L = np.stack(values, axis=-1).astype(np.float64)
    V = np.stack(variances, axis=-1).astype(np.float64)
    M = np.eye(3)
    for c, d in np.argwhere(~np.eye(3, dtype=bool)):
        w = 1.0 / np.maximum(V[:, c, d] + V[:, c, c], TINY)
        squares = np.sum(w * (L[:, c, c] ** 2 - V[:, c, c]))
        if squares <= 0:
            raise InputError(
                f"lit[{c}] has no light in its own channel {c}; is the order red, green, blue?"
            )
        M[c, d] = np.sum(w * L[:, c, d] * L[:, c, c]) / squares
    return check_mixing(M, 3, has_blocks=False)
