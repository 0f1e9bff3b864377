# SPDX-License-Identifier: BSD-3-Clause
"""Tuning: the fastest variant and machine speeds are measured once per device."""

from __future__ import annotations

import functools
import json
import os
import stat

import pytest

from ltcl.device import tuning
from ltcl.errors import DeviceError, MemoryLimitError


class Race:
    """Variants that take as long as they are set to, on a clock of their own."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **seconds: float | Exception) -> None:
        self.now = 0.0
        self.launches = []
        self.variants = {}
        monkeypatch.setattr(tuning.time, "perf_counter", lambda: self.now)
        for name, time in seconds.items():
            self.variants[name] = functools.partial(self.run, name, time)

    def run(self, name: str, seconds: float | Exception) -> None:
        self.launches.append(name)
        if isinstance(seconds, Exception):
            raise seconds
        self.now += seconds


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Cache folder, which does not exist yet."""
    monkeypatch.setenv("LTCL_CACHE", str(tmp_path / "a" / "cache"))
    monkeypatch.delenv("LTCL_TUNE", raising=False)
    return tmp_path / "a" / "cache"


def test_the_fastest_is_chosen_and_remembered_for_this_problem(device, monkeypatch):
    race = Race(monkeypatch, a=2.0, b=1.0, c=3.0)
    pair = {name: race.variants[name] for name in "ab"}
    for _ in range(2):
        assert tuning.choose(device, "csr", "k=1", pair) == "b"
    assert len(race.launches) < 20
    cases = [("dense", "k=1", pair), ("csr", "k=2", pair), ("csr", "k=1", race.variants)]
    for file, problem, variants in cases:
        race.launches.clear()
        tuning.choose(device, file, problem, variants)
        assert set(race.launches) == set(variants)


def test_variants_that_fail_are_left_out(device, monkeypatch):
    race = Race(monkeypatch, a=DeviceError("no"), b=1.0, c=MemoryLimitError("no"))
    assert tuning.choose(device, "csr", "k=1", race.variants) == "b"
    with pytest.raises(DeviceError, match=r"kernels/csr\.cl"):
        tuning.choose(device, "csr", "k=2", {name: race.variants[name] for name in "ac"})


def test_seconds_are_measured_once_for_a_key(device, monkeypatch):
    race = Race(monkeypatch, one=0.5, other=0.25)
    for _ in range(3):
        assert tuning.seconds(device, "a", race.variants["one"]) == 0.5
    assert tuning.seconds(device, "b", race.variants["other"]) == 0.25
    assert len(race.launches) < 20


@pytest.mark.parametrize("speed", [tuning.bandwidth, lambda _: tuning.factorization_flops()])
def test_speeds_of_the_machine_are_remembered(device, speed):
    measured = speed(device)
    assert 1e6 < measured < 1e16
    assert speed(device) == measured


def test_a_launch_and_a_wait_are_timed(device):
    overheads = tuning.overheads(device)
    assert 0.0 < overheads.launch < 1.0
    assert 0.0 < overheads.wait < 1.0
    assert tuning.overheads(device) == overheads


def test_without_tuning_the_first_variant_and_constants_are_taken(device, monkeypatch, folder):
    monkeypatch.setenv("LTCL_TUNE", "0")
    assert tuning.choose(device, "csr", "k=1", {"a": pytest.fail, "b": pytest.fail}) == "a"
    assert tuning.seconds(device, "a", pytest.fail) == tuning.SECONDS
    assert tuning.bandwidth(device) == tuning.BANDWIDTH[device.is_cpu]
    assert tuning.factorization_flops() == tuning.FLOPS
    assert tuning.overheads(device) == (tuning.LAUNCH_SECONDS, tuning.SECONDS)
    assert not folder.exists()


@pytest.mark.parametrize(
    "answer", ["gone", 7, None, ["b"], {}, 0.0, -1.0, float("nan"), float("inf")]
)
def test_a_damaged_answer_is_measured_over(device, monkeypatch, folder, answer):
    race = Race(monkeypatch, a=2.0, b=1.0)
    tuning.choose(device, "csr", "k=1", race.variants)
    tuning.seconds(device, "a", race.variants["b"])
    for key in json.loads((folder / "tuning.json").read_text()):
        tuning.remember(key, answer)
    assert tuning.choose(device, "csr", "k=1", race.variants) == "b"
    assert tuning.seconds(device, "a", race.variants["b"]) == 1.0


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b'"key"', b"\xff\xfe\0", b"null"])
def test_a_spoilt_file_is_as_good_as_none(folder, content):
    tuning.remember("key", 1)
    (folder / "tuning.json").write_bytes(content)
    assert tuning.recall("key") is None
    for key, value in (("key", 2), ("other", None)):
        tuning.remember(key, value)
    assert json.loads((folder / "tuning.json").read_text()) == {"key": 2, "other": None}
    assert [file.name for file in folder.iterdir()] == ["tuning.json"]


@pytest.mark.skipif(os.name != "posix", reason="modes are POSIX's")
def test_a_new_folder_is_private_and_an_old_one_keeps_its_mode(folder):
    tuning.remember("key", 1)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    folder.chmod(0o755)
    tuning.remember("key", 2)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o755


def test_an_unwritable_place_is_no_error(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("LTCL_CACHE", str(tmp_path / "file" / "cache"))
    tuning.remember("key", 1)
    assert tuning.recall("key") is None
