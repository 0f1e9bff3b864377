# SPDX-License-Identifier: BSD-3-Clause
"""Measured light transport T = S F: first bounce, noise, diagnostics, and verdict on its use."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ltcl.transport.transport import Transport

__all__ = ["Transport"]


def __getattr__(name: str) -> Any:
    # Loaded at the first use: solvers import `ltcl.transport.frames`, and a Transport needs the
    # solvers.
    if name != "Transport":
        raise AttributeError(f"module 'ltcl.transport' has no attribute {name!r}")
    from ltcl.transport.transport import Transport

    return Transport
