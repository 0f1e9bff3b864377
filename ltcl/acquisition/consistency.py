# SPDX-License-Identifier: BSD-3-Clause
"""Checks of a calibration: photographs that cannot be what they should be are refused by number.

    geometry        pixels of the photographs and of the projector
    black           no lamp was on in one photograph of several
    uniform codes   show black and a rising part of white
    light           white is brighter than black, and the scan's exposures show it
    colours         red, green and blue add up to white, else it is a warning
    superposition   few pixels and all others add up to white: no dynamic contrast
    map             no pattern of Gray code was exchanged with its inverse

An AcquisitionError names photographs, an InputError an argument of `ltcl.acquire`.
"""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ltcl.acquisition import agreement, anchor
from ltcl.acquisition.agreement import ADVICE, CameraModel
from ltcl.acquisition.geometry import Correspondence, GrayCode, Resampling, decode
from ltcl.acquisition.geometry.photographs import PhotographFile
from ltcl.acquisition.radiance import RadiancePicture, on_projector, strips
from ltcl.acquisition.radiometry import Radiance
from ltcl.acquisition.radiometry.exposures import NO_LIGHT
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.session import CaptureSession, Photograph
from ltcl.errors import AcquisitionError, InputError

# Light of a lamp in a photograph of black, relative to full scale: less moves T p by less than
# 1 %; more may be another pattern, which `agreement` reports.
MIN_LAMP_LEVEL = 0.01
MAX_LAMP_LEVEL = 0.1
# Standard deviations by which the mean of a photograph must be above the others.
LAMP_SIGMAS = 5.0
# Relative deviation of red, green and blue from white, and its standard deviations, from which on
# a projector does not add its colours: clean ones deviate by less than 1 %.
MAX_COLOUR_DEVIATION = 0.03
COLOUR_SIGMAS = 5.0
# Relative deviation of few pixels and the others from white, from which on the projector's light
# depends on the picture. Clean ones deviate by less than 1 %.
MAX_CONTRAST_CHANGE = 0.03
# Standard deviations that the light of a pixel must be above to show whose it is.
CLEAR_SIGMAS = 6.0
# Standard deviations of noise that white must be above.
MIN_SIGMAS = 3.0
# Relative deviation of a projector's curve from pixel to pixel that is allowed.
PROJECTOR_UNEVENNESS = 0.1
# Correlation of a picture of blocks with their pattern: 0.98 and more with the right map.
MIN_MAP_CORRELATION = 0.9
# The same where coarse stripes have no inverses: 0.74 and less if one shows another.
MIN_COARSE_CORRELATION = 0.85
# Share of a pixel's own light in what white shows there, at least, in most scenes.
MIN_DIRECT_SHARE = 0.5


logger = logging.getLogger(__name__)


def check_geometry(shots: Shots, geometry: str | Correspondence) -> None:
    """Refuse a geometry of other pixels than those of the first photograph."""
    grid = shots.grid
    camera = shots.camera_grid
    name = repr(geometry)
    if isinstance(geometry, Correspondence):
        grid = geometry.grid
        camera = geometry.camera_grid
        name = "a Correspondence"
    elif geometry == "aligned":
        camera = shots.grid
    if (grid, camera) != (shots.grid, shots.camera_grid):
        raise InputError(
            f"geometry is {name}, from photographs of {camera} to a projector of {grid}; "
            f"the rig has photographs of {shots.camera_grid} and a projector of {shots.grid}"
        )


def check_black(session: CaptureSession, photographs: Sequence[Photograph]) -> None:
    """Refuse a photograph of black that is brighter than the others of the same exposure.

    Compared pixel by pixel with that one, all others would deviate.
    """
    response = session.camera.response
    light = np.stack([response.linear(shot.sampled).ravel() for shot in photographs])
    level = light.mean(axis=1)
    deviation = light - light.mean(axis=0) - level[:, None]
    noise_of_level = float(np.std(deviation)) / math.sqrt(light.shape[1])
    excess = level - level.min()
    threshold = MIN_LAMP_LEVEL + LAMP_SIGMAS * noise_of_level
    is_too_bright = (excess > threshold) & (excess < MAX_LAMP_LEVEL)
    if is_too_bright.any():
        name = session.name(photographs[int(np.argmax(is_too_bright))])
        raise AcquisitionError(f"{name}, of black, is too bright: another light was on; {ADVICE}")


def check_light(
    exposures: Sequence[float], white: RadiancePicture, resampling: Resampling, camera: CameraModel
) -> None:
    """Refuse a projector without light; exposures that saturate lit pixels, or show noise alone."""
    total = 0.0
    variance = 0.0
    for strip in strips(white):
        total += float(strip.value.sum(dtype=np.float64))
        variance += float(strip.variance[strip.valid].sum(dtype=np.float64))
    if total <= MIN_SIGMAS * math.sqrt(variance):
        raise AcquisitionError(
            f"photographs are no brighter under white than under black; {NO_LIGHT}"
        )
    light = on_projector(white, "value", resampling)[resampling.seen]
    is_lit = light > 0
    level = float(np.median(light[is_lit])) if is_lit.any() else 0.0
    shortest = exposures[0]
    longest = exposures[-1]
    read_noise = float(np.sqrt(camera.noise.variance(0.0)))
    if shortest * MIN_DIRECT_SHARE * level > camera.noise.saturation:
        limit = f"below {shortest / 2:.2g}"
        reason = f"saturates at {shortest:g} s, which must be {limit}"
    elif 0 < longest * level < MIN_SIGMAS * read_noise:
        limit = f"above {2 * longest:.2g}"
        reason = f"is lost in noise at {longest:g} s, which must be {limit}"
    else:
        return
    raise InputError(f"exposures is {exposures}; half of white {reason}")


def check_colours(colours: Sequence[Radiance], white: Radiance, black: Radiance) -> None:
    """Warn if pictures of red, green and blue (H, W, 3) do not add up to that of white.

    With W = white - black in a channel of the camera, and C the same of the sum of the colours,
    least squares give C = r W, r = sum_p W C / sum_p W^2, whose variance is that of C.
    """
    light = white - black
    colour_light = [colour - black for colour in colours]
    total = np.sum([colour.value for colour in colour_light], axis=0)
    variance = np.sum([colour.variance for colour in colour_light], axis=0)
    is_valid = np.all([picture.valid for picture in [light, *colour_light]], axis=0)
    worst = 0.0
    for c in range(total.shape[2]):
        pixels = is_valid[..., c]
        W = light.value[..., c][pixels].astype(np.float64)
        square = max(float(W @ W), 1e-30)
        change = float(W @ total[..., c][pixels]) / square - 1.0
        deviation = math.sqrt(W**2 @ variance[..., c][pixels]) / square
        if abs(change) > max(COLOUR_SIGMAS * deviation, MAX_COLOUR_DEVIATION, abs(worst)):
            worst = change
    if worst:
        logger.warning(
            "red, green and blue together have %.0f %% of the light of white: the projector's "
            "colour mode does not add its colours (a white segment, BrilliantColor, dynamic "
            "colours), so that coloured patterns are off by as much; choose another mode (sRGB, "
            "cinema, reference), and begin again",
            100.0 * (1.0 + worst),
        )


def check_superposition(
    session: CaptureSession,
    few: Photograph,
    others: Photograph,
    dark: Sequence[Photograph],
    bright: Sequence[Photograph],
) -> None:
    """Refuse a projector whose light depends on the picture, as by dynamic contrast.

    Few pixels and all others must add up to the same part of white where the few are, in a dark
    picture, and elsewhere, in a bright one. A lamp that fades changes both.
    """
    black = session.merge_sampled(dark)
    light = session.merge_sampled(bright) - black
    few_light = session.merge_sampled([few]) - black
    other_light = session.merge_sampled([others]) - black
    total = few_light.value + other_light.value
    variance = few_light.variance + other_light.variance
    is_valid = light.valid & few_light.valid & other_light.valid
    # Where the projector gives no light, noise would decide which pixels are the few.
    is_valid &= light.value > CLEAR_SIGMAS * np.sqrt(variance)
    is_few = few_light.value > 0.5 * light.value
    shares = []
    deviations = []
    for pixels in (is_valid & is_few, is_valid & ~is_few):
        W = light.value[pixels].astype(np.float64)
        square = max(float(W @ W), 1e-30)
        shares.append(float(W @ total[pixels]) / square)
        deviations.append(math.sqrt(W**2 @ variance[pixels]) / square)
    dark_share, bright_share = shares
    if dark_share <= 0 or bright_share <= 0:
        return
    tolerance = max(COLOUR_SIGMAS * math.hypot(*deviations), MAX_CONTRAST_CHANGE)
    change = dark_share / bright_share
    if abs(change - 1.0) > tolerance:
        raise AcquisitionError(
            f"{session.name(few)} or {session.name(others)} deviates: pixels in a dark picture are "
            f"{change:.2f} times as bright as in a bright one, so the projector's light depends on "
            "the picture: switch off dynamic contrast, automatic iris and lamp, local dimming; or "
            f"another pattern was shown; {ADVICE}"
        )


@dataclass(frozen=True, kw_only=True)
class _UniformReference:
    """Black, and k pictures of light, at some `pixels` of the photographs, with their variances.

    Black is (n, c); the light is that of white, or of three colours, (k, n, c).
    """

    pixels: np.ndarray
    black: np.ndarray
    black_variance: np.ndarray
    light: np.ndarray
    lit_variance: np.ndarray

    @classmethod
    def from_pictures(cls, ambient: Radiance, lit: Sequence[Radiance]) -> _UniformReference:
        known = np.all([picture.valid for picture in (ambient, *lit)], axis=0)
        in_all_channels = known.reshape(*known.shape[:2], -1).all(axis=2)
        pixels = agreement.spread(np.flatnonzero(in_all_channels))

        def sampled(picture: np.ndarray) -> np.ndarray:
            return agreement.sample(picture, pixels).astype(np.float64)

        black = sampled(ambient.value)
        return cls(
            pixels=pixels,
            black=black,
            black_variance=sampled(ambient.variance),
            light=np.stack([sampled(picture.value) - black for picture in lit]),
            lit_variance=np.stack([sampled(picture.variance) for picture in lit]),
        )

    def shares(self, picture: Radiance) -> tuple[np.ndarray, np.ndarray]:
        """Parts g (k,) of the light that a picture shows, and their standard deviations.

        By least squares: g = (A A^T)^-1 A y of light A and picture y, without black.
        """
        value = agreement.sample(picture.value, self.pixels)
        variance = agreement.sample(picture.variance, self.pixels)
        valid = agreement.sample(picture.valid, self.pixels)
        A = self.light[:, valid]
        inverse = np.linalg.pinv(A @ A.T) @ A
        noise = (variance + self.black_variance)[valid]
        return inverse @ (value - self.black)[valid], np.sqrt(inverse**2 @ noise)

    def expected(self, shares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Radiance under parts of the light, and its variance."""
        light = np.tensordot(shares, self.light, 1)
        unevenness = (PROJECTOR_UNEVENNESS * light) ** 2
        lit_variance = np.tensordot(shares**2, self.lit_variance, 1)
        return self.black + light, self.black_variance + lit_variance + unevenness


def check_uniform(
    session: CaptureSession,
    photographs: Sequence[Photograph],
    pictures: Sequence[Radiance],
    lit: Sequence[Radiance],
    ambient: Radiance,
    colours: Sequence[Photograph] = (),
) -> None:
    """Refuse photographs of uniform codes that do not show black and a rising part of the light.

    `lit` is white, or each colour, whose photographs are `colours`.
    """
    reference = _UniformReference.from_pictures(ambient, lit)
    about_colours = ""
    if colours:
        names = [session.name(photograph) for photograph in colours]
        about_colours = f", by its colours in {', '.join(names)}"
    previous_shares = np.zeros(len(lit))
    previous_name = None
    for photograph, picture in zip(photographs, pictures, strict=True):
        name = session.name(photograph)
        shares, noise = reference.shares(picture)
        sampled = agreement.sample(photograph.sampled, reference.pixels)
        deviation = agreement.find_deviation(
            [sampled], [photograph.seconds], session.camera, reference.expected(shares)
        )
        tolerance = MIN_SIGMAS * noise + PROJECTOR_UNEVENNESS * previous_shares
        is_darker = shares < previous_shares - tolerance
        wrong_name = name if deviation is not None else None
        if previous_name is not None and is_darker.any():
            wrong_name = wrong_name or _colour_cast(previous_name, previous_shares, name, shares)
        if wrong_name is not None:
            raise AcquisitionError(
                f"{wrong_name}, of a uniform code, does not show a part of white{about_colours}: "
                f"another light was on, or it is another pattern; {ADVICE}"
            )
        if previous_name is not None and is_darker.any():
            channel = int(is_darker.argmax())
            ratio = shares[channel] / previous_shares[channel]
            raise AcquisitionError(
                f"{previous_name} or {name} deviates: it shows {ratio:.2g} times "
                f"the light of a darker code; {ADVICE}"
            )
        previous_shares = shares
        previous_name = name


def _colour_cast(
    first: str, first_shares: np.ndarray, second: str, second_shares: np.ndarray
) -> str | None:
    """Name of the one of two photographs of grey codes that has the colour of another light.

    None if neither has.
    """
    casts = []
    for shares in (first_shares, second_shares):
        casts.append(float(np.ptp(shares)) / max(float(shares.mean()), 1e-30))
    if casts[0] > 2.0 * casts[1] + PROJECTOR_UNEVENNESS:
        return first
    if casts[1] > 2.0 * casts[0] + PROJECTOR_UNEVENNESS:
        return second
    return None


def check_map(
    session: CaptureSession,
    resampling: Resampling,
    stripes: Sequence[Photograph],
    light: PhotographFile,
    blocks: RadiancePicture,
    white: RadiancePicture,
) -> None:
    """Refuse Gray code with a pattern and its inverse exchanged, or one without an inverse wrong.

    Its map is mirrored in part. The picture of blocks tells: it is more like their pattern in the
    map that exchanging them back gives. `light` is linear, of the stripes; blocks and white are
    without ambient light.
    """
    likeness = _block_correlation(resampling, blocks, white)
    if likeness > MIN_MAP_CORRELATION:
        return
    layout = GrayCode(resampling.grid).layout_of(len(stripes))
    for k in layout.first[layout.has_inverse].tolist():
        exchanged = light.exchanged(k, k + 1)
        with contextlib.suppress(InputError):
            mapping = decode(exchanged, resampling.grid, levels=session.shots.levels)
            corrected = Resampling.of(mapping)
            likeness_of_corrected = _block_correlation(corrected, blocks, white)
            if likeness_of_corrected > max(likeness, MIN_MAP_CORRELATION):
                first = session.name(stripes[k])
                second = session.name(stripes[k + 1])
                raise AcquisitionError(
                    f"{first} and {second} are exchanged, a pattern and its inverse; {ADVICE}"
                )
    coarse = layout.first[~layout.has_inverse].tolist()
    if coarse and likeness < MIN_COARSE_CORRELATION:
        raise AcquisitionError(
            f"{session.name(stripes[coarse[0]])} or a later one to "
            f"{session.name(stripes[coarse[-1]])}, of coarse stripes without their inverses, shows "
            f"another pattern: the map that they give does not fit that of blocks; {ADVICE}"
        )


def _block_correlation(
    resampling: Resampling, blocks: RadiancePicture, white: RadiancePicture
) -> float:
    """Correlation of a picture of blocks, relative to white, with their pattern."""
    codes = anchor.pattern(resampling.grid).ravel()
    lit = on_projector(blocks, "value", resampling).reshape(len(codes), -1).sum(axis=1)
    full = on_projector(white, "value", resampling).reshape(len(codes), -1).sum(axis=1)
    seen = resampling.seen.ravel() & (full > 0)
    # Without any pixels, or if all are alike, the correlation is NaN.
    with np.errstate(invalid="ignore", divide="ignore"):
        return float(np.corrcoef(lit[seen] / full[seen], codes[seen])[0, 1])
