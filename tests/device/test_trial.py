# SPDX-License-Identifier: BSD-3-Clause
"""Drivers that abort or hang are found in a child process and hidden from this one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from ltcl.device import probe, trial

# What the loader would do, with a driver that does as its file says.
PROBE = """
import os, time
from pathlib import Path
place = Path(os.environ["OCL_ICD_VENDORS"])
for file in [place] if place.is_file() else place.glob("*.icd"):
    action = file.read_text()
    if action == "abort":
        os.abort()
    if action == "hang":
        time.sleep(60)
    if action == "refuse":
        raise RuntimeError("a Python error harms nobody")
"""


@pytest.fixture
def drivers(device, tmp_path, monkeypatch):
    """A folder of driver files, the one place that a loader would look at; ours has looked already."""
    folder = tmp_path / "vendors"
    folder.mkdir()
    script = tmp_path / "probe.py"
    script.write_text(PROBE)
    monkeypatch.setattr(trial, "_SCRIPT", script)
    monkeypatch.setattr(trial, "_home", lambda: tmp_path)  # pyopencl's bundled drivers: none
    monkeypatch.setenv("LTCL_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("OCL_ICD_VENDORS", str(folder))
    monkeypatch.setenv("PYOPENCL_HOME", os.environ.get("PYOPENCL_HOME", ""))  # restored after the test
    trial.hide_fatal_drivers.cache_clear()
    yield folder
    trial.hide_fatal_drivers.cache_clear()


def install(folder: Path, **actions: str) -> list[str]:
    folder.mkdir(exist_ok=True)
    for name, action in actions.items():
        (folder / f"{name}.icd").write_text(action)
    return [str(folder / f"{name}.icd") for name in actions]


def visible() -> set[str]:
    """Names of the drivers that the loader of this process would load now."""
    return {file.name for file in Path(os.environ["OCL_ICD_VENDORS"]).glob("*.icd")}


def test_good_drivers_are_all_kept(drivers):
    install(drivers, one="work", two="refuse")
    assert trial.hide_fatal_drivers() == []
    assert os.environ["OCL_ICD_VENDORS"] == str(drivers)


def test_a_driver_that_aborts_is_found_and_hidden(drivers):
    bad, _ = install(drivers, bad="abort", good="work")
    assert not trial.survives({})
    assert trial.find_fatal(trial.icd_files()) == [bad]
    assert trial.hide_fatal_drivers() == [bad]
    assert visible() == {"good.icd"}
    assert trial.survives({})


def test_a_driver_that_hangs_is_hidden(drivers, monkeypatch):
    install(drivers, bad="hang", good="work")
    monkeypatch.setattr(trial, "_SECONDS", 2)
    trial.hide_fatal_drivers()
    assert visible() == {"good.icd"}


def test_pyopencls_own_driver_can_be_the_bad_one(drivers, tmp_path, monkeypatch):
    install(drivers, good="work")
    (bad,) = install(tmp_path / ".libs", pocl="abort")
    monkeypatch.setattr(trial, "survives", lambda added: added.get("LTCL_PROBE_HOME") == "")
    assert trial.hide_fatal_drivers() == [bad]
    assert visible() == {"good.icd"}
    assert os.environ["PYOPENCL_HOME"] == ""


def test_the_verdict_is_remembered_until_a_driver_changes(drivers, monkeypatch):
    bad, _ = install(drivers, bad="abort", good="work")
    asked = []
    find = trial.find_fatal
    monkeypatch.setattr(trial, "find_fatal", lambda files: asked.append(files) or find(files))

    def verdict_of_a_new_process() -> list[str]:
        monkeypatch.setenv("OCL_ICD_VENDORS", str(drivers))
        trial.hide_fatal_drivers.cache_clear()
        return trial.hide_fatal_drivers()

    assert verdict_of_a_new_process() == verdict_of_a_new_process() == [bad]
    assert len(asked) == 1
    install(drivers, bad="work again")
    assert verdict_of_a_new_process() == []
    assert len(asked) == 2


def test_children_start_from_what_was_hidden(drivers):
    bad, _, worse = install(drivers, bad="abort", good="work", worse="work")
    trial.hide_fatal_drivers()
    assert visible() == {"good.icd", "worse.icd"}
    install(Path(os.environ["OCL_ICD_VENDORS"]), worse="abort")
    trial.hide_fatal_drivers.cache_clear()
    trial.hide_fatal_drivers()
    assert visible() == {"good.icd"}
    assert Path(bad).exists()  # the system's own files are left alone
    assert Path(worse).read_text() == "work"


def test_hiding_needs_no_writable_cache(drivers, monkeypatch, tmp_path):
    install(drivers, bad="abort", good="work")
    (tmp_path / "file").touch()
    monkeypatch.setenv("LTCL_CACHE", str(tmp_path / "file" / "cache"))
    trial.hide_fatal_drivers()
    assert visible() == {"good.icd"}


@pytest.mark.parametrize("content", [b"\0", b"x" * 5000, b"\xff\xfe", b""])
def test_odd_driver_files_are_no_trouble(drivers, content):
    (drivers / "odd.icd").write_bytes(content)
    assert trial.hide_fatal_drivers() == []


def test_pocl_gets_a_cache_where_home_cannot_be_written(drivers, monkeypatch, tmp_path):
    monkeypatch.setenv("POCL_CACHE_DIR", "restored after the test")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    trial.hide_fatal_drivers()
    assert os.environ["POCL_CACHE_DIR"] == "restored after the test"
    monkeypatch.delenv("POCL_CACHE_DIR")
    trial.hide_fatal_drivers.cache_clear()
    trial.hide_fatal_drivers()
    assert "POCL_CACHE_DIR" not in os.environ
    (tmp_path / "home").touch()  # a file: nothing can be made in it
    trial.hide_fatal_drivers.cache_clear()
    trial.hide_fatal_drivers()
    assert Path(os.environ["POCL_CACHE_DIR"]).is_dir()


def test_the_real_probe_runs_to_its_end(device, caplog):
    caplog.set_level("INFO", logger=trial.__name__)
    assert trial.survives({})
    assert "ended early" not in caplog.text


def test_the_real_probe_passes_on_this_device(device):
    run = subprocess.run([sys.executable, "-P", probe.__file__], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    results = [json.loads(line) for line in run.stdout.splitlines()]
    assert all(result["passed"] for result in results)
    assert device.name in [result["device"].strip() for result in results]
