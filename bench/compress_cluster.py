# SPDX-License-Identifier: BSD-3-Clause
"""Compression by workers of one core each: the corner of `resolution131k.py`, by one of them and by two.

Dask workers make, transform and threshold blocks of rows, then of the columns that are left. Each
is bound to a core, with one thread for OpenCL; one is timed after the other, and the numbers must
have the same bits.
"""

from __future__ import annotations

import os
import resource
import time

import numpy as np
from distributed import Client, LocalCluster

from _coefficients import note
from _corner import Bounce
from _harness import Options, Row, parse_options, report
from ltcl.operators import Wavelet
from ltcl.tasks.compression.bases import CoefficientAnalysis
from ltcl.tasks.compression.coefficients import Coefficients, coefficients
from ltcl.tasks.compression.sources import source
from resolution131k import MEMORY, REFERENCE, THRESHOLD

SHARE = 0.6  # of the time of one worker, which two may take


def compress(given: Options, rows: Bounce, workers: int) -> tuple[Coefficients, float]:
    """The numbers of A, and seconds they took."""
    W, host = CoefficientAnalysis(Wavelet(given.device, rows.grid, "db2")), "127.0.0.1"
    sizes = {"n_workers": workers, "threads_per_worker": 1, "env": {"POCL_MAX_PTHREAD_COUNT": "1"}}
    with (
        LocalCluster(host=host, dashboard_address=f"{host}:0", **sizes) as cluster,
        Client(cluster) as client,
    ):
        for core, address in zip(range(workers), client.scheduler_info()["workers"], strict=True):
            client.run(os.sched_setaffinity, 0, {core}, workers=[address])
        start = time.perf_counter()
        blocks = source("A", rows, MEMORY, client)
        A = coefficients(blocks, W, W, THRESHOLD, first=THRESHOLD / 4)
        spent = time.perf_counter() - start
    note(f"{workers} workers: {spent:.3g} s")
    return A, spent


def main() -> None:
    given = parse_options(__doc__ or "")
    rows = Bounce(8 if given.smoke else 256, REFERENCE)
    (one, slow), (two, fast) = (compress(given, rows, workers) for workers in (1, 2))
    for name in ("indptr", "indices", "data"):
        np.testing.assert_array_equal(getattr(one.core, name), getattr(two.core, name))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    facts = {
        "pixels": rows.shape[0],
        "share of the time": fast / slow,
        "peak memory here, MB": peak,
    }
    row = Row.from_times(
        "numbers of A", "one worker", slow, fast, "s", None if given.smoke else 1 / SHARE
    )
    report(given, "compression by two workers of a core", [row], facts)


if __name__ == "__main__":
    main()
