# SPDX-License-Identifier: BSD-3-Clause
"""What happened, as plain data: the JSON report beside every result, and what ``--json`` prints."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import json
import math
import os
import platform
from typing import Any

import numpy as np

from ltcl.device import Device
from ltcl.files import replace_file
from ltcl.solvers import Solution


def plain(value: Any) -> Any:
    """`value` in the types that JSON knows; numbers that are not finite become None."""
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
    return value if value is None or isinstance(value, (bool, int, str)) else str(value)


def dumps(value: Any) -> str:
    """`value` as a JSON document that any parser takes: no NaN, no Infinity."""
    return json.dumps(plain(value), indent=2, ensure_ascii=False, allow_nan=False)


def write(path: str | os.PathLike[str], value: Any) -> None:
    """Write `value` as a JSON file, whole or not at all."""
    with replace_file(path) as temporary:
        temporary.write_text(dumps(value) + "\n", encoding="utf-8")


def solution(solved: Solution | tuple[Solution, ...]) -> list[dict[str, Any]]:
    """Facts of a solve, one entry per colour channel, without the solution itself."""
    names = (
        "method",
        "iterations",
        "products",
        "residual",
        "residuals",
        "seconds",
        "reason",
        "error",
    )
    return [
        {name: getattr(channel, name) for name in names}
        | {"status": channel.status.name.lower(), "standard_error": _spread(channel.standard_error)}
        for channel in (solved if isinstance(solved, tuple) else (solved,))
    ]


def _spread(error: np.ndarray | None) -> dict[str, float] | None:
    """Of the standard errors of pixels that the method knows, and how many it does not."""
    if error is None:
        return None
    known = error[~np.isnan(error)]
    largest, median = (np.max(known), np.median(known)) if known.size else (np.nan, np.nan)
    return {"largest": float(largest), "median": float(median), "unknown": error.size - known.size}


def device(opened: Device) -> dict[str, Any]:
    """Which device worked."""
    index = opened.description.index
    return {"index": index, "name": opened.name, "kind": opened.kind, "driver": opened.driver}


def versions() -> dict[str, str]:
    """Versions that a result can depend on."""
    from ltcl import __version__  # `ltcl` itself imports this module

    own = {"ltcl": __version__, "python": platform.python_version(), "system": platform.platform()}
    return own | {name: importlib.metadata.version(name) for name in ("numpy", "scipy", "pyopencl")}
