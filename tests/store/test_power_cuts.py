# SPDX-License-Identifier: BSD-3-Clause
"""After a power cut nothing that was committed is lost; `bench/power_cuts.py` tries 100 000 states.

Before the fix that each stands for, these lost files: new folders that are not flushed into their
parents, a store that is final before its folders are on the disk, an earlier folder that is removed
before the new one is.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from ltcl import files
from tests.store import power_cut_works as works
from tests.store.power_cuts import Recorder, Survey, survey


def survey_of(work: works.Work, states: int = 400, resumed: int = 2) -> Survey:
    random = np.random.default_rng()
    return survey(work.operations, work.read, work.judge, states, random, work.resume, resumed)


def assert_safe(result: Survey) -> None:
    assert (result.lost, result.wrong) == (0, 0), result.examples[0]


@pytest.mark.parametrize("replaces", [False, True])
@pytest.mark.parametrize("extension", [".npz", ".npy", ".mtx", ".h5", ".mat", ".zarr"])
def test_save(extension: str, replaces: bool) -> None:
    place = f"T{extension}" if replaces else f"new/er/T{extension}"
    assert_safe(survey_of(works.saving(place, replaces=replaces)))


@pytest.mark.slow
def test_save_where_folders_cannot_be_exchanged() -> None:
    with mock.patch("ltcl.files.exchange", return_value=False):
        work = works.saving("T.zarr", replaces=True)
    assert_safe(survey_of(work))


@pytest.mark.parametrize("appearance", [False, True])
def test_compensate_frames(appearance: bool) -> None:
    assert_safe(survey_of(works.patterns(appearance=appearance)))


@pytest.mark.rare
@pytest.mark.parametrize("strategy", ["pixel", "adaptive"])
def test_acquire(strategy: str) -> None:
    assert_safe(survey_of(works.acquisition(strategy)))


def write_in_place(path: Path) -> None:
    """No temporary file."""
    path.write_bytes(b"new")
    handle = os.open(path, os.O_RDONLY)
    os.fsync(handle)
    os.close(handle)


def write_without_flush(path: Path) -> None:
    """A temporary file that takes its place before it is flushed."""
    temporary = path.with_suffix(".tmp")
    temporary.write_bytes(b"new")
    os.replace(temporary, path)


def write_well(path: Path) -> None:
    """As it is done here."""
    with files.replace_file(path) as temporary:
        temporary.write_bytes(b"new")


@pytest.mark.parametrize(
    ("write", "is_safe"),
    [(write_in_place, False), (write_without_flush, False), (write_well, True)],
)
def test_the_simulation_sees_what_writers_forget(
    tmp_path: Path, write: Callable[[Path], None], is_safe: bool
) -> None:
    (tmp_path / "a").write_bytes(b"old")
    recorder = Recorder(tmp_path)
    with recorder.recording():
        write(tmp_path / "a")
        recorder.commit("new")
    result = survey(
        recorder.operations,
        lambda folder: (folder / "a").read_bytes(),
        lambda data, committed: (
            "" if data == b"new" or (data, committed) == (b"old", set()) else "lost"
        ),
        200,
        np.random.default_rng(),
    )
    assert (result.lost == 0) == is_safe
