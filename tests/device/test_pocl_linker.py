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


def answer_of(command: list[str], variables: dict[str, str]) -> tuple[int, str, str]:
    """Exit code, output and errors."""
    run = subprocess.run(command, env=variables, capture_output=True, text=True, check=False)
    return run.returncode, run.stdout, run.stderr


@pytest.mark.parametrize("tools", [[], ["ld"]])
def test_kernels_are_linked_where_gcc_is_missing(tmp_path, tools):
    """Also in a child that gets no more than PATH."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for tool in tools:
        if there := shutil.which(tool):
            (folder / tool).symlink_to(there)
    path = str(folder)
    for cache in ("parent", "child"):
        places = {
            "PATH": path,
            "POCL_CACHE_DIR": str(tmp_path / cache),
            "LTCL_CACHE": str(tmp_path / cache),
        }
        code, output, errors = answer_of([sys.executable, "-c", PRODUCT], os.environ | places)
        product, _, path = output.strip().partition("\n")
        assert (code, product) == (0, "[0.0, 1.0, 2.0, 3.0]"), errors


@pytest.mark.skipif(os.name == "nt", reason="PoCL's wheel is for Linux")
def test_what_others_link_is_left_to_another_linker(tmp_path):
    own, other = Path(linker.__file__).with_name("ld"), tmp_path / "ld"
    other.write_text('#!/bin/sh\necho "$@"\n', encoding="utf-8")
    other.chmod(0o755)
    command, variables = [str(own), "-shared", "-o", "a.so", "a.o"], {"LTCL_PYTHON": sys.executable}
    both = {"PATH": f"{own.parent}{os.pathsep}{tmp_path}"}
    assert answer_of(command, variables | both) == (0, "-shared -o a.so a.o\n", "")
    code, _, errors = answer_of(command, variables | {"PATH": str(own.parent)})
    assert (code, errors[:12]) == (127, "ld: this one")
