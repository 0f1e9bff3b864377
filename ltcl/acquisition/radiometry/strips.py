# SPDX-License-Identifier: BSD-3-Clause
"""Work on a picture in strips of rows, in parallel: temporary arrays then stay in the cache."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor


def in_strips(
    height: int, rows: int, work: Callable[[slice], None], workers: int | None = None
) -> None:
    """Do `work` on slices of at most `rows` (at least one) of `height` rows, in parallel.

    At most so many `workers` have strips in memory; None: one for each core.
    """
    step = max(rows, 1)
    strips = []
    for top in range(0, height, step):
        strips.append(slice(top, min(top + step, height)))
    if len(strips) == 1:
        # A thread takes longer to start than the work on a small picture.
        work(strips[0])
        return
    threads = os.cpu_count() or 1
    if workers is not None:
        threads = min(threads, workers)
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, strips))
