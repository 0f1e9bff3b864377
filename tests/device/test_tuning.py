# SPDX-License-Identifier: BSD-3-Clause
"""What is timed once per device and remembered: the fastest variant, machine speeds."""

from __future__ import annotations

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
        self.launches: list[str] = []
        monkeypatch.setattr(tuning.time, "perf_counter", lambda: self.now)
        self.variants = {name: lambda name=name: self.run(name, seconds[name]) for name in seconds}

    def run(self, name: str, seconds: float | Exception) -> None:
        self.launches.append(name)
        if isinstance(seconds, Exception):
            raise seconds
        self.now += seconds


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """The cache folder, which is not there yet."""
    monkeypatch.setenv("LTCL_CACHE", str(tmp_path / "a" / "cache"))
    monkeypatch.delenv("LTCL_TUNE", raising=False)
    return tmp_path / "a" / "cache"


@pytest.fixture
def hardware(device, monkeypatch):
    """The device as one whose speed means something."""
    monkeypatch.setattr(device, "kind", "cpu" if device.is_cpu else device.kind)
    return device


def test_the_fastest_is_chosen_and_remembered(device, monkeypatch):
    race = Race(monkeypatch, slow=2.0, fast=1.0, slower=3.0)
    assert tuning.choose(device, "csr", "k=1", race.variants) == "fast"
    race.launches.clear()
    assert tuning.choose(device, "csr", "k=1", race.variants) == "fast"
    assert race.launches == []


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
    race = Race(monkeypatch, a=kind("no"), b=kind("no"))
    with pytest.raises(DeviceError, match=r"kernels/csr\.cl"):
        tuning.choose(device, "csr", "k=2", race.variants)


def test_seconds_are_measured_once_for_a_key(hardware, monkeypatch):
    race = Race(monkeypatch, one=0.5, other=0.25, broken=DeviceError("no"))
    assert [tuning.seconds(hardware, "a", race.variants["one"]) for _ in range(3)] == [0.5] * 3
    assert tuning.seconds(hardware, "a", race.variants["other"]) == 0.5  # not asked
    assert tuning.seconds(hardware, "b", race.variants["other"]) == 0.25
    assert len(race.launches) < 20
    with pytest.raises(DeviceError, match=r"\bc\b"):
        tuning.seconds(hardware, "c", race.variants["broken"])


@pytest.mark.parametrize("answer", ["gone", 7, None, ["fast"], {}, 0.0, -1.0, float("nan"), float("inf")])
def test_a_damaged_memory_is_measured_over(hardware, monkeypatch, folder, answer):
    race = Race(monkeypatch, slow=2.0, fast=1.0)
    for measure, wanted in (
        (lambda: tuning.choose(hardware, "csr", "k=1", race.variants), "fast"),
        (lambda: tuning.seconds(hardware, "a", race.variants["fast"]), 1.0),
    ):
        measure()
        (key,) = json.loads((folder / "tuning.json").read_text())
        tuning.remember(key, answer)
        assert measure() == wanted == tuning.recall(key)
        (folder / "tuning.json").unlink()


@pytest.mark.parametrize("speed", [tuning.bandwidth, lambda _: tuning.factorization_flops()])
def test_speeds_of_the_machine_are_remembered(device, speed):
    measured = speed(device)
    assert 1e6 < measured < 1e16
    assert speed(device) == measured


def test_without_tuning_speeds_are_constants(device, monkeypatch, folder):
    monkeypatch.setenv("LTCL_TUNE", "0")
    assert tuning.seconds(device, "a", pytest.fail) == tuning.SECONDS
    assert tuning.seconds(device, "a", pytest.fail, default=3.0) == 3.0
    assert tuning.bandwidth(device) == pytest.approx(tuning.BANDWIDTH[device.is_cpu])
    assert tuning.factorization_flops() == pytest.approx(tuning.FLOPS)
    assert not folder.exists()


def test_what_was_remembered_is_recalled_and_nothing_else_is_written(folder):
    assert tuning.recall("key") is None
    for key, value in (("key", ["a", 1]), ("other", None), ("key", ["b"])):
        tuning.remember(key, value)
    assert tuning.recall("key") == ["b"]
    assert json.loads((folder / "tuning.json").read_text()) == {"key": ["b"], "other": None}
    assert [file.name for file in folder.iterdir()] == ["tuning.json"]


@pytest.mark.skipif(os.name != "posix", reason="modes are POSIX's")
def test_a_new_folder_is_private_and_an_old_one_keeps_its_mode(folder):
    tuning.remember("key", 1)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert stat.S_IMODE((folder / "tuning.json").stat().st_mode) == 0o600
    folder.chmod(0o755)
    tuning.remember("key", 2)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o755


@pytest.mark.parametrize("content", [b"", b"{", b"[1]", b'"key"', b"\xff\xfe\0", b"null"])
def test_a_spoilt_file_is_as_good_as_none(folder, content):
    tuning.remember("key", 1)
    (folder / "tuning.json").write_bytes(content)
    assert tuning.recall("key") is None
    tuning.remember("key", 2)
    assert tuning.recall("key") == 2


def test_an_unwritable_place_is_no_error(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("LTCL_CACHE", str(tmp_path / "file" / "cache"))
    tuning.remember("key", 1)
    assert tuning.recall("key") is None
    monkeypatch.delenv("LTCL_CACHE")
    assert "ltcl" in tuning.folder().parts[-1]
