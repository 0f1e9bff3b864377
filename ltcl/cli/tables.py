# SPDX-License-Identifier: BSD-3-Clause
"""Tables and numbers as text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.cells import cell_len

from ltcl.transport.verdict import Verdict

DIVERGES = "diverges"
# Names of colour channels, by their number.
COLOURS = {1: ("grey",), 3: ("red", "green", "blue")}


def table(columns: Sequence[str], rows: Iterable[Iterable[Any]]) -> str:
    """Format a table, numbers right-aligned; nothing is cut off in a narrow terminal."""
    texts = [[cell(value) for value in row] for row in rows]
    aligned = []
    for name, *values in zip(columns, *texts, strict=True):
        aligned.append(_align_column(name, values))
    return "\n".join("   ".join(row).rstrip() for row in zip(*aligned, strict=True))


def _align_column(name: str, values: list[str]) -> list[str]:
    texts = [name, *values]
    width = max(map(cell_len, texts))
    is_numeric = all(map(_is_number, values))
    aligned = []
    for text in texts:
        gap = " " * (width - cell_len(text))
        if is_numeric:
            aligned.append(gap + text)
        else:
            aligned.append(text + gap)
    return aligned


def _is_number(text: str) -> bool:
    return text[:1] in "+-.0123456789" or text == DIVERGES


def cell(value: Any) -> str:
    """Format a value; "-" if it is unknown, "diverges" for infinity."""
    if value is None:
        return "-"
    if not isinstance(value, float):
        return str(value)
    if math.isfinite(value):
        return f"{value:.4g}"
    return DIVERGES if value > 0 else "-"


def percent(share: float | None, digits: int = 3) -> str | None:
    """Format a share in percent; None if it is unknown."""
    if share is None:
        return None
    value = 100 * share
    if 1 <= value < 1000:
        # 60 %, and not 6e+01 %.
        whole_digits = len(str(round(value)))
        digits = max(digits, whole_digits)
    return f"{value:.{digits}g} %"


def size_text(size: tuple[int, int] | None) -> str:
    """Format height and width."""
    return "unknown" if size is None else "{} x {}".format(*size)


def interval_text(lowest: float, highest: float) -> str:
    """Format the ends of an interval."""
    return f"{lowest:.4g} .. {highest:.4g}"


def verdict_lines(verdicts: Mapping[str, Verdict]) -> list[str]:
    """Format the verdicts on files: their numbers side by side, and a text for each."""
    names: dict[str, None] = {}
    for verdict in verdicts.values():
        names |= dict.fromkeys(verdict.numbers)
    lines = []
    if names:
        rows = []
        for name in names:
            numbers = [verdict.numbers.get(name) for verdict in verdicts.values()]
            rows.append([name, *numbers])
        lines += ["", table(["verdict", *verdicts], rows)]
    for file, verdict in verdicts.items():
        label = f"{file}: " if len(verdicts) > 1 else ""
        lines.append(f"{label}{verdict.text}")
    return lines
