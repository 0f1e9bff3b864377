# SPDX-License-Identifier: BSD-3-Clause
"""`Settings`: what `acquire` is asked for, checked before the first photograph, and before a plan of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ltcl import checks
from ltcl.acquisition import exposing
from ltcl.acquisition.geometry import Correspondence
from ltcl.acquisition.radiometry import Response
from ltcl.acquisition.rig import Shots
from ltcl.acquisition.scanning import plan
from ltcl.errors import InputError, InputTypeError


@dataclass(frozen=True)
class Settings:
    """What decides which photographs are taken, and what becomes of them."""

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
        """Arguments of `acquire`, for the rig behind `shots`.

        Raises
        ------
        InputError, InputTypeError
            One of them cannot be used, or not with this rig.
        """
        made = cls(
            checks.one_of("strategy", strategy, ("auto", *plan.STRATEGIES)),
            _named(geometry),
            _seconds(exposures),
            checks.count("block", block, least=2),
            _order(order),
            checks.number("threshold", threshold, above=0.0, below=1.0),
            checks.number("sigmas", sigmas, least=0.0),
            checks.count("frames", frames),
        )
        if not isinstance(response, Response | None):
            raise InputTypeError(f"response is a {type(response).__name__}; it must be a Response, or None")
        if response is None and shots.exposures is not None and len(shots.exposures) == 1:
            raise InputError(exposing.ONE)
        exposing.refuse_absent(shots, made.exposures or ())
        return made


def _named(geometry: Any) -> str:
    if isinstance(geometry, str):
        return checks.one_of("geometry", geometry, ("graycode", "aligned"))
    if not isinstance(geometry, Correspondence):
        kind = type(geometry).__name__
        raise InputTypeError(
            f"geometry is a {kind}; it must be 'graycode', 'aligned' or a measured Correspondence"
        )
    return "given"


def _seconds(exposures: Any) -> tuple[float, ...] | None:
    if exposures is None:
        return None
    found = checks.finite("exposures", checks.real("exposures", exposures))
    if found.ndim != 1 or found.size == 0 or found.min() <= 0:
        raise InputError(f"exposures is {exposures!r}; it must be a sequence of positive seconds")
    return tuple(found.astype(float).tolist())


def _order(order: Any) -> int:
    checks.count("order", order)
    if order & (order + 1):
        raise InputError(f"order is {order}; it must be 2^k - 1: 1, 3, 7, 15, ...")
    return int(order)
