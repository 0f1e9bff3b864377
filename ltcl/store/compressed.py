# SPDX-License-Identifier: BSD-3-Clause
"""Compressed transports in .npz archives: one array for each part of their operators.

`format` is "ltcl-compressed-1"; names and meaning of all others are those of `ltcl.transport` and
`ltcl.operators.stored`. Here they are plain arrays: finite, of declared sizes, with a grid and a first bounce
that fit; what they make is checked where it is made.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ltcl import checks, layout
from ltcl.errors import FileError, InputError
from ltcl.store.archive import Archive

LAYOUT = "ltcl-compressed-1"
INVERSE = "ltcl-inverse-1"  # of `ltcl.solvers.Inverse.to_arrays`; see `ltcl.store.inverses`
_MAY_BE_INFINITE = ".solution_error"


@dataclass(frozen=True, eq=False)
class Parts:
    """Contents of a file of a compressed transport, or of an inverse: arrays by name.

    Raises
    ------
    InputError
        No grid or first bounce, ones that do not fit, values that are not finite.
    """

    arrays: Mapping[str, np.ndarray]

    def __post_init__(self) -> None:
        for name in ("grid", "first_bounce", "system_0.R.kind"):
            if name not in self.arrays:
                raise InputError(f"a compressed transport has the array {name!r}, which is missing")
        F = self.arrays["first_bounce"]
        if F.ndim != 2 or len(F) not in (1, 3):
            raise InputError(f"first_bounce has shape {F.shape}; it must be (1, N) or (3, N)")
        checks.shape("grid", self.arrays["grid"], (2,))
        checks.grid("grid", self.arrays["grid"].tolist(), F.shape[1])
        for name, array in self.arrays.items():
            if array.dtype.kind == "f" and not name.endswith(_MAY_BE_INFINITE):
                checks.finite(f"array {name!r}", array)
        if "mixing" in self.arrays:
            layout.mixing(self.arrays["mixing"], len(F), None)

    @property
    def shape(self) -> tuple[int, int]:
        """(N, N)."""
        n = self.first_bounce.shape[1]
        return n, n

    @property
    def grid(self) -> tuple[int, int]:
        """(h, w) of projector and camera."""
        h, w = self.arrays["grid"].tolist()
        return h, w

    @property
    def camera_grid(self) -> None:
        """None: that of the projector."""
        return None

    @property
    def first_bounce(self) -> np.ndarray:
        """F, (channels, N)."""
        return self.arrays["first_bounce"]

    @property
    def mixing(self) -> np.ndarray | None:
        """Of the projector's colours, (3, 3)."""
        return self.arrays.get("mixing")

    @property
    def error(self) -> float:
        """What solutions may be off by: the largest of all channels, and of the errors of an inverse."""
        ends = (_MAY_BE_INFINITE, "errors")
        found = [array for name, array in self.arrays.items() if name.endswith(ends)]
        numbers = [array for array in found if array.dtype.kind in "fiu"]
        return max((float(np.max(array, initial=0.0)) for array in numbers), default=0.0)

    @property
    def nbytes(self) -> int:
        """Bytes of the operators, as they are stored."""
        return sum(array.nbytes for name, array in self.arrays.items() if _is_of_operator(name))

    @property
    def entries(self) -> int:
        """Values that are not 0, of all cores."""
        ends = (".data", ".codes", ".matrix")
        stored = [array for name, array in self.arrays.items() if name.endswith(ends)]
        return sum(int(np.count_nonzero(array)) for array in stored)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Names of the cores and bases, each once."""
        named = [(name, array) for name, array in self.arrays.items() if array.dtype.kind in "SU"]
        cores = {str(array) for name, array in named if name.endswith(".kind")} - {"compressed", "sum"}
        bases = {str(array) for name, array in named if name.startswith("basis_")}
        return (*sorted(cores), *sorted(bases))


def read(archive: Archive) -> Parts:
    """Every array of an archive of this layout; messages come without the file's name."""
    names = [name for name in archive.names if name != "format"]
    return Parts({name: _array(archive, name) for name in names})


def write(path: Path, parts: Parts, layout: str = LAYOUT) -> None:
    """Write everything in `parts`, uncompressed: numbers of few bits hardly shrink."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
        for name, array in {"format": np.array(layout), **parts.arrays}.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)


def _array(archive: Archive, name: str) -> np.ndarray:
    if archive.header(name).dtype.kind in "SU":
        return np.array(archive.text(name))
    return archive.numbers(name)


def _is_of_operator(name: str) -> bool:
    return name.startswith(("system_", "basis_"))


def is_layout(archive: Archive, layout: str = LAYOUT) -> bool:
    """Whether an archive says that it is of this layout."""
    if "format" not in archive.names:
        return False
    try:
        return archive.text("format") == layout
    except FileError:  # not a string: whoever reads it says so
        return False
