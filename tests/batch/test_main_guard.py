# SPDX-License-Identifier: BSD-3-Clause
"""Scripts that start local workers: with the main guard they may, without it one error names it."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from ltcl.errors import ClusterError, InputError

# No worker is started: none at all is asked for, which is refused after the guard is checked.
START = """
from concurrent.futures import ThreadPoolExecutor
from ltcl.cluster import connect

def start():
    with connect("local", workers=0):
        pass
"""
UNGUARDED = {
    "at the top": "with connect('local', workers=0): pass",
    "in a function": "start()",
    "in a condition": "if start.__name__:\n    start()",
    "in a thread": "ThreadPoolExecutor().submit(start).result()",
    "in a module that is imported": "import module_that_starts_workers",
}
GUARDED = {
    "guard": "if __name__ == '__main__':\n    start()",
    "guard turned round": "if '__main__' == __name__ and start:\n    start()",
    "guard in a block": "try:\n    if __name__ == '__main__':\n        start()\nfinally:\n    pass",
    "thread": "if __name__ == '__main__':\n    ThreadPoolExecutor().submit(start).result()",
}


def run(folder: Path, text: str) -> None:
    script = folder / "film.py"
    script.write_text(START + text)
    runpy.run_path(str(script), run_name="__main__")


@pytest.mark.parametrize("text", UNGUARDED.values(), ids=UNGUARDED)
def test_without_the_guard_no_worker_is_started(tmp_path, monkeypatch, text):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "module_that_starts_workers", raising=False)
    (tmp_path / "module_that_starts_workers.py").write_text(f"{START}\nstart()")
    line = START.count("\n") + text.count("\n") + 1
    with pytest.raises(ClusterError, match=f"film.py, line {line}.*__main__") as error:
        run(tmp_path, text)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_workers_that_do_not_start_are_one_error(tmp_path):
    """The file ends each worker as that imports it."""
    script = tmp_path / "film.py"
    text = "import os\nif __name__ != '__main__':\n    os._exit(3)\n"
    text += "from ltcl.cluster import connect\n"
    text += "if __name__ == '__main__':\n    with connect('local', workers=1):\n        pass\n"
    script.write_text(text)
    words = [sys.executable, str(script)]
    run = subprocess.run(words, capture_output=True, text=True, check=False)
    last = run.stderr.splitlines()[-1]
    assert last.startswith("ltcl.errors.ClusterError: cluster is 'local'")


@pytest.mark.parametrize("text", GUARDED.values(), ids=GUARDED)
def test_with_the_guard_workers_may_start(tmp_path, text):
    with pytest.raises(InputError, match="workers is 0"):
        run(tmp_path, text)
