# SPDX-License-Identifier: BSD-3-Clause
"""Values that cross between host and device again and again, such as the frames of a film.

A device with memory of its own copies by two queues beside that of kernels, one for each direction,
and from memory of the host that stays in its place ("pinned"): the next frame comes up and the last
one goes down while kernels are at work. Queues know nothing of each other; what has to come first
is said by events. A device that shares the host's memory copies in its one queue, from any memory.

`LTCL_TRANSFERS` chooses, "pinned" or "direct".
"""

from __future__ import annotations

import abc
import os
from typing import TYPE_CHECKING, Any

import numpy as np

from ltcl.device import driver_errors
from ltcl.device.arrays import Array
from ltcl.device.profile import DOWNLOAD, UPLOAD
from ltcl.errors import InputError

if TYPE_CHECKING:
    from ltcl.device.device import Device

VARIABLE = "LTCL_TRANSFERS"
PINNED = "pinned"
DIRECT = "direct"


def upload(array: Array) -> Upload:
    """The way of the host's values into `array`, as suits its device."""
    if are_pinned(array.device):
        return PinnedUpload(array)
    return DirectUpload(array)


def download(array: Array) -> Download:
    """The way of the values of `array` to the host, as suits its device."""
    if are_pinned(array.device):
        return PinnedDownload(array)
    return DirectDownload(array)


def are_pinned(device: Device) -> bool:
    """True if transfers go by pinned memory and queues of their own.

    InputError if `LTCL_TRANSFERS` is not one of its two values.
    """
    chosen = os.environ.get(VARIABLE)
    if chosen and chosen not in (PINNED, DIRECT):
        raise InputError(f"LTCL_TRANSFERS is {chosen!r}; it must be 'pinned' or 'direct'")
    if chosen:
        return chosen == PINNED
    return not device.is_cpu and not device.handle.host_unified_memory


class Upload(abc.ABC):
    """Values of the host on their way into `array`, again and again."""

    def __init__(self, array: Array) -> None:
        self.array = array
        self._host = np.empty(0)
        self._sent: Any = None

    @property
    def host(self) -> np.ndarray:
        """The array to write the next values to; waits until the last ones have left it."""
        if self._sent is not None:
            self._sent.wait()
            self._sent = None
        return self._host

    @abc.abstractmethod
    def send(self) -> None:
        """Queue a copy of `host`; launches that are queued later find its values in `array`."""

    @abc.abstractmethod
    def release(self, read: Any) -> None:
        """Let the next values come when the launch with the event `read` has ended."""


class Download(abc.ABC):
    """Values of `array` on their way to the host, again and again."""

    def __init__(self, array: Array) -> None:
        self.array = array
        self._host = np.empty(0)
        self._sent: Any = None

    @abc.abstractmethod
    def make_room(self) -> None:
        """Let launches that are queued later wait until the last copy has left `array`."""

    @abc.abstractmethod
    def send(self, written: Any) -> None:
        """Queue a copy of what the launch with the event `written` leaves in `array`."""

    @abc.abstractmethod
    def take(self) -> np.ndarray:
        """Wait for the last copy; the result belongs to the caller."""

    def __del__(self) -> None:
        # Its array goes back to the pool, where a copy would not be seen.
        if getattr(self, "_sent", None) is not None:
            self._sent.wait()


class DirectUpload(Upload):
    """Uploads by the queue of kernels, in which the order is that of the calls."""

    def __init__(self, array: Array) -> None:
        super().__init__(array)
        self._host = np.empty(array.shape, array.dtype)

    def send(self) -> None:
        """Queue a copy of `host`."""
        self._sent = self.array.device.queue_copy(self.array.buffer, self._host)

    def release(self, read: Any) -> None:
        """Do nothing: the next copy is queued behind that launch."""


class DirectDownload(Download):
    """Downloads by the queue of kernels, in which the order is that of the calls."""

    def __init__(self, array: Array) -> None:
        super().__init__(array)
        self._host = np.empty(array.shape, array.dtype)

    def make_room(self) -> None:
        """Do nothing: later launches are queued behind the last copy."""

    def send(self, written: Any) -> None:
        """Queue a copy to `host`."""
        self._sent = self.array.device.queue_copy(self._host, self.array.buffer)

    def take(self) -> np.ndarray:
        """Wait, and hand over the memory itself; the next copy gets new memory."""
        self._sent.wait()
        self._sent = None
        host = self._host
        self._host = np.empty_like(host)
        return host


class PinnedUpload(Upload):
    """Uploads by a queue of their own, from pinned memory."""

    def __init__(self, array: Array) -> None:
        super().__init__(array)
        self._memory, self._host = _pinned(array)
        # Launches with what had this memory of the device before.
        self._read = array.device.mark()

    def send(self) -> None:
        """Queue a copy of `host`, behind the launch that reads the last values."""
        device = self.array.device
        queue = device.session.uploads
        self._sent = _queue_copy(device, queue, self.array.buffer, self._host, self._read)
        device.profile_copy(UPLOAD, self._sent, self.array.nbytes)
        device.wait_for(self._sent)

    def release(self, read: Any) -> None:
        """Let the next copy wait for the launch with this event."""
        self._read = read


class PinnedDownload(Download):
    """Downloads by a queue of their own, to pinned memory."""

    def __init__(self, array: Array) -> None:
        super().__init__(array)
        self._memory, self._host = _pinned(array)

    def make_room(self) -> None:
        """Let later launches wait for the last copy."""
        if self._sent is not None:
            self.array.device.wait_for(self._sent)

    def send(self, written: Any) -> None:
        """Queue a copy to `host`, behind the launch that writes the values."""
        device = self.array.device
        # Else another queue would wait for it forever.
        device.flush()
        queue = device.session.downloads
        self._sent = _queue_copy(device, queue, self._host, self.array.buffer, written)
        device.profile_copy(DOWNLOAD, self._sent, self.array.nbytes)

    def take(self) -> np.ndarray:
        """Wait, and copy the values: the memory serves the next ones."""
        self._sent.wait()
        self._sent = None
        return self._host.copy()


def _pinned(array: Array) -> tuple[Any, np.ndarray]:
    """Memory of the host that the driver keeps in its place, and its values like `array`."""
    device = array.device
    cl = device.cl
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.ALLOC_HOST_PTR
    both_ways = cl.map_flags.READ | cl.map_flags.WRITE
    with driver_errors.translated(f"pinning memory for {device.name}"):
        device.allocations += 1
        memory = cl.Buffer(device.context, flags, max(array.nbytes, 1))
        # By a queue that does not wait for kernels.
        queue = device.session.uploads
        host, _ = cl.enqueue_map_buffer(queue, memory, both_ways, 0, array.shape, array.dtype)
    return memory, host


def _queue_copy(device: Device, queue: Any, destination: Any, source: Any, after: Any) -> Any:
    """Queue a copy in a queue of transfers behind an event, and start it."""
    with driver_errors.translated(f"copying on {device.name}"):
        event = device.cl.enqueue_copy(
            queue, destination, source, is_blocking=False, wait_for=[after]
        )
        queue.flush()
    return event
