# SPDX-License-Identifier: BSD-3-Clause
"""One function of many items on the workers of a Dask cluster: results in order, in bounded memory.

Before its first task a worker says whether it can take part (its version of ltcl, its device, that nobody
else works on its GPU) and gets the function, once. Dask does the tasks of a lost worker again on others; one
that was started again is asked anew. The next item is taken when a result is.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import platform
import secrets
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from ltcl import checks
from ltcl.device import list_devices, open_device
from ltcl.errors import ClusterError, InputError, InputTypeError, LtclError

if TYPE_CHECKING:
    from distributed import Client, Future

logger = logging.getLogger(__name__)
_TRIES = 20  # of an item whose workers are lost, before it is taken for the reason
_PATIENCE = 60.0  # seconds without a worker: what was killed has been started again by then
_PERIOD = 1.0  # seconds between two looks at the list of workers
_GATHER = 5.0  # seconds that a result may take on its way, at first
_PCI = ("pci_domain_id_nv", "pci_bus_id_nv", "pci_slot_id_nv")  # what CUDA_VISIBLE_DEVICES does not renumber

# Of a worker's process: functions of streams, by their tokens; one device, one task.
_functions: dict[str, Callable[[Any], Any]] = {}
_ended: set[str] = set()
_running = threading.Lock()


def stream(
    client: Client,
    function: Callable[[Any], Any],
    items: Iterable[Any],
    *,
    window: int = 3,
    share_gpu: bool = False,
) -> Iterator[Any]:
    """Yield function(item) of each item, in their order, computed on the workers of a Dask client.

    Parameters
    ----------
    client : distributed.Client
    function : callable(item)
        Sent to each worker once, with all it holds, and called by one thread at a time. It may offer two
        methods: `reference()`, a small stand-in for it, or None; and `resolve()` of that on a worker, which
        is the function, or None where it has to be sent after all, or an LtclError, which excludes a worker.
    items : iterable
    window : int
        Items on the way for each worker: one is computed, others are there when it ends.
    share_gpu : bool
        Whether several workers may use one GPU; else all but the first are excluded. A CPU can be shared.

    A worker that is excluded is named with the reason in a warning.

    Raises
    ------
    ClusterError
        No worker can take part or, for a minute, none is left; the scheduler is lost; an item loses workers.
    LtclError
        Of `function`, at the place of its item.

    Examples
    --------
    >>> from distributed import Client
    >>> with Client(processes=False, n_workers=1, dashboard_address=None) as client:
    ...     list(stream(client, abs, [-1, -2, 3]))
    [1, 2, 3]
    """
    require(client)
    crew, window = _Crew(client, function, share_gpu), checks.count("window", window)
    try:
        for item in items:
            while crew.tasks and len(crew.tasks) >= window * len(crew.ready):
                yield crew.result()
            crew.tasks.append(_Task(_Item(item)))
            crew.submit(crew.tasks[-1])
        while crew.tasks:
            yield crew.result()
    finally:
        crew.leave()


def require(client: Any) -> None:
    """Refuse what is no connected `distributed.Client`, and that Dask is missing."""
    if not isinstance(client, _distributed().Client):
        raise InputTypeError(f"client is a {type(client).__name__}; it must be a distributed.Client")
    if client.status != "running":
        raise ClusterError(f"client is {client.status}; it must be connected to a scheduler")


@contextlib.contextmanager
def connect(cluster: str, workers: int | None = None, device: str | None = None) -> Iterator[Client]:
    """A client of the scheduler at an address or, "local", of `workers` processes that end with the block.

    These have a GPU each; or share `device`, by default that of LTCL_DEVICE, or the CPU and its cores. By
    default they are as many as there are GPUs, or one. ClusterError where nothing answers.
    """
    dask = _distributed()
    with contextlib.ExitStack() as stack:
        if cluster == "local":
            same = device or os.environ.get("LTCL_DEVICE")
            gpus = [] if same else [each.index for each in list_devices() if each.kind == "gpu"]
            count = checks.count("workers", max(1, len(gpus)) if workers is None else workers)
            cores = {} if gpus else {"POCL_MAX_PTHREAD_COUNT": str(max(1, (os.cpu_count() or 1) // count))}
            names = gpus or [same or open_device().description.index]
            local = {"host": "127.0.0.1", "dashboard": False, "dashboard_address": "127.0.0.1:0"}
            one = {**local, "nthreads": 1, "memory_limit": 0}
            nannies = [{**one, "env": {**cores, "LTCL_DEVICE": names[k % len(names)]}} for k in range(count)]
            specification = {k: {"cls": dask.Nanny, "options": nanny} for k, nanny in enumerate(nannies)}
            scheduler = {"cls": dask.Scheduler, "options": local}
            address = dask.SpecCluster(specification, scheduler, silence_logs=logging.CRITICAL)
            stack.enter_context(address)
        elif workers is not None:
            raise InputError(f"workers is {workers}, but the cluster at {cluster} has its own")
        else:
            address = cluster
        try:
            client = stack.enter_context(dask.Client(address, set_as_default=False))
        except (OSError, ValueError) as error:
            reason = " ".join(str(error).split())
            raise ClusterError(f"cluster is {cluster!r}, where no scheduler answers: {reason}") from None
        yield client


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        raise ClusterError(f"a cluster needs Dask ({error}); pip install 'ltcl[batch]'") from None
    return distributed


class _Item:
    """Around an item: Dask looks for its own keys in lists and texts."""

    def __init__(self, value: Any) -> None:
        self.value = value


@dataclass(eq=False)
class _Task:
    item: _Item
    future: Any = None
    workers: frozenset[str] = frozenset()  # that may do it
    tries: int = 0


@dataclass(eq=False)
class _Crew:
    """The workers of a stream: those that are ready, asked, or excluded."""

    client: Any
    function: Any
    share_gpu: bool
    tasks: deque[_Task] = field(default_factory=deque)  # in order, until their results are yielded
    ready: set[str] = field(default_factory=set)
    asked: dict[str, tuple[Future, list[tuple[Any, ...]]]] = field(default_factory=dict)  # and what is next
    excluded: set[str] = field(default_factory=set)
    gpus: dict[str, str | None] = field(default_factory=dict)
    token: str = field(default_factory=lambda: f"ltcl-{secrets.token_hex(8)}")
    seen: float = field(default_factory=time.monotonic)  # when some worker was last there
    looked: float = -math.inf
    begun: bool = False  # whether some worker has been ready

    def __post_init__(self) -> None:
        self.dask, self.scheduler = _distributed(), self.client.scheduler.address

    def submit(self, task: _Task) -> None:
        """Send a task to the workers that are ready, when there are some."""
        if task.tries == _TRIES:
            raise ClusterError(f"an item lost its workers {_TRIES} times; it may be what ends them")
        while not self.ready:
            self.look()
            time.sleep(0.0 if self.ready else _PERIOD / 10)
        task.workers, task.tries = frozenset(self.ready), task.tries + 1
        task.future = self._send(task.workers, _work, self.token, task.item)

    def result(self) -> Any:
        """What the first task gives, however many workers it takes."""
        task, patience, answer = self.tasks[0], _GATHER, None
        while answer is None:
            self.look()
            for each in self.tasks:
                if not each.workers & self.ready:  # all of them have gone, and Dask must not choose others
                    self.submit(each)
            try:
                self.dask.wait(task.future, timeout=_PERIOD)
                answer = task.future.result(timeout=patience)
            except TimeoutError:  # not done, or large, or on a worker that has died: then Dask does it again
                patience *= 2
            except (self.dask.CancelledError, self.dask.KilledWorker):
                self.looked = -math.inf
                self.look()  # which raises where it was the scheduler
                self.submit(task)
            if isinstance(answer, str):  # a worker started again at the same address has no function
                self.ready.discard(answer)
                answer = self.submit(task)
        self.tasks.popleft().future.release()
        if answer[1] is not None:
            raise answer[1]
        return answer[0]

    def look(self) -> None:
        """Forget workers that have gone, ask new ones; ClusterError where none can be expected."""
        if self.ready and time.monotonic() < self.looked + _PERIOD:
            return
        self.looked, there = time.monotonic(), None
        with contextlib.suppress(OSError):
            there = set(self.client.nthreads()) if self.client.status == "running" else None
        if there is None:
            raise self._scheduler_lost()
        self.ready &= there
        self.excluded &= there
        for address in self.asked.keys() - there:
            del self.asked[address]
        for address in there - self.ready - self.excluded - self.asked.keys():
            self._ask(address, self._questions())
        for address in [address for address, (future, _) in self.asked.items() if future.done()]:
            self._admit(address)
        self.gpus = {address: gpu for address, gpu in self.gpus.items() if address in there - self.excluded}
        if self.ready or self.asked:
            self.seen = time.monotonic()
        elif (self.excluded and not self.begun) or time.monotonic() > self.seen + _PATIENCE:
            excluded = f"; {len(self.excluded)} take no work, for the reasons above" if self.excluded else ""
            raise ClusterError(f"no worker is left at {self.scheduler}{excluded}")

    def _scheduler_lost(self) -> ClusterError:
        return ClusterError(f"the scheduler at {self.scheduler} was lost")

    def leave(self) -> None:
        """Leave nothing on the scheduler and the workers."""
        workers = [*self.ready, *self.asked]
        sent = [task.future for task in self.tasks if task.future is not None]
        for future in (*sent, *(future for future, _ in self.asked.values())):
            future.release()
        if workers and self.client.status == "running":
            with contextlib.suppress(OSError):
                self.client.run(_leave, self.token, workers=workers, on_error="ignore")

    def _questions(self) -> list[tuple[Any, ...]]:
        """Calls for a worker that is new; each answers False where the next is needed."""
        from ltcl import __version__  # here, because it is set after this module is imported

        reference = self.function.reference() if hasattr(self.function, "reference") else None
        forms = filter(None, (reference, self.function))
        return [(_introduction(), __version__), *((_join, self.token, form) for form in forms)]

    def _ask(self, address: str, questions: list[tuple[Any, ...]]) -> None:
        self.asked[address] = self._send([address], *questions[0]), questions[1:]

    def _admit(self, address: str) -> None:
        """Take the answer of a worker: it is ready, excluded, or asked once more."""
        future, further = self.asked.pop(address)
        try:
            answer = future.result(timeout=_PATIENCE)
        except (TimeoutError, self.dask.CancelledError, self.dask.KilledWorker):
            return  # gone; or asked from the beginning
        except Exception as error:  # noqa: BLE001 - whatever its ltcl or its driver raises
            answer = f"{'' if isinstance(error, LtclError) else type(error).__name__ + ': '}{error}"
        finally:
            future.release()  # now: a traceback may hold it for long
        if isinstance(answer, tuple):
            name, gpu = answer
            others = [other for other in self.gpus if self.gpus[other] == gpu]
            self.gpus[address], answer = gpu, False
            if gpu and others and not self.share_gpu:
                answer = f"{name} is the GPU of worker {others[0]}; give it an LTCL_DEVICE, or share_gpu=True"
        if answer is True:
            self.ready.add(address)
            self.begun = True
        elif answer is False:
            self._ask(address, further)
        else:
            self.excluded.add(address)
            logger.warning("worker %s takes no work: %s", address, " ".join(answer.split()))

    def _send(self, workers: Iterable[str], *call: Any) -> Future:
        if self.client.status != "running":
            raise self._scheduler_lost()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of large arguments, which `window` bounds
            try:
                return self.client.submit(*call, workers=[*workers], pure=False)
            except (TypeError, AttributeError, ValueError) as error:
                reason = " ".join(str(error.__cause__ or error.__context__ or error).split())
                raise InputTypeError(f"what workers need cannot be sent to them: {reason:.200}") from error


# What runs on workers


def _introduction() -> Callable[[str], Any]:
    """Name and GPU of a worker. A local function is sent as code: there may be another ltcl, or none."""

    def introduce(version: str) -> Any:
        try:
            from ltcl import __version__, cluster
        except ImportError as error:
            return f"it cannot import ltcl: {error}"
        if __version__ != version:
            return f"it has ltcl {__version__}, and the client {version}"
        return cluster.describe()

    return introduce


def describe() -> tuple[str, str | None]:
    """Name of the device, and of a GPU what no other has; DeviceError where there is no device."""
    device = open_device()
    place = [device.description.index]
    with contextlib.suppress(AttributeError, device.cl.Error):  # of other drivers than NVIDIA's
        place = [str(getattr(device.handle, name)) for name in _PCI]
    return device.name, f"{platform.node()} {' '.join(place)}" if device.kind == "gpu" else None


def _join(token: str, function: Any) -> bool:
    """Keep the function of a stream; False where it cannot be had by reference."""
    resolved = function.resolve() if hasattr(function, "resolve") else function
    if resolved is not None and token not in _ended:
        _functions[token] = resolved
    return resolved is not None


def _work(token: str, item: _Item) -> tuple[Any, LtclError | None] | str:
    """Result or error of an item; the address of a worker that was started after the function was sent."""
    if (function := _functions.get(token)) is None:
        from distributed import get_worker

        return get_worker().address
    with _running:
        try:
            return function(item.value), None
        except LtclError as error:  # without what it holds, which may lie on the device
            return None, type(error)(*error.args)


def _leave(token: str) -> None:
    _ended.add(token)
    _functions.pop(token, None)
