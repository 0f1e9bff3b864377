# SPDX-License-Identifier: BSD-3-Clause
"""The linker that PoCL's wheel gets where gcc is missing."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ltcl.device import pocl_linker as linker

PRODUCT = """
import os, numpy as np, ltcl
from ltcl.operators import Dense
print((Dense(ltcl.open_device(), np.eye(4)) @ np.arange(4.0)).tolist())
print(os.environ["PATH"])
"""


def run_command(command: list[str], variables: dict[str, str]) -> tuple[int, str, str]:
    """Exit code, output and errors."""
    run = subprocess.run(command, env=variables, capture_output=True, text=True, check=False)
    return run.returncode, run.stdout, run.stderr


@pytest.mark.rare
@pytest.mark.parametrize("tools", [[], ["ld"]])
def test_kernels_are_linked_where_gcc_is_missing(tmp_path, tools):
    """A child that gets no more than PATH links, too."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for tool in tools:
        program = shutil.which(tool)
        if program:
            (folder / tool).symlink_to(program)
    path = str(folder)
    for cache in ("parent", "child"):
        places = {
            "PATH": path,
            "POCL_CACHE_DIR": str(tmp_path / cache),
            "LTCL_CACHE": str(tmp_path / cache),
        }
        code, output, errors = run_command([sys.executable, "-c", PRODUCT], os.environ | places)
        product, _, path = output.strip().partition("\n")
        assert (code, product) == (0, "[0.0, 1.0, 2.0, 3.0]"), errors


@pytest.mark.skipif(os.name == "nt", reason="PoCL's wheel is for Linux")
def test_what_others_link_is_left_to_another_linker(tmp_path):
    script = Path(linker.__file__).with_name("ld")
    system_linker = tmp_path / "ld"
    system_linker.write_text('#!/bin/sh\necho "$@"\n', encoding="utf-8")
    system_linker.chmod(0o755)
    command = [str(script), "-shared", "-o", "a.so", "a.o"]
    variables = {"LTCL_PYTHON": sys.executable}

    both = {"PATH": f"{script.parent}{os.pathsep}{tmp_path}"}
    assert run_command(command, variables | both) == (0, "-shared -o a.so a.o\n", "")
    code, _, errors = run_command(command, variables | {"PATH": str(script.parent)})
    assert code == 127
    assert errors.startswith("ld: ")
