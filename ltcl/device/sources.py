# SPDX-License-Identifier: BSD-3-Clause
"""Sources of kernels: where `kernels/` is, a file with its includes, and its program for a device.

Includes are expanded here, with `#line` marks, so that the messages of every driver point at the
file that a person edits.
"""

from __future__ import annotations

import contextlib
import functools
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ltcl.device import pocl_cache
from ltcl.errors import DeviceError

if TYPE_CHECKING:
    from ltcl.device.device import Device

# Exact float32: no fast-math, which deletes tests for NaN. Contraction of a * b + c is left to the
# driver. Names of arguments are kept for launches, and all warnings are off.
OPTIONS = ["-cl-std=CL1.2", "-cl-kernel-arg-info", "-w"]
# Times that PoCL is asked for a program before its failure counts.
POCL_ATTEMPTS = 3
INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"\s*$')


def folder() -> Path:
    """Folder of the kernels: `ltcl/kernels` of a wheel, `kernels/` of a checkout."""
    package = Path(__file__).resolve().parents[1]
    for candidate in (package / "kernels", package.parent / "kernels"):
        if (candidate / "common" / "real.h").is_file():
            return candidate
    raise DeviceError(f"the OpenCL kernels of ltcl are missing beside {package}; reinstall ltcl")


@functools.cache
def load(name: str) -> str:
    """Text of `kernels/<name>.cl` with its includes, ready for the compiler.

    The path of a .cl file elsewhere is a name, too; its includes are beside it or in `kernels/`.
    """
    root = folder()
    if name.endswith(".cl"):
        return _expand(Path(name).resolve(), root, set())
    return _expand(root / f"{name}.cl", root, set())


def _expand(path: Path, root: Path, included_files: set[Path]) -> str:
    """Text of a file with each include in place of its line, at its first occurrence only."""
    included_files.add(path)
    name = path.relative_to(root).as_posix() if path.is_relative_to(root) else path.name
    lines = [f'#line 1 "{name}"']
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        include = INCLUDE.match(line)
        if include is None:
            lines.append(line)
            continue
        included = path.parent / include[1]
        if not included.is_file():
            included = root / include[1]
        if included not in included_files:
            lines.append(_expand(included, root, included_files))
        lines.append(f'#line {number + 1} "{name}"')
    return "\n".join(lines)


def build(device: Device, file: str, defines: Mapping[str, Any]) -> Any:
    """Program of `kernels/<file>.cl` for `device`, from pyopencl.

    Raises
    ------
    DeviceError
        The source does not compile; the message has the compiler's own words. Or the driver is
        PoCL, and cannot use its folder of compiled kernels.
    """
    if pocl_cache.DRIVER not in device.driver:
        # Intel's compiler reports every success as a warning.
        with warnings.catch_warnings(action="ignore", category=device.cl.CompilerWarning):
            return _build(device, file, defines)
    with pocl_cache.checked():
        for _ in range(POCL_ATTEMPTS - 1):
            # Two processes that build the same program at the same time disturb each other.
            with contextlib.suppress(_FailedWithoutReason):
                return _build(device, file, defines)
        return _build(device, file, defines)


class _FailedWithoutReason(DeviceError):
    """A program was not built, and its compiler found no error."""


def _build(device: Device, file: str, defines: Mapping[str, Any]) -> Any:
    options = list(OPTIONS)
    for name, value in sorted(defines.items()):
        options.append(f"-D{name}={value}")
    try:
        program = device.cl.Program(device.context, load(file))
        return program.build(options, devices=[device.handle])
    except device.cl.Error as error:
        # pyopencl adds options and source to the log.
        log_text = str(error).partition("(options:")[0].strip()
        where = f"{device.name} ({device.driver}) with {' '.join(options)}"
        kind = DeviceError if "error" in log_text else _FailedWithoutReason
        raise kind(f"kernels/{file}.cl does not compile on {where}:\n{log_text}") from error
