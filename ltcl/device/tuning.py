# SPDX-License-Identifier: BSD-3-Clause
"""What is timed once per device and then remembered: the fastest of several kernel variants, machine speeds.

`LTCL_TUNE=0` turns timing off: the first variant is taken, speeds are constants. Variants agree to
rounding. The memory is a JSON file in the user's cache, or where `LTCL_CACHE` says; it may be
deleted.
"""

from __future__ import annotations

import json
import logging
import math
import os
import platform
import time
import timeit
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import platformdirs
import scipy
import scipy.linalg

from ltcl import files
from ltcl.device import kernels, vectors
from ltcl.errors import DeviceError, FileError, MemoryLimitError

if TYPE_CHECKING:
    from ltcl.device.device import Device

# Under LTCL_TUNE=0: of a launch; bytes a second, of a CPU or not; a second, of a factorization.
SECONDS, BANDWIDTH, FLOPS = 20e-6, {True: 2e10, False: 2e12}, 5e10

log = logging.getLogger(__name__)
_REPEATS = 5
_TRIAD_BYTES = 1 << 26  # of one of its three arrays: beyond the caches
_FACTORIZED = 768  # rows


def choose(
    device: Device, file: str, problem: str, variants: Mapping[str, Callable[[], None]]
) -> str:
    """The fastest of `variants`, each of which queues a launch; remembered for all of this `problem`."""
    names = list(variants)
    if len(names) == 1 or os.environ.get("LTCL_TUNE") == "0":
        return names[0]
    version = f"{file} {zlib.crc32(kernels.load(file).encode()):08x}"
    key = "|".join((device.name, device.driver, version, problem, ",".join(names)))
    if (known := recall(key)) in names:
        return known
    times = {}
    for name, launch in variants.items():
        try:
            times[name] = _time(launch, device.finish)
        except (
            DeviceError,
            MemoryLimitError,
        ) as error:  # the latter where a group needs too many registers
            log.info("%s of %s fails and is left out: %s", name, file, error)
    if not times:
        raise DeviceError(
            f"no variant of kernels/{file}.cl runs on {device.name} ({device.driver})"
        )
    best = min(times, key=times.__getitem__)
    log.info("%s on %s, %s: %s of %s", file, device.name, problem, best, times)
    remember(key, best)
    return best


def seconds(device: Device, key: str, launch: Callable[[], object]) -> float:
    """Seconds that `launch` takes on `device`, waiting included."""
    return _measured(
        (device.name, device.driver, key), SECONDS, lambda: _time(launch, device.finish)
    )


def bandwidth(device: Device) -> float:
    """Bytes a second that the device moves at best, by a triad a b + c y: two reads, one write."""
    nbytes = min(_TRIAD_BYTES, device.max_allocation // 4)

    def measure() -> float:
        b, c, out = (vectors.fill(device.empty(nbytes // 4), 1.0) for _ in range(3))
        return 3 * nbytes / _time(lambda: vectors.axpby(0.5, b, 1.0, c, out), device.finish)

    key = (device.name, device.driver, f"bandwidth by {nbytes} bytes")
    return _measured(key, BANDWIDTH[device.is_cpu], measure)


def factorization_flops() -> float:
    """Operations a second of a float64 LU factorization on this host."""

    def measure() -> float:
        matrix = np.random.default_rng(0).standard_normal((_FACTORIZED, _FACTORIZED))
        return 2 / 3 * _FACTORIZED**3 / _time(lambda: scipy.linalg.lu_factor(matrix), lambda: None)

    key = (platform.node(), f"{os.cpu_count()} cores", f"scipy {scipy.__version__}", "LU, flops")
    return _measured(key, FLOPS, measure)


def _measured(key: tuple[str, ...], default: float, measure: Callable[[], float]) -> float:
    """What is remembered as `key`, else measured now; `default` where timing is off."""
    if os.environ.get("LTCL_TUNE") == "0":
        return default
    value = recall("|".join(key))
    if not (isinstance(value, float) and 0 < value < math.inf):
        value = measure()
        remember("|".join(key), value)
    return value


def _time(run: Callable[[], object], wait: Callable[[], object]) -> float:
    """Best of a few runs."""

    def once() -> None:
        run()
        wait()

    once()  # builds
    return min(timeit.repeat(once, number=1, repeat=_REPEATS, timer=time.perf_counter))


def folder() -> Path:
    """The cache folder; it may not exist yet."""
    return Path(
        os.environ.get("LTCL_CACHE") or platformdirs.user_cache_dir("ltcl", appauthor=False)
    )


def make_folder() -> Path:
    """The cache folder, created for its owner only where it is missing."""
    path = folder()
    path.mkdir(
        mode=0o700, parents=True, exist_ok=True
    )  # an existing folder keeps its mode: it is the user's
    return path


def recall(key: str) -> Any:
    """What is remembered as `key`, or None."""
    return _memory().get(key)


def remember(key: str, value: Any) -> None:
    """Remember `value` (plain JSON) as `key`, in a file replaced whole; an unwritable folder forgets it."""
    content = json.dumps({**_memory(), key: value}, indent=1, sort_keys=True)
    try:
        with files.replace_file(make_folder() / "tuning.json") as temporary:
            temporary.write_text(content, encoding="utf-8")
    except (OSError, FileError) as error:
        log.debug("%s is not remembered: %s", key, error)


def _memory() -> dict[str, Any]:
    try:
        content = json.loads((folder() / "tuning.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
