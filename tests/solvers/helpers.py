# SPDX-License-Identifier: BSD-3-Clause
"""The methods that the tables of this folder run over."""

from __future__ import annotations

from typing import Any

from ltcl.device import Device
from ltcl.device.kernels import Kernel
from ltcl.solvers.solve import ITERATIVE as _ITERATIVE
from ltcl.solvers.solve import METHODS as ALL
from ltcl.solvers.solve import SAMPLED as _SAMPLED

ITERATIVE = tuple(_ITERATIVE)
METHODS = tuple(method for method in ALL if method not in _SAMPLED)  # those that keep a tolerance
READS_ROWS = (
    "gauss_seidel",
    "sor",
    "block_gauss_seidel",
    "southwell",
)  # methods that refuse operators whose entries cannot be read


def small_blocks(method: str, block: int = 4) -> dict[str, Any]:
    """Options with which a method takes steps even where N is small: one block of all rows solves at once."""
    return {"block": block} if method == "block_gauss_seidel" else {}


def force_groups(monkeypatch: Any, device: Device, group: int) -> None:
    """Let all kernels run with work-groups of one size, as far as the device allows it."""
    monkeypatch.setattr(device, "reductions", {})  # what was planned for other groups does not fit these
    real = Kernel.group

    def forced(kernel: Kernel, wanted: Any) -> Any:
        wanted = group if isinstance(wanted, int) else tuple(min(n, group) for n in wanted)
        return real(kernel, wanted)

    monkeypatch.setattr(Kernel, "group", forced)


__all__ = ["ALL", "ITERATIVE", "METHODS", "READS_ROWS", "force_groups", "small_blocks"]
