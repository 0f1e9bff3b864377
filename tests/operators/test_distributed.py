# SPDX-License-Identifier: BSD-3-Clause
"""Rows on the ranks of `mpiexec`, two processes on this machine; what they run is in `mpi_ranks.py`."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MPIEXEC = shutil.which("mpiexec", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
CASES = "products", "bits_of_rows", "solves", "transports", "refusals"


def mpiexec(*command, timeout=60):
    """Two ranks with a thread each; the test fails where they do not end."""
    assert MPIEXEC is not None, "mpiexec is missing: pip install ltcl[mpi]"
    ranks = [MPIEXEC, "-n", "2", sys.executable, "-m", *map(str, command)]
    env = os.environ | {"PYTHONPATH": str(ROOT), "POCL_MAX_PTHREAD_COUNT": "1"}
    return subprocess.run(ranks, capture_output=True, text=True, cwd=ROOT, env=env, timeout=timeout)


@pytest.fixture(scope="module")
def ranks(tmp_path_factory):
    """Of one run for all cases: starting takes longer than what they do."""
    return mpiexec("mpi4py", "tests/operators/mpi_ranks.py", *CASES, tmp_path_factory.mktemp("ranks"))


@pytest.mark.parametrize("case", CASES)
def test_ranks(ranks, case):
    assert f"passed {case}" in ranks.stdout.splitlines(), ranks.stderr


@pytest.mark.parametrize("case", ["is_killed", "fails_alone"])
def test_a_rank_that_ends_alone_ends_the_other(tmp_path, case):
    run = mpiexec("mpi4py", "tests/operators/mpi_ranks.py", case, tmp_path)
    assert run.returncode != 0
    assert "passed" not in run.stdout
    assert ("only here" in run.stderr) == (case == "fails_alone")
