# SPDX-License-Identifier: BSD-3-Clause
"""Kernels: their sources, compilation, typed launches, and launches that are bound once."""

from __future__ import annotations

import gc
import math
import re
import threading
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest

from ltcl.device import Device, kernels, vectors
from ltcl.errors import DeviceError

TWINS = (Path(__file__).parents[1] / "reference.py").read_text(encoding="utf-8")
FILES = sorted(path.stem for path in kernels.folder().glob("*.cl"))


@pytest.mark.parametrize("name", FILES)
def test_every_kernel_has_a_twin_and_every_line_its_mark(name):
    source = kernels.load(name)
    file, number, seen = "", 0, []
    for line in source.text.splitlines():
        mark = re.fullmatch(r'#line (\d+) "(.+)"', line)
        if mark:
            number, file = int(mark[1]), mark[2]
            continue
        assert (kernels.folder() / file).read_text().splitlines()[number - 1] == line
        seen.append((file, number))
        number += 1
    assert len(set(seen)) == len(seen)  # each include comes once
    assert (f"{name}.cl", 1) in seen
    assert list(source.kernels) == re.findall(r"^kernel void (\w+)", source.text, re.MULTILINE)
    for kernel in source.kernels:
        assert kernel.startswith(f"{name}_")
        assert re.search(rf"^def {re.sub('_(stream|group|sum)$', '', kernel)}", TWINS, re.MULTILINE), kernel


@pytest.fixture
def own_kernels(tmp_path, monkeypatch):
    """A folder of kernels in which a test writes its own."""
    monkeypatch.setattr(kernels, "folder", lambda: tmp_path)
    kernels.load.cache_clear()
    yield tmp_path
    kernels.load.cache_clear()


def test_a_change_of_an_include_changes_the_digest(own_kernels):
    (own_kernels / "own.cl").write_text('#include "part.h"\n')
    digests = set()
    for text in ("int a;", "int b;"):
        (own_kernels / "part.h").write_text(text)
        kernels.load.cache_clear()
        digests.add(kernels.load("own").digest)
    assert len(digests) == 2


def test_missing_kernels_are_reported_with_the_fix(tmp_path, monkeypatch):
    monkeypatch.setattr(kernels, "__file__", str(tmp_path / "ltcl" / "device" / "kernels.py"))
    with pytest.raises(DeviceError, match=r"reinstall ltcl"):
        kernels.folder()
    for place in (tmp_path / "kernels", tmp_path / "ltcl" / "kernels"):  # a checkout, and installed
        (place / "common").mkdir(parents=True)
        (place / "common" / "real.h").touch()
        assert kernels.folder() == place


def test_messages_name_file_line_and_defines(device, own_kernels):
    (own_kernels / "part.h").write_text("// fine\nint broken(void) { return nonsense; }\n")
    (own_kernels / "own.cl").write_text('// first\n#include "part.h"\nkernel void own_a(int n) { }\n')
    with pytest.raises(DeviceError) as error:
        device.kernel("own", "own_a", K=3, LANES=8)
    text = str(error.value)
    assert text.startswith("kernels/own.cl")
    assert device.driver in text
    assert "-DK=3 -DLANES=8" in text.splitlines()[0]
    assert "nonsense" in text
    if device.kind != "simulator":  # Oclgrind blots the #line marks out
        assert re.search(r"part\.h\W+2\b", text), text


@pytest.mark.parametrize(("file", "name"), [("csr", "csr_matvec"), ("dense", "dense_matvec")])
def test_missing_and_wrong_defines_are_refused(device, file, name):
    with pytest.raises(DeviceError, match="needs -DK="):
        device.kernel(file, name)
    with pytest.raises(DeviceError, match="K must be 1, 2, 3, 4 or 8"):
        device.kernel(file, name, K=5, LANES=1)


def test_an_unknown_kernel_is_an_error_of_ltcl(device):
    with pytest.raises(DeviceError, match="vector_none"):
        device.kernel("vector", "vector_none")


def test_a_program_is_built_once(small_device, monkeypatch):
    first = small_device.kernel("vector", "vector_fill")
    monkeypatch.setattr(kernels, "build", lambda *_: pytest.fail("built again"))
    assert small_device.kernel("vector", "vector_fill") is first
    assert small_device.kernel("vector", "vector_axpby") is not first


@pytest.mark.parametrize("count", [1, 63, 64, 65, 1000])
@pytest.mark.parametrize("group", [None, 1, 64])
def test_items_are_rounded_up_to_whole_groups(device, count, group):
    x = vectors.fill(device.empty(1000), -1)
    device.kernel("vector", "vector_fill")(count, group, count, 2, x)
    np.testing.assert_array_equal(x.get(), np.where(np.arange(1000) < count, 2, -1))


def test_no_items_are_no_launch(device):
    x = vectors.fill(device.empty(4), 1)
    kernel = device.kernel("vector", "vector_fill")
    with device.profile() as profile:
        kernel(0, 64, 4, 2, x)
        kernel.bind((64, 0), (64, 1), 4, 2, x)()
    assert profile.launches == {}
    assert (x.get() == 1).all()


def test_numbers_take_the_types_of_the_source(device, own_kernels):
    """Which may stand in a macro."""
    (own_kernels / "own.cl").write_text(
        "#define NUMBERS_ARGUMENTS int i, uint u, \\\n    ulong l, float f\n"
        "kernel void own_a(NUMBERS_ARGUMENTS, global float *out, local float *s)\n"
        "{ s[0] = f; out[0] = i; out[1] = u; out[2] = l >> 32; out[3] = s[0]; }\n"
    )
    out = device.empty(4)
    kernel = device.kernel("own", "own_a")
    for number in (1, True, np.int64(1), np.uint8(1)):
        for real in (number, 1.0, np.float64(1)):
            kernel(1, 1, number, number, int(number) << 32, real, vectors.fill(out, 0), device.local(1))
            assert out.get().tolist() == [1, 1, 1, 1]
    kernel(1, 1, -1, 2**31, 2**63, -1e300, out, device.local(1))
    assert out.get().tolist() == [-1, 2**31, 2**31, -math.inf]


@pytest.mark.parametrize("wanted", [1 << 20, (1 << 20, 1), (1, 1 << 14), (1 << 10, 1 << 10), 24, 1])
def test_groups_are_clamped_to_what_kernel_and_device_allow(device, wanted):
    kernel = device.kernel("vector", "vector_fill")
    group = kernel.group(wanted)
    sizes = group if isinstance(group, tuple) else (group,)
    assert 1 <= math.prod(sizes) <= device.max_group
    assert kernel.group(group) == group
    x = device.empty(5)
    kernel(5 if isinstance(wanted, int) else (5, 1), wanted, 5, 0.5, x)
    assert x.get().tolist() == [0.5] * 5


def test_a_bound_launch_runs_again_with_changed_arguments(device):
    x, y = (vectors.fill(device.empty(100), value) for value in (1, 10))
    kernel = device.kernel("vector", "vector_axpby")
    launch = kernel.bind(100, 64, 100, 2.0, x, 1.0, y, y)
    other = kernel.bind(100, 64, 100, 0.0, y, 0.0, y, y)  # has arguments of its own
    kernel(100, 64, 100, 5.0, y, 0.0, y, device.empty(100))
    launch()
    assert (y.get() == 12).all()
    launch.set(1, -1)
    launch()
    launch.set(5, x)
    launch()
    assert (y.get() == 11).all()
    assert (x.get() == 10).all()
    other()
    assert (y.get() == 0).all()


def test_a_bound_launch_keeps_its_arrays(device):
    out, kernel = device.empty(1000), device.kernel("vector", "vector_axpby")
    x, y = (vectors.fill(device.empty(1000), value) for value in (1, 2))
    launch = kernel.bind(1000, 64, 1000, 1.0, x, 1.0, y, out)
    del x, y
    gc.collect()
    for _ in range(10):
        vectors.fill(device.empty(1000), -1)  # would take the blocks of arrays that are gone
    launch()
    assert (out.get() == 3).all()


def test_what_the_driver_refuses_is_an_error_of_ltcl(device, monkeypatch):
    x = device.empty(3)
    kernel = device.kernel("vector", "vector_fill")
    for act in (
        lambda: kernel(1, 1, 1, 0.5, device.local(1)),
        lambda: kernel.bind(1, 1, 1, 0.5, x).set(2, device.local(1)),
    ):
        with pytest.raises(DeviceError, match="vector_fill"):
            act()

    def refuse(*_):
        raise cl.LogicError("clCreateKernel failed: INVALID_KERNEL_DEFINITION")

    monkeypatch.setattr(cl, "Kernel", refuse)
    with pytest.raises(DeviceError, match=r"vector_fill.*INVALID_KERNEL_DEFINITION"):
        Device(device.description).kernel("vector", "vector_fill")


def test_threads_may_launch_one_kernel(device):
    """The arguments of a launch are state of the kernel: no thread may see another's."""
    arrays = [vectors.fill(device.empty(256), -1) for _ in range(4)]

    def work(number: int) -> None:
        for _ in range(50):
            vectors.fill(arrays[number], number)

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for number, array in enumerate(arrays):
        assert (array.get() == number).all()
