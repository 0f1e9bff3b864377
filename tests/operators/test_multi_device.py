# SPDX-License-Identifier: BSD-3-Clause
"""Rows on several devices: solves, shares, refusals, the command line."""

from __future__ import annotations

import copy
import dataclasses
import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.cli.main import main
from ltcl.device import Device, discovery, exchange, tuning, vectors
from ltcl.errors import InputError
from ltcl.operators import CSR, Dense, IdentityPlus, MultiDevice
from tests import gallery
from tests.bases import rotation
from tests.operators.large import GRID, PIXELS, Stored, transport
from tests.problems import enclosure

pytestmark = pytest.mark.slow


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch, device: Device) -> list[discovery.Description]:
    """Two devices: halves of the one here, or the same one twice if its driver cannot halve it."""
    import pyopencl as cl

    handles = [device.handle] * 2
    if device.handle.partition_max_sub_devices >= 2 and device.compute_units >= 2:
        half = [cl.device_partition_property.EQUALLY, device.compute_units // 2]
        handles = device.handle.create_sub_devices(half)[:2]
    descriptions = []
    for number, handle in enumerate(handles):
        description = dataclasses.replace(
            device.description,
            index=f"7:{number}",
            handle=handle,
            compute_units=handle.max_compute_units,
        )
        descriptions.append(description)
    monkeypatch.delenv("LTCL_DEVICE", raising=False)
    monkeypatch.setattr(discovery, "list_devices", lambda: descriptions)
    # None of another test, which had less memory.
    monkeypatch.setattr(discovery, "_opened", {})
    return descriptions


@pytest.mark.parametrize("method", ["gauss_seidel", "sor", "southwell", "monte_carlo"])
def test_methods_that_read_rows_say_where_these_are(two, method):
    S = ltcl.Transport(transport(), GRID, device="all").systems[0]
    with pytest.raises(InputError, match=rf"{method}.*devices"):
        ltcl.solve(S, np.ones(PIXELS), method)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["auto", "chebyshev", "cg", "gmres", "neumann", "bicgstab"])
def test_methods_of_products_alone_solve_on_all_devices(two, method):
    S = ltcl.Transport(transport(), GRID, device="all").systems[0]
    b = np.ones(PIXELS)
    # "auto" tries, then surveys.
    for _ in range(3):
        solution = ltcl.solve(S, b, method, rtol=1e-5)
        residual = S.to_dense() @ solution.x - b
        assert np.linalg.norm(residual) <= 1.01e-5 * np.linalg.norm(b)


MATRICES: dict[str, Any] = {
    "dense": np.asarray,
    "sparse": scipy.sparse.csr_array,
    "stored": Stored,
}


def three_times_as_fast(device: Device, *_: Any) -> float:
    """Seconds of a product: the first device is three times as fast as the other."""
    return 1.0 if device.description.index == "all" else 3.0


@pytest.mark.parametrize(
    ("kind", "channels"),
    [
        ("dense", 3),
        ("sparse", 1),
        ("stored", 1),
        pytest.param("dense", 1, marks=pytest.mark.slow),
        pytest.param("sparse", 3, marks=pytest.mark.slow),
        pytest.param("stored", 3, marks=pytest.mark.slow),
    ],
)
def test_all_devices_give_the_answer_of_one(two, monkeypatch, kind, channels):
    monkeypatch.setattr(tuning, "work_seconds", three_times_as_fast)
    make = MATRICES[kind]
    matrices = [make(transport() * (1.0 + channel / 10)) for channel in range(channels)]
    one = ltcl.Transport(matrices, GRID)
    several = ltcl.Transport(matrices, GRID, device="all")
    devices = set()
    for S in several.systems:
        R: Any = S.R
        assert [part.shape[0] for _, part in R.parts] == [576, 192]
        devices |= {part.device for _, part in R.parts}
    assert len(devices) == 2

    light = np.full(GRID if channels == 1 else (*GRID, 3), 0.5, np.float32)
    picture = one @ light
    expected = ltcl.compensate(one, picture, method="chebyshev").pattern
    pattern = ltcl.compensate(several, picture, method="chebyshev").pattern
    assert np.linalg.norm(pattern - expected) <= 1e-6 * np.linalg.norm(expected)
    expected = ltcl.separate(one, picture, method="chebyshev").bounces
    bounces = ltcl.separate(several, picture, method="chebyshev").bounces
    assert np.linalg.norm(bounces - expected) <= 1e-6 * np.linalg.norm(expected)
    # In float64, on the host.
    fine = ltcl.solve(several.systems[0], np.ones(PIXELS), rtol=1e-12)
    assert fine.residual <= 1e-12


def together() -> tuple[Device, Device]:
    """Devices of one context."""
    device = ltcl.open_device("all")
    return device, device.others[0]


def apart() -> tuple[Device, Device]:
    """Devices that copy through the host."""
    return ltcl.open_device("7:0"), ltcl.open_device("7:1")


def shared(devices: tuple[Device, Device], matrix: Any, form: Any = Dense) -> MultiDevice:
    """A matrix of which the first device has a third of the rows."""
    first, second = devices
    cut = matrix.shape[0] // 3
    return MultiDevice(first, [form(first, matrix[:cut]), form(second, matrix[cut:])])


@pytest.mark.parametrize("open_two", [together, apart])
@pytest.mark.parametrize("columns", [None, 1, 3, 11])
@pytest.mark.parametrize("form", [Dense, CSR])
def test_products_with_all_that_is_added(two, open_two, columns, form):
    devices = open_two()
    matrix = gallery.vectors(53, 53).astype(np.float32)
    A = shared(devices, scipy.sparse.csr_array(matrix) if form is CSR else matrix, form)
    x, y = (gallery.vectors(53, columns, seed).astype(np.float32) for seed in (1, 2))
    x_there, y_there = (A.device.upload(values) for values in (x, y))
    for B, dense in ((A, matrix), (A.T, matrix.T)):
        products = [
            (B.apply(x_there), dense @ x),
            (B.apply(x_there, scale=2.0, shift=0.5), 2 * dense @ x + 0.5 * x),
            (B.apply(x_there, add=y_there, add_scale=-3.0), dense @ x - 3 * y),
            (B.apply(x_there, add=y_there, shift=0.25), dense @ x + y + 0.25 * x),
            (B.apply(x_there, y_there.copy(), add=y_there, add_scale=0.0), dense @ x),
        ]
        in_place = y_there.copy()
        products.append((B.apply(x_there, in_place, add=in_place), dense @ x + y))
        for product, expected in products:
            np.testing.assert_allclose(product.get(), expected, rtol=0, atol=2e-4)


@pytest.mark.parametrize("open_two", [together, apart])
@pytest.mark.parametrize("columns", [None, 3])
def test_steps_are_those_of_one_device(two, open_two, columns):
    """Also after x and r were changed between, and after norms were read."""
    devices = open_two()
    matrix = (gallery.vectors(40, 40) / 40).astype(np.float32)
    numbers = [(0.0, 1.0), (0.25, 0.5), (-0.5, 0.75), (0.5, 0.5)]
    results = []
    for R in (Dense(devices[0], matrix), shared(devices, matrix)):
        S = IdentityPlus(R)
        x = S.device.upload(gallery.vectors(40, columns, 7))
        r = S.device.upload(gallery.vectors(40, columns, 8))
        stepper = S.stepper(x, r)
        stepper.start(0.5)
        for keep, gain in numbers:
            stepper.step(keep, gain)
        norms = [stepper.norms()]
        vectors.axpby(0.5, r, 0.1, x, r)
        for keep, gain in numbers[:2]:
            stepper.step(keep, gain)
        direction = stepper.d.get()
        stepper.finish()
        assert stepper.waiting == 0
        results.append([*norms, x.get(), r.get(), direction])
        stepper.start(0.25)
        stepper.step(0.5, 0.5)
        results[-1] += [stepper.norms(), x.get(), r.get()]
    for found, expected in zip(*results, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def test_vectors_are_not_on_any_device_of_the_rows(two):
    """Steps then are products and what lies between, on the device of the vectors."""
    first, second = together()
    matrix = (gallery.vectors(40, 40) / 40).astype(np.float32)
    S = IdentityPlus(MultiDevice(first, [Dense(second, matrix)]))
    b = np.ones(40)
    for method in ("chebyshev", "gmres"):
        solution = ltcl.solve(S, b, method, rtol=1e-4)
        assert np.linalg.norm(b - solution.x - matrix @ solution.x) <= 1e-3


def waits_of(monkeypatch: pytest.MonkeyPatch, call: Callable[[], object]) -> int:
    """How often the host waits for a device."""
    waits = []
    copy, finish = Device.copy, Device.finish

    def counted_copy(self: Device, to: Any, source: Any, **sizes: Any) -> None:
        if isinstance(to, np.ndarray) or isinstance(source, np.ndarray):
            waits.append(1)
        copy(self, to, source, **sizes)

    def counted_finish(self: Device) -> None:
        waits.append(1)
        finish(self)

    with monkeypatch.context() as patch:
        patch.setattr(Device, "copy", counted_copy)
        patch.setattr(Device, "finish", counted_finish)
        call()
    return len(waits)


def test_products_and_steps_wait_for_nothing_and_exchange_what_changes(two, monkeypatch):
    first, second = together()
    matrix = (gallery.vectors(60, 60) / 60).astype(np.float32)
    S = IdentityPlus(shared((first, second), matrix))
    x, r, out = (first.upload(np.ones(60)) for _ in range(3))
    multiply = S.bind(x, out)
    transposed = S.bind(x, out, transpose=True)
    stepper = S.stepper(x, r)
    stepper.start(0.5)

    def moved(call: Callable[[], object]) -> int:
        """Numbers that go between the devices."""
        with first.profile() as here, second.profile() as there:
            call()
        copies = [*here.copies.items(), *there.copies.items()]
        assert {name for name, _ in copies} == {"copy"}
        return sum(times.nbytes for _, times in copies) // 4

    for call, numbers in ((multiply, 60 + 40), (transposed, 40 + 60 + 20)):
        assert waits_of(monkeypatch, call) == 0
        assert moved(call) == numbers
    assert waits_of(monkeypatch, lambda: stepper.step(0.5, 0.5)) == 0
    assert moved(lambda: stepper.step(0.5, 0.5)) == 20 + 40


def test_products_are_right_whichever_device_is_late(two):
    """Each device in turn is held, and memory is dropped and used again meanwhile."""
    import pyopencl as cl

    first, second = together()
    matrix = (gallery.vectors(60, 60) / 60).astype(np.float32)
    A = shared((first, second), matrix)
    for late in (first, second):
        gate = cl.UserEvent(late.context)
        x = first.upload(np.ones(60))
        late.wait_for(gate)
        late.flush()
        product = A.apply(A.apply(x))
        del x
        for device in (first, second):
            vectors.fill(device.empty(60), -1.0)
            device.flush()
        gate.set_status(cl.command_execution_status.COMPLETE)
        expected = matrix @ (matrix @ np.ones(60))
        np.testing.assert_allclose(product.get(), expected, rtol=0, atol=1e-5)


KRYLOV = [("cg", {}), ("gmres", {}), ("gmres", {"restart": 3}), ("bicgstab", {})]


def one_and_several(S: np.ndarray, weights: Any = None) -> list[IdentityPlus]:
    """S on the first of two devices, and on both."""
    devices = together()
    R = (S - np.eye(len(S))).astype(np.float32)
    return [IdentityPlus(A, weights=weights) for A in (Dense(devices[0], R), shared(devices, R))]


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize(("method", "options"), KRYLOV)
def test_krylov_methods_in_shares_take_the_steps_of_one_device(two, method, options, k):
    """Also with a weighted inner product, a column that is solved early, and one that is dark."""
    scene = enclosure(60, 0.8, seed=18)
    weights = np.linspace(0.5, 2.0, 60)
    S = scene.S * np.sqrt(weights) / np.sqrt(weights)[:, None]
    b = gallery.vectors(60, k, 3).astype(np.float64)
    if b.ndim == 2 and b.shape[1] > 1:
        b[:, 1] = 0.0
        b[:, 2] = np.linalg.eigh(scene.S)[1][:, 3] / np.sqrt(weights)
    solutions = []
    for operator in one_and_several(S, weights):
        solutions.append(ltcl.solve(operator, b, method, rtol=1e-5, **options))
    one, several = solutions
    updates = {name for name in together()[1].launches if name.startswith("krylov")}
    assert (
        updates
        == {
            "cg": {"krylov_cg"},
            "gmres": {"krylov_subtract"},
            "bicgstab": {"krylov_half", "krylov_bicgstab"},
        }[method]
    )
    assert several.converged
    steps = min(several.iterations, one.iterations)
    found, expected = (solution.residuals[: steps + 1] for solution in solutions[::-1])
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=2e-6)
    np.testing.assert_allclose(several.x, one.x, rtol=0, atol=5e-5)
    assert np.linalg.norm(b - S @ several.x) <= 1.01e-5 * np.linalg.norm(b)


@pytest.mark.parametrize(
    ("method", "S", "b"),
    [
        ("cg", np.diag([0.0, 1.0, 2.0, 4.0]), [[0.0, 1.0, 1.0, 1.0], [1.0, 0.0, 0.0, 0.0]]),
        ("gmres", np.diag([1.0, 4.0, 0.0]), [[1.0, 2.0, 0.0]]),
        ("gmres", np.diag([1.0, 4.0, 0.0]), [[1.0, 2.0, 1.0]]),
        ("bicgstab", np.eye(3) + np.eye(3, k=-1), [[1.0, 0.0, 0.0], [1.0, 2.0, 3.0]]),
        ("bicgstab", np.diag([1.0, -1.0, 1.0])[:, [1, 0, 2]], [[1.0, 1.0, 0.0]]),
    ],
)
def test_krylov_methods_in_shares_end_and_restart_as_on_one_device(two, method, S, b):
    solutions = []
    for operator in one_and_several(S):
        b_columns = np.transpose(b)
        solutions.append(ltcl.solve(operator, b_columns, method, rtol=1e-5, throw=False))
    one, several = solutions
    assert several.status is one.status
    np.testing.assert_allclose(several.x, one.x, rtol=1e-4, atol=1e-5)


def exchanged_numbers(monkeypatch: pytest.MonkeyPatch, call: Callable[[], object]) -> int:
    """Numbers that go from one device to another."""
    counts = []
    send = exchange.send_rows

    def counted(source: Any, first: int, target: Any, at: int, count: int, ready: Any) -> Any:
        counts.append(count * source.columns)
        return send(source, first, target, at, count, ready)

    with monkeypatch.context() as patch:
        patch.setattr(exchange, "send_rows", counted)
        call()
    return sum(counts)


@pytest.mark.parametrize("k", [1, 3])
@pytest.mark.parametrize(
    ("method", "products", "sums"),
    [
        # Sums of a column, in 12 steps: of each step, or of both passes of steps 7 to 18.
        ("cg", 12, 12 * 2),
        ("bicgstab", 24, 12 * (5 + 2)),
        ("gmres", 12, 2 * sum(range(8, 20))),
    ],
)
def test_steps_in_shares_exchange_the_multiplied_vector_and_few_sums(
    two, monkeypatch, method, products, sums, k
):
    n = 200
    Q = rotation(n)
    S = one_and_several((Q * np.logspace(0, 2, n)) @ Q.T)[1]
    b = gallery.vectors(n, k, 5)

    def solve(steps: int) -> None:
        solution = ltcl.solve(S, b, method, rtol=1e-5, maxiter=steps, throw=False)
        assert solution.iterations == steps

    counts = [exchanged_numbers(monkeypatch, lambda steps=steps: solve(steps)) for steps in (6, 18)]
    # Each device gets the rows of the other, and sums of its only slice of rows.
    assert counts[1] - counts[0] == products * n * k + 2 * sums * k


@pytest.mark.parametrize("method", ["cg", "gmres", "bicgstab"])
@pytest.mark.parametrize("place", [0, 1])
def test_krylov_methods_in_shares_are_right_whichever_device_is_late(
    two, monkeypatch, method, place
):
    import pyopencl as cl

    one, several = one_and_several(enclosure(60, 0.6, seed=5).S)
    b = gallery.vectors(60, 3, 6)
    expected = ltcl.solve(one, b, method, rtol=1e-5)
    late = together()[place]
    send = exchange.send_rows

    def send_late(source: Any, first: int, target: Any, *where: Any) -> Any:
        if target.device is late:
            gate = cl.UserEvent(late.context)
            late.wait_for(gate)
            complete = cl.command_execution_status.COMPLETE
            threading.Timer(0.003, gate.set_status, [complete]).start()
        return send(source, first, target, *where)

    monkeypatch.setattr(exchange, "send_rows", send_late)
    found = ltcl.solve(several, b, method, rtol=1e-5)
    assert found.products <= expected.products + 2
    np.testing.assert_allclose(found.x, expected.x, rtol=0, atol=5e-5)


@pytest.mark.parametrize("quicker", ["home", "shares"])
def test_vectors_are_where_a_step_was_quicker(two, monkeypatch, quicker):
    def seconds(_: Device, key: str, launch: Callable[[], object]) -> float:
        launch()
        return 1.0 if quicker in key else 2.0

    monkeypatch.setattr(tuning, "seconds", seconds)
    several = one_and_several(enclosure(60, 0.6, seed=5).S)[1]
    b = gallery.vectors(60, None, 6)
    x = ltcl.solve(several, b, "cg", rtol=1e-4).x
    assert np.linalg.norm(b - several @ x) <= 1.01e-4 * np.linalg.norm(b)
    assert ("krylov_cg" in together()[1].launches) == (quicker == "shares")


def test_a_rectangular_T_is_on_all_devices(two):
    matrix = gallery.vectors(12, 20) + 2.0
    light = np.ones((4, 5))
    one = ltcl.Transport(matrix, (4, 5), camera_grid=(3, 4))
    several = ltcl.Transport(matrix, (4, 5), camera_grid=(3, 4), device="all")
    assert isinstance(several.operators[0], MultiDevice)
    np.testing.assert_allclose(several @ light, one @ light, rtol=1e-6)


def test_all_devices_are_opened_once(two, monkeypatch):
    device = ltcl.open_device("all")
    assert ltcl.open_device(" ALL ") is device
    assert device.description.index == "all"
    assert [other.description.index for other in device.others] == ["7:1"]
    assert ltcl.open_device("7:1") is device.others[0]
    assert not ltcl.open_device().others
    T = ltcl.Transport(transport(), GRID, device=device)
    assert copy.deepcopy(T).device is device
    monkeypatch.setenv("LTCL_DEVICE", "all")
    assert ltcl.open_device() is device
    monkeypatch.setattr(discovery, "list_devices", lambda: two[:1])
    assert ltcl.open_device("all") is ltcl.open_device("7:0")


@pytest.mark.slow
def test_the_command_line_takes_all_devices(two, tmp_path, capsys):
    matrix = str(tmp_path / "T.npz")
    picture = str(tmp_path / "picture.exr")
    ltcl.save(matrix, ltcl.Transport(transport(), GRID))
    ltcl.images.write(picture, np.full(GRID, 0.5, np.float32))
    patterns = []
    for device in ("7:0", "all"):
        folder = tmp_path / device.replace(":", "-")
        command = ["compensate", matrix, picture, "--out", str(folder), "--device", device]
        assert main(command) == 0
        patterns.append(ltcl.images.read(folder / "picture_pattern.exr"))
    np.testing.assert_allclose(patterns[1], patterns[0], rtol=1e-5)


SOLVES = """
import sys
import numpy as np, ltcl
device = ltcl.open_device("all")
print([other.context == device.context for other in device.others])
matrix = np.random.default_rng(0).random((768, 768)) / 1536 + np.eye(768)
S = ltcl.Transport(matrix, (24, 32), device=device).systems[0]
b = np.ones(768)
for method in ("chebyshev", "gmres", "cg"):
    x = ltcl.solve(S, b, method, rtol=1e-3).x
    assert np.linalg.norm(S.to_dense() @ x - b) <= 2e-3 * np.linalg.norm(b)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("devices", "share_a_context"), [("pthread pthread", True), ("basic pthread", False)]
)
def test_all_devices_of_pocl(device, devices, share_a_context):
    """Those that lock themselves up on events of others exchange through the host.

    Other drivers than PoCL 3 show the devices that they have.
    """
    environment = {**os.environ}
    environment.pop("LTCL_DEVICE", None)
    is_pocl = "Portable Computing Language 3" in device.driver
    if is_pocl:
        environment["POCL_DEVICES"] = devices
    run = [sys.executable, "-c", SOLVES]
    output = subprocess.run(
        run, env=environment, check=True, timeout=300, stdout=subprocess.PIPE, text=True
    )
    if is_pocl:
        assert output.stdout.strip() == f"[{share_a_context}]"


@pytest.mark.slow
def test_the_page_on_scale_runs(two, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    root = Path(__file__).resolve().parents[2]
    page = (root / "docs" / "guide" / "scale.md").read_text(encoding="utf-8")
    names: dict[str, Any] = {}
    for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(code, names)  # noqa: S102
    assert isinstance(names["T"].systems[0].R, MultiDevice)
    assert names["patterns"].shape == (8, 24, 48)
    direct = 0.5 * names["T"].first_bounce.reshape(24, 48)
    assert abs(names["separated"].direct - direct).max() < 1e-3
