# SPDX-License-Identifier: BSD-3-Clause
"""The fastest of several kernel variants, timed once per device, driver and source, then remembered.

`LTCL_TUNE=0` turns timing off: the first variant named is taken, and results repeat across machines of
one kind. Variants agree to rounding, not to the bit.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from ltcl.device import cache, sources
from ltcl.errors import DeviceError, MemoryLimitError

if TYPE_CHECKING:
    from ltcl.device.device import Device

log = logging.getLogger(__name__)
_FILE = "tuning.json"
_REPEATS = 5


def choose(device: Device, file: str, problem: str, variants: Mapping[str, Callable[[], None]]) -> str:
    """Name of the fastest of `variants` for this class of `problem`.

    Parameters
    ----------
    device : Device
        Where they run.
    file : str
        Stem of the kernel file; a change of its source asks for a new measurement.
    problem : str
        What is alike enough to share an answer, for instance "k=8 width=512".
    variants : mapping of name to callable
        Each queues one launch. The first is the one taken untimed under ``LTCL_TUNE=0``.
    """
    names = list(variants)
    if len(names) == 1 or os.environ.get("LTCL_TUNE", "1") == "0":
        return names[0]
    key = "|".join((device.name, device.driver, sources.load(file).digest[:16], problem, ",".join(names)))
    known = cache.recall(_FILE, key)
    if isinstance(known, str) and known in variants:
        return known
    times = {name: _seconds(device, launch) for name, launch in variants.items()}
    best = min(times, key=times.__getitem__)
    if times[best] == float("inf"):
        raise DeviceError(f"no variant of kernels/{file}.cl runs on {device.name} ({device.driver})")
    log.info("%s on %s, %s: %s of %s", file, device.name, problem, best, times)
    cache.remember(_FILE, key, best)
    return best


def _seconds(device: Device, launch: Callable[[], None]) -> float:
    """Best of a few launches: the minimum is what the code can do, the rest is the machine's noise."""
    try:
        launch()  # builds
        device.finish()
        best = float("inf")
        for _ in range(_REPEATS):
            start = time.perf_counter()
            launch()
            device.finish()
            best = min(best, time.perf_counter() - start)
        return best
    except (DeviceError, MemoryLimitError) as error:  # the latter where a group asks for too many registers
        log.info("a variant failed and is left out: %s", error)
        return float("inf")
