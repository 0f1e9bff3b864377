# SPDX-License-Identifier: BSD-3-Clause
"""Operators R~ = P + W_out^T C W_in of two cores: how each is stored, and the sum of both."""

from __future__ import annotations

import numpy as np
import scipy.sparse

from ltcl.compression import cores
from ltcl.compression.cores import Core
from ltcl.compression.kinds import Kind
from ltcl.device import Device
from ltcl.operators import Compressed, Operator, Sum

Sparse = scipy.sparse.csr_array


def summed(
    kind: Kind, P: Operator, C: Operator, error: float = 0.0, diagonal: np.ndarray | None = None
) -> Sum:
    """P + out^T C into; `diagonal` is that of R."""
    rest = None if diagonal is None else diagonal - P.diagonal()
    smooth = Compressed(C, kind.out, kind.into, error=error, diagonal=rest)
    return Sum(Compressed(P, None, None, error=0.0), smooth)


def parts(R: Sum) -> tuple[Operator, Operator]:
    """The cores P and C of such a sum."""
    P, C = (A.core for A in R.operators if isinstance(A, Compressed))
    return P, C


def best(device: Device, kind: Kind, P: Sparse, C: Sparse, allowance: float, budget: float) -> Core:
    """Cores for both, as `cores.best` has them; `operator` is the sum, `format` and `precision` name C first.

    The 2-norm of what both round is at most the sum of theirs, and each may have half. Of the budget C has as
    much as of the numbers, and P the rest.
    """
    share, half = C.nnz / max(P.nnz + C.nnz, 1), 0.5 * allowance
    smooth = cores.best(device, C, half, share * budget)
    sharp = cores.best(device, P, half, budget - smooth.nbytes)
    timed = smooth.seconds is not None and sharp.seconds is not None
    return Core(
        summed(kind, sharp.operator, smooth.operator),
        _named(smooth.format, sharp.format),
        smooth.width,
        _named(smooth.precision, sharp.precision),
        smooth.nbytes + sharp.nbytes,
        smooth.quantisation + sharp.quantisation,
        (smooth.seconds or 0.0) + (sharp.seconds or 0.0) if timed else None,
    )


def _named(smooth: str, sharp: str) -> str:
    return smooth if smooth == sharp else f"{smooth} + {sharp}"
