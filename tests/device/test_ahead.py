# SPDX-License-Identifier: BSD-3-Clause
"""Programs that a thread builds beside an upload."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from ltcl.device import Device, ahead, sources
from ltcl.errors import DeviceError
from ltcl.operators import Dense


@pytest.fixture
def fresh(device):
    """A device on which nothing is built yet."""
    return Device(device.description)


def wait_for_builds() -> None:
    for thread in threading.enumerate():
        if thread.name == ahead.THREAD:
            thread.join()


def test_solves_find_their_programs(fresh, monkeypatch):
    if "Portable Computing Language" not in fresh.driver:
        pytest.skip("other drivers build as programs are asked for")
    Dense(fresh, np.eye(520))
    wait_for_builds()
    files = {file for file, *_ in fresh.session.programs}
    assert files == {"dense", "krylov", "vector"}
    monkeypatch.setattr(sources, "build", lambda *_: pytest.fail("built again"))
    fresh.kernel("vector", "vector_fill")


def test_small_matrices_build_nothing(fresh):
    Dense(fresh, np.eye(8))
    wait_for_builds()
    assert not fresh.session.programs


def test_failed_builds_are_told_by_users(fresh, monkeypatch):
    def fail(*_):
        raise DeviceError("kernels/dense.cl does not compile")

    monkeypatch.setattr(sources, "build", fail)
    ahead.begin(fresh, "dense", {"K": 1})
    wait_for_builds()
    with pytest.raises(DeviceError, match="does not compile"):
        fresh.kernel("dense", "dense_matvec", K=1)


def test_users_wait_for_the_thread(fresh, monkeypatch):
    begun = threading.Event()
    may_end = threading.Event()
    calls = []

    def build(_, file, __):
        calls.append(file)
        begun.set()
        may_end.wait(10)
        return file

    monkeypatch.setattr(sources, "build", build)
    thread = threading.Thread(target=fresh.program, args=("vector", {}))
    thread.start()
    begun.wait(10)
    threading.Timer(0.05, may_end.set).start()
    assert fresh.program("vector", {})[0] == "vector"
    thread.join()
    assert calls == ["vector"]
