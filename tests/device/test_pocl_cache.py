# SPDX-License-Identifier: BSD-3-Clause
"""PoCL's folder of compiled kernels: refused where PoCL would end the process."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import ltcl
from ltcl.device import Device, pocl_cache
from ltcl.errors import DeviceError

# Bytes that are left of a file: none, a part of its head, and without its end.
CUTS = [0, 3, 4, 63, 100, 0.5, -4, -1]


@pytest.fixture
def compiled(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of PoCL with a program and a kernel in it."""
    if pocl_cache.DRIVER not in device.driver:
        pytest.skip("the device is not of PoCL")
    for program in pocl_cache._programs(pocl_cache.folder()):
        kernels = list(program.glob("*/*/*.so"))
        if kernels:
            break
    else:
        pytest.fail("PoCL has compiled nothing")
    copy = tmp_path / "AB" / "PROGRAM"
    kernel = copy / "vector_fill" / "1-1-1" / "vector_fill.so"
    kernel.parent.mkdir(parents=True)
    (copy / "last_accessed").touch()
    (copy / "program.bc").write_bytes((program / "program.bc").read_bytes())
    kernel.write_bytes(kernels[0].read_bytes())
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(pocl_cache, "WRITING_SECONDS", 0.0)
    return copy


def test_whole_files_pass(compiled: Path, tmp_path: Path) -> None:
    pocl_cache.check_programs(tmp_path)
    assert pocl_cache.check_kernels() == 1


@pytest.mark.parametrize("cut", CUTS)
@pytest.mark.parametrize("suffix", [".bc", ".so"])
def test_a_file_that_is_cut_off_is_named(
    compiled: Path, tmp_path: Path, suffix: str, cut: float
) -> None:
    (path,) = compiled.rglob(f"*{suffix}")
    content = path.read_bytes()
    size = int(cut * len(content)) if isinstance(cut, float) else cut
    path.write_bytes(content[:size])
    with pytest.raises(DeviceError, match="POCL_CACHE_DIR") as refused, pocl_cache.checked():
        pass
    assert str(path) in str(refused.value)
    assert str(tmp_path) in str(refused.value)


def test_kernels_of_other_programs_do_not_matter(compiled: Path) -> None:
    (kernel,) = compiled.rglob("*.so")
    kernel.write_bytes(b"")
    os.utime(compiled / "last_accessed", (1e9, 1e9))
    with pocl_cache.checked():
        pass


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("f_bavail", 1),
        ("f_favail", 3),
        ("f_flag", getattr(os, "ST_NOEXEC", 8)),
    ],
)
def test_a_disk_that_holds_no_kernels_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, problem: int
) -> None:
    disk = {"f_bavail": 1 << 20, "f_frsize": 4096, "f_files": 1000, "f_favail": 900, "f_flag": 0}
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(os, "statvfs", lambda path: SimpleNamespace(**disk))
    pocl_cache.check_folder()
    disk[name] = problem
    with pytest.raises(DeviceError, match="POCL_CACHE_DIR") as refused:
        pocl_cache.check_folder()
    assert str(tmp_path) in str(refused.value)


def test_a_folder_that_cannot_be_made_is_refused(
    device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if pocl_cache.DRIVER not in device.driver:
        pytest.skip("the device is not of PoCL")
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("POCL_CACHE_DIR", str(tmp_path / "file" / "folder"))
    fresh = Device(device.description)
    with pytest.raises(DeviceError, match="POCL_CACHE_DIR"):
        ltcl.operators.Dense(fresh, np.eye(2)).matvec(np.ones(2))


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({"POCL_CACHE_DIR": "/a", "XDG_CACHE_HOME": "/b", "HOME": "/c"}, "/a"),
        ({"POCL_CACHE_DIR": "", "XDG_CACHE_HOME": "/b", "HOME": "/c"}, "/b/pocl/kcache"),
        ({"HOME": "/c"}, "/c/.cache/pocl/kcache"),
    ],
)
def test_the_folder_is_that_of_pocl(
    monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], expected: str
) -> None:
    for name in ("POCL_CACHE_DIR", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert pocl_cache.folder() == Path(expected)
