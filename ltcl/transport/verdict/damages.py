# SPDX-License-Identifier: BSD-3-Clause
"""Damages of a measured transport: the limits of the number that shows each, cause, and advice."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Damage:
    """A damage, shown by the number of the same name.

    Attributes
    ----------
    name : str
    threshold : float
        The damage is named, and spoils compensation and bounces, if the number is larger.
    compensation_limit, bounces_limit : float, optional
        Limits of their own for what the damage spoils.
    cause, advice : str
        Texts, whose fields are {p} the number in percent, {n} the number, {where} a place in the
        picture, {more} a number of exposures, {noisy} and {spread} the bounces that are uncertain
        by noise, or by the choice of the first bounce. A guess at a cause is called "perhaps".
    """

    name: str
    threshold: float
    cause: str
    advice: str
    compensation_limit: float | None = None
    bounces_limit: float | None = None

    def spoils_compensation(self, value: float) -> bool:
        """True if the number spoils compensation."""
        if self.compensation_limit is None:
            return value > self.threshold
        return value > self.compensation_limit

    def spoils_bounces(self, value: float) -> bool:
        """True if the number spoils bounces."""
        if self.bounces_limit is None:
            return value > self.threshold
        return value > self.bounces_limit


# Limit of a use that a damage does not spoil. Only a T that is noise alone exceeds it.
NOISE_ALONE = 9.0

# Most important first.
DAMAGES = (
    Damage(
        name="other_grid",
        threshold=0.0,
        cause="T fits a grid of {where} pixels better",
        advice="give --grid {where}",
    ),
    Damage(
        name="exchanged",
        threshold=0.0,
        cause="colour channels are perhaps exchanged, {where}",
        advice="put them in one order",
    ),
    Damage(
        name="shifted",
        threshold=0.2,
        cause="{p} of pixels are brightest {where} away",
        advice="align camera and projector",
    ),
    Damage(
        name="hot_rows",
        threshold=0.0,
        cause="{n} hot camera pixel(s){where} see all patterns alike",
        advice="mask or replace them",
    ),
    Damage(
        name="saturated",
        threshold=2.0,
        cause="{n} entries of T{where} saturate at one value",
        advice="take shorter exposures, too",
    ),
    Damage(
        name="quantized",
        threshold=0.3,
        cause="T is stored in steps of {p} of its mean indirect light, and less is lost",
        advice="store T as floats",
        # Measured: then pictures of rounded corners and boxes are off by 2 %.
        compensation_limit=1.2,
    ),
    Damage(
        name="saturation",
        threshold=0.01,
        cause="{p} of the camera saturates",
        advice="take shorter exposures, too",
    ),
    Damage(
        name="sum_deviation",
        threshold=0.03,
        cause="row sums deviate by {p} from white",
        advice="warm up, and scan again",
    ),
    Damage(
        name="left_out",
        threshold=0.02,
        cause="{p} of the light is indirect and was left out of T",
        advice="scan with strategy 'sketch', 'adaptive' or 'pixel' for all of it",
    ),
    Damage(
        name="ambient",
        threshold=0.05,
        cause="{p} of a bounce is perhaps ambient light left in T, or came by unlit surfaces",
        advice="subtract black, unless that was done",
    ),
    Damage(
        name="row_offset",
        threshold=0.015,
        cause="camera pixels have offsets, {p} under white, perhaps errors of the dark frame",
        advice="measure black again, and subtract it",
        compensation_limit=0.02,
    ),
    Damage(
        name="offset",
        threshold=0.02,
        cause="T has a negative offset, {p} of its mean light",
        advice="subtract less black",
    ),
    Damage(
        name="flicker",
        threshold=0.02,
        cause="the light of projector pixels differs by {p}, and perhaps drifted in the scan",
        advice="scan again",
    ),
    Damage(
        name="outliers",
        threshold=0.0,
        compensation_limit=0.02,
        cause="outliers{where} change pictures by {p}",
        advice="measure these pixels again",
    ),
    Damage(
        name="irreciprocal",
        threshold=0.1,
        compensation_limit=NOISE_ALONE,
        cause="T is not reciprocal to {p}, perhaps by gloss",
        advice="bounces are approximate",
    ),
    Damage(
        name="pictures",
        threshold=0.02,
        bounces_limit=NOISE_ALONE,
        cause="pictures are uncertain to {p} because of noise{where}",
        advice="{more}",
    ),
    Damage(
        name="bounces",
        threshold=0.05,
        compensation_limit=NOISE_ALONE,
        cause="{noisy} uncertain to {p} because of noise{where}",
        advice="{more}",
    ),
    Damage(
        name="bounce_highest",
        threshold=1.0,
        cause="pixels return {p} of their light",
        advice="check black level and exposures",
    ),
    Damage(
        name="negative_bounce",
        threshold=0.005,
        compensation_limit=NOISE_ALONE,
        cause="{p} of a bounce is negative, perhaps by gloss",
        advice="bounces are rough",
    ),
    Damage(
        name="no_bounces",
        threshold=0.0,
        compensation_limit=NOISE_ALONE,
        cause="bounces need one grid for camera and projector",
        advice="bring T onto it by 'ltcl align', or ltcl.align(T)",
    ),
    Damage(
        name="blocks",
        threshold=0.0,
        compensation_limit=NOISE_ALONE,
        cause="bounces need a T without blocks between colours",
        advice="give the blocks on the diagonal alone, if others are dark",
    ),
    Damage(
        name="dark",
        threshold=0.0,
        compensation_limit=0.05,
        bounces_limit=0.05,
        cause="{p} of projector pixels{where} stay unlit, too dark",
        advice="expose them longer",
    ),
    Damage(
        name="spread",
        threshold=0.05,
        compensation_limit=NOISE_ALONE,
        cause="the first bounce, diag(T) or 1 / diag(T^-1), makes a difference of {p} in {spread}",
        advice="give first_bounce='exact'",
    ),
)
# Relative deviation of a bounce, by noise or by the choice of the first bounce, that makes it
# uncertain.
BOUNCES_THRESHOLD = 0.05
# Damages that cause most others, which are then not named.
CAUSING_OTHERS = frozenset({"other_grid", "exchanged", "shifted", "quantized"})
# Damages that are named only if nothing else is wrong, as the scene may be the cause.
OF_SURFACES = frozenset({"bounce_highest", "irreciprocal", "negative_bounce", "spread"})
