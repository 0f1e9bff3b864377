# SPDX-License-Identifier: BSD-3-Clause
"""PyTorch's tensors, with derivatives of any order of linear calls."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch.autograd import forward_ad

from ltcl.errors import InputTypeError
from ltcl.interop.arrays import Kind
from ltcl.interop.calls import Call, give_result, replaced
from ltcl.interop.host import say_once
from ltcl.interop.linear_map import LinearMap


class TensorKind(Kind):
    """`torch.Tensor`."""

    def read(self, value: Any) -> np.ndarray:
        """The memory of a tensor on the CPU; a copy of one elsewhere, or in bfloat16."""
        if value.requires_grad and not self.is_tracked(value):
            value = self.untracked(value)
        if value.device.type != "cpu":
            place = value.device.type
            value = value.cpu()
            say_once(f"tensors on {place}")
        if value.dtype is torch.bfloat16:
            value = value.float()
        return value.resolve_conj().resolve_neg().numpy()

    def give(self, array: np.ndarray, like: Any) -> Any:
        """A tensor in the memory of the array, if that may be written, where `like` is."""
        if not array.flags.writeable or min(array.strides, default=0) < 0:
            array = array.copy()
        tensor = torch.from_numpy(array)
        dtype = tensor.dtype
        if dtype.is_floating_point and like.dtype.is_floating_point:
            dtype = like.dtype
        return tensor.to(like.device, dtype)

    def is_tracked(self, value: Any) -> bool:
        """True if autograd records what becomes of the tensor, or pushes a derivative forward."""
        if value.requires_grad and torch.is_grad_enabled():
            return True
        return forward_ad.unpack_dual(value).tangent is not None

    def unreadable_advice(self, value: Any) -> str:
        """Advise on a tensor without numbers, or one that is not dense."""
        if value.device.type == "meta":
            return "it has no numbers: give it on another device"
        if value.layout is not torch.strided:
            return "a tensor must be dense: give it as .to_dense()"
        return "torch.func and torch.compile do not see through a call; use torch.autograd"

    def untracked(self, value: Any) -> Any:
        """The tensor out of the graph, in the same memory."""
        return value.detach()

    def differentiate(self, call: Call) -> Any:
        """The result of the numbers, of which one array joins the graph."""
        for name, value in call.arrays.items():
            if _is_tracked(value) and not value.requires_grad:
                raise InputTypeError(
                    f"{name} is a Tensor with a derivative of forward mode, which has none here; "
                    "use backward()"
                )
        numbers = call.run_numpy()
        result = give_result(numbers, call.give)
        tracked = next(value for value in call.arrays.values() if _is_tracked(value))
        derivative = call.derivative(self, tracked)
        name = derivative.result_name
        value = getattr(result, name) if name else result
        linear_map = derivative.linear_map(derivative.state_of(numbers))
        joined = _Linear.apply(derivative.source, linear_map, value)
        return replaced(result, name, joined)


class _Linear(torch.autograd.Function):
    """A linear map of a tensor, whose adjoint is one, too; the value may be known already."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, linear_map: LinearMap, value: Any) -> torch.Tensor:
        ctx.linear_map = linear_map
        if value is not None:
            return value
        return KIND.give(linear_map(KIND.read(x)), x)

    @staticmethod
    def backward(ctx: Any, *gradients: Any) -> Any:
        (gradient,) = gradients
        return _Linear.apply(gradient, ctx.linear_map.T, None), None, None


def _is_tracked(value: Any) -> bool:
    return isinstance(value, torch.Tensor) and KIND.is_tracked(value)


def is_array(cls: type) -> bool:
    """True for the class of tensors, and those that derive from it, such as parameters."""
    return issubclass(cls, torch.Tensor)


KIND = TensorKind()
