# SPDX-License-Identifier: BSD-3-Clause
"""Compression by workers of one core each: the corner of `resolution131k.py`, by one and by two.

Dask workers make, transform and threshold blocks of rows, then of the remaining columns. Each is
bound to a core, with one thread for OpenCL; one is timed after the other, and the numbers must have
the same bits.
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
from ltcl.tasks.compression.basis_pairs import CoefficientAnalysis
from ltcl.tasks.compression.coefficients import Coefficients, coefficients
from ltcl.tasks.compression.sources import source
from resolution131k import BLOCK_BYTES, REFERENCE, THRESHOLD

# Largest time of two workers over that of one.
MAX_SHARE = 0.6
HOST = "127.0.0.1"


def compress(options: Options, rows: Bounce, workers: int) -> tuple[Coefficients, float]:
    """Compute the coefficients of A, and the seconds this took."""
    W = CoefficientAnalysis(Wavelet(options.device, rows.grid, "db2"))
    cluster = LocalCluster(
        host=HOST,
        dashboard_address=f"{HOST}:0",
        n_workers=workers,
        threads_per_worker=1,
        env={"POCL_MAX_PTHREAD_COUNT": "1"},
    )
    with cluster, Client(cluster) as client:
        addresses = client.scheduler_info()["workers"]
        for core, address in zip(range(workers), addresses, strict=True):
            client.run(os.sched_setaffinity, 0, {core}, workers=[address])
        start = time.perf_counter()
        blocks = source("A", rows, BLOCK_BYTES, client)
        A = coefficients(blocks, W, W, THRESHOLD, first=THRESHOLD / 4)
        spent = time.perf_counter() - start
    note(f"{workers} workers: {spent:.3g} s")
    return A, spent


def main() -> None:
    """Run the bench."""
    options = parse_options(__doc__)
    n = 256
    target = 1 / MAX_SHARE
    if options.smoke:
        n = 8
        target = None
    rows = Bounce(n, REFERENCE)
    by_one, seconds_of_one = compress(options, rows, workers=1)
    by_two, seconds_of_two = compress(options, rows, workers=2)
    for name in ("indptr", "indices", "data"):
        first = getattr(by_one.core, name)
        second = getattr(by_two.core, name)
        np.testing.assert_array_equal(first, second)
    facts = {
        "pixels": rows.shape[0],
        "share of the time": seconds_of_two / seconds_of_one,
        "peak memory here, MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    row = Row.from_times(
        "numbers of A", "one worker", seconds_of_one, seconds_of_two, "s", target=target
    )
    report(options, "compression by two workers of a core", [row], facts)


if __name__ == "__main__":
    main()
