# SPDX-License-Identifier: BSD-3-Clause
"""Signs in a separation that T or its first bounce is wrong, or that bounces are approximate.

Direct light is from 0 to all of a picture. T of a Lambertian scene is reciprocal, its bounces have
no negative light (section 8.4, eq. 28 and 29), and no flat wall lights itself, as ambient light
left in T would suggest, and light by way of unlit surfaces.
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from ltcl.errors import InputError
from ltcl.transport.covariance import EntryErrors
from ltcl.transport.diagnostics import PARTS_PER_SIDE, negative_bounce, picture_parts
from ltcl.transport.noise import Noise
from ltcl.transport.transport import Transport

# Largest defect and share of negative light of a scene that is taken for Lambertian: noise of path
# tracing alone gives a defect of 0.05 and a share of 0.0004.
LARGEST_DEFECT = 0.1
LARGEST_NEGATIVE = 0.005
# Standard deviations of noise that negative light between parts of a picture does not exceed.
NEGATIVE_SIGMAS = 3.0
# Largest share of ambient light, as in `ltcl.transport.verdict`: clean scenes have 0, and scenes
# with 1 % of ambient light mostly more.
LARGEST_AMBIENT = 0.05
# Standard deviations of direct light beyond what is possible: more is no noise.
MAX_DEVIATIONS = 5.0
# Share of the image: direct light that is uncertain by more is no result.
MAX_UNCERTAINTY = 0.5
# Share of negative light in an image: with more it is no picture, and is not judged.
MAX_NEGATIVE_SHARE = 0.01
# Pixels that a refusal names.
WORST_PIXELS = 8


def check_direct_light(
    T: Transport, image: list[np.ndarray], direct: list[np.ndarray], rtol: float
) -> None:
    """Refuse direct light that is not from 0 to all light of a frame and channel.

    `image` and `direct` hold (N, frames) for each channel; `rtol` is the error of the solves.
    """
    for channel, (picture, direct_picture) in enumerate(zip(image, direct, strict=True)):
        light = picture.sum(axis=0)
        direct_light = direct_picture.sum(axis=0)
        negative_light = np.minimum(picture, 0.0).sum(axis=0)
        is_picture = negative_light > -MAX_NEGATIVE_SHARE * light
        excess = np.maximum(-direct_light, direct_light - light)
        excess = np.where(is_picture, excess, 0.0)
        if not (excess > 0.0).any():
            continue
        uncertainty = _uncertainty_of_direct_light(T, channel, picture, direct_picture, rtol)
        if not (excess > uncertainty).any():
            continue
        frame = int(np.argmax(excess - uncertainty))
        share = direct_light[frame] / light[frame]
        relative_uncertainty = uncertainty[frame] / light[frame]
        pixels = _worst_pixels(T, picture[:, frame], direct_picture[:, frame])
        raise InputError(
            f"direct light is {share:.0%} of the image, uncertain to {relative_uncertainty:.1%}; "
            "it must be from 0 to 100 %: T or its first bounce is wrong or noisy, most of all at "
            f"the pixels (row, column): {pixels}; mask dark ones by dark_threshold=, or measure T "
            "again"
        )


def _uncertainty_of_direct_light(
    T: Transport, channel: int, picture: np.ndarray, direct: np.ndarray, rtol: float
) -> np.ndarray:
    """Uncertainty of the direct light of each frame, (frames,), at most a share of all light.

    The variance of direct light b is at most sum_j N (sigma_j b_j / F_j)^2, with the noise sigma_j
    of F_j for all of column j.
    """
    largest = MAX_UNCERTAINTY * picture.sum(axis=0)
    F = np.atleast_2d(T.first_bounce)
    # The noise of operators is unknown.
    with suppress(InputError):
        is_lit = ~T.masked
        relative_noise = T.noise.diagonal(F)[channel, is_lit] / F[channel, is_lit]
        noise = np.linalg.norm(relative_noise[:, None] * direct[is_lit], axis=0)
        solve_error = 2.0 * (rtol + T.error) * np.linalg.norm(picture, axis=0)
        uncertainty = np.sqrt(len(picture)) * (MAX_DEVIATIONS * noise + solve_error)
        return np.minimum(uncertainty, largest)
    return largest


def _worst_pixels(T: Transport, picture: np.ndarray, direct: np.ndarray) -> str:
    """The pixels (row, column) whose direct light is farthest from 0 to all light."""
    _, width = T.grid
    least_possible = np.minimum(direct, picture - direct)
    pixels = []
    for j in np.argsort(least_possible)[:WORST_PIXELS]:
        pixels.append(f"({j // width}, {j % width})")
    return ", ".join(pixels)


def bounce_limits(T: Transport) -> str:
    """Limits of bounces by T, and the meaning of their standard deviations, in words."""
    text = (
        "bounces hold as far as light between matt surfaces that the projector lights explains T, "
        "which does not show unlit surfaces, gloss, or light that returns to its own pixel"
    )
    if not np.isnan(T.bounce_spread).any():
        first, second, third = (f"{100 * spread:.2g}" for spread in T.bounce_spread)
        text += (
            f"; the first bounces diag(T) and 1 / diag(T^-1) differ by {first}, {second} and "
            f"{third} % in bounces 1, 2 and 3 under white"
        )
    if not np.isnan(T.resolution_spread).any():
        first, second, third = (f"{100 * spread:.2g}" for spread in T.resolution_spread)
        text += (
            f"; light that is uneven within pixels makes about {first}, {second} and {third} %, as "
            "pixels of twice the size do"
        )
    return f"{text}; std is the effect of noise in T alone"


def _negative_beyond_noise(T: Transport, noise: Noise) -> list[float]:
    """Share of light that one bounce takes away beyond noise of T, for each channel."""
    errors = EntryErrors(T, noise)
    parts = picture_parts(T.grid, PARTS_PER_SIDE)
    pixels = parts.sum(axis=0)
    shares = []
    for channel, F in enumerate(np.atleast_2d(T.first_bounce)):
        inverse_F = np.divide(1.0, F, out=np.zeros_like(F), where=F > 0)
        # The errors of the bounce are about those of T F^-1.
        squares = inverse_F[:, None] ** 2 * parts
        variances = parts.T @ np.maximum(errors.variance(channel, squares), 0.0)
        deviation = np.sqrt(variances) / (pixels[:, None] * pixels)
        allowed = NEGATIVE_SIGMAS * deviation
        shares.append(negative_bounce(T.systems[channel], T.grid, allowed))
    return shares


def bounce_warning(T: Transport) -> str:
    """The reasons why bounces by T are only approximate; empty if T shows none."""
    warnings = []
    if T.ambient_share > LARGEST_AMBIENT:
        warnings.append(
            f"{T.ambient_share:.0%} of a bounce reaches all places alike: unless black was "
            "subtracted from each picture of T, this is ambient light, and bounces are too bright; "
            "else it came by way of surfaces that the projector does not light"
        )
    reasons = []
    # Comparisons with NaN, of what is unknown, are false.
    largest_defect = LARGEST_DEFECT + T.error
    if T.reciprocity_defect > largest_defect:
        reasons.append(
            f"T is not reciprocal (defect {T.reciprocity_defect:.2g}, above {largest_defect:.2g})"
        )
    largest_negative = LARGEST_NEGATIVE + T.error
    negative = max(T.negative_bounces)
    if negative > largest_negative and T.measured_noise is not None:
        negative = max(_negative_beyond_noise(T, T.measured_noise))
    if negative > largest_negative:
        reasons.append(
            f"a bounce holds a share {negative:.2g} of negative light "
            f"(above {largest_negative:.2g})"
        )
    if reasons:
        warnings.append(
            f"{' and '.join(reasons)}: surfaces reflect differently to different sides, or T is "
            "noisy; with one camera the bounces of such a scene are approximate "
            "(section 8.4, eq. 28 and 29)"
        )
    return "; ".join(warnings)
