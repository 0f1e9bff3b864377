# SPDX-License-Identifier: BSD-3-Clause
"""The state that CG and BiCGStab keep on the device, (rows, k): names of its rows, and phases.

There are two copies of COPY_ROWS numbers, of which a step reads one, by parity, and writes the
other; then what BiCGStab keeps; from STATE_ROWS on partial sums of squared residuals of SLOTS
steps. `kernels/krylov.cl` gets all of this by `DEFINES`.
"""

from __future__ import annotations

from ltcl.device import ahead
from ltcl.solvers.stopping import SLOTS

STATE_ROWS = 16
COPY_ROWS = 4

# Rows of a copy, CG: <r, r>, alpha, and 1 for a column that met no positive curvature.
CG_SQUARE = 0
CG_ALPHA = 1
CG_INDEFINITE = 2

# Rows of a copy, BiCGStab: rho, and the phase of a column.
BICGSTAB_RHO = 0
BICGSTAB_PHASE = 1

# Rows of the state, BiCGStab: alpha, |r*|^2, and the square that <r*, v> is compared with:
# |S^T r*|^2, or |r*|^2 if S has no transpose.
BICGSTAB_ALPHA = 8
BICGSTAB_SHADOW = 9
BICGSTAB_AGAINST = 10

# Phases of a column of BiCGStab: it moves; has restarted and made no step since; waits for a
# restart by the host; has no step even after a restart; rests, since it is solved.
PHASE_MOVES = 0.0
PHASE_FRESH = 1.0
PHASE_WAITS = 2.0
PHASE_BROKEN = 3.0
PHASE_RESTS = 4.0

DEFINES: dict[str, int | str] = {
    "STATE_ROWS": STATE_ROWS,
    "RESIDUAL_SLOTS": SLOTS,
    "COPY_ROWS": COPY_ROWS,
    "CG_SQUARE": CG_SQUARE,
    "CG_ALPHA": CG_ALPHA,
    "CG_INDEFINITE": CG_INDEFINITE,
    "BICGSTAB_RHO": BICGSTAB_RHO,
    "BICGSTAB_PHASE": BICGSTAB_PHASE,
    "BICGSTAB_ALPHA": BICGSTAB_ALPHA,
    "BICGSTAB_SHADOW": BICGSTAB_SHADOW,
    "BICGSTAB_AGAINST": BICGSTAB_AGAINST,
    "PHASE_MOVES": f"{PHASE_MOVES}f",
    "PHASE_FRESH": f"{PHASE_FRESH}f",
    "PHASE_WAITS": f"{PHASE_WAITS}f",
    "PHASE_BROKEN": f"{PHASE_BROKEN}f",
}
ahead.announce("krylov", DEFINES)


def row_in_copy(row: int, step: int) -> int:
    """Return where a row of a copy is in the state that `step` reads."""
    return step % 2 * COPY_ROWS + row
