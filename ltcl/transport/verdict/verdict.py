# SPDX-License-Identifier: BSD-3-Clause
"""The verdict on a measured T: two sentences that follow from numbers.

T is good for compensation if errors by noise are at most 2 % in pictures, for bounces if they are
at most 5 % in bounces 1 to 3, as is their change by the choice of the first bounce, and if no
damage spoils the use (`ltcl.transport.verdict.damages`). The numbers come from T itself
(`ltcl.transport.verdict.evidence`) and from the caller.

Known limits: bounces are those of light between surfaces that the projector lights and that are
matt; light from other surfaces, gloss that T does not show as such, and light that returns to its
own pixel are unknown. Light that is uneven within pixels changes bounces, by about as much as
pixels of twice the size do (`resolution_1` to `resolution_3`), which the text tells. T alone cannot
show damages that another scene would explain as well: a gain of entries, camera pixels or colours;
light that changes slowly during a scan (`sum_deviation` shows it); saturation without noise; three
channels exchanged as a whole; light of one colour in another without `mixing` or blocks; little
ambient light, or any if gloss has bounces below 0.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ltcl.errors import InputError
from ltcl.transport.transport import Transport, check_transport
from ltcl.transport.verdict.damages import (
    BOUNCES_THRESHOLD,
    CAUSING_OTHERS,
    DAMAGES,
    OF_SURFACES,
    Damage,
)
from ltcl.transport.verdict.evidence import MIN_PIXELS, Evidence, Measure

# What T shows of bounces.
BOUNCES_AS_EXPLAINED = "bounces as far as light between lit, matt surfaces explains T"
# Four times as many exposures halve an error by noise.
HALVING_EXPOSURES = 4.0


@dataclass(frozen=True)
class Verdict:
    """Result of `verdict`.

    Attributes
    ----------
    text : str
        At most two sentences.
    compensation, bounces : bool or None
        Whether T is good for them: errors by noise are at most 2 % in pictures, 5 % in bounces 1 to
        3, the choice of the first bounce changes these by at most 5 %, and no damage spoils them.
        Bounces are good as far as light between lit, matt surfaces explains T, and is even within
        pixels. None if unknown.
    causes : tuple of str
        Names of those `numbers` that deviate, most important first; docs/reference/json.md lists
        them.
    numbers : dict
    """

    text: str
    compensation: bool | None = None
    bounces: bool | None = None
    causes: tuple[str, ...] = ()
    numbers: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Finding:
    """A damage that T has, with the sentence that names it."""

    name: str
    spoils_compensation: bool
    spoils_bounces: bool
    cause: str
    advice: str

    @property
    def spoils(self) -> bool:
        """True if it spoils some use."""
        return self.spoils_compensation or self.spoils_bounces


# Numbers that are not finite are refused below.
@np.errstate(over="ignore", invalid="ignore")
def verdict(T: Transport, **known: float) -> Verdict:
    """Judge the uses that T is good for; opens no device if T is an array or sparse.

    Parameters
    ----------
    T : Transport
    known : float
        Further numbers, such as `sum_deviation` and `saturation`, a share of the camera's pixels,
        of a scan. NaN does not count.

    Examples
    --------
    >>> import ltcl
    >>> T = ltcl.scenes.dihedral(8, albedo=0.6).transport(first_bounce="exact")
    >>> verdict(T).text.split(".")[0]
    'Good for compensation, and for bounces as far as light between lit, matt surfaces explains T'
    """
    numbers = {name: value for name, value in known.items() if not math.isnan(value)}
    places: dict[str, str] = {}
    try:
        check_transport(T, square=False)
        _check_enough_pixels(T)
        for measure in Evidence(T).measures():
            _keep_worst(measure, numbers, places)
    except (InputError, np.linalg.LinAlgError) as error:
        # For example compressed entries without noise. Some damages show without it.
        judged = _judge(numbers, places)
        if judged.compensation:
            return Verdict(f"Unknown: {error}.", numbers=numbers)
        return judged
    return _judge(numbers, places)


def _check_enough_pixels(T: Transport) -> None:
    if not T.noise.is_measured and min(T.shape) < MIN_PIXELS:
        raise InputError(
            f"fewer than {MIN_PIXELS} pixels do not tell their noise: use ltcl analyze --noise"
        )


def _keep_worst(measure: Measure, numbers: dict[str, float], places: dict[str, str]) -> None:
    """Keep the worst number of each name: the least gain, the largest of all others."""
    name, value, place = measure
    if not math.isfinite(value):
        raise InputError(
            f"{name} is {value:g}: check T and its noise for numbers that are too large"
        )
    if name in numbers:
        is_better = value < numbers[name]
        if name == "gain":
            is_better = value >= numbers[name]
        if is_better:
            return
    numbers[name] = float(value)
    places[name] = place


def _judge(numbers: dict[str, float], places: Mapping[str, str]) -> Verdict:
    uncertain = {
        "bounces": _uncertain_bounces(numbers, "bounce"),
        "spread": _uncertain_bounces(numbers, "spread"),
    }
    findings = _find_damages(numbers, places, uncertain)
    # Those that spoil a use first.
    findings.sort(key=lambda finding: not finding.spoils)
    spoils_compensation = [finding.name for finding in findings if finding.spoils_compensation]
    spoils_bounces = [finding.name for finding in findings if finding.spoils_bounces]
    refused = "bounces"
    if set(spoils_bounces) <= set(uncertain):
        # Other bounces are good.
        refused_numbers = [k for name in spoils_bounces for k in uncertain[name]]
        refused = _name_bounces(sorted({*refused_numbers}))
    is_good_for_compensation = not spoils_compensation
    is_good_for_bounces = not spoils_bounces
    uses = _describe_uses(is_good_for_compensation, is_good_for_bounces, refused)
    causes = [finding.name for finding in findings]
    return Verdict(
        text=f"{uses}. {_explain(findings, numbers)}.",
        compensation=is_good_for_compensation,
        bounces=is_good_for_bounces,
        causes=tuple(causes),
        numbers=numbers,
    )


def _describe_uses(compensation: bool, bounces: bool, refused: str) -> str:
    """First sentence of the text; `refused` names the bounces that T is not good for."""
    if compensation and bounces:
        return f"Good for compensation, and for {BOUNCES_AS_EXPLAINED}"
    if compensation:
        return f"Good for compensation, not for {refused}"
    if bounces:
        return f"Good for {BOUNCES_AS_EXPLAINED}, not for compensation"
    return f"Not good for compensation or {refused}"


def _explain(findings: list[Finding], numbers: Mapping[str, float]) -> str:
    """Second sentence: the first damage, advice, and the second damage; or the errors by noise."""
    if not findings:
        pictures = _round_percent(numbers.get("pictures", 0.0))
        text = f"Errors by noise are {pictures} in pictures"
        if "bounces" in numbers:
            bounces = _round_percent(numbers["bounces"])
            text += f" and {bounces} in bounces at most; {_describe_spreads(numbers)}"
        return text
    first = findings[0]
    text = f"{first.cause}: {first.advice}"
    text = text[0].upper() + text[1:]
    if len(findings) > 1:
        text += f"; also, {findings[1].cause}"
    return text


def _describe_spreads(numbers: Mapping[str, float]) -> str:
    """Changes of bounces by what T alone does not decide."""
    spread = max(numbers[f"spread_{k}"] for k in (1, 2, 3))
    text = f"the choice of the first bounce makes {_round_percent(spread)} in bounces"
    if "resolution_1" in numbers:
        change = max(numbers[f"resolution_{k}"] for k in (1, 2, 3))
        text += f", pixels of twice the size make {_round_percent(change)}"
    return text


def _find_damages(
    numbers: Mapping[str, float], places: Mapping[str, str], uncertain: Mapping[str, list[int]]
) -> list[Finding]:
    """The damages that numbers show, most important first.

    Damages that an earlier one explains are left out: those of surfaces by any.
    """
    findings = []
    spoilers: set[str] = set()
    for damage in DAMAGES:
        value = numbers.get(damage.name, 0.0)
        explanations = spoilers if damage.name in OF_SURFACES else spoilers & CAUSING_OTHERS
        if value <= damage.threshold or explanations:
            continue
        finding = _describe(damage, value, places.get(damage.name, ""), uncertain)
        findings.append(finding)
        if finding.spoils_bounces:
            spoilers.add(damage.name)
    return findings


def _describe(
    damage: Damage, value: float, place: str, uncertain: Mapping[str, list[int]]
) -> Finding:
    noisy = uncertain["bounces"]
    verb = "are" if len(noisy) > 1 else "is"
    facts = {
        "p": _round_percent(value),
        "n": _round(value),
        "where": place,
        "noisy": f"{_name_bounces(noisy)} {verb}",
        "spread": _name_bounces(uncertain["spread"]),
        "more": _advise_exposures(value, damage.threshold),
    }
    return Finding(
        name=damage.name,
        spoils_compensation=damage.spoils_compensation(value),
        spoils_bounces=damage.spoils_bounces(value),
        cause=damage.cause.format(**facts),
        advice=damage.advice.format(**facts),
    )


def _advise_exposures(error: float, threshold: float) -> str:
    """Advice to average out a noise: its variance falls with the number of exposures."""
    exposures = (error / max(threshold, 1e-9)) ** 2
    if exposures <= HALVING_EXPOSURES:
        return "4 times as many exposures would halve that"
    goal = _round_percent(threshold)
    return f"{_round(exposures)} times as many exposures would bring that to {goal}"


def _uncertain_bounces(numbers: Mapping[str, float], name: str) -> list[int]:
    """The bounces, of 1 to 3, whose number of this name is too large."""
    uncertain = []
    for k in (1, 2, 3):
        if numbers.get(f"{name}_{k}", 0.0) > BOUNCES_THRESHOLD:
            uncertain.append(k)
    return uncertain


def _name_bounces(uncertain: list[int]) -> str:
    """Bounces by their numbers: "bounce 2", "bounces 2 and 3", "bounces 1 to 3"."""
    if uncertain == [1, 2, 3]:
        return "bounces 1 to 3"
    noun = "bounces" if len(uncertain) > 1 else "bounce"
    return f"{noun} {' and '.join(map(str, uncertain))}"


def _round(value: float) -> str:
    return f"{float(f'{value:.2g}'):g}"


def _round_percent(value: float) -> str:
    return f"{_round(100 * value)} %"
