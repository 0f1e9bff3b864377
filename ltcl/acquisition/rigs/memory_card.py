# SPDX-License-Identifier: BSD-3-Clause
"""The order in which a camera took the files on its memory card.

Cameras count their files, IMG_0412.NEF, IMG_0413.NEF, and begin again at 0001 after 9999. Numbers
order files within one round of the counter; the time of each photograph, in its EXIF header, tells
where the round ended. Files without that time are ordered by number; if their numbers span both
ends of a counter, the dates of the files decide.

Known limit: EXIF counts whole seconds, some cameras add hundredths.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ltcl.acquisition.rigs.photographs import read_exif
from ltcl.errors import FileError, InputError

# Tags of EXIF 2.32.
TIME_TAG = 36867
SUBSECOND_TAG = 37521

# Shares of a counter: a round that ends has files above the one and, begun again, below the other.
ROUND_END = 0.9
ROUND_BEGIN = 0.1
# Digits of a counter, at least.
MIN_DIGITS = 3


def number_key(path: Path) -> str:
    """Key to sort by: numbers in names compare as numbers."""
    return re.sub("[0-9]+", lambda digits: digits[0].zfill(20), path.name)


def in_order_of_capture(paths: Sequence[Path]) -> list[Path]:
    """Photographs in the order in which they were taken.

    InputError if that is not known: times contradict the numbers, or the counter began again and no
    times say so.
    """
    numbered = sorted(paths, key=number_key)
    times = [_time_of_capture(path) for path in numbered]
    has_begun_again = _spans_counter(numbered)
    if not has_begun_again and not all(times):
        return numbered
    if has_begun_again and (not all(times) or len(set(times)) == 1):
        return _in_order_of_dates(numbered)
    begin = _begin_of_round(times)
    if begin is not None:
        return numbered[begin:] + numbered[:begin]
    if len(set(times)) < len(times):
        raise InputError(
            f"files {numbered[0].name} to {numbered[-1].name}: their order is not known, times in "
            "their EXIF contradict their numbers; save them by the names on the list"
        )
    return [numbered[k] for k in np.argsort(times)]


def _in_order_of_dates(numbered: list[Path]) -> list[Path]:
    """Files of a counter that began again, without EXIF times, by their dates."""
    begin = _begin_of_round([path.stat().st_mtime_ns for path in numbered])
    if not begin:
        raise InputError(
            f"files {numbered[0].name} to {numbered[-1].name}: their order is not known, the "
            "camera's counter began again, and neither EXIF nor dates of the files say where; "
            "save them by the names on the list"
        )
    return numbered[begin:] + numbered[:begin]


def _begin_of_round(times: Sequence[Any]) -> int | None:
    """Place from which on, and then from the first, times never fall; None without one."""
    falls = [k for k in range(1, len(times)) if times[k] < times[k - 1]]
    if not falls:
        return 0
    if len(falls) == 1 and times[-1] <= times[0]:
        return falls[0]
    return None


def _spans_counter(paths: Sequence[Path]) -> bool:
    """True if the last numbers in the names are near both ends of a counter."""
    numbers = []
    lengths = set()
    for path in paths:
        match = re.search("([0-9]+)[^0-9]*$", path.stem)
        if match is None:
            return False
        numbers.append(int(match[1]))
        lengths.add(len(match[1]))
    if len(lengths) != 1 or max(lengths) < MIN_DIGITS:
        return False
    end = 10 ** max(lengths)
    return max(numbers) > ROUND_END * end and min(numbers) < ROUND_BEGIN * end


def _time_of_capture(path: Path) -> str:
    """DateTimeOriginal with its fraction of a second, which sorts by time; empty without one."""
    try:
        return read_exif(path, _time_from_tags) or ""
    except FileError:
        return ""


def _time_from_tags(tags: Mapping[int, Any]) -> str:
    time = str(tags.get(TIME_TAG, "")).strip("\0 ")
    fraction = str(tags.get(SUBSECOND_TAG, "")).strip("\0 ")
    return f"{time}.{fraction}" if time else ""
