# SPDX-License-Identifier: BSD-3-Clause
"""Two ranks of `mpiexec` on this machine: what `mpi_ranks.py` has, and what docs/guide/mpi.md shows."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse

import ltcl
from ltcl.cli.main import main

ROOT = Path(__file__).resolve().parents[2]
CASES = "products", "bits_of_rows", "solves", "times_that_differ", "transports", "refusals"


def mpiexec(*command, cwd):
    """Two ranks of one thread each; the test fails where they do not end."""
    launcher = shutil.which(
        "mpiexec", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    )
    assert launcher is not None, "mpiexec is missing: pip install mpich"
    env = os.environ | {"PYTHONPATH": str(ROOT), "POCL_MAX_PTHREAD_COUNT": "1"}
    ranks = [launcher, "-n", "2", sys.executable, "-m", *map(str, command)]
    return subprocess.run(ranks, capture_output=True, text=True, cwd=cwd, env=env, timeout=200)


def run_cases(*names, folder):
    return mpiexec("mpi4py", ROOT / "tests/operators/mpi_ranks.py", *names, folder, cwd=folder)


def test_all_cases_in_one_run(tmp_path):
    """Starting takes longer than what they do."""
    run = run_cases(*CASES, folder=tmp_path)
    assert run.stdout.splitlines() == [f"passed {case}" for case in CASES], run.stderr


@pytest.mark.parametrize("case", ["is_killed", "fails_alone"])
def test_a_rank_that_ends_alone_ends_the_other(tmp_path, case):
    run = run_cases(case, folder=tmp_path)
    assert run.returncode != 0
    assert "passed" not in run.stdout
    assert ("only here" in run.stderr) == (case == "fails_alone")


def test_the_page_and_the_command_line(tmp_path, monkeypatch):
    page = (ROOT / "docs/guide/mpi.md").read_text(encoding="utf-8")
    (script,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    command = re.search(
        r"mpiexec -n 2 ltcl (compensate T.zarr picture.png --mpi --out patterns)", page
    )
    assert command is not None
    monkeypatch.chdir(tmp_path)
    T = ltcl.scenes.dihedral(12).transport()
    stored = ltcl.Transport(scipy.sparse.csr_array(T.to_numpy()), T.grid)
    for file in ("T.zarr", "T.npz"):
        ltcl.save(file, stored)
    ltcl.images.write("picture.png", np.full(T.grid, 0.1))
    Path("script.py").write_text(script, encoding="utf-8")
    run = mpiexec("mpi4py", "script.py", cwd=tmp_path)
    assert run.stdout.startswith("2 ranks, "), run.stderr
    words = command[1].split()
    run = mpiexec("ltcl", *words, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert run.stdout.count("look at patterns") == 1
    assert main([*words[:-1], "one", "--quiet"]) == 0  # on one rank, in this process
    assert {path.name for path in Path("one").iterdir()} == {
        path.name for path in Path("patterns").iterdir()
    }
    one, two = (ltcl.images.read(f"{folder}/picture_pattern.exr") for folder in ("one", "patterns"))
    assert np.linalg.norm(one - two) <= 1e-2 * np.linalg.norm(one)


def test_what_all_ranks_refuse_is_said_once(tmp_path):
    asked = "T.zarr a.png --cluster local", "--transports *.zarr a.png"
    code = "import sys; from ltcl.cli.main import main; end = '--mpi --out patterns'; "
    code += "sys.exit(min(main(f'compensate {words} {end}'.split()) for words in sys.argv[1:]))"
    (tmp_path / "start.py").write_text(code, encoding="utf-8")
    run = mpiexec("start", *asked, cwd=tmp_path)
    assert run.returncode == 1
    assert [line[:27] for line in run.stderr.splitlines()] == ["ltcl: error: --mpi is given"] * 2, (
        run.stderr
    )
    assert not (tmp_path / "patterns").exists()


def test_a_command_that_fails_on_one_rank_ends_all(tmp_path):
    np.save(tmp_path / "T.npy", np.eye(600))
    ltcl.images.write(tmp_path / "picture.png", np.full((20, 30), 0.1))
    code = "import sys; from mpi4py import MPI; from ltcl.cli.main import main; "
    code += "sys.argv[2] += 'absent' * MPI.COMM_WORLD.rank; sys.exit(main())"
    (tmp_path / "start.py").write_text(code, encoding="utf-8")
    words = "compensate", "T.npy", "picture.png", "--grid", "20x30", "--mpi", "--out", "patterns"
    run = mpiexec("mpi4py", "start.py", *words, cwd=tmp_path)
    assert run.returncode == 1
    assert run.stderr.startswith("ltcl: error: T.npyabsent"), run.stderr
    assert run.stderr.count("\n") == 1, run.stderr  # and nothing by MPI itself
