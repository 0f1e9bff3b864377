# SPDX-License-Identifier: BSD-3-Clause
"""One function of many items on the workers of a Dask cluster: results in order, in bounded memory.

A worker that comes is asked for its version of ltcl and its device, and gets the function, before
its first task. Dask does the tasks of a lost worker on others. The next item is taken when a result
is.
"""

from __future__ import annotations

import contextlib
import importlib
import itertools
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
from ltcl.device import list_devices, open_device
from ltcl.errors import ClusterError, InputError, InputTypeError, LtclError

if TYPE_CHECKING:
    from distributed import Client

logger = logging.getLogger(__name__)
_TRIES = 4  # of an item whose workers are lost, before it is taken for the reason
_PATIENCE = 60.0  # seconds without a worker: what was killed has been started again by then
_PERIOD = 1.0  # seconds between two looks at the list of workers
_PCI = (
    "pci_domain_id_nv",
    "pci_bus_id_nv",
    "pci_slot_id_nv",
)  # what CUDA_VISIBLE_DEVICES does not renumber

# Of a worker's process: functions of streams, by tokens, pickled until the first task; one device,
# one task.
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
        Sent to each worker once, with all it holds, and called by one thread at a time. A worker
        that cannot unpickle it takes no work.
    items : iterable
    window : int
        Items on the way for each worker: one is computed, others are there when it ends.
    share_gpu : bool
        Whether several workers may use one GPU; else all but the first are excluded. A CPU can be
        shared.
    errors : bool
        Whether the error of an item is yielded in its place, and not raised, which ends the stream.

    A worker that is excluded is named with the reason in a warning.

    Raises
    ------
    ClusterError
        No worker can take part or, for a minute, none is left; the scheduler is lost.
    LtclError
        Of `function`, at the place of its item; of one that ends its workers, or whose result
        cannot be sent.

    Examples
    --------
    >>> from distributed import Client
    >>> with Client(processes=False, n_workers=1, dashboard_address=None) as client:
    ...     list(stream(client, abs, [-1, -2, 3]))
    [1, 2, 3]
    """
    if client is None:
        yield from (_attempt(function, item) for item in items) if errors else map(function, items)
        return
    crew = _Crew(client, require(client), _pickled(function), share_gpu, errors)
    window = checks.count("window", window)
    try:
        for item in items:
            while crew.tasks and len(crew.tasks) >= window * len(crew.ready):
                yield crew.result()
            crew.tasks.append(_Task(_pickled(item)))
            crew.submit(crew.tasks[-1])
        while crew.tasks:
            yield crew.result()
    finally:
        crew.leave()


def _attempt(function: Callable[[Any], Any], item: Any) -> Any:
    """Its result, or an LtclError without what it holds, which may lie on the device."""
    try:
        return function(item)
    except LtclError as error:
        return type(error)(*error.args)


def is_there(client: Any, path: Any) -> bool:
    """Whether all workers see a file or folder; None is no file."""
    require(client)
    return path is not None and all(client.run(os.path.exists, path, on_error="ignore").values())


def require(client: Any) -> str:
    """Address of its scheduler; refuses what is no connected `distributed.Client`, and a missing Dask."""
    if not isinstance(client, _distributed().Client):
        raise InputTypeError(
            f"client is a {type(client).__name__}; it must be a distributed.Client"
        )
    if client.status != "running":
        raise ClusterError(f"client is {client.status}; it must be connected to a scheduler")
    return client.scheduler.address


@contextlib.contextmanager
def connect(
    cluster: str, workers: int | None = None, device: str | None = None
) -> Iterator[Client]:
    """A client of the scheduler at an address or, "local", of `workers` processes that end with the block.

    These have a GPU each; or share `device`, by default that of LTCL_DEVICE, or the CPU, each with
    all of its cores: with fewer, sums are rounded in another order than without a cluster. By
    default they are as many as there are GPUs, or one. InputError for what is no address,
    ClusterError where nothing answers.
    """
    distributed = _distributed()
    from dask import config

    port = cluster.rpartition(":")[2]
    if cluster != "local" and not (
        port.isdecimal() and int(port) < 1 << 16
    ):  # Dask would try for a minute
        raise InputError(f"cluster is {cluster!r}; it must be 'local' or a scheduler's host:port")
    if cluster != "local" and workers is not None:
        raise InputError(f"workers is {workers}, but the cluster at {cluster} has its own")
    # Else a worker that takes 15 s to start again, on a busy machine, is given up.
    patience = {"distributed.deploy.lost-worker-timeout": f"{_PATIENCE}s"}
    place = _processes(workers, device) if cluster == "local" else contextlib.nullcontext(cluster)
    quiet = distributed.utils.silence_logging_cmgr(
        logging.CRITICAL
    )  # of whoever is lost: one error says it
    with place as address, config.set(patience), quiet:
        try:
            if cluster != "local":
                distributed.comm.resolve_address(cluster)  # else Dask tries for a while
            client = distributed.Client(address, set_as_default=False)
        except (OSError, ValueError) as error:
            reason = " ".join(str(error).split())
            raise ClusterError(
                f"cluster is {cluster!r}, where no scheduler answers: {reason}"
            ) from None
        with client:
            yield client


def _processes(workers: int | None, device: str | None) -> Any:
    """Workers on this machine, each with an environment of its own, unlike those of a LocalCluster."""
    distributed, quiet = _distributed(), logging.CRITICAL
    device = device or os.environ.get("LTCL_DEVICE")
    gpus = [] if device else [each.index for each in list_devices() if each.kind == "gpu"]
    count = checks.count("workers", max(1, len(gpus)) if workers is None else workers)
    devices = itertools.cycle(gpus or [device or open_device().description.index])
    local = {"host": "127.0.0.1", "dashboard": False, "dashboard_address": "127.0.0.1:0"}
    alike = {**local, "nthreads": 1, "memory_limit": 0, "silence_logs": quiet}
    environments = ({"LTCL_DEVICE": next(devices)} for _ in range(count))
    nannies = (
        {"cls": distributed.Nanny, "options": {**alike, "env": each}} for each in environments
    )
    scheduler = {"cls": distributed.Scheduler, "options": local}
    return distributed.SpecCluster(dict(enumerate(nannies)), scheduler, silence_logs=quiet)


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        raise ClusterError(f"a cluster needs Dask ({error}); pip install 'ltcl[batch]'") from None
    return distributed


def _pickled(
    value: Any, what: str = "what workers need cannot be sent to them", **how: Any
) -> bytes:
    """Bytes: Dask looks for no keys in them, and a worker reads them when it has ltcl."""
    from distributed.protocol.pickle import dumps

    try:
        return dumps(value, **how)
    except Exception as error:  # of whatever it holds
        reason = " ".join(str(error).split())
        raise InputTypeError(f"{what}: {reason:.200}") from error


@dataclass(eq=False)
class _Task:
    item: bytes
    future: Any = None
    data: Any = None  # the item on a worker
    workers: frozenset[str] = frozenset()  # that may do it
    tries: int = 0


@dataclass(eq=False)
class _Crew:
    """The workers of a stream, and its tasks on them."""

    client: Any
    scheduler: str  # its address
    function: bytes
    share_gpu: bool
    errors: bool  # whether they are results
    tasks: deque[_Task] = field(default_factory=deque)  # in order, until their results are yielded
    ready: dict[str, str | None] = field(
        default_factory=dict
    )  # addresses of workers, and their GPUs
    excluded: set[str] = field(default_factory=set)
    token: str = field(default_factory=lambda: secrets.token_hex(8))
    lost: bool = False  # whether some worker has gone, which may be started again
    seen: float = field(default_factory=time.monotonic)  # when some worker was last there
    looked: float = -math.inf

    def submit(self, task: _Task) -> None:
        """Send a task to the workers that are ready, when there are some."""
        self.release(task)
        self.look()
        while not self.ready:
            time.sleep(_PERIOD / 10)
            self.look()
        task.workers, task.tries, argument = frozenset(self.ready), task.tries + 1, task.item
        rules: Any = {"workers": [*task.workers]}
        # An argument stays in memory, here and on the scheduler: Dask keeps a thousand messages.
        with contextlib.suppress(
            OSError, KeyError
        ):  # of workers that have gone, or are short of memory
            argument = task.data = self.client.scatter(
                task.item, hash=False, timeout=_PERIOD, **rules
            )
        task.future = self.client.submit(_work, self.token, argument, pure=False, **rules)

    def release(self, task: _Task) -> None:
        """Let the scheduler forget a task; tracebacks of waits in vain hold its futures, too."""
        for future in (task.future, task.data):
            if future is not None:
                future.release()
        task.data = None

    def result(self) -> Any:
        """What the first task gives, however many workers it takes."""
        from distributed import CancelledError, KilledWorker, wait

        task, patience, result = self.tasks[0], _PERIOD, None
        while True:
            self.look()
            there = self.ready.keys()
            lost = [
                each for each in self.tasks if not each.workers & there or each.future.cancelled()
            ]
            if task in lost and task.tries == _TRIES:
                error = ClusterError(
                    f"an item lost its workers {_TRIES} times; it may be what ends them"
                )
                break
            for each in lost:  # with the item, or all that may do it: Dask must not choose others
                if (
                    each is task or each.tries < _TRIES - 1
                ):  # the last try alone: others may end workers
                    self.submit(each)
            try:
                with self.client.as_current():
                    wait(
                        task.future, timeout=_PERIOD
                    )  # `result` that waits in vain leaves tracebacks behind
                error, refusal = (
                    task.future.exception() if task.future.status == "error" else None,
                    None,
                )
                if isinstance(error, KilledWorker):
                    raise error
                if error is None:
                    result, refusal = task.future.result(timeout=patience)
            except (OSError, CancelledError, KilledWorker) as failure:
                if not isinstance(failure, TimeoutError):
                    self.looked, task.workers = -math.inf, frozenset()  # look, and submit it again
                elif task.future.status == "finished":  # large, or on a worker that has died
                    patience *= 2.0
                continue
            if refusal is None:
                break
            self.admit(*refusal)
            task.workers, task.tries = frozenset(), 0
        self.release(self.tasks.popleft())
        if error is not None and not (self.errors and isinstance(error, LtclError)):
            raise error
        return result if error is None else error

    def leave(self) -> None:
        """Leave nothing on the scheduler and the workers, also where a traceback holds this."""
        self.tasks.clear()
        if self.ready and self.client.status == "running":
            with contextlib.suppress(OSError):
                self.client.run(_leave, self.token, workers=[*self.ready], on_error="ignore")

    def look(self) -> None:
        """Forget workers that have gone, ask new ones; ClusterError where none can be expected."""
        running = self.client.status == "running"
        if running and self.ready and time.monotonic() < self.looked + _PERIOD:
            return
        self.looked, there, answers = time.monotonic(), [], None
        with contextlib.suppress(OSError):
            if running:
                there = [*self.client.nthreads()]
                new = [
                    each for each in there if each not in self.ready and each not in self.excluded
                ]
                question = importlib.import_module("ltcl").__version__, self.token, self.function
                # Dask sends it to the scheduler even where nobody is asked, and a function may be
                # large.
                answers = (
                    self.client.run(_ask(), *question, workers=new, on_error="return")
                    if new
                    else {}
                )
        if answers is None:
            raise ClusterError(f"the scheduler at {self.scheduler} was lost")
        self.lost |= not self.ready.keys() <= {*there}
        self.ready = {address: gpu for address, gpu in self.ready.items() if address in there}
        self.excluded &= {*there}
        for address, answer in answers.items():
            self.admit(address, answer)
        if self.ready:
            self.seen = time.monotonic()
        elif (self.excluded and not self.lost) or time.monotonic() > self.seen + _PATIENCE:
            excluded = (
                f"; {len(self.excluded)} take no work, for the reasons above"
                if self.excluded
                else ""
            )
            raise ClusterError(f"no worker is left at {self.scheduler}{excluded}")

    def admit(self, address: str, answer: Any) -> None:
        """A worker is ready, or excluded and named once; neither where it has gone or is asked again."""
        self.ready.pop(address, None)
        if isinstance(answer, tuple):
            name, gpu = answer
            others = [other for other, its in self.ready.items() if its == gpu]
            if gpu is None or not others or self.share_gpu:
                self.ready[address] = gpu
                return
            answer = f"{name} is the GPU of worker {others[0]}; give it an LTCL_DEVICE, or share_gpu=True"
        if answer and not isinstance(answer, OSError) and address not in self.excluded:
            self.excluded.add(address)
            logger.warning("worker %s takes no work: %s", address, " ".join(str(answer).split()))


# What runs on workers


def _ask() -> Callable[..., Any]:
    """Keeps the function of a stream, if it can; sent as code: a worker may have another ltcl, or none."""

    def ask(version: str, token: str, function: bytes) -> Any:
        try:
            if (theirs := importlib.import_module("ltcl").__version__) != version:
                return f"it has ltcl {theirs}, and the client {version}"
            module: Any = importlib.import_module("ltcl.batch.cluster")
            answer, module._functions[token] = module.describe(), function
            return answer
        except Exception as error:  # noqa: BLE001 - whatever its ltcl or its driver raises
            return f"{type(error).__name__}: {error}"

    return ask


def describe() -> tuple[str, str | None]:
    """Name of the device, and of a GPU what no other has; DeviceError where there is no device."""
    device = open_device()
    place = [device.description.index]
    with contextlib.suppress(AttributeError, device.cl.Error):  # of other drivers than NVIDIA's
        place = [str(getattr(device.handle, name)) for name in _PCI]
    return device.name, f"{platform.node()} {' '.join(place)}" if device.kind == "gpu" else None


def _work(token: str, item: bytes) -> tuple[Any, tuple[str, str] | None]:
    """Result of an item; or the address of this worker, and why it has no such function."""
    from distributed import get_worker
    from distributed.protocol.pickle import loads

    with _running:
        if token not in _functions:  # started again, at the same address
            return None, (get_worker().address, "")
        try:
            if isinstance(_functions[token], bytes):
                _functions[token] = loads(_functions[token])
        except Exception as error:  # noqa: BLE001 - of whatever reads a part of it
            return None, (get_worker().address, f"{type(error).__name__}: {error}")
        result = _attempt(_functions[token], loads(item))
        if isinstance(result, LtclError):
            raise result
        _pickled(
            result, "the result cannot be sent from a worker", buffer_callback=lambda buffer: False
        )
        return result, None


def _leave(token: str) -> None:
    _functions.pop(token, None)
