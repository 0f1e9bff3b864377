# SPDX-License-Identifier: BSD-3-Clause
"""What a budget of bytes holds: the best of a tolerance, else about the least tolerance that fits into it.

Sizes are of what was made, as it would be handed out; nothing is refused on an estimate.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from ltcl import checks
from ltcl.compression.choice import Choice
from ltcl.compression.confirm import Confirmed
from ltcl.errors import ConvergenceError, InputError

Made = tuple[Confirmed, Choice]
Make = Callable[[float, float], Sequence[Made]]  # all channels, of a tolerance and the bytes each may take
_DECADE = 24  # tolerances in a factor of ten
_STRIDE = 12  # of them at once, until one does not fit
_LOOSEST = 0.99
_SMALLEST = 0.0  # bytes that nothing fits into: the fewest are taken


def within(make: Make, rtol: float, budget: int | None) -> Sequence[Made]:
    """All channels of `rtol` in at most `budget` bytes together: the best, else as small as can be.

    Raises
    ------
    InputError
        They do not fit; it says what they need, and the least tolerance that does, to a tenth of it.
    """
    made = make(rtol, math.inf if budget is None else budget)
    if budget is None or _bytes(made) <= budget:
        return made
    made = make(rtol, _SMALLEST)
    needed = _bytes(made)
    if needed <= budget:
        return made

    def fits(looser: float) -> bool:
        try:
            return looser > rtol and _bytes(make(looser, _SMALLEST)) <= budget
        except (InputError, ConvergenceError):  # nothing of that tolerance can be had
            return False

    allowed = _least(fits)
    advice = "no rtol below 1 fits into it" if allowed is None else f"it allows rtol {allowed:g}"
    raise InputError(
        f"budget is {budget} bytes, but rtol {rtol:g} needs {needed} ({checks.size(needed)}); {advice}"
    )


def _least(fits: Callable[[float], bool]) -> float | None:
    """The least tolerance that fits, to a tenth; those tried do not depend on what was asked for.

    >>> _least(lambda rtol: rtol > 0.0305)
    0.032
    """
    good, bad = -1, 0
    while fits(_tolerance(bad)):
        good, bad = bad, bad + _STRIDE
    if good < 0:
        return None
    while bad - good > 1:
        middle = (good + bad) // 2
        good, bad = (middle, bad) if fits(_tolerance(middle)) else (good, middle)
    return _tolerance(good)


def _tolerance(step: int) -> float:
    """Tolerances of two digits, each about a tenth below the one before.

    >>> [_tolerance(step) for step in range(4)]
    [0.99, 0.91, 0.83, 0.75]
    """
    return min(_LOOSEST, float(f"{10.0 ** (-step / _DECADE):.1e}"))


def _bytes(made: Sequence[Made]) -> int:
    return sum(found.core.nbytes for found, _ in made)
