# SPDX-License-Identifier: BSD-3-Clause
"""Work on a cluster of two processes: in order, whatever is killed, and with the bytes of a serial run."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from typing import Any

import dask.config
import pytest
from distributed import Client, LocalCluster

import ltcl
from ltcl.cluster import stream
from ltcl.errors import ClusterError, InputError, InputTypeError

WORKERS: dict[str, Any] = {"n_workers": 2, "threads_per_worker": 1, "host": "127.0.0.1", "silence_logs": 50}
WORKERS |= {"scheduler_kwargs": {"dashboard": False, "dashboard_address": "127.0.0.1:0"}}


@pytest.fixture(scope="module")
def client(private_cache) -> Iterator[Client]:
    """Of two workers, each with the device that ltcl opens by default, and what tests remember."""
    slowly = dask.config.set({"distributed.deploy.lost-worker-timeout": "120s"})  # on a busy machine
    environment = {"LTCL_CACHE": str(private_cache)}
    with slowly, LocalCluster(**WORKERS, env=environment) as cluster, Client(cluster) as client:
        yield client


def pids(client: Client, *workers: str) -> list[int]:
    """Processes of these workers, or of all."""
    answers: Any = client.run(os.getpid, workers=[*workers] or None)
    return [*answers.values()]


def kill(client: Client) -> None:
    """End a worker as the kernel does when memory is short."""
    os.kill(pids(client)[0], signal.SIGKILL)


def test_results_come_in_order_and_items_are_taken_as_results_are(client):
    taken = []

    def items() -> Iterator[int]:
        for number in range(40):
            taken.append(number)
            yield number

    def slow(number: int) -> int:
        time.sleep(0.05 if number % 5 == 0 else 0.0)
        return number * number

    for done, result in enumerate(stream(client, slow, items(), window=3)):
        assert result == done * done
        assert len(taken) <= done + 1 + 2 * 3
    assert len(taken) == 40
    for _ in range(50):  # nothing stays on the scheduler
        time.sleep(0.1 if client.futures else 0.0)
    assert not client.futures


def test_an_error_is_raised_at_the_place_of_its_item(client):
    def fails(number: int) -> int:
        if number == 7:
            raise InputError("number is 7")
        return number

    results = stream(client, fails, range(20))
    assert [next(results) for _ in range(7)] == [*range(7)]
    with pytest.raises(InputError, match="number is 7"):
        next(results)


def test_what_was_killed_is_done_by_others_and_joins_again(client):
    def slow(number: int) -> tuple[int, int]:
        time.sleep(0.05)
        return number, os.getpid()

    results = []
    for result in stream(client, slow, range(100)):
        results.append(result)
        if len(results) in (5, 10, 15):
            kill(client)
    assert [number for number, _ in results] == [*range(100)]
    assert len({pid for _, pid in results}) >= 3  # of two


@pytest.mark.parametrize(("select", "text"), [("abacus", "device is 'abacus'"), ("", "no OpenCL device")])
def test_a_worker_without_device_is_named_and_takes_no_work(client, caplog, select, text):
    first, second = client.nthreads()

    def hide() -> None:
        import pyopencl

        if select:
            os.environ["LTCL_DEVICE"] = select
        else:
            module: Any = pyopencl
            module.platforms, module.get_platforms = module.get_platforms, list

    def show() -> None:
        import pyopencl

        os.environ.pop("LTCL_DEVICE", None)
        module: Any = pyopencl
        module.get_platforms = getattr(module, "platforms", module.get_platforms)

    client.run(hide, workers=[first])
    try:
        used = {*stream(client, lambda _: os.getpid(), range(20))}
    finally:
        client.run(show, workers=[first])
    assert used == {*pids(client, second)}
    lines = [record.getMessage() for record in caplog.records if first in record.getMessage()]
    assert len(lines) == 1
    assert text in lines[0]


def test_another_version_takes_no_work_and_without_workers_nothing_is_done(client, caplog):
    def rename(version: str) -> None:
        ltcl.__version__ = version

    client.run(rename, "0.0.9")
    try:
        with pytest.raises(ClusterError, match=r"no worker is left at tcp.* 2 "):
            list(stream(client, abs, range(3)))
    finally:
        client.run(rename, ltcl.__version__)
    assert f"has ltcl 0.0.9, and the client {ltcl.__version__}" in caplog.text
    assert list(stream(client, abs, range(3))) == [0, 1, 2]


def test_what_is_no_client_or_cannot_be_sent_is_refused(client):
    wrong: Any = 3
    with pytest.raises(InputTypeError, match="client is a int"):
        list(stream(wrong, abs, [1]))
    lock = threading.Lock()
    with pytest.raises(InputTypeError, match=r"sent.*lock"):
        list(stream(client, lambda _: lock, [1]))
