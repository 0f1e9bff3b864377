# SPDX-License-Identifier: BSD-3-Clause
"""The uncompressed transport beside a compressed one: what tasks take as `exact=`.

The compressed one solves, the exact one judges (`ltcl.solvers.refinement`), and everything that is shown is
of the exact one.
"""

from __future__ import annotations

from typing import Any

from ltcl import checks
from ltcl.errors import InputTypeError
from ltcl.operators import IdentityPlus
from ltcl.transport import Transport, refuse_other, require


def beside(T: Transport, exact: Any) -> tuple[Transport, tuple[IdentityPlus | None, ...]]:
    """The transport that counts, and the S that judges in each channel: T and none where `exact` is None.

    Raises
    ------
    InputError, InputTypeError
        `exact` is no Transport with an S, or not one of the same pixels, colours and first bounce as T.

    Examples
    --------
    >>> T = Transport([[0.5, 0.1], [0.1, 0.5]], grid=(1, 2))
    >>> beside(T, None)[0] is T, beside(T, None)[1]
    (True, (None,))
    """
    if exact is None:
        return T, (None,) * T.channels
    require(T)
    if not isinstance(exact, Transport):
        raise InputTypeError(
            f"exact is a {type(exact).__name__}; it must be a ltcl.Transport: give exact=T, the uncompressed "
            "transport"
        )
    require(exact, name="exact")
    refuse_other("exact", exact, T, "it must be that of T, or T made from exact")
    return exact, exact.systems


def itself(error: float) -> str:
    """Behind a result, what the T that it is of is off by; nothing where that is 0.

    >>> itself(0.0412), itself(0.0)
    (' with a T that itself is off by 0.042', '')
    """
    return f" with a T that itself is off by {checks.upwards(error)}" if error else ""
