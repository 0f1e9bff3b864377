# SPDX-License-Identifier: BSD-3-Clause
"""The fastest of several variants is found by timing, remembered, and survives spoilt memory."""

from __future__ import annotations

import json

import pytest

from ltcl.device import cache, tuning
from ltcl.errors import DeviceError, MemoryLimitError


class Race:
    """Variants that take as long as told, on a clock of their own."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **seconds: float | Exception) -> None:
        self.now = 0.0
        self.launches: list[str] = []
        monkeypatch.setattr(tuning.time, "perf_counter", lambda: self.now)
        self.variants = {name: lambda name=name: self.run(name, seconds[name]) for name in seconds}

    def run(self, name: str, seconds: float | Exception) -> None:
        self.launches.append(name)
        if isinstance(seconds, Exception):
            raise seconds
        self.now += seconds


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("LTCL_CACHE", str(tmp_path))
    monkeypatch.delenv("LTCL_TUNE", raising=False)


def test_the_fastest_is_found_and_remembered(device, monkeypatch, tmp_path):
    race = Race(monkeypatch, slow=2.0, fast=1.0, slower=3.0)
    assert tuning.choose(device, "csr", "k=1", race.variants) == "fast"
    race.launches.clear()
    assert tuning.choose(device, "csr", "k=1", race.variants) == "fast"
    assert race.launches == []
    assert [file.name for file in tmp_path.iterdir()] == ["tuning.json"]


@pytest.mark.parametrize(
    ("file", "problem", "names"), [("dense", "k=1", "ab"), ("csr", "k=2", "ab"), ("csr", "k=1", "abc")]
)
def test_another_problem_is_measured_anew(device, monkeypatch, file, problem, names):
    race = Race(monkeypatch, a=1.0, b=2.0, c=3.0)
    tuning.choose(device, "csr", "k=1", {name: race.variants[name] for name in "ab"})
    race.launches.clear()
    tuning.choose(device, file, problem, {name: race.variants[name] for name in names})
    assert set(race.launches) == set(names)


@pytest.mark.parametrize("tune", ["0", None])
def test_nothing_is_timed_where_there_is_no_choice(device, monkeypatch, tune):
    race = Race(monkeypatch, slow=2.0, fast=1.0)
    if tune is None:
        race.variants.pop("fast")
    else:
        monkeypatch.setenv("LTCL_TUNE", tune)
    assert tuning.choose(device, "csr", "k=1", race.variants) == "slow"
    assert race.launches == []


@pytest.mark.parametrize("kind", [DeviceError, MemoryLimitError])
def test_a_variant_that_fails_is_left_out(device, monkeypatch, kind):
    race = Race(monkeypatch, broken=kind("no"), works=1.0)
    assert tuning.choose(device, "csr", "k=1", race.variants) == "works"


def test_variants_that_all_fail_are_an_error(device, monkeypatch):
    race = Race(monkeypatch, a=DeviceError("no"), b=DeviceError("no"))
    with pytest.raises(DeviceError, match=r"no variant of kernels/csr\.cl runs on"):
        tuning.choose(device, "csr", "k=1", race.variants)


@pytest.mark.parametrize("answer", ["gone", 7, None, ["fast"], {"fast": 1}])
def test_a_spoilt_memory_is_measured_over(device, monkeypatch, tmp_path, answer):
    race = Race(monkeypatch, slow=2.0, fast=1.0)
    tuning.choose(device, "csr", "k=1", race.variants)
    (key,) = json.loads((tmp_path / "tuning.json").read_text())
    cache.remember("tuning.json", key, answer)
    assert tuning.choose(device, "csr", "k=1", race.variants) == "fast"
    assert cache.recall("tuning.json", key) == "fast"
