# SPDX-License-Identifier: BSD-3-Clause
"""What is timed once per device and then remembered: the fastest of several kernel variants, machine speeds.

`LTCL_TUNE=0` turns timing off: the first variant named is taken, speeds are the constants below, and results
repeat across machines of one kind. Variants agree to rounding, not to the bit.

The memory is a small JSON file in a private folder (mode 0700) of the user's cache, or in the folder that
`LTCL_CACHE` names. It can be lost at any time: then things are measured again, which is no error.
"""

from __future__ import annotations

import contextlib
import functools
import json
import logging
import math
import os
import platform
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import platformdirs
import scipy
import scipy.linalg

from ltcl.device import kernels
from ltcl.device.kernels import Launch
from ltcl.errors import DeviceError, MemoryLimitError

if TYPE_CHECKING:
    from ltcl.device.device import Device

SECONDS = 20e-6  # under LTCL_TUNE=0, of a launch
BANDWIDTH = {True: 2e10, False: 2e12}  # bytes a second, of a CPU or not
FLOPS = 5e10  # a second, of a factorization

log = logging.getLogger(__name__)
_REPEATS = 5
_TRIAD_BYTES = 1 << 26  # of one of its three arrays: beyond the caches
_FACTORIZED = 768  # rows


def choose(device: Device, file: str, problem: str, variants: Mapping[str, Callable[[], None]]) -> str:
    """Name of the fastest of `variants`, each of which queues a launch, for this class of `problem`.

    `problem` names what is alike enough to share an answer, for instance "k=8 width=512"; a change of the
    kernel `file` asks for a new measurement. Under ``LTCL_TUNE=0`` the first variant is taken, untimed.
    """
    names = list(variants)
    if len(names) == 1 or _off():
        return names[0]
    key = _key(device, kernels.load(file).digest[:16], problem, ",".join(names))
    if recall(key) in names:
        return recall(key)
    times = {name: _time(launch, device.finish) for name, launch in variants.items()}
    best = min(times, key=times.__getitem__)
    if times[best] == math.inf:
        raise DeviceError(f"no variant of kernels/{file}.cl runs on {device.name} ({device.driver})")
    log.info("%s on %s, %s: %s of %s", file, device.name, problem, best, times)
    remember(key, best)
    return best


def seconds(device: Device, key: str, launch: Callable[[], object], default: float = SECONDS) -> float:
    """Seconds that `launch` takes on `device`, waiting included; measured once and remembered as `key`.

    Under ``LTCL_TUNE=0``, and on a simulator, the answer is `default`.
    """
    if device.kind == "simulator":
        return default
    return _measured(_key(device, key), lambda: _time(launch, device.finish), default)


def bandwidth(device: Device) -> float:
    """Bytes a second that the device moves at best, by our own triad a = s b + c: two reads, one write."""
    nbytes = min(_TRIAD_BYTES, device.max_allocation // 4)

    @functools.cache
    def triad() -> Launch:
        arrays = (device.empty(nbytes // 4) for _ in range(3))
        return device.kernel("vector", "vector_triad").bind(nbytes // 32, 64, nbytes // 32, 0.5, *arrays)

    default = 3 * nbytes / BANDWIDTH[device.is_cpu]
    return 3 * nbytes / seconds(device, f"triad of {nbytes} bytes", lambda: triad()(), default)


def factorization_flops() -> float:
    """Operations a second of this host's LAPACK, in an LU factorization in float64."""
    matrix = np.random.default_rng(0).standard_normal((_FACTORIZED, _FACTORIZED))
    work = 2 / 3 * _FACTORIZED**3
    key = f"{platform.node()}|{os.cpu_count()} cores|scipy {scipy.__version__}|factorization"
    return work / _measured(key, lambda: _time(lambda: scipy.linalg.lu_factor(matrix)), work / FLOPS)


def _key(device: Device, *what: str) -> str:
    return "|".join((device.name, device.driver, *what))


def _off() -> bool:
    return os.environ.get("LTCL_TUNE") == "0"


def _measured(key: str, measure: Callable[[], float], default: float) -> float:
    """What is remembered as `key`, else measured now; `default` where timing is off."""
    if _off():
        return default
    known = recall(key)
    if isinstance(known, float) and 0 < known < math.inf:
        return known
    measured = measure()
    if not measured < math.inf:
        raise DeviceError(f"{key}: nothing to measure, it does not run")
    remember(key, measured)
    return measured


def _time(run: Callable[[], object], wait: Callable[[], object] = lambda: None) -> float:
    """Best of a few runs: the minimum is what the code can do, the rest is the machine's noise."""
    try:
        run()  # builds
        wait()
        best = math.inf
        for _ in range(_REPEATS):
            start = time.perf_counter()
            run()
            wait()
            best = min(best, time.perf_counter() - start)
        return best
    except (DeviceError, MemoryLimitError) as error:  # the latter where a group asks for too many registers
        log.info("a variant failed and is left out: %s", error)
        return math.inf


def folder() -> Path:
    """The cache folder; it may not exist yet."""
    named = os.environ.get("LTCL_CACHE")
    return Path(named) if named else Path(platformdirs.user_cache_dir("ltcl", appauthor=False))


def make_folder() -> Path:
    """The cache folder, created for its owner only where it is missing."""
    path = folder()
    path.mkdir(mode=0o700, parents=True, exist_ok=True)  # an existing folder keeps its mode: it is the user's
    return path


def recall(key: str) -> Any:
    """What is remembered as `key`, or None."""
    return _memory().get(key)


def remember(key: str, value: Any) -> None:
    """Remember `value` (plain JSON) as `key`, in a file replaced whole; an unwritable folder forgets it."""
    content, aside = json.dumps({**_memory(), key: value}, indent=1, sort_keys=True), ""
    try:
        handle, aside = tempfile.mkstemp(dir=make_folder(), prefix=".tuning.json.")
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            stream.write(content)
        os.replace(aside, folder() / "tuning.json")
    except OSError as error:
        log.debug("%s is not remembered: %s", key, error)
        with contextlib.suppress(OSError):
            os.unlink(aside)


def _memory() -> dict[str, Any]:
    try:
        content = json.loads((folder() / "tuning.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
