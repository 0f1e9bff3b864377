# SPDX-License-Identifier: BSD-3-Clause
"""Compilation: messages that point at the file a person edits; binaries that are kept and checked."""

from __future__ import annotations

import re

import numpy as np
import pytest
from pyopencl import characterize

from ltcl.device import Device, programs, sources
from ltcl.errors import DeviceError


@pytest.fixture
def own_kernels(tmp_path, monkeypatch):
    """A folder of kernels in which a test writes its own."""
    monkeypatch.setattr(sources, "folder", lambda: tmp_path)
    sources.load.cache_clear()
    yield tmp_path
    sources.load.cache_clear()


def test_messages_name_file_line_and_defines(device, own_kernels):
    (own_kernels / "part.h").write_text("// fine\nint broken(void) { return nonsense; }\n")
    (own_kernels / "own.cl").write_text('// first\n#include "part.h"\nkernel void own_a(int n) { }\n')
    with pytest.raises(DeviceError) as error:
        device.kernel("own", "own_a", K=3, LANES=8)
    text = str(error.value)
    assert text.startswith(f"kernels/own.cl does not compile on {device.name} ({device.driver}) with")
    assert "-DK=3 -DLANES=8" in text.splitlines()[0]
    assert "nonsense" in text
    if device.kind != "simulator":  # Oclgrind blots the #line marks out
        assert re.search(r"part\.h\W+2\b", text), text


@pytest.mark.parametrize(("file", "name"), [("csr", "csr_matvec"), ("dense", "dense_matvec")])
def test_missing_and_wrong_defines_are_told(device, file, name):
    with pytest.raises(DeviceError, match="needs -DK=<right-hand sides of one launch"):
        device.kernel(file, name)
    with pytest.raises(DeviceError, match="K must be 1, 2, 3, 4 or 8"):
        device.kernel(file, name, K=5, LANES=1)


def test_a_program_is_built_once(small_device, monkeypatch):
    first = small_device.kernel("vector", "vector_fill")
    monkeypatch.setattr(programs, "build", lambda *_: pytest.fail("built again"))
    assert small_device.kernel("vector", "vector_fill") is first


@pytest.fixture
def kept(device, tmp_path, monkeypatch):
    """The folder of binaries of a device whose driver has no cache of its own."""
    monkeypatch.setattr(characterize, "has_src_build_cache", lambda _: False)
    monkeypatch.setenv("LTCL_CACHE", str(tmp_path))
    return tmp_path / "binaries"


def fill(device: Device) -> np.ndarray:
    """A vector filled by a kernel built as if in a new process."""
    x = Device(device.description).empty(5)
    x.device.kernel("vector", "vector_fill")(5, 16, 5, 0.5, x)
    return x.get()


def test_binaries_are_kept_and_used_again(device, kept, monkeypatch):
    fill(device)
    (binary,) = kept.iterdir()
    assert binary.stat().st_size > 0
    monkeypatch.setattr(programs, "_compile", lambda *_: pytest.fail("compiled again"))
    assert (fill(device) == 0.5).all()


def test_spoilt_binaries_are_compiled_anew(device, kept):
    fill(device)
    (binary,) = kept.iterdir()
    binary.write_bytes(b"spoilt")
    assert (fill(device) == 0.5).all()
    assert binary.read_bytes() != b"spoilt"


def test_binaries_need_no_writable_cache(device, kept, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("LTCL_CACHE", str(tmp_path / "file" / "cache"))
    assert (fill(device) == 0.5).all()
