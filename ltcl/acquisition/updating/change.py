# SPDX-License-Identifier: BSD-3-Clause
"""The rest that a moved transport leaves of the fitted pictures, as a change of its rows.

With pictures y_m of patterns p_m, and the moved transport T, the rows of the change dT are those of
`estimation.regression` for y_m - T p_m: their prior, how much of which scale has changed where, is
learned from the same pictures. So direct light that is brighter now, a crease that falls between
other pixels, and light from beyond the old picture are corrected as far as few pictures show them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.sparse

from ltcl.acquisition.estimation.regression import learn_prior, solve_rows
from ltcl.acquisition.estimation.windows import Windows, sums_under_hats
from ltcl.acquisition.updating.warp import HostTransport, without_negligible

# Light of the change, relative to that of T, before anything is learned of it.
FIRST_CHANGE = 0.3


@dataclass(frozen=True, eq=False, kw_only=True)
class ChangedTransport:
    """The transport with its change, and the change of each pixel's own light, (channels, N)."""

    transport: HostTransport
    own: np.ndarray


def with_change(
    T: HostTransport,
    patterns: np.ndarray,
    pictures: np.ndarray,
    variance: np.ndarray,
    white: np.ndarray,
    progress: Callable[[int], None],
    centres: np.ndarray | None = None,
) -> ChangedTransport:
    """T and the change that pictures (k, N, channels) of patterns (k, N) show.

    `white` is the light under white, (N, channels); `progress` is called with rows that are done;
    `centres` (N,) are the pixels around which rows change, by default their own.
    """
    windows = Windows.of(T.grid)
    if centres is not None:
        windows = replace(windows, nodes=windows.nodes[centres])
    sums = sums_under_hats(T.W, list(patterns))
    residuals = pictures - T.products(patterns)
    is_own = windows.nodes == np.arange(len(windows.nodes))[:, None]
    cores = []
    own = []
    for channel, core in enumerate(T.cores):
        light = np.maximum(white[:, channel], 1e-3 * white[:, channel].max()) * FIRST_CHANGE
        residual = np.ascontiguousarray(residuals[:, :, channel].T)
        noise = np.ascontiguousarray(variance[:, :, channel].T)
        prior = learn_prior(windows, sums, residual, light, progress, noise)
        rows = solve_rows(windows, sums, residual, prior, progress, noise)
        # Pixels of which nothing is known have no rows to be changed.
        is_known = (np.diff(core.indptr) > 0)[:, None]
        mean = np.where(is_known, rows.mean, 0.0)
        cores.append(without_negligible(core + _in_nodes(windows, mean)))
        own.append(np.where(is_own, mean, 0.0).sum(axis=1))
    changed = HostTransport(grid=T.grid, cores=cores, W=T.W)
    return ChangedTransport(transport=changed, own=np.stack(own))


def _in_nodes(windows: Windows, values: np.ndarray) -> Any:
    """Values of the functions of each row, (N, q), at their nodes."""
    row, function = np.nonzero((windows.nodes != windows.absent) & (values != 0.0))
    places = row, windows.nodes[row, function]
    return scipy.sparse.csr_array(
        (values[row, function], places), shape=(len(values), windows.absent)
    )
