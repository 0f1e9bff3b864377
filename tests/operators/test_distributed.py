# SPDX-License-Identifier: BSD-3-Clause
"""Two ranks of `mpiexec` on this machine run the cases of `mpi_ranks.py`."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CASES = (
    "products",
    "bits_of_rows",
    "solves",
    "times_that_differ",
    "transports",
    "refusals",
    "the_page",
    "refused_commands",
)
# Cases that end both ranks, with a part of what they print.
ENDINGS = {
    "is_killed": "",
    "fails_alone": "only here",
    "command_fails_alone": "ltcl: error: T.npyabsent",
}


def run_cases(folder: Path, *names: str) -> subprocess.CompletedProcess[str]:
    """Run cases on two ranks of one thread each, in a folder."""
    places = [str(Path(sys.executable).parent), os.environ["PATH"]]
    launcher = shutil.which("mpiexec", path=os.pathsep.join(places))
    assert launcher is not None, "mpiexec is missing: pip install mpich"
    script = ROOT / "tests/operators/mpi_ranks.py"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "POCL_MAX_PTHREAD_COUNT": "1"}
    ranks = [launcher, "-n", "2", sys.executable, "-m", "mpi4py", str(script)]
    return subprocess.run(
        [*ranks, *names, str(folder)],
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
        env=environment,
        timeout=200,
    )


@pytest.mark.rare
def test_all_cases_in_one_run(tmp_path):
    """Starting takes longer than what they do."""
    run = run_cases(tmp_path, *CASES)
    assert run.stdout.splitlines() == [f"passed {case}" for case in CASES], run.stderr


@pytest.mark.rare
@pytest.mark.parametrize("case", ENDINGS)
def test_a_rank_that_ends_alone_ends_the_other(tmp_path, case):
    run = run_cases(tmp_path, case)
    assert run.returncode != 0
    assert "passed" not in run.stdout
    assert ENDINGS[case] in run.stderr
    if case == "command_fails_alone":
        # MPI itself prints nothing.
        assert (run.returncode, run.stderr.count("\n")) == (1, 1)
