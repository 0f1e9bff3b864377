# SPDX-License-Identifier: BSD-3-Clause
"""A cluster of two processes on loopback."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import dask.config
import pytest

import ltcl

if TYPE_CHECKING:
    from distributed import Client

WORKERS: dict[str, Any] = {
    "n_workers": 2,
    "threads_per_worker": 1,
    "host": "127.0.0.1",
    "silence_logs": 50,
}
WORKERS |= {"scheduler_kwargs": {"dashboard": False, "dashboard_address": "127.0.0.1:0"}}


@pytest.fixture(scope="module")
def cluster(private_cache) -> Iterator[Client]:
    """A cluster of two workers, each with ltcl's default device and what tests remember."""
    from distributed import Client, LocalCluster  # imported here it mutes no handler of pytest

    # On a busy machine workers take long to answer.
    slowly = dask.config.set({"distributed.deploy.lost-worker-timeout": "120s"})
    environment = {"LTCL_CACHE": str(private_cache)}
    with slowly, LocalCluster(**WORKERS, env=environment) as cluster, Client(cluster) as client:
        yield client


@pytest.fixture
def client(cluster) -> Client:
    """Both workers, also where an earlier test killed them; an error if they do not come back."""
    cluster.cluster.scale(2)
    cluster.wait_for_workers(2, timeout=240)
    cluster.run(lambda: ltcl.open_device().name)
    return cluster
