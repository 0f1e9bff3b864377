# SPDX-License-Identifier: BSD-3-Clause
"""The uncompressed transport beside a compressed one: what tasks take as `exact=`.

The compressed one solves, the exact one judges (`ltcl.solvers.refinement`), and everything that is shown is
of the exact one.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ltcl.errors import InputError
from ltcl.operators import IdentityPlus
from ltcl.transport import Transport, require

_SAME = 1e-6  # relative difference of first bounces, which float32 hardly tells from none


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
    require(exact, name="exact")
    for name in ("grid", "channels"):
        if getattr(exact, name) != getattr(T, name):
            raise InputError(
                f"exact has {name} {getattr(exact, name)}; it must be that of T, {getattr(T, name)}"
            )
    if not np.allclose(exact.first_bounce, T.first_bounce, rtol=_SAME, atol=0.0):
        raise InputError("exact has another first bounce; it must be that of T, or T made from exact")
    own, others = (np.eye(3) if M is None else M for M in (T.mixing, exact.mixing))
    if not np.array_equal(own, others):
        raise InputError("exact mixes colours in another way; it must mix them as T does")
    return exact, exact.systems
