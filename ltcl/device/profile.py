# SPDX-License-Identifier: BSD-3-Clause
"""Times of kernels and copies by the clock of a device: `Device.profile`.

Each launch and copy leaves an event, in which the driver notes when it began and ended. Waiting of
the host, and the time between launches, do not count.
"""

from __future__ import annotations

import statistics
import threading
import time
from collections import defaultdict, deque
from dataclasses import dataclass
from typing import Any

UPLOAD = "upload"
DOWNLOAD = "download"
# Within a device, or between two.
COPY = "copy"
COPIES = (UPLOAD, DOWNLOAD, COPY)
# Events that may wait to be read: each holds memory of the driver.
MAX_WAITING = 4096
WIDTH = 34


@dataclass(frozen=True)
class Times:
    """Times of one kernel, or of one kind of copies.

    Attributes
    ----------
    launches : int
    total, median : float
        Seconds on the device: of all, and of the one in the middle.
    nbytes : int
        Bytes that were copied; 0 of a kernel.

    Examples
    --------
    >>> from ltcl.device import Times
    >>> Times(launches=2, total=3e-5, median=1.5e-5).median
    1.5e-05
    """

    launches: int
    total: float
    median: float
    nbytes: int = 0


class Profile:
    """Times of what a device did inside a ``with device.profile()``, known at its end.

    Attributes
    ----------
    kernels : dict of str to Times
        By name, those that took longest first.
    copies : dict of str to Times
        "upload" and "download" between host and device, "copy" within the device or from another.
    seconds : float
        Length of the block by the clock of the host.

    Examples
    --------
    >>> import ltcl, numpy
    >>> S = ltcl.operators.Dense(ltcl.open_device(), numpy.eye(64))
    >>> with S.device.profile() as profile:
    ...     product = S @ numpy.ones(64)
    >>> [times.launches for times in profile.kernels.values()], sorted(profile.copies)
    ([1], ['download', 'upload'])
    >>> profile.copies["upload"].nbytes, 0.0 < profile.copy_share < 1.0
    (256, True)
    """

    def __init__(self) -> None:
        self.kernels: dict[str, Times] = {}
        self.copies: dict[str, Times] = {}
        self.seconds = 0.0
        self._begun_at = time.perf_counter()
        self._waiting: deque[tuple[str, Any, int]] = deque()
        self._reading = threading.Lock()
        self._seconds: defaultdict[str, list[float]] = defaultdict(list)
        self._nbytes: defaultdict[str, int] = defaultdict(int)

    @property
    def busy(self) -> float:
        """Seconds of all kernels and copies, one after the other."""
        return sum(times.total for times in (*self.kernels.values(), *self.copies.values()))

    @property
    def copy_share(self) -> float:
        """Share of `busy` that copies take; 0 where nothing was queued."""
        busy = self.busy
        copies = sum(times.total for times in self.copies.values())
        return copies / busy if busy > 0.0 else 0.0

    def __str__(self) -> str:
        lines = [f"{'':{WIDTH}}  launches    total ms   median us"]
        for name, times in (*self.kernels.items(), *self.copies.items()):
            total = f"{1e3 * times.total:12.3f}"
            lines.append(f"{name:{WIDTH}}{times.launches:10d}{total}{1e6 * times.median:12.1f}")
        busy = f"busy {1e3 * self.busy:.3f} ms of {1e3 * self.seconds:.3f} ms"
        lines.append(f"{busy}, copies {self.copy_share:.0%} of it")
        return "\n".join(lines)

    # For the device.

    def add(self, name: str, event: Any, nbytes: int = 0) -> None:
        """Take note of a launch or copy that was queued."""
        self._waiting.append((name, event, nbytes))
        if len(self._waiting) > MAX_WAITING:
            self._read(only_ended=True)

    def end(self) -> None:
        """Read all times, after the device has done everything."""
        self._read(only_ended=False)
        self.seconds = time.perf_counter() - self._begun_at
        times = {}
        for name, spent in self._seconds.items():
            times[name] = Times(
                launches=len(spent),
                total=sum(spent),
                median=statistics.median(spent),
                nbytes=self._nbytes[name],
            )
        longest_first = sorted(times, key=lambda name: -times[name].total)
        self.kernels = {name: times[name] for name in longest_first if name not in COPIES}
        self.copies = {name: times[name] for name in longest_first if name in COPIES}

    def _read(self, *, only_ended: bool) -> None:
        import pyopencl as cl

        ended = cl.command_execution_status.COMPLETE
        with self._reading:
            while self._waiting:
                name, event, nbytes = self._waiting[0]
                if only_ended and event.command_execution_status != ended:
                    return
                self._waiting.popleft()
                try:
                    nanoseconds = event.profile.end - event.profile.start
                except cl.Error:
                    # Of a copy that was on its way before the profile began.
                    continue
                self._seconds[name].append(1e-9 * nanoseconds)
                self._nbytes[name] += nbytes
