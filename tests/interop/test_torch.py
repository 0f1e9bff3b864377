# SPDX-License-Identifier: BSD-3-Clause
"""PyTorch's tensors: their kind comes back, and derivatives are those of dense matrices."""

from __future__ import annotations

import importlib.util
import warnings
from typing import Any

import numpy as np
import pytest
import scipy.sparse.linalg

import ltcl
from ltcl.errors import InputError, InputTypeError
from ltcl.interop import host
from tests.interop.calls import CALLS, GRID, gives_back, picture, transport
from tests.interop.derivatives import (
    COMPENSATE,
    LINEAR,
    RTOL,
    agrees_with_differences,
    counted,
)

if importlib.util.find_spec("torch") is None:
    pytest.skip(
        "PyTorch is not installed: python -m pip install 'ltcl[torch]'", allow_module_level=True
    )
pytestmark = [pytest.mark.usefixtures("device"), pytest.mark.filterwarnings("error")]


@pytest.fixture(scope="module")
def torch() -> Any:
    import torch

    return torch


@pytest.mark.parametrize("call", CALLS)
def test_a_call_gives_back_a_tensor(torch, call):
    gives_back(CALLS[call], torch.from_numpy, torch.Tensor)


@pytest.mark.parametrize("name", ["float16", "bfloat16", "float32", "float64"])
def test_floats_come_back_in_their_type(torch, name):
    dtype = getattr(torch, name)
    light = torch.tensor(picture(), dtype=dtype)
    result = transport() @ light
    assert result.dtype is dtype
    expected = transport() @ light.double().numpy()
    np.testing.assert_allclose(result.double(), expected, rtol=2 * torch.finfo(dtype).eps)


def test_whole_numbers_come_back_as_floats_and_codes_as_codes(torch):
    assert (transport() @ torch.ones(GRID, dtype=torch.uint8)).dtype is torch.float32
    with ltcl.Compensator(transport(), dtype="uint16") as compensator:
        assert compensator(torch.ones(GRID)).dtype is torch.uint16


def test_memory_is_shared_both_ways(torch):
    light = torch.tensor(picture(), dtype=torch.float32)
    before = ltcl.checks.real("light", light)
    light[0, 0] = 7.0
    assert before[0, 0] == 7.0
    codes = torch.zeros(GRID, dtype=torch.uint8)
    with ltcl.Compensator(transport()) as compensator:
        assert compensator(light.clamp(0, 1), out=codes) is codes
    assert codes.any()


def test_tensors_without_a_gradient_may_be_parameters(torch):
    parameter = torch.nn.Parameter(torch.ones(GRID))
    with torch.no_grad():
        assert not (transport() @ parameter).requires_grad
    assert (transport() @ parameter).requires_grad


def test_tensors_of_another_device_go_through_the_host_which_is_said_once(
    torch, monkeypatch, caplog
):
    """This machine may have none: a tensor says that it is on one, and copies as it would."""

    class Elsewhere(torch.Tensor):
        device = torch.device("cuda", 0)
        copies = 0

        def cpu(self, *arguments: Any) -> Any:
            Elsewhere.copies += 1
            return self.as_subclass(torch.Tensor)

    moved: list[Any] = []
    to = torch.Tensor.to

    def recorded(self: Any, device: Any, dtype: Any) -> Any:
        moved.append(device)
        return to(self, dtype)

    monkeypatch.setattr(torch.Tensor, "to", recorded)
    host.say_once.cache_clear()
    light = torch.ones(GRID).as_subclass(Elsewhere)
    results = [transport() @ light for _ in range(2)]
    np.testing.assert_allclose(results[1].numpy(), transport() @ np.ones(GRID), rtol=1e-6)
    assert (Elsewhere.copies, moved) == (2, [Elsewhere.device] * 2)
    assert ["through the host" in record.message for record in caplog.records] == [True]


def gradcheck(torch: Any, function: Any, operand: np.ndarray) -> None:
    """PyTorch's check in float64 against finite differences, to 1e-3, with second derivatives.

    Products are in float32, which hides 1e-7 of an operand: its steps are 0.1, and a linear
    function has no other error of finite differences.
    """
    x = torch.tensor(operand, requires_grad=True)
    options = {"eps": 0.1, "atol": 1e-4, "rtol": 1e-3}
    assert torch.autograd.gradcheck(function, (x,), **options)
    assert torch.autograd.gradgradcheck(function, (x,), **options)


@pytest.mark.parametrize("name", ["T @ p", "T in colour @ grey", "S @ X", "solve"])
def test_gradcheck(torch, name):
    gradcheck(torch, LINEAR[name].run, LINEAR[name].operand)


@pytest.mark.parametrize("name", LINEAR)
def test_gradients_of_linear_calls_are_products_with_the_transpose(torch, name):
    call = LINEAR[name]
    x = torch.tensor(call.operand, requires_grad=True)
    result = call.run(x)
    weights = picture(*result.shape, seed=4)
    result.backward(torch.tensor(weights))
    expected = call.matrix().T @ weights.ravel()
    np.testing.assert_allclose(x.grad.numpy().ravel(), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", COMPENSATE)
def test_gradients_of_compensation_are_solves_on_the_free_pixels(torch, name):
    call = COMPENSATE[name]
    inputs = {"desired": torch.tensor(call.desired, requires_grad=True)}
    if call.background is not None:
        inputs["background"] = torch.tensor(call.background, requires_grad=True)
    c = call.run(**inputs)
    weights = np.random.default_rng(1).standard_normal(c.pattern.shape)
    c.pattern.backward(torch.tensor(weights))
    gradients = {which: tensor.grad.numpy() for which, tensor in inputs.items()}
    agrees_with_differences(call, weights, gradients)


def test_the_pattern_is_linear_while_the_same_pixels_are_free(torch):
    """The gradient has a derivative in the one that comes back, and none in desired."""
    call = COMPENSATE["clipped"]
    desired = torch.tensor(call.desired, requires_grad=True)
    weights = torch.tensor(picture(seed=9), requires_grad=True)
    pattern = call.run(desired).pattern
    (gradient,) = torch.autograd.grad((pattern * weights).sum(), desired, create_graph=True)
    along = torch.tensor(picture(seed=8))
    (slope,) = torch.autograd.grad((gradient * along).sum(), weights)
    ahead = call.run(call.desired + 1e-4 * along.numpy()).pattern.astype(np.float64)
    behind = call.run(call.desired - 1e-4 * along.numpy()).pattern
    np.testing.assert_allclose(slope.numpy(), (ahead - behind) / 2e-4, atol=5e-3)


def test_a_gradient_goes_through_a_network_of_calls(torch):
    """What is undone shows again: the loss of T @ pattern has no slope where none is clipped."""
    desired = torch.full(GRID, 0.2, dtype=torch.float64, requires_grad=True)
    pattern = ltcl.compensate(transport(), desired, rtol=RTOL).pattern
    (transport() @ pattern).sum().backward()
    np.testing.assert_allclose(desired.grad.numpy(), 1.0, rtol=1e-4)


@pytest.mark.parametrize(
    ("run", "message"),
    [
        (lambda t: ltcl.separate(transport(), t), "image is a Tensor whose derivative"),
        (lambda t: ltcl.compensate(transport(), picture(), weights=t), "weights is a Tensor"),
        (lambda t: ltcl.compensate(transport(), t, gain="auto"), "gain is 'auto'"),
        (lambda t: ltcl.compensate(transport(), picture(), gain=t.sum()), "gain is a Tensor whose"),
        (lambda t: ltcl.Compensator(transport())(t), "frame is a Tensor whose derivative"),
        (lambda t: ltcl.solve(np.eye(32), t.ravel(), "monte_carlo"), "method is 'monte_carlo'"),
        (lambda t: ltcl.solve(np.eye(32), picture(32), x0=t.ravel()), "x0 is a Tensor"),
        (lambda t: ltcl.Transport(t[:2, :2], (1, 2)), "matrix is a Tensor"),
    ],
)
def test_what_has_no_derivative_is_refused(torch, run, message):
    with pytest.raises((InputError, InputTypeError), match=message):
        run(torch.tensor(picture(), requires_grad=True))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda t: t.to("meta"), "pattern is a Tensor .* no numbers"),
        (lambda t: t.to_sparse(), r"pattern is a Tensor .*to_dense\(\)"),
    ],
)
def test_a_tensor_that_cannot_be_read_is_refused_with_advice_for_it(torch, caplog, make, message):
    with pytest.raises(InputTypeError, match=message):
        _ = transport() @ make(torch.tensor(picture()))
    assert caplog.text == ""


def test_functions_of_torch_func_do_not_see_through_a_call(torch):
    derivative = torch.func.grad(lambda light: (transport() @ light).sum())
    with pytest.raises(InputTypeError, match=r"pattern is a Tensor .*torch\.autograd"):
        derivative(torch.tensor(picture()))


def test_a_derivative_of_forward_mode_is_refused_and_not_lost(torch):
    forward_ad = torch.autograd.forward_ad
    light = torch.tensor(picture())
    with forward_ad.dual_level():
        # PyTorch itself compiles formulas at the first dual number, by what it warns of.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            dual = forward_ad.make_dual(light, light)
        with pytest.raises(InputTypeError, match=r"pattern is a Tensor .*forward mode"):
            _ = transport() @ dual


def test_a_tensor_that_requires_a_gradient_is_read_where_none_is_recorded(torch):
    frame = torch.tensor(picture(), requires_grad=True)
    with torch.no_grad(), ltcl.Compensator(transport()) as compensator:
        codes = compensator(frame)
        expected = compensator(frame.detach())
    assert torch.equal(codes, expected)


def test_gradients_of_a_compressed_transport_are_those_of_what_it_is(torch):
    """And with `exact`, or by an inverse, those of what it stands for."""
    T = ltcl.scenes.dihedral(16, albedo=0.8).transport()
    small = ltcl.compress(T, rtol=1e-2)
    desired = torch.full(T.grid, 0.2, dtype=torch.float64, requires_grad=True)
    side = picture(*T.grid, seed=1)
    cases: list[tuple[dict[str, Any], ltcl.Transport, float]] = [
        ({}, small, 1e-2),
        ({"exact": T, "rtol": 1e-5}, T, 1e-5),
        ({"inverse": ltcl.invert(T, 1e-2)}, T, 1e-2),
    ]
    for options, reference, rtol in cases:
        solving = T if "inverse" in options else small
        c: Any = ltcl.compensate(solving, desired, **options)
        (gradient,) = torch.autograd.grad(c.pattern, desired, torch.tensor(side))
        S = reference.systems[0].to_dense()
        expected = np.linalg.solve(S.T, side.ravel() / T.first_bounce)
        error = np.linalg.norm(gradient.numpy().ravel() - expected) / np.linalg.norm(expected)
        assert error < 5 * rtol, options


def test_gradients_with_a_transpose_leave_the_errors_of_a_compressed_system(torch):
    T = ltcl.scenes.dihedral(16, albedo=0.8).transport()
    (S,) = ltcl.compress(T, rtol=1e-2).systems
    errors = (S.solution_error, S.error_bound)
    assert min(errors) > 0
    b = torch.tensor(picture(S.shape[0]), requires_grad=True)
    x: Any = ltcl.solve(S.T, b, rtol=0.1).x
    x.sum().backward()
    assert (S.solution_error, S.error_bound) == errors


def test_patterns_of_several_projectors_have_none(torch):
    matrices = [np.diag([1.0, 1.0, 0.5, 0.1]), np.diag([0.1, 0.5, 1.0, 1.0])]
    T = ltcl.combine([ltcl.Transport(matrix, (2, 2)) for matrix in matrices])
    with pytest.raises(InputError, match="several projectors"):
        ltcl.compensate(T, torch.full((2, 2), 0.3, requires_grad=True))


def test_a_backward_product_costs_one_product_with_the_transpose(torch, monkeypatch):
    T = transport()
    p = torch.tensor(picture(), requires_grad=True)
    loss = (T @ p).sum()
    with counted(monkeypatch) as count:
        loss.backward()
    assert count.products == 1


def test_a_backward_solve_costs_as_much_as_one_with_the_transpose(torch, monkeypatch):
    S: Any = ltcl.scenes.dihedral(20, albedo=0.9).transport().interreflection
    b = torch.tensor(picture(S.shape[0]), requires_grad=True)
    side = picture(S.shape[0], seed=1)
    for method in ("chebyshev", "gmres", "auto"):
        x: Any = ltcl.solve(S, b, method, rtol=1e-4).x
        # What "auto" learns of S^T is learnt once.
        ltcl.solve(S.T, side, method, rtol=1e-4)
        with counted(monkeypatch) as direct:
            ltcl.solve(S.T, side, method, rtol=1e-4)
        with counted(monkeypatch) as backward:
            x.backward(torch.tensor(side))
        assert backward.products <= 1.2 * direct.products, method


def test_a_backward_compensation_costs_a_solve(torch, monkeypatch):
    """Within the bounds one solve with S^T; clipped, no more products than the pattern took."""
    T = ltcl.scenes.dihedral(20, albedo=0.9).transport()
    (S,) = T.systems
    side = picture(*T.grid, seed=1)
    for level, has_clipped in ((0.1, False), (0.6, True)):
        desired = torch.tensor(level * picture(*T.grid, high=1.0) + 0.1, requires_grad=True)
        c: Any = ltcl.compensate(T, desired, rtol=1e-3)
        assert (c.clipped > 0) == has_clipped
        ltcl.solve(S.T, side.ravel(), rtol=1e-3)
        with counted(monkeypatch) as direct:
            ltcl.solve(S.T, side.ravel(), rtol=1e-3)
        with counted(monkeypatch) as backward:
            c.pattern.backward(torch.tensor(side))
        most = c.limited[0].products if has_clipped else direct.products
        assert backward.products <= 1.2 * most


@pytest.mark.parametrize("weighted", [False, True])
def test_a_backward_clipped_compensation_costs_one_adjoint_solve(torch, monkeypatch, weighted):
    """At most 1.2 times the products of SciPy's conjugate gradients on the free pixels."""
    T = ltcl.scenes.dihedral(20, albedo=0.9).transport()
    side = picture(*T.grid, seed=1)
    weights = picture(*T.grid, seed=2) + 0.5 if weighted else None
    desired = torch.tensor(1.6 * picture(*T.grid, high=1.0), requires_grad=True)
    c: Any = ltcl.compensate(T, desired, rtol=1e-3, weights=weights)
    free = c.free_pixels().ravel() != 0
    assert 0.1 < free.mean() < 0.9
    reference = AdjointSolve(T, free, weights)
    expected = reference.gradient(side)
    with counted(monkeypatch) as backward:
        c.pattern.backward(torch.tensor(side))
    error = np.linalg.norm(desired.grad.numpy().ravel() - expected) / np.linalg.norm(expected)
    # Both are as near to the solution as the tolerance of the compensation.
    assert error < 5e-3
    assert reference.products > 4
    assert 0 < backward.products <= 1.2 * reference.products


class AdjointSolve:
    """W^2 S_f q with S_f^T W^2 S_f q = F^-1 g, in float64, which counts products."""

    def __init__(self, T: Any, free: np.ndarray, weights: np.ndarray | None) -> None:
        (S,) = T.systems
        self.first_bounce = T.first_bounce[free].astype(np.float64)
        self.A = S.to_dense().astype(np.float64)[:, free]
        self.squares = np.ones(len(free)) if weights is None else weights.ravel() ** 2
        self.free = free
        self.products = 0

    def gradient(self, side: np.ndarray) -> np.ndarray:
        count = len(self.first_bounce)
        operator: Any = scipy.sparse.linalg.LinearOperator
        equations = operator((count, count), matvec=self._equations, dtype=np.float64)
        b = side.ravel()[self.free] / self.first_bounce
        # The tolerance of the compensation.
        q, info = scipy.sparse.linalg.cg(equations, b, rtol=1e-3)
        assert info == 0
        self.products += 1
        return self.squares * (self.A @ q)

    def _equations(self, q: np.ndarray) -> np.ndarray:
        self.products += 2
        return self.A.T @ (self.squares * (self.A @ q))
