# SPDX-License-Identifier: BSD-3-Clause
"""Many scenes, here and on a cluster: failures are named, and the rest goes on."""

from __future__ import annotations

import os
import pickle
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tblib.pickling_support import install

import ltcl
from ltcl import errors
from ltcl.errors import BatchError, ClusterError, FileError, InputTypeError

pytestmark = pytest.mark.slow


@pytest.fixture(params=[False, True], ids=["here", "on a cluster"])
def where(request) -> Any:
    return request.getfixturevalue("client") if request.param else None


@pytest.mark.slow
def test_one_task_each_and_those_that_fail_are_named(where, tmp_path):
    ltcl.save(tmp_path / "T.npz", ltcl.Transport(np.eye(6), grid=(2, 3)))
    paths = [tmp_path / f"{name}.npz" for name in ("T", "none", "T", "nor")]
    calls = []

    def light(path: Path) -> float:
        return float(ltcl.load(path).first_bounce.sum())

    with pytest.raises(BatchError, match=r"2 of 4 .*none\.npz: .*nor\.npz: ") as error:
        ltcl.batch.map(light, paths, client=where, progress=lambda *now: calls.append(now))
    assert calls == [("scenes", number, 4) for number in (1, 2, 3, 4)]
    assert error.value.results[::2] == [6.0, 6.0]
    assert all(isinstance(each, FileError) for each in error.value.results[1::2])


@pytest.mark.parametrize("kind", [errors.LtclError, *errors.LtclError.__subclasses__(), FileError])
def test_every_error_comes_back_from_a_worker(kind):
    """Dask that was imported after ltcl pickles errors by tblib, which may leave out `__init__`."""
    install(kind)
    error = kind("a file")
    copy = pickle.loads(pickle.dumps(error))  # noqa: S301 - ours
    assert (type(copy), str(copy), vars(copy)) == (kind, "a file", vars(kind("a file")))


@pytest.mark.rare
def test_a_scene_that_ends_its_workers_is_named_and_the_rest_goes_on(client):
    def end(scene: str) -> str:
        if scene in ("b", "c"):
            os._exit(1)
        return scene

    with pytest.raises(BatchError, match=r"^2 of 5 .*b: .*c: ") as error:
        ltcl.batch.map(end, "abcde", client=client)
    results = error.value.results
    assert [*results[:1], *results[3:]] == ["a", "d", "e"]
    assert [type(each) for each in results[1:3]] == [ClusterError] * 2


def test_what_an_error_holds_stays_with_the_worker(client):
    def fail(scene: str) -> None:
        # A lock cannot be pickled.
        raise errors.ConvergenceError(f"{scene} is none", threading.Lock())

    with pytest.raises(BatchError, match=r"1 of 1 .*: a: a is none"):
        ltcl.batch.map(fail, "a", client=client)


@pytest.mark.slow
def test_a_result_that_cannot_be_sent_is_the_error_of_its_scene(client):
    def lazily(scene: str) -> Any:
        return (letter for letter in scene) if scene == "b" else scene

    with pytest.raises(BatchError, match=r"1 of 3 .*b: .*generator") as error:
        ltcl.batch.map(lazily, "abc", client=client)
    assert error.value.results[::2] == ["a", "c"]
    assert isinstance(error.value.results[1], InputTypeError)


@pytest.mark.slow
def test_an_error_that_is_none_of_ltcl_ends_all(where):
    with pytest.raises(ZeroDivisionError):
        ltcl.batch.map(lambda scene: 1 / scene, [1, 0, 1], client=where)
