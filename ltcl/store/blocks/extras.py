# SPDX-License-Identifier: BSD-3-Clause
"""Small arrays beside the blocks: a group with one array `array`, vouched for as blocks are."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ltcl.errors import FileError, InputError, InputTypeError
from ltcl.store.blocks import aside, entries, nodes

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.-]{0,100}")


def check_name(name: str) -> str:
    """`name`, if it can be that of a folder anywhere."""
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise InputError(f"name is {name!r:.60}; it must be letters, digits, _, - and . with a letter first")
    return name


def write(root: Path, name: str, array: np.ndarray) -> None:
    """Commit an array of numbers."""
    if array.dtype.name not in nodes.TYPES:
        raise InputTypeError(f"{name} holds {array.dtype}; it must hold real numbers")
    with aside.placed(root, "extra", name) as folder:
        entries.write_arrays(folder, {"array": array}, {})


def read(root: Path, full: str, due: str | None) -> np.ndarray:
    """The array in root / full, memory-mapped and checked."""
    arrays = entries.entry(root, full, due)
    if set(arrays) != {"array"}:
        raise FileError(f"{full}/zarr.json describes no array")
    return nodes.read_array(root, f"{full}/array", arrays["array"])
