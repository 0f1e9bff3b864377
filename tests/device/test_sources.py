# SPDX-License-Identifier: BSD-3-Clause
"""Kernel sources: includes, line marks, signatures; every kernel has a NumPy twin."""

from __future__ import annotations

import re

import numpy as np
import pytest

from ltcl.device import sources
from ltcl.errors import DeviceError
from tests import reference

FILES = sorted(path.stem for path in sources.folder().glob("*.cl"))


@pytest.mark.parametrize("name", FILES)
def test_every_line_is_marked_with_its_file_and_number(name):
    file, number, seen = "", 0, []
    for line in sources.load(name).text.splitlines():
        mark = re.fullmatch(r'#line (\d+) "(.+)"', line)
        if mark:
            number, file = int(mark[1]), mark[2]
            continue
        assert (sources.folder() / file).read_text().splitlines()[number - 1] == line
        seen.append((file, number))
        number += 1
    assert len(set(seen)) == len(seen)  # each include comes once
    assert {file for file, _ in seen} > {f"{name}.cl"}


@pytest.mark.parametrize("name", FILES)
def test_every_kernel_has_its_arguments_known_and_a_twin(name):
    source = sources.load(name)
    declared = re.findall(r"^kernel void (\w+)", source.text, re.MULTILINE)
    assert set(source.signatures) == set(declared)
    for kernel, types in source.signatures.items():
        assert set(types) <= {None, np.int32, np.uint32, np.uint64, np.float32}
        assert kernel.startswith(f"{name}_")
        assert callable(getattr(reference, re.sub("_(stream|group)$", "", kernel)))


def test_signatures_tell_numbers_from_buffers(tmp_path, monkeypatch):
    (tmp_path / "own.cl").write_text(
        "kernel void own_a(int n, real a, uint u,\n"
        "    ulong v, float f, global const real *x, local real *s)\n{}\n"
        "kernel void own_b(global int* x) {}\n"
    )
    monkeypatch.setattr(sources, "folder", lambda: tmp_path)
    signatures = sources.load("own").signatures
    sources.load.cache_clear()
    assert signatures["own_a"] == (np.int32, np.float32, np.uint32, np.uint64, np.float32, None, None)
    assert signatures["own_b"] == (None,)


def test_a_change_of_an_include_changes_the_digest(tmp_path, monkeypatch):
    monkeypatch.setattr(sources, "folder", lambda: tmp_path)
    (tmp_path / "own.cl").write_text('#include "part.h"\n')
    digests = set()
    for text in ("int a;", "int b;"):
        (tmp_path / "part.h").write_text(text)
        sources.load.cache_clear()
        digests.add(sources.load("own").digest)
    sources.load.cache_clear()
    assert len(digests) == 2


def test_missing_kernels_are_told_with_the_fix(tmp_path, monkeypatch):
    monkeypatch.setattr(sources, "__file__", str(tmp_path / "ltcl" / "device" / "sources.py"))
    with pytest.raises(DeviceError, match=r"OpenCL kernels of ltcl are missing beside .*; reinstall ltcl"):
        sources.folder()
    (tmp_path / "kernels" / "common").mkdir(parents=True)
    (tmp_path / "kernels" / "common" / "real.h").touch()
    assert sources.folder() == tmp_path / "kernels"  # a checkout
    (tmp_path / "ltcl" / "kernels" / "common").mkdir(parents=True)
    (tmp_path / "ltcl" / "kernels" / "common" / "real.h").touch()
    assert sources.folder() == tmp_path / "ltcl" / "kernels"  # installed
