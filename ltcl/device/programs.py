# SPDX-License-Identifier: BSD-3-Clause
"""Compile a kernel source for a device, or find it compiled.

Drivers with a binary cache of their own (PoCL, NVIDIA) are left to it. For the others the binary is kept in
ltcl's private cache folder. pyopencl's cache is bypassed: it reads and writes pickles.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ltcl.device import cache
from ltcl.device.sources import Source
from ltcl.errors import DeviceError

if TYPE_CHECKING:
    from ltcl.device.device import Device

log = logging.getLogger(__name__)


def build(device: Device, source: Source, options: list[str]) -> Any:
    """The built pyopencl program of `source`; raises DeviceError with the compiler's own words."""
    import pyopencl as cl
    from pyopencl.characterize import has_src_build_cache

    try:
        if has_src_build_cache(device.handle):
            return _compile(device, source, options)
        return _from_binary(device, source, options) or _compile_and_keep(device, source, options)
    except cl.Error as error:
        log_text = str(error).split("(options:")[0].strip()  # pyopencl adds options and source
        raise DeviceError(
            f"kernels/{source.name}.cl does not compile on {device.name} ({device.driver}) with "
            f"{' '.join(options)}:\n{log_text}"
        ) from error


def _compile(device: Device, source: Source, options: list[str]) -> Any:
    import pyopencl as cl

    program = cl.Program(device.context, source.text)
    with warnings.catch_warnings():
        # Asking about a program before it is built is pyopencl's documented way past its cache.
        warnings.filterwarnings("ignore", message="Pre-build attribute access")
        program.get_info(cl.program_info.NUM_DEVICES)
    return _quietly(program, options)


def _quietly(program: Any, options: list[str]) -> Any:
    import pyopencl as cl

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", cl.CompilerWarning)  # Intel's compiler reports every success
        return program.build(options)


def _compile_and_keep(device: Device, source: Source, options: list[str]) -> Any:
    import pyopencl as cl

    program = _compile(device, source, options)
    with contextlib.suppress(OSError, cl.Error):  # a lost binary costs a compilation, nothing else
        cache.make_folder("binaries")
        path = _binary(device, source, options)
        aside = path.with_suffix(f".{os.getpid()}")
        aside.write_bytes(program.get_info(cl.program_info.BINARIES)[0])
        os.replace(aside, path)
    return program


def _from_binary(device: Device, source: Source, options: list[str]) -> Any:
    import pyopencl as cl

    try:
        binary = _binary(device, source, options).read_bytes()
        return _quietly(cl.Program(device.context, [device.handle], [binary]), options)
    except OSError:
        return None
    except cl.Error as error:
        log.info("a kept binary of kernels/%s.cl is of no use any more: %s", source.name, error)
        return None


def _binary(device: Device, source: Source, options: list[str]) -> Path:
    facts = "|".join((device.name, device.driver, device.description.platform, source.digest, *options))
    return cache.folder() / "binaries" / hashlib.sha256(facts.encode()).hexdigest()
