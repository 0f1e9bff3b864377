# SPDX-License-Identifier: BSD-3-Clause
"""Kernels: sources, compilation, launches with named arguments, bound launches, errors."""

from __future__ import annotations

import gc
import math
import re
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest
from pyopencl import _cl

from ltcl.device import sources, vectors
from ltcl.errors import DeviceError, InputTypeError, MemoryLimitError
from ltcl.solvers import krylov_state

TWINS = (Path(__file__).parents[1] / "reference.py").read_text(encoding="utf-8")
FILES = sorted(path.stem for path in sources.folder().glob("*.cl"))


@pytest.mark.parametrize("name", FILES)
def test_every_kernel_has_a_twin_and_every_line_its_mark(name):
    text = sources.load(name)
    file = ""
    number = 0
    seen = []
    for line in text.splitlines():
        mark = re.fullmatch(r'#line (\d+) "(.+)"', line)
        if mark:
            number = int(mark[1])
            file = mark[2]
            continue
        assert (sources.folder() / file).read_text().splitlines()[number - 1] == line
        seen.append((file, number))
        number += 1
    # Each include comes once.
    assert len(set(seen)) == len(seen)
    for kernel in re.findall(r"\bkernel\s+void\s+(\w+)", text):
        assert kernel.startswith(f"{name}_")
        # The levels of a tail are those of a transform.
        twin = re.sub("_(group|sum)$|_tail", "", kernel)
        assert re.search(rf"^def {twin}", TWINS, re.MULTILINE), kernel


HEADER = "common/lanes.h"
# One value of each define of each file.
DEFINES = {
    "K": 2,
    "STRIP": 2,
    "STRIPS": 1,
    "WIDTH": 8,
    "PLACE": "int",
    "VALUES": 2,
    "TAPS": 4,
    "PAIRS": 1,
    "LANES": 8,
    "BLOCKS": 1,
    "CHUNK": 2,
    "WALKS": 2,
    "CHANNELS": 2,
    "LINKED": 1,
    "CODE": "uchar",
    **krylov_state.DEFINES,
}
# Where a kernel takes no others.
ONLY_DEFINES = {"wavelet_tail": {"K": 1}}


@pytest.mark.parametrize("name", FILES)
def test_the_compiler_reads_the_files_as_they_are(device, name):
    """Editors and offline compilers, too: headers have guards, and name each other by place."""
    path = sources.folder() / f"{name}.cl"
    text = "\n".join(f'#include "{header.as_posix()}"' for header in (path.parent / HEADER, path))
    defines = {**DEFINES, **ONLY_DEFINES.get(name, {})}
    options = [f"-D{define}={value}" for define, value in defines.items()]
    program = cl.Program(device.context, text).build([*sources.OPTIONS, *options])
    assert f"{name}_" in program.kernel_names


@pytest.fixture
def own_kernels(tmp_path, monkeypatch):
    """A folder of kernels in which a test writes its own."""
    monkeypatch.setattr(sources, "folder", lambda: tmp_path)
    sources.load.cache_clear()
    yield tmp_path
    sources.load.cache_clear()


def test_messages_name_file_line_and_defines(device, own_kernels):
    (own_kernels / "part.h").write_text("// fine\nint broken(void) { return nonsense; }\n")
    (own_kernels / "own.cl").write_text(
        '// first\n#include "part.h"\nkernel void own_a(int n) { }\n'
    )
    with pytest.raises(
        DeviceError, match=r"^kernels/own\.cl.*-DK=3 -DLANES=8(?s:.*)nonsense"
    ) as error:
        device.kernel("own", "own_a", K=3, LANES=8)
    assert device.driver in str(error.value)
    # Oclgrind removes the #line marks.
    if device.kind != "simulator":
        assert re.search(r"part\.h\W+2\b", str(error.value))


@pytest.mark.parametrize("failures", [1, 2, 3])
def test_a_program_that_fails_without_a_reason_is_built_again(
    device, own_kernels, monkeypatch, failures
):
    """PoCL does so where two processes build the same program at the same time."""
    # A program of its own for each number of failures: a device keeps what it has built.
    name = f"own{failures}"
    (own_kernels / f"{name}.cl").write_text(f"kernel void {name}_a(int n) {{ }}\n")
    build = cl.Program.build
    left = failures

    def fail_at_first(program, *options, **more):
        nonlocal left
        left -= 1
        if left >= 0:
            raise cl.RuntimeError("clBuildProgram failed: BUILD_PROGRAM_FAILURE")
        return build(program, *options, **more)

    monkeypatch.setattr(cl.Program, "build", fail_at_first)
    if failures < sources.POCL_ATTEMPTS and "Portable" in device.driver:
        assert device.kernel(name, f"{name}_a").name == f"{name}_a"
    else:
        with pytest.raises(DeviceError, match=name):
            device.kernel(name, f"{name}_a")


@pytest.mark.parametrize("file", ["csr", "dense"])
def test_missing_and_wrong_defines_and_names_are_refused(device, file):
    for name, defines, part in (
        ("matvec", {}, "needs -DK="),
        ("matvec", {"K": 5, "STRIP": 1, "STRIPS": 1}, "1, 2, 3, 4 or 8"),
        ("none", {"K": 1, "STRIP": 1, "STRIPS": 1}, f"{file}_none"),
    ):
        with pytest.raises(DeviceError, match=part):
            device.kernel(file, f"{file}_{name}", **defines)


def test_a_program_is_built_once(small_device, monkeypatch):
    small_device.kernel("vector", "vector_fill")
    monkeypatch.setattr(sources, "build", lambda *_: pytest.fail("built again"))
    small_device.kernel("vector", "vector_axpby")


@pytest.mark.parametrize("group", [1, 64])
def test_items_are_rounded_up_to_whole_groups(device, group):
    x = device.empty(1000)
    kernel = device.kernel("vector", "vector_fill")
    for count in (1, 63, 64, 65, 1000):
        kernel(count, group, count=count, value=2, out=vectors.fill(x, -1))
        np.testing.assert_array_equal(x.get(), np.where(np.arange(1000) < count, 2, -1))
    before = device.launches.total()
    kernel(0, group, count=1000, value=3, out=x)
    kernel.bind((64, 0), (64, 1), count=1000, value=3, out=x)()
    assert device.launches.total() == before


def test_numbers_take_the_types_of_the_source(device, own_kernels):
    """Arguments may stand in a macro."""
    (own_kernels / "own.cl").write_text(
        "#define NUMBERS_ARGUMENTS int i, uint u, \\\n    ulong l, float f\n"
        "kernel void own_a(NUMBERS_ARGUMENTS, global float *out, local float *s)\n"
        "{ s[0] = f; out[0] = i; out[1] = u; out[2] = l >> 32; out[3] = s[0]; }\n"
    )
    out = device.empty(4)
    kernel = device.kernel("own", "own_a")
    launch = kernel.bind(1, 1, i=0, u=0, l=0, f=0, out=out, s=device.local(1))
    for number in (1, True, np.int64(1), np.uint8(1)):
        for real in (number, 1.0, np.float64(1)):
            vectors.fill(out, 0)
            launch.set(i=number, u=number, l=int(number) << 32, f=real)
            launch()
            assert out.get().tolist() == [1, 1, 1, 1]
    kernel(1, 1, i=-1, u=2**31, l=2**63, f=-1e300, out=out, s=device.local(1))
    assert out.get().tolist() == [-1, 2**31, 2**31, -math.inf]


@pytest.mark.parametrize("size", [1 << 20, (1 << 20, 1), (1, 1 << 14), (1 << 10, 1 << 10), 24, 1])
def test_groups_are_clamped_to_what_kernel_and_device_allow(device, size):
    kernel = device.kernel("vector", "vector_fill")
    group = kernel.group(size)
    assert 1 <= np.prod(group) <= device.max_group
    assert kernel.group(group) == group
    x = device.empty(5)
    items = 5 if isinstance(size, int) else (5, 1)
    kernel(items, size, count=5, value=0.5, out=x)
    assert x.get().tolist() == [0.5] * 5


def test_a_bound_launch_keeps_its_arrays_and_runs_again_with_changed_arguments(device):
    x = vectors.fill(device.empty(1000), 1)
    y = vectors.fill(device.empty(1000), 10)
    z = vectors.fill(device.empty(1000), 2)
    kernel = device.kernel("vector", "vector_axpby")
    launch = kernel.bind(1000, 64, count=1000, a=2.0, x=z, b=1.0, y=y, out=y)
    # Another launch has arguments of its own.
    zeroing = kernel.bind(1000, 64, out=y, count=1000, a=0.0, x=y, b=0.0, y=y)
    kernel(1000, 64, count=1000, a=5.0, x=y, b=0.0, y=y, out=device.empty(1000))
    del z
    gc.collect()
    for _ in range(10):
        # This would take the blocks of arrays that are gone.
        vectors.fill(device.empty(1000), -1)
    launch()
    assert (y.get() == 14).all()
    launch.set(a=-1)
    launch()
    launch.set(a=-1.0, out=x)
    launch()
    assert (y.get() == 12).all()
    assert (x.get() == 10).all()
    zeroing()
    assert (y.get() == 0).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"value": None}, "vector_fill needs argument value$"),
        ({"valeu": 1.0}, "vector_fill has no argument valeu; it has count, value, out"),
        ({"value": None, "valeu": 1.0}, "vector_fill has no argument valeu"),
        ({"value": "1"}, "argument value of kernel vector_fill is '1'; .*number"),
        ({"count": 1.5}, "argument count of kernel vector_fill is 1.5"),
    ],
)
def test_wrong_and_missing_names_are_refused_at_once(device, changes, message):
    kernel = device.kernel("vector", "vector_fill")
    arguments = {"count": 3, "value": 1.0, "out": device.empty(3)} | changes
    named = {name: value for name, value in arguments.items() if value is not None}
    launches = device.launches.total()
    for act in (kernel, kernel.bind):
        with pytest.raises(InputTypeError, match=message):
            act(3, 1, **named)
    assert device.launches.total() == launches


def test_a_bound_launch_refuses_names_that_its_kernel_has_not(device):
    launch = device.kernel("vector", "vector_fill").bind(
        3, 1, count=3, value=1.0, out=device.empty(3)
    )
    with pytest.raises(InputTypeError, match=r"vector_fill .* x; .*count"):
        launch.set(x=1.0)


def test_threads_may_launch_one_kernel(device):
    """Arguments are state of a cl_kernel: no thread may see another's."""
    arrays = [vectors.fill(device.empty(256), -1) for _ in range(4)]

    def work(number: int) -> None:
        for _ in range(50):
            vectors.fill(arrays[number], number)

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(work, range(4)))
    for number, array in enumerate(arrays):
        assert (array.get() == number).all()


def test_arguments_that_the_driver_refuses_are_errors_of_ltcl(device):
    kernel = device.kernel("vector", "vector_fill")
    local = device.local(1)
    for act in (
        lambda: kernel(1, 1, count=1, value=0.5, out=local),
        lambda: kernel.bind(1, 1, count=1, value=0.5, out=device.empty(3)).set(out=local),
    ):
        with pytest.raises(DeviceError, match=r"vector_fill"):
            act()


@pytest.mark.parametrize(
    ("name", "kind", "advice"),
    [
        ("MEM_OBJECT_ALLOCATION_FAILURE", MemoryLimitError, "memory"),
        ("OUT_OF_RESOURCES", MemoryLimitError, "compress"),
        ("DEVICE_NOT_AVAILABLE", DeviceError, "LTCL_DEVICE=cpu"),
        ("COMPILER_NOT_AVAILABLE", DeviceError, "ltcl devices"),
        ("INVALID_VALUE", DeviceError, "ltcl doctor"),
    ],
)
def test_status_codes_say_what_to_do(device, monkeypatch, name, kind, advice):
    def fail(*_, **__):
        raise cl.RuntimeError(
            _cl._ErrorRecord(msg="", code=getattr(cl.status_code, name), routine="clDo")
        )

    x = device.empty(3)
    monkeypatch.setattr(cl, "enqueue_copy", fail)
    monkeypatch.setattr(cl, "enqueue_nd_range_kernel", fail)
    for act in (x.get, lambda: vectors.fill(x, 1.0)):
        with pytest.raises(kind, match=f"{device.name}: .*{name}.*{advice}|{name}.*{advice}"):
            act()


def test_a_compiler_prints_nothing(device, capfd):
    """Remarks on a kernel of constants; a define of its own keeps the driver's cache out."""
    device.kernel("form_factor", "form_factor_matvec", K=1, LANES=8, BLOCKS=0, FRESH=time.time_ns())
    assert capfd.readouterr() == ("", "")
