# SPDX-License-Identifier: BSD-3-Clause
"""Apply one function to many items on a Dask cluster: results in order, in bounded memory.

A worker that comes is asked for its version of ltcl and its device, and gets the function, before
its first task. Dask does the tasks of a lost worker on others. The next item is taken when a result
is.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import math
import os
import platform
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from ltcl import checks
from ltcl.batch.main_guard import check_main_guard
from ltcl.device import list_devices, open_device
from ltcl.errors import ClusterError, InputError, InputTypeError, LtclError

if TYPE_CHECKING:
    from distributed import Client

logger = logging.getLogger(__name__)

# Attempts of an item whose workers are lost, before the item itself is taken for the cause.
MAX_TRIES = 4
# Seconds without a worker before a stream ends: workers that were killed have restarted by then.
PATIENCE = 60.0
# Seconds between two looks at the list of workers.
PERIOD = 1.0
# Properties of an NVIDIA device that CUDA_VISIBLE_DEVICES does not renumber.
PCI_ADDRESS = ("pci_domain_id_nv", "pci_bus_id_nv", "pci_slot_id_nv")
MAX_PORT = 65535

# In a worker's process: the functions of streams by token, pickled until their first task. The lock
# lets one task run at a time, as there is one device.
_functions: dict[str, Any] = {}
_running = threading.Lock()


def stream(
    client: Client | None,
    function: Callable[[Any], Any],
    items: Iterable[Any],
    *,
    window: int = 3,
    share_gpu: bool = False,
    errors: bool = False,
) -> Iterator[Any]:
    """Yield function(item) of each item, in their order, computed on the workers of a Dask client.

    Parameters
    ----------
    client : distributed.Client, or None: calls are made here, one after the other
    function : callable(item)
        It is sent to each worker once, with all it holds, and called by one thread at a time. A
        worker that cannot unpickle it takes no work.
    items : iterable
    window : int
        Number of items sent to each worker: while one is computed, the others wait there.
    share_gpu : bool
        Let several workers use one GPU; else all but the first are excluded. Workers always share
        a CPU.
    errors : bool
        Yield the error of an item in its place, instead of raising it, which ends the stream.

    Raises
    ------
    ClusterError
        No worker can take part or, for a minute, none is left; the scheduler is lost.
    LtclError
        `function` raised it, at the place of its item; or an item ends its workers, or its result
        cannot be sent.

    Notes
    -----
    A worker that is excluded is named with the reason in a warning.

    Examples
    --------
    >>> from distributed import Client
    >>> with Client(processes=False, n_workers=1, dashboard_address=None) as client:
    ...     list(stream(client, abs, [-1, -2, 3]))
    [1, 2, 3]
    """
    if client is None:
        for item in items:
            yield _attempt(function, item) if errors else function(item)
        return
    window = checks.count("window", window)
    crew = _Crew(
        client=client,
        scheduler=require(client),
        function=_pickled(function),
        share_gpu=share_gpu,
        yields_errors=errors,
    )
    try:
        for item in items:
            while crew.tasks and len(crew.tasks) >= window * len(crew.ready):
                yield crew.result()
            task = _Task(_pickled(item))
            crew.tasks.append(task)
            crew.submit(task)
        while crew.tasks:
            yield crew.result()
    finally:
        crew.leave()


def _attempt(function: Callable[[Any], Any], item: Any) -> Any:
    """The result, or an LtclError without what it holds, which may lie on the device."""
    try:
        return function(item)
    except LtclError as error:
        return type(error)(*error.args)


def is_there(client: Any, path: Any) -> bool:
    """True if all workers see a file or folder; None is no file."""
    require(client)
    if path is None:
        return False
    return all(client.run(os.path.exists, path, on_error="ignore").values())


def require(client: Any) -> str:
    """Return the address of the scheduler of a connected client.

    Anything but a connected `distributed.Client` is refused, and so is a missing Dask.
    """
    if not isinstance(client, _distributed().Client):
        kind = type(client).__name__
        raise InputTypeError(f"client is a {kind}; it must be a distributed.Client")
    if client.status != "running":
        raise ClusterError(f"client is {client.status}; it must be connected to a scheduler")
    return client.scheduler.address


@contextlib.contextmanager
def connect(
    cluster: str, workers: int | None = None, device: str | None = None
) -> Iterator[Client]:
    """Connect to a scheduler, or start worker processes that end with the block.

    Parameters
    ----------
    cluster : str
        The scheduler's host:port, or "local" for processes on this machine.
    workers : int, optional
        Number of local processes; as many as there are GPUs, or one, when not given.
    device : str, optional
        The device that local workers share, LTCL_DEVICE when not given. Without either they have a
        GPU each, or share the CPU, each with all of its cores: with fewer, sums are rounded in
        a different order than without a cluster.

    Raises
    ------
    InputError
        `cluster` is no address, or has workers of its own.
    ClusterError
        Nothing answers at the address; local workers do not start, or are started outside of the
        main guard, by a file that each of them imports.
    """
    distributed = _distributed()
    from dask import config

    is_local = cluster == "local"
    if not is_local:
        _check_address(cluster)
        if workers is not None:
            raise InputError(f"workers is {workers}, but the cluster at {cluster} has its own")
    # Without this, a worker that takes 15 s to start again, on a busy machine, is given up.
    patience = {"distributed.deploy.lost-worker-timeout": f"{PATIENCE}s"}
    if is_local:
        place = _processes(workers, device)
    else:
        place = contextlib.nullcontext(cluster)
    # Lost workers are not logged: one error names them.
    quiet = distributed.utils.silence_logging_cmgr(logging.CRITICAL)
    with place as address, config.set(patience), quiet:
        try:
            if not is_local:
                distributed.comm.resolve_address(cluster)  # fails at once, where Dask would wait
            client = distributed.Client(address, set_as_default=False)
        except (OSError, ValueError) as error:
            reason = " ".join(str(error).split())
            raise ClusterError(
                f"cluster is {cluster!r}, where no scheduler answers: {reason}"
            ) from None
        with client:
            yield client


def _check_address(cluster: str) -> None:
    """Refuse at once what is no host:port; Dask would try for a minute."""
    port = cluster.rpartition(":")[2]
    if not port.isdecimal() or int(port) > MAX_PORT:
        raise InputError(f"cluster is {cluster!r}; it must be 'local' or a scheduler's host:port")


def _processes(workers: int | None, device: str | None) -> Any:
    """Workers on this machine, each with its own environment, unlike those of a LocalCluster."""
    check_main_guard()
    distributed = _distributed()
    devices = _worker_devices(device or os.environ.get("LTCL_DEVICE"))
    count = len(devices) if workers is None else checks.count("workers", workers)
    loopback = {"host": "127.0.0.1", "dashboard": False, "dashboard_address": "127.0.0.1:0"}
    options = {**loopback, "nthreads": 1, "memory_limit": 0, "silence_logs": logging.CRITICAL}
    nannies = {}
    for number in range(count):
        environment = {"LTCL_DEVICE": devices[number % len(devices)]}
        nannies[number] = {
            "cls": distributed.Nanny,
            "options": {**options, "env": environment},
        }
    scheduler = {"cls": distributed.Scheduler, "options": loopback}
    try:
        return distributed.SpecCluster(nannies, scheduler, silence_logs=logging.CRITICAL)
    except (OSError, RuntimeError, TimeoutError) as error:
        reason = " ".join(str(error).split())
        raise ClusterError(
            f"cluster is 'local', but its {count} worker(s) did not start: {reason}"
        ) from None


def _worker_devices(requested: str | None) -> list[str]:
    """Indices of the devices that workers take in turn."""
    if requested:
        return [requested]
    gpus = [description.index for description in list_devices() if description.kind == "gpu"]
    return gpus or [open_device().description.index]


def _distributed() -> Any:
    return checks.load_extra("distributed", "batch", "a cluster", ClusterError)


def _pickled(
    value: Any, problem: str = "what workers need cannot be sent to them", **options: Any
) -> bytes:
    """Pickle a value: Dask looks for no keys in bytes, and a worker reads them when it has ltcl."""
    from distributed.protocol.pickle import dumps

    try:
        return dumps(value, **options)
    except Exception as error:  # whatever the value holds may raise anything
        reason = " ".join(str(error).split())
        raise InputTypeError(f"{problem}: {reason:.200}") from error


@dataclass(eq=False)
class _Task:
    """Item that is being worked on, and its future."""

    item: bytes
    future: Any = None
    data: Any = None  # the item on a worker
    workers: frozenset[str] = frozenset()  # those that may do it
    tries: int = 0

    def submit_again(self) -> None:
        """Forget the workers, so that the task counts as lost."""
        self.workers = frozenset()


@dataclass(eq=False, kw_only=True)
class _Crew:
    """The workers of a stream, and its tasks on them."""

    client: Any
    scheduler: str  # its address
    function: bytes
    share_gpu: bool
    yields_errors: bool
    tasks: deque[_Task] = field(default_factory=deque)  # in order, until their results are yielded
    # Addresses of workers, and their GPUs.
    ready: dict[str, str | None] = field(default_factory=dict)
    excluded: set[str] = field(default_factory=set)
    token: str = field(default_factory=lambda: secrets.token_hex(8))
    has_lost_workers: bool = False  # they may be started again
    last_seen: float = field(default_factory=time.monotonic)  # when some worker was there
    last_look: float = -math.inf

    def submit(self, task: _Task) -> None:
        """Send a task to the workers that are ready, as soon as there are some."""
        self.release(task)
        self.look()
        while not self.ready:
            time.sleep(PERIOD / 10)
            self.look()
        task.workers = frozenset(self.ready)
        task.tries += 1
        rules: Any = {"workers": list(task.workers)}
        argument: Any = task.item
        # An argument stays in memory, here and on the scheduler: Dask keeps a thousand messages. So
        # the item is scattered, unless its workers have gone or are short of memory.
        with contextlib.suppress(OSError, KeyError):
            task.data = self.client.scatter(task.item, hash=False, timeout=PERIOD, **rules)
            argument = task.data
        task.future = self.client.submit(_work, self.token, argument, pure=False, **rules)

    def release(self, task: _Task) -> None:
        """Let the scheduler forget a task; tracebacks of waits in vain hold its futures, too."""
        for future in (task.future, task.data):
            if future is not None:
                future.release()
        task.data = None

    def result(self) -> Any:
        """Result of the first task, however many workers it takes."""
        task = self.tasks[0]
        patience = PERIOD
        outcome = None
        while outcome is None:
            self.look()
            if not self._submit_lost(task):
                error = ClusterError(
                    f"an item lost its workers {MAX_TRIES} times; perhaps it ends them"
                )
                outcome = _Outcome(error=error)
                break
            try:
                outcome = self._wait(task, patience)
            except TimeoutError:
                if task.future.status == "finished":  # large, or on a worker that has died
                    patience *= 2.0
            except (OSError, *_lost_worker_errors()):
                self.last_look = -math.inf  # look at once, and submit it again
                task.submit_again()
            if outcome is not None and outcome.refusal is not None:
                self.admit(*outcome.refusal)
                task.submit_again()
                task.tries = 0
                outcome = None
        self.release(self.tasks.popleft())
        if outcome.error is None:
            return outcome.result
        if self.yields_errors and isinstance(outcome.error, LtclError):
            return outcome.error
        raise outcome.error

    def _submit_lost(self, first: _Task) -> bool:
        """Submit the tasks that have lost all their workers; False if the first has no try left."""
        lost = []
        for task in self.tasks:
            has_workers = bool(task.workers & self.ready.keys())
            if not has_workers or task.future.cancelled():
                lost.append(task)
        if first in lost and first.tries == MAX_TRIES:
            return False
        for task in lost:
            # The last try is made alone: other items may have ended the workers.
            if task is first or task.tries < MAX_TRIES - 1:
                self.submit(task)
        return True

    def _wait(self, task: _Task, patience: float) -> _Outcome | None:
        """Wait for a task for a while; raises TimeoutError, or an error if its worker is lost."""
        from distributed import KilledWorker, wait

        with self.client.as_current():
            # `result` that waits in vain leaves tracebacks behind.
            wait(task.future, timeout=PERIOD)
        if task.future.status == "error":
            error = task.future.exception()
            if isinstance(error, KilledWorker):
                raise error
            return _Outcome(error=error)
        result, refusal = task.future.result(timeout=patience)
        return _Outcome(result=result, refusal=refusal)

    def leave(self) -> None:
        """Leave nothing on the scheduler and the workers, even if a traceback holds this object."""
        self.tasks.clear()
        if self.ready and self.client.status == "running":
            with contextlib.suppress(OSError):
                workers = list(self.ready)
                self.client.run(_leave, self.token, workers=workers, on_error="ignore")

    def look(self) -> None:
        """Forget workers that have gone, ask new ones; ClusterError where none can be expected."""
        is_running = self.client.status == "running"
        is_recent = time.monotonic() < self.last_look + PERIOD
        if is_running and self.ready and is_recent:
            return
        self.last_look = time.monotonic()
        present: list[str] = []
        answers = None
        with contextlib.suppress(OSError):
            if is_running:
                present = list(self.client.nthreads())
                answers = self._ask_new(present)
        if answers is None:
            raise ClusterError(f"the scheduler at {self.scheduler} was lost")
        lost = self.ready.keys() - set(present)
        if lost:
            self.has_lost_workers = True
        for address in lost:
            del self.ready[address]
        self.excluded.intersection_update(present)
        for address, answer in answers.items():
            self.admit(address, answer)
        if self.ready:
            self.last_seen = time.monotonic()
        else:
            self._check_expected()

    def _ask_new(self, present: list[str]) -> dict[str, Any]:
        """Answers of the workers that were not asked yet, by address."""
        known = self.ready.keys() | self.excluded
        new = [address for address in present if address not in known]
        if not new:
            # Dask would send the function to the scheduler all the same, and it may be large.
            return {}
        version = importlib.import_module("ltcl").__version__
        return self.client.run(
            _ask(), version, self.token, self.function, workers=new, on_error="return"
        )

    def _check_expected(self) -> None:
        """ClusterError where no worker is there, and none can be expected to come."""
        is_hopeless = bool(self.excluded) and not self.has_lost_workers
        if not is_hopeless and time.monotonic() <= self.last_seen + PATIENCE:
            return
        reasons = ""
        if self.excluded:
            reasons = f"; {len(self.excluded)} take no work, for the reasons above"
        raise ClusterError(f"no worker is left at {self.scheduler}{reasons}")

    def admit(self, address: str, answer: Any) -> None:
        """Make a worker ready, or exclude it and name it once.

        `answer` is its device, or the reason why it can take no work, empty if it is asked again.
        """
        self.ready.pop(address, None)
        reason = answer
        if isinstance(answer, tuple):
            name, gpu = answer
            sharing = [worker for worker, used_gpu in self.ready.items() if used_gpu == gpu]
            if gpu is None or not sharing or self.share_gpu:
                self.ready[address] = gpu
                return
            advice = "give it an LTCL_DEVICE, or share_gpu=True"
            reason = f"{name} is the GPU of worker {sharing[0]}; {advice}"
        has_gone = isinstance(reason, OSError)
        if reason and not has_gone and address not in self.excluded:
            self.excluded.add(address)
            text = " ".join(str(reason).split())
            logger.warning("worker %s takes no work: %s", address, text)


@dataclass(frozen=True, kw_only=True)
class _Outcome:
    """End of a task: a result, an error, or the reason of a worker that lacks the function."""

    result: Any = None
    error: BaseException | None = None
    refusal: tuple[str, str] | None = None


def _lost_worker_errors() -> tuple[type[BaseException], ...]:
    """Exceptions by which Dask says that the worker of a task is lost."""
    from distributed import CancelledError, KilledWorker

    return CancelledError, KilledWorker


# What runs on workers


def _ask() -> Callable[..., Any]:
    """A function that keeps the function of a stream, if the worker can.

    It is sent as code: a worker may have another ltcl, or none.
    """

    def ask(version: str, token: str, function: bytes) -> Any:
        try:
            version_there = importlib.import_module("ltcl").__version__
            if version_there != version:
                return f"it has ltcl {version_there}, and the client {version}"
            module: Any = importlib.import_module("ltcl.batch.cluster")
            answer = module.describe()
            module._functions[token] = function
            return answer
        except Exception as error:  # noqa: BLE001 - whatever its ltcl or its driver raises
            return f"{type(error).__name__}: {error}"

    return ask


def describe() -> tuple[str, str | None]:
    """Name of the device, and of a GPU a text that no other has; DeviceError without a device."""
    device = open_device()
    if device.kind != "gpu":
        return device.name, None
    place = [device.description.index]
    # Drivers other than NVIDIA's lack the address on the bus.
    with contextlib.suppress(AttributeError, device.cl.Error):
        place = [str(getattr(device.handle, name)) for name in PCI_ADDRESS]
    return device.name, f"{platform.node()} {' '.join(place)}"


def _work(token: str, item: bytes) -> tuple[Any, tuple[str, str] | None]:
    """Result of an item; or the address of this worker, and why it has no such function."""
    from distributed import get_worker
    from distributed.protocol.pickle import loads

    with _running:
        if token not in _functions:  # the worker was started again, at the same address
            return None, (get_worker().address, "")
        try:
            if isinstance(_functions[token], bytes):
                _functions[token] = loads(_functions[token])
        except Exception as error:  # noqa: BLE001 - whatever reads a part of it raises
            return None, (get_worker().address, f"{type(error).__name__}: {error}")
        result = _attempt(_functions[token], loads(item))
        if isinstance(result, LtclError):
            raise result
        problem = "the result cannot be sent from a worker"
        _pickled(result, problem, buffer_callback=lambda buffer: False)
        return result, None


def _leave(token: str) -> None:
    _functions.pop(token, None)
