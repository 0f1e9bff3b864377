# SPDX-License-Identifier: BSD-3-Clause
"""`Settings` of `acquire`, checked before the first photograph; and whether a scan is resumed with the same.

A store keeps the settings and what the rig said of itself. A scan is resumed with the same settings and the
same rig: what `describe()` says, the grids, the bits of the camera, and how the first photographs under black
and white look. Keys that differ from session to session are left out, `VOLATILE_KEYS`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ltcl import checks
from ltcl.acquisition import exposure
from ltcl.acquisition.calibration import PREFIX
from ltcl.acquisition.geometry import Correspondence
from ltcl.acquisition.radiometry import Response
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.scanning import plan
from ltcl.errors import FileError, InputError, InputTypeError
from ltcl.store import BlockStore

VOLATILE_KEYS = frozenset(
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
_CLOSE = 1e-4  # relative difference of equal numbers
_SAME_VIEW = 0.03  # of full scale, mean over the cells of a digest: lamps and exposures vary less


@dataclass(frozen=True)
class Settings:
    """What decides which photographs are taken, and what is made of them."""

    strategy: str
    geometry: str
    exposures: tuple[float, ...] | None
    block: int
    order: int
    threshold: float
    sigmas: float
    frames: int

    @classmethod
    def of(
        cls,
        shots: Shots,
        *,
        geometry: Any,
        strategy: Any,
        exposures: Any,
        response: Any,
        frames: Any,
        block: Any,
        order: Any,
        threshold: Any,
        sigmas: Any,
    ) -> Settings:
        """Arguments of `acquire` for the rig of `shots`; InputError, InputTypeError where one is unusable."""
        if not isinstance(geometry, str | Correspondence):
            kind = type(geometry).__name__
            raise InputTypeError(
                f"geometry is a {kind}; it must be 'graycode', 'aligned' or a measured Correspondence"
            )
        if not isinstance(response, Response | None):
            raise InputTypeError(f"response is a {type(response).__name__}; it must be a Response, or None")
        if response is None and shots.exposures is not None and len(shots.exposures) == 1:
            raise InputError(exposure.ONE_EXPOSURE)
        if isinstance(geometry, str):
            checks.one_of("geometry", geometry, ("graycode", "aligned"))
        if checks.count("order", order) & (order + 1):
            raise InputError(f"order is {order}; it must be 2^k - 1: 1, 3, 7, 15, ...")
        return cls(
            checks.one_of("strategy", strategy, ("auto", *plan.STRATEGIES)),
            geometry if isinstance(geometry, str) else "given",
            _seconds(shots, exposures),
            checks.count("block", block, least=2),
            int(order),
            checks.number("threshold", threshold, above=0.0, below=1.0),
            checks.number("sigmas", sigmas, least=0.0),
            checks.count("frames", frames),
        )

    def to_json(self) -> dict[str, Any]:
        """As plain JSON."""
        return {name: list(v) if isinstance(v, tuple) else v for name, v in asdict(self).items()}


def _seconds(shots: Shots, exposures: Any) -> tuple[float, ...] | None:
    if exposures is None:
        return None
    seconds = checks.finite("exposures", checks.real("exposures", exposures))
    if seconds.ndim != 1 or seconds.size == 0 or seconds.min() <= 0:
        raise InputError(f"exposures is {exposures!r}; it must be a sequence of positive seconds")
    exposure.check_offered(shots, seconds.tolist())
    return tuple(seconds.astype(float).tolist())


def check_same(store: BlockStore, shots: Shots, settings: Settings) -> None:
    """Refuse to go on with a store that was begun with another rig or with other settings."""
    facts, path = store.attributes, store.path
    before, planned = (v if isinstance(v, dict) else {} for v in (facts.get("settings"), facts.get("plan")))
    if facts["strategy"] not in plan.STRATEGIES or type(planned.get("patterns")) is not int:
        raise FileError(
            f"{path}: its scan is {facts['strategy']!r:.40} of {planned!r:.40}; ltcl makes no such scan"
        )
    for name, value in settings.to_json().items():
        if before.get(name) != value:
            raise _changed(name, value, path, before.get(name))
    grid, channels = store.extra(PREFIX + "resampling.coverage").shape, store.layout.channels
    if (grid, channels) != (shots.grid, shots.channels):
        raise InputError(
            f"rig has {shots.grid} pixels and {shots.channels} channel(s), but {path} was begun with {grid} "
            f"and {channels}; it must be that rig, or another store"
        )
    described = store.provenance["acquisition"]
    described = described if isinstance(described, dict) else {}
    check_same_rig(described.get("rig"), shots, path)
    if getattr(shots.rig, "describe", None) is None and not store.final:
        _check_same_view(described, shots, path)


def check_same_rig(described: Any, shots: Shots, path: Path) -> None:
    """Refuse a rig that describes itself otherwise than `described`, that of the photographs in `path`."""
    before, now = _leaves(described), _leaves(json.loads(json.dumps(shots.describe()["rig"], default=str)))
    for key in sorted(before.keys() | now.keys()):
        if not _equal(now.get(key), before.get(key)):
            raise _changed(f"rig.{key}", now.get(key), path, before.get(key))


def _check_same_view(described: dict[str, Any], shots: Shots, path: Path) -> None:
    """Photograph black and white again, with a rig without `describe()`, and compare the pictures."""
    for name, first in described.get("digest", {}).items():
        code = np.float32(1.0 if name == "white" else 0.0)
        shots.photograph(np.full(shots.grid, code), first["seconds"])
        for key in ("camera_grid", "levels"):
            now = shots.describe()[key]
            if now != described[key]:
                raise _changed(f"{key} of the rig", now, path, described[key])
        difference = np.mean(np.abs(np.subtract(shots.digest[name]["cells"], first["cells"])))
        if difference > _SAME_VIEW:
            raise InputError(
                f"rig shows {name} otherwise than the one that {path} was begun with, by {difference:.1%} of "
                "full scale; it must be the same rig and scene"
            )


def _changed(name: str, now: Any, path: Path, before: Any) -> InputError:
    return InputError(
        f"{name} is {now!r:.80}, but {path} was begun with {before!r:.80}; it must be that, or another store"
    )


def _leaves(tree: Any, above: str = "") -> dict[str, Any]:
    """What is no dict, by its keys with dots between, volatile ones left out.

    >>> _leaves({"kind": "live", "camera": {"kind": "opencv"}, "seed": 3})
    {'kind': 'live', 'camera.kind': 'opencv'}
    """
    leaves: dict[str, Any] = {}
    for key, value in tree.items() if isinstance(tree, Mapping) else ():
        name = f"{above}{key}"
        if name not in VOLATILE_KEYS:
            leaves |= _leaves(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return leaves


def _equal(a: Any, b: Any) -> bool:
    """Of plain JSON; numbers up to rounding."""
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(_equal, a, b))
    if isinstance(a, (int, float)) and isinstance(b, (int, float)) and bool not in (type(a), type(b)):
        return math.isclose(a, b, rel_tol=_CLOSE) or (math.isnan(a) and math.isnan(b))
    return a == b
