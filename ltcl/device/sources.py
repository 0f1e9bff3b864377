# SPDX-License-Identifier: BSD-3-Clause
"""Kernel sources: found in the installed package or beside it, includes expanded, signatures read.

A `.cl` file compiles as it stands with the kernels folder on the include path. ltcl expands the includes
itself, with `#line` marks, so that every driver's messages point at the file a person edits.
"""

from __future__ import annotations

import functools
import hashlib
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ltcl.errors import DeviceError

_INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"\s*$')
_KERNEL = re.compile(r"\bkernel\s+void\s+(\w+)\s*\(([^)]*)\)", re.DOTALL)
_SCALARS = {"int": np.int32, "uint": np.uint32, "ulong": np.uint64, "real": np.float32, "float": np.float32}


@dataclass(frozen=True)
class Source:
    """One kernel file, ready for the compiler.

    `signatures` gives for each kernel the NumPy type of every scalar argument, None for buffers.
    """

    name: str
    text: str
    digest: str
    signatures: dict[str, tuple[type | None, ...]]


def folder() -> Path:
    """The folder of `.cl` files: `ltcl/kernels` where installed, `kernels/` beside `ltcl/` in a checkout."""
    package = Path(__file__).resolve().parents[1]
    for place in (package / "kernels", package.parent / "kernels"):
        if (place / "common" / "real.h").is_file():
            return place
    raise DeviceError(f"the OpenCL kernels of ltcl are missing beside {package}; reinstall ltcl")


@functools.cache
def load(name: str) -> Source:
    """Read `kernels/<name>.cl` with its includes.

    >>> load("csr").signatures["csr_matvec"][:2] == (np.int32, np.int32)
    True
    """
    text = _expand(f"{name}.cl", folder(), set())
    found = {kernel: _types(arguments) for kernel, arguments in _KERNEL.findall(text)}
    return Source(name, text, hashlib.sha256(text.encode()).hexdigest(), found)


def _expand(relative: str, root: Path, seen: set[str]) -> str:
    seen.add(relative)
    lines = [f'#line 1 "{relative}"']
    for number, line in enumerate((root / relative).read_text(encoding="utf-8").splitlines(), 1):
        include = _INCLUDE.match(line)
        if include is None:
            lines.append(line)
            continue
        if include[1] not in seen:
            lines.append(_expand(include[1], root, seen))
        lines.append(f'#line {number + 1} "{relative}"')
    return "\n".join(lines)


def _types(arguments: str) -> tuple[type | None, ...]:
    return tuple(_type(argument.split()) for argument in arguments.split(","))


def _type(words: list[str]) -> type | None:
    if any("*" in word for word in words):
        return None
    return _SCALARS[words[-2]]
