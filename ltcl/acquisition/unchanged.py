# SPDX-License-Identifier: BSD-3-Clause
"""Whether a scan in a store is gone on with by the set-up, and with the settings, that it was begun with.

A store keeps what the rig said of itself, `describe()`. What differs from session to session is left out of
the comparison, `PASSING`: what is measured or counted anew, and where things lie.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ltcl.acquisition.rig import Shots
from ltcl.errors import InputError

PASSING = frozenset(
    {
        "survey",  # latency and noise, as measured
        "shots",  # on the list so far
        "folder",
        "seed",
        "mitsuba",
        "camera.source",  # as the system numbers them
        "camera.backend",
        "display.index",
        "display.driver",
    }
)
"""Keys of `describe()` that may differ when a scan is resumed."""
_CLOSE = 1e-4  # relative difference of numbers that are the same


def refuse_other_rig(told: Any, shots: Shots, path: Path) -> None:
    """Refuse a rig that describes itself otherwise than the one that `path` was begun with, as `told`."""
    if getattr(shots.rig, "describe", None) is None:
        return
    was = _leaves(told)
    now = _leaves(json.loads(json.dumps(shots.describe()["rig"], default=str)))
    for key in sorted((was.keys() | now.keys()) - PASSING):
        if not _same(now.get(key), was.get(key)):
            raise changed(f"rig.{key}", now.get(key), path, was.get(key))


def changed(name: str, now: Any, path: Path, was: Any) -> InputError:
    """What is refused, in one line."""
    return InputError(
        f"{name} is {now!r:.80}, but {path} was begun with {was!r:.80}; it must be that, or another store"
    )


def _leaves(told: Any, above: str = "") -> dict[str, Any]:
    """What is no dict, by its keys with dots between.

    >>> _leaves({"kind": "live", "camera": {"kind": "opencv"}})
    {'kind': 'live', 'camera.kind': 'opencv'}
    """
    found: dict[str, Any] = {}
    for key, value in told.items() if isinstance(told, Mapping) else ():
        name = f"{above}{key}"
        if isinstance(value, Mapping) and name not in PASSING:
            found |= _leaves(value, f"{name}.")
        else:
            found[name] = value
    return found


def _same(a: Any, b: Any) -> bool:
    """Of plain JSON; a number is the same to rounding."""
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, (int, float)) and isinstance(b, (int, float)) and bool not in (type(a), type(b)):
        return math.isclose(a, b, rel_tol=_CLOSE) or (math.isnan(a) and math.isnan(b))
    return a == b
