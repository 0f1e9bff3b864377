# SPDX-License-Identifier: BSD-3-Clause
"""The methods that the tables of this folder run over."""

from __future__ import annotations

from typing import Any

from ltcl.solvers.methods import ITERATIVE as _ITERATIVE
from ltcl.solvers.methods import METHODS as ALL
from ltcl.solvers.methods import SAMPLED as _SAMPLED

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


__all__ = ["ALL", "ITERATIVE", "METHODS", "READS_ROWS", "small_blocks"]
