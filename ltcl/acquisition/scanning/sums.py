# SPDX-License-Identifier: BSD-3-Clause
"""Light that has to add up and does not: a warning, or the end of the scan."""

from __future__ import annotations

import logging

from ltcl.errors import ScanRefused

logger = logging.getLogger(__name__)
WRONG = 0.3  # of the light: what is further off has little to do with it


def compare(what: str, off: float, due: str, much: float) -> None:
    """Warn where `what` adds up to light that is `off` from what is `due` by more than `much`, or refuse it.

    Raises
    ------
    ScanRefused
        What is committed already is of no use.

    Examples
    --------
    >>> compare("columns of T", 0.5, "what white showed", much=0.05)  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    ltcl.errors.ScanRefused: columns of T add up to light that is 50% beside what white showed; ...
    """
    if not off > much:
        return
    told = f"{what} add up to light that is {off:.0%} beside {due}"
    if off > WRONG:
        raise ScanRefused(
            f"{told}; photographs must be in the order of their patterns and exposed for long enough to "
            "stand out of noise, and the light, the camera and the scene must stay as they were. Put that "
            "right, and acquire into another store"
        )
    logger.warning("%s: noise, photographs in another order, or a set-up that changed", told)
