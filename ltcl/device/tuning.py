# SPDX-License-Identifier: BSD-3-Clause
"""Measurements made once per device and then remembered: fastest kernel variants, machine speeds.

`LTCL_TUNE=0` turns timing off: the first variant is taken, speeds are constants. Variants agree to
rounding. The memory is a JSON file in the user's cache folder, or in that of `LTCL_CACHE`; it may
be deleted.
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
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import platformdirs
import scipy
import scipy.linalg

from ltcl import files
from ltcl.device import sources, vectors
from ltcl.errors import DeviceError, FileError, MemoryLimitError

if TYPE_CHECKING:
    from ltcl.device.device import Device

# Speeds under LTCL_TUNE=0: seconds of a wait and of a launch, bytes per second of a CPU (True) or
# another device, operations per second of a factorization.
SECONDS = 20e-6
LAUNCH_SECONDS = 5e-6
BANDWIDTH = {True: 2e10, False: 2e12}
FLOPS = 5e10

# Runs of which the best counts.
REPEATS = 5
# Bytes of each of the three arrays of a triad: beyond the caches.
TRIAD_BYTES = 1 << 26
# Launches that are timed together.
TIMED_LAUNCHES = 16
# Rows of the matrix that is factorized.
FACTORIZED_ROWS = 768

log = logging.getLogger(__name__)


class Overheads(NamedTuple):
    """Seconds of a launch, and of a wait for its result."""

    launch: float
    wait: float


def choose(
    device: Device, file: str, problem: str, variants: Mapping[str, Callable[[], None]]
) -> str:
    """Name of the fastest of `variants`, each of which queues a launch.

    The answer is remembered for the device, the kernel file and the `problem`. Variants that fail
    are left out; if all do, `DeviceError` is raised.
    """
    names = list(variants)
    if len(names) == 1 or _is_off():
        return names[0]
    checksum = zlib.crc32(sources.load(file).encode())
    version = f"{file} {checksum:08x}"
    key = "|".join((device.name, device.driver, version, problem, ",".join(names)))
    remembered = recall(key)
    if remembered in names:
        return remembered

    times = {}
    for name, launch in variants.items():
        try:
            times[name] = _time_work(device, launch)
        # A MemoryLimitError tells that a group needs too many registers.
        except (DeviceError, MemoryLimitError) as error:
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

    def measure() -> float:
        return _time(launch, device.finish)

    return _measured((device.name, device.driver, key), SECONDS, measure)


def overheads(device: Device) -> Overheads:
    """Seconds of a launch that others follow, and of a dot product of 64 numbers with its wait."""
    if _is_off():
        return Overheads(LAUNCH_SECONDS, SECONDS)
    x = device.empty(64)

    def fill_repeatedly() -> None:
        for _ in range(TIMED_LAUNCHES):
            vectors.fill(x, 0.0)

    wait = seconds(device, "a wait", lambda: vectors.dot(x, x))
    launches = seconds(device, f"{TIMED_LAUNCHES} launches", fill_repeatedly)
    return Overheads(launches / TIMED_LAUNCHES, wait)


def work_seconds(device: Device, key: str, launch: Callable[[], object]) -> float:
    """Seconds that `launch` keeps `device` at work, by its own clock if it has one."""

    def measure() -> float:
        return _time_work(device, launch)

    return _measured((device.name, device.driver, key, "work"), SECONDS, measure)


def bandwidth(device: Device) -> float:
    """Bytes per second that the device moves at best: a triad a b + c y reads two, writes one."""
    nbytes = min(TRIAD_BYTES, device.max_allocation // 4)

    def measure() -> float:
        b, c, out = (vectors.fill(device.empty(nbytes // 4), 1.0) for _ in range(3))
        triad_seconds = _time_work(device, lambda: vectors.axpby(0.5, b, 1.0, c, out))
        return 3 * nbytes / triad_seconds

    key = (device.name, device.driver, f"bandwidth by {nbytes} bytes")
    return _measured(key, BANDWIDTH[device.is_cpu], measure)


def factorization_flops() -> float:
    """Operations per second of a float64 LU factorization on this host."""

    def measure() -> float:
        rng = np.random.default_rng(0)
        matrix = rng.standard_normal((FACTORIZED_ROWS, FACTORIZED_ROWS))
        lu_seconds = _time(lambda: scipy.linalg.lu_factor(matrix), lambda: None)
        return 2 / 3 * FACTORIZED_ROWS**3 / lu_seconds

    key = (platform.node(), f"{os.cpu_count()} cores", f"scipy {scipy.__version__}", "LU, flops")
    return _measured(key, FLOPS, measure)


def _is_off() -> bool:
    return os.environ.get("LTCL_TUNE") == "0"


def _measured(key: tuple[str, ...], default: float, measure: Callable[[], float]) -> float:
    """The number remembered as `key`, else measured now; `default` if timing is off."""
    if _is_off():
        return default
    value = recall("|".join(key))
    is_usable = isinstance(value, float) and 0 < value < math.inf
    if not is_usable:
        value = measure()
        remember("|".join(key), value)
    return value


def _time_work(device: Device, run: Callable[[], object]) -> float:
    """Best of a few runs, in seconds on the device.

    The host's clock is noise below some 30 us; it counts where the device has none, or `run` queues
    nothing.
    """
    if not device.has_clock:
        return _time(run, device.finish)
    spent = []
    # The first run builds kernels.
    for _ in range(1 + REPEATS):
        with device.profile() as profile:
            run()
        if not profile.busy > 0.0:
            return _time(run, device.finish)
        spent.append(profile.busy)
    return min(spent[1:])


def _time(run: Callable[[], object], wait: Callable[[], object]) -> float:
    """Best of a few runs, in seconds."""

    def once() -> None:
        run()
        wait()

    # The first run builds kernels.
    once()
    return min(timeit.repeat(once, number=1, repeat=REPEATS, timer=time.perf_counter))


def folder() -> Path:
    """The cache folder; it may not exist yet."""
    chosen_by_user = os.environ.get("LTCL_CACHE")
    if chosen_by_user:
        return Path(chosen_by_user)
    return Path(platformdirs.user_cache_dir("ltcl", appauthor=False))


def make_folder() -> Path:
    """The cache folder; if it is missing it is created, for its owner only."""
    path = folder()
    # An existing folder keeps its mode: it is the user's.
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    return path


def recall(key: str) -> Any:
    """The value remembered as `key`, or None."""
    return _memory().get(key)


def remember(key: str, value: Any) -> None:
    """Remember `value` (plain JSON) as `key`; nothing is remembered in an unwritable folder.

    The file is replaced whole.
    """
    memory = _memory()
    memory[key] = value
    content = json.dumps(memory, indent=1, sort_keys=True)
    try:
        with files.replace_file(make_folder() / "tuning.json") as temporary:
            temporary.write_text(content, encoding="utf-8")
    except (OSError, FileError) as error:
        log.debug("%s is not remembered: %s", key, error)


def _memory() -> dict[str, Any]:
    """All that is remembered; nothing if the file is missing or damaged."""
    try:
        content = json.loads((folder() / "tuning.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
