# SPDX-License-Identifier: BSD-3-Clause
"""Tensors that NumPy cannot read are refused by name: with gradients, sparse, in bfloat16."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import ltcl
from ltcl.errors import InputTypeError

MATRIX = np.eye(64) + 0.01
PICTURE = np.full((8, 8), 0.1)
REFUSALS = {
    "a gradient": RuntimeError("Can't call numpy() on Tensor that requires grad."),
    "bfloat16": TypeError("Got unsupported ScalarType BFloat16"),
    "sparse": TypeError("can't convert Sparse layout tensor to numpy.\nUse Tensor.to_dense()"),
}


class Tensor:
    """An array whose numbers are out of NumPy's reach."""

    def __init__(self, array: np.ndarray, error: Exception) -> None:
        self.shape = array.shape
        self.ndim = array.ndim
        self._error = error

    def __array__(self, *arguments: Any, **options: Any) -> np.ndarray:
        raise self._error


def transport() -> ltcl.Transport:
    return ltcl.Transport(MATRIX, (8, 8))


USES: dict[str, Callable[[Callable[[np.ndarray], Tensor]], Any]] = {
    "matrix": lambda tensor: ltcl.Transport(tensor(MATRIX), (8, 8)),
    "matrix[0]": lambda tensor: ltcl.Transport([tensor(MATRIX)] * 3, (8, 8)),
    "first_bounce": lambda tensor: ltcl.Transport(MATRIX, (8, 8), tensor(np.ones(64))),
    "pattern": lambda tensor: transport() @ tensor(PICTURE),
    "desired": lambda tensor: ltcl.compensate(transport(), tensor(PICTURE)),
    "weights": lambda tensor: ltcl.compensate(transport(), PICTURE, weights=tensor(PICTURE)),
    "background": lambda tensor: ltcl.compensate(transport(), PICTURE, background=tensor(PICTURE)),
    "image": lambda tensor: ltcl.separate(transport(), tensor(PICTURE)),
    "b": lambda tensor: ltcl.solve(MATRIX, tensor(np.ones(64))),
    "S": lambda tensor: ltcl.solve(tensor(MATRIX), np.ones(64)),
}


@pytest.mark.usefixtures("device")
@pytest.mark.parametrize("name", USES)
@pytest.mark.parametrize("kind", REFUSALS)
def test_a_tensor_is_refused_by_name(name, kind):
    with pytest.raises(InputTypeError) as caught:
        USES[name](lambda array: Tensor(array, REFUSALS[kind]))
    message = str(caught.value)
    # A matrix to solve with becomes that of an operator.
    named = "matrix" if name == "S" else name
    assert message.startswith(f"{named} is a Tensor")
    assert "\n" not in message


@pytest.mark.usefixtures("device")
def test_a_transport_is_refused_with_advice_that_holds():
    """What the message names is accepted in its place."""
    grey = transport()
    colour = ltcl.Transport([MATRIX] * 3, (8, 8))
    wide = ltcl.Transport(np.ones((64, 32)), (4, 8), camera_grid=(8, 8))
    for T, words in ((grey, "T.interreflection"), (colour, "T.systems"), (wide, "no S")):
        with pytest.raises(InputTypeError, match=words):
            ltcl.solve(T, np.ones(64))
    for S in (grey.interreflection, *colour.systems):
        assert ltcl.solve(S, np.ones(64)).converged
