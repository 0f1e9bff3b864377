# SPDX-License-Identifier: BSD-3-Clause
"""JAX's arrays: their kind comes back, under `jit`, `grad` and `vmap`, too."""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.errors import InputError, InputTypeError
from tests.interop.calls import CALLS, GRID, gives_back, picture, transport
from tests.interop.derivatives import COMPENSATE, LINEAR, agrees_with_differences, counted

if importlib.util.find_spec("jax") is None:
    pytest.skip("JAX is not installed: python -m pip install 'ltcl[jax]'", allow_module_level=True)
pytestmark = [pytest.mark.usefixtures("device"), pytest.mark.filterwarnings("error")]


@pytest.fixture(scope="module")
def jax() -> Any:
    import jax

    return jax


def given(jax: Any, array: np.ndarray) -> Any:
    """An array of JAX in its usual float32."""
    return jax.numpy.asarray(array.astype(np.float32))


@pytest.mark.parametrize("call", CALLS)
def test_a_call_gives_back_an_array(jax, call):
    gives_back(CALLS[call], lambda array: given(jax, array), jax.Array)


@pytest.mark.parametrize("name", ["float16", "bfloat16", "float32"])
def test_floats_come_back_in_their_type(jax, name):
    light = jax.numpy.asarray(picture(), name)
    result = transport() @ light
    assert result.dtype == name
    traced = jax.jit(lambda p: transport() @ p)(light)
    assert traced.dtype == name
    np.testing.assert_allclose(np.asarray(traced, np.float32), np.asarray(result, np.float32))


def test_whole_numbers_come_back_as_floats(jax):
    ones = jax.numpy.ones(GRID, "uint8")
    for call in (lambda p: transport() @ p, jax.jit(lambda p: transport() @ p)):
        assert call(ones).dtype == "float32"


def test_double_precision_is_kept_where_jax_has_it(jax):
    with (
        jax.experimental.enable_x64()
        if hasattr(jax.experimental, "enable_x64")
        else (jax.enable_x64(True))
    ):
        b = jax.numpy.asarray(picture(32), "float64")
        S = transport().interreflection
        assert ltcl.solve(S, b).x.dtype == "float64"
        assert jax.jit(lambda b: ltcl.solve(S, b).x)(b).dtype == "float64"


@pytest.mark.parametrize("name", LINEAR)
def test_derivatives_of_linear_calls_are_products_with_the_transpose(jax, name):
    call = LINEAR[name]
    operand = given(jax, call.operand)
    shape = call.run(call.operand).shape
    weights = given(jax, picture(*shape, seed=4))
    result, pull = jax.vjp(jax.jit(call.run), operand)
    np.testing.assert_allclose(result, call.run(call.operand), rtol=1e-4, atol=1e-5)
    expected = call.matrix().T @ np.ravel(weights)
    np.testing.assert_allclose(np.ravel(pull(weights)[0]), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", ["T @ p", "solve"])
def test_second_derivatives_of_linear_calls(jax, name):
    """The Hessian of ||A x||^2 / 2 is A^T A."""
    call = LINEAR[name]

    def loss(x: Any) -> Any:
        return 0.5 * jax.numpy.sum(call.run(x) ** 2)

    hessian = jax.jacrev(jax.grad(loss))(given(jax, call.operand))
    matrix = call.matrix()
    np.testing.assert_allclose(hessian.reshape(32, 32), matrix.T @ matrix, atol=1e-4)


@pytest.mark.parametrize("name", LINEAR)
def test_vmap_over_frames_is_one_call(jax, name, monkeypatch):
    call = LINEAR[name]
    stack = np.stack([call.operand, 0.5 * call.operand, call.operand[::-1]])
    expected = [call.run(x) for x in stack]
    with counted(monkeypatch) as one:
        call.run(stack[0])
    with counted(monkeypatch) as mapped:
        result = jax.vmap(call.run)(given(jax, stack))
    np.testing.assert_allclose(result, expected, rtol=1e-4, atol=1e-5)
    # A solve of three columns may take a step more than that of one.
    assert mapped.products <= 1.5 * one.products + 2
    nested = jax.vmap(jax.vmap(call.run))(given(jax, stack[None]))
    np.testing.assert_allclose(nested[0], expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", COMPENSATE)
def test_gradients_of_compensation_are_solves_on_the_free_pixels(jax, name):
    call = COMPENSATE[name]
    inputs = [given(jax, call.desired)]
    if call.background is not None:
        inputs.append(given(jax, call.background))
    shape = call.run(call.desired, call.background).pattern.shape
    weights = np.random.default_rng(1).standard_normal(shape)

    def loss(*arrays: Any) -> Any:
        return jax.numpy.sum(call.run(*arrays).pattern * weights)

    found = jax.jit(jax.grad(loss, argnums=tuple(range(len(inputs)))))(*inputs)
    names = ("desired", "background")[: len(inputs)]
    gradients = {name: np.asarray(value) for name, value in zip(names, found, strict=True)}
    agrees_with_differences(call, weights, gradients)


def test_vmap_over_frames_of_compensation(jax):
    frames = picture(3, *GRID, high=0.4)
    weights = picture(seed=5, high=1.0) + 0.5

    def pattern(desired: Any, background: Any = BLACK) -> Any:
        return ltcl.compensate(
            transport(), desired, background=background, weights=weights, rtol=1e-5
        ).pattern

    mapped = jax.vmap(pattern)(given(jax, frames))
    expected = [pattern(frame) for frame in frames]
    np.testing.assert_allclose(mapped, expected, atol=1e-3)

    def loss(desired: Any, background: Any) -> Any:
        return jax.numpy.sum(pattern(desired, background) ** 2)

    gradient = jax.grad(loss, argnums=(0, 1))
    together = jax.vmap(gradient, in_axes=(0, None))(given(jax, frames), given(jax, BLACK))
    alone = [gradient(given(jax, frame), given(jax, BLACK)) for frame in frames]
    for k in range(2):
        np.testing.assert_allclose(together[k], [pair[k] for pair in alone], atol=1e-2)


BLACK = picture(seed=6, high=0.05)


def test_only_the_array_that_depends_is_there_while_jax_traces(jax):
    assert np.asarray(jax.jit(lambda d: ltcl.compensate(transport(), d).pattern)(picture())).any()
    with pytest.raises(InputTypeError, match="error has no numbers"):
        jax.jit(lambda d: ltcl.compensate(transport(), d).error)(picture())


@pytest.mark.parametrize(
    ("run", "message"),
    [
        (lambda x: ltcl.separate(transport(), x).direct, "image is a .*Tracer whose derivative"),
        (lambda x: ltcl.compensate(transport(), x, gain="auto").pattern, "gain is 'auto'"),
        (
            lambda x: ltcl.compensate(transport(), picture(), gain=x.sum()).pattern,
            "gain is a .*Tra",
        ),
        (lambda x: ltcl.Compensator(transport())(x), "frame is a .*Tracer .*outside of jit"),
        (lambda x: transport() @ x[:2], "pattern has shape"),
        (lambda x: ltcl.Transport(x, GRID), "matrix is a .*Tracer"),
    ],
)
def test_what_cannot_be_traced_is_refused(jax, run, message):
    with pytest.raises((InputError, InputTypeError), match=message):
        jax.jit(run)(picture())


def test_what_is_wrong_with_traced_numbers_is_said(jax):
    S = transport().interreflection
    solve = jax.jit(lambda b: ltcl.solve(S, b).x)
    with pytest.raises(jax.errors.JaxRuntimeError, match="b has 32 NaN"):
        jax.block_until_ready(solve(np.full(32, np.nan)))
    product = jax.jit(lambda pattern: transport() @ pattern)
    with pytest.raises(jax.errors.JaxRuntimeError, match="pattern has 32 NaN"):
        jax.block_until_ready(product(np.full(GRID, np.nan)))


def test_a_backward_solve_costs_as_much_as_one_with_the_transpose(jax, monkeypatch):
    S: Any = ltcl.scenes.dihedral(20, albedo=0.9).transport().interreflection
    b = given(jax, picture(S.shape[0]))
    side = given(jax, picture(S.shape[0], seed=1))
    _, pull = jax.vjp(lambda b: ltcl.solve(S, b, "chebyshev", rtol=1e-4).x, b)
    with counted(monkeypatch) as direct:
        ltcl.solve(S.T, np.asarray(side), "chebyshev", rtol=1e-4)
    with counted(monkeypatch) as backward:
        pull(side)[0].block_until_ready()
    assert backward.products <= 1.2 * direct.products
