# SPDX-License-Identifier: BSD-3-Clause
"""Results as plain data: the JSON report beside every result, and the output of ``--json``."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import json
import math
import os
import platform
import re
from typing import Any

import numpy as np

from ltcl.device import Device
from ltcl.files import replace_file
from ltcl.solvers import Solution

SURROGATE = re.compile(r"[\ud800-\udfff]")


def plain(value: Any) -> Any:
    """Convert `value` to the types that JSON knows; numbers that are not finite become None."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    if isinstance(value, dict):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(entry) for entry in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    return str(value)


def dumps(value: Any) -> str:
    """`value` as a JSON document that any parser takes: no NaN, no Infinity, valid UTF-8."""
    text = json.dumps(plain(value), indent=2, ensure_ascii=False, allow_nan=False)
    # Bytes of file names that are no UTF-8 stand in Python's text as single surrogates.
    return SURROGATE.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def write(path: str | os.PathLike[str], value: Any) -> None:
    """Write `value` as a JSON file, whole or not at all."""
    with replace_file(path) as temporary:
        temporary.write_text(dumps(value) + "\n", encoding="utf-8")


def solution(solved: Solution | tuple[Solution, ...]) -> list[dict[str, Any]]:
    """Facts of a solve, one entry per colour channel, without the solution itself."""
    channels = solved if isinstance(solved, tuple) else (solved,)
    return [_solution_facts(channel) for channel in channels]


def _solution_facts(solved: Solution) -> dict[str, Any]:
    return {
        "method": solved.method,
        "iterations": solved.iterations,
        "products": solved.products,
        "residual": solved.residual,
        "residuals": solved.residuals,
        "seconds": solved.seconds,
        "reason": solved.reason,
        "error": solved.error,
        "status": solved.status.name.lower(),
        "standard_error": _summary(solved.standard_error),
    }


def _summary(standard_error: np.ndarray | None) -> dict[str, float] | None:
    """The largest and the median error of pixels, and the number of pixels without a known one."""
    if standard_error is None:
        return None
    known = standard_error[~np.isnan(standard_error)]
    largest = math.nan
    median = math.nan
    if known.size > 0:
        largest = float(np.max(known))
        median = float(np.median(known))
    return {
        "largest": largest,
        "median": median,
        "unknown": standard_error.size - known.size,
    }


def device(opened: Device) -> dict[str, Any]:
    """Facts of the device that worked."""
    return {
        "index": opened.description.index,
        "name": opened.name,
        "kind": opened.kind,
        "driver": opened.driver,
    }


def versions() -> dict[str, str]:
    """Versions that a result can depend on."""
    # `ltcl` itself imports this module.
    from ltcl import __version__

    facts = {
        "ltcl": __version__,
        "python": platform.python_version(),
        "system": platform.platform(),
    }
    for name in ("numpy", "scipy", "pyopencl"):
        facts[name] = importlib.metadata.version(name)
    return facts
